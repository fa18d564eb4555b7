"""Plug-ins: registration, values of their functions, and errors."""

from __future__ import annotations

import hashlib
import pickle
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from scripted_world import ScriptedWorld

from surefoot.errors import SurefootError
from surefoot.learn.symmetry import mirror_columns
from surefoot.policy.contract import Contract, PluginRecord
from surefoot.task.config import TaskConfig
from surefoot.task.contract_mapping import make_contract, task_from_contract
from surefoot.task.env import LocomotionEnv
from surefoot.task.leg_config import WaveConfig
from surefoot.task.observation import PARTS, Observer
from surefoot.task.plugins import (
    changed_plugins,
    load_plugins,
    register_plugin,
    registered_plugins,
    remove_plugins,
    used_plugins,
)
from surefoot.task.policy_plugins import plugin_notes
from surefoot.task.reference_config import SineReferenceConfig
from surefoot.task.reward import TERMS
from surefoot.world.sim_world import SimWorld

HEAD = """
import numpy as np
from surefoot.task.plugins import observation, reward_term
"""
TERM = """
@reward_term("constant", unit="1")
def constant(motion):
    return {}
"""
OBSERVATION = """
@observation("twice", unit="rad", frame="motor", columns={})
def twice(inputs):
    return {}
"""
TASK = TaskConfig(reference=SineReferenceConfig(extension=WaveConfig(offset=2.0)))
CONSTANT, TWICE = (
    TERM.format("np.full(2, 3.0)"),
    OBSERVATION.format("('twice',)", "2 * inputs.readings.motor_angle[:, :1]"),
)


@pytest.fixture(autouse=True)
def _no_plugin_is_left() -> Iterator[None]:
    before = [*TERMS], [*PARTS]
    yield
    remove_plugins()
    assert ([*TERMS], [*PARTS]) == before


@pytest.fixture
def write(tmp_path: Path):
    """Return a function that writes a plug-in, loads it and returns its path."""

    def write(*parts: str, name: str = "mine.py") -> Path:
        path = tmp_path / name
        path.write_text(HEAD + "".join(parts))
        load_plugins([path])
        return path

    return write


def make_env() -> LocomotionEnv:
    task = replace(TASK, observations=("roll", "twice"), reward={"constant": 2.0, "energy": 0.0})
    return LocomotionEnv(task, 2, ScriptedWorld)


def test_terms_and_observations_work_as_built_in_ones(write) -> None:
    write(CONSTANT, TWICE)
    env = make_env()
    observation, _ = env.reset()
    np.testing.assert_allclose(observation[:, 1], 2 * env.state.readings.motor_angle[:, 0], rtol=1e-6)
    _, reward, *_ = env.step(np.zeros((2, 8)))
    np.testing.assert_allclose(reward, 2.0 * 3.0 * env.world.params.control_step)  # a rate
    assert env.observer.columns == ["roll", "twice"]


def test_a_term_that_needs_the_error_over_a_stride_gets_it(write) -> None:
    for needs, is_computed in (("", False), ("stride_error", True)):
        write(TERM.replace('"1"', f'"1", needs="{needs}"').format("motion.stride_error[:, 0]"))
        env = LocomotionEnv(replace(TASK, reward={"constant": 1.0}), 2, SimWorld, threads=1)
        env.reset()
        _, reward, *_ = env.step(np.zeros((2, 8)))
        assert reward.astype(bool).tolist() == [is_computed] * 2
        remove_plugins()


def test_a_policy_records_its_plugins_and_needs_only_their_observations(write, robot) -> None:
    path = write(CONSTANT, TWICE)
    contract = Contract.from_json(make_contract(make_env()).to_json())
    (record,) = contract.plugins
    assert (record.name, record.rewards, record.observations) == ("mine.py", ("constant",), ("twice",))
    assert str(path.parent) not in contract.to_json()
    assert task_from_contract(contract, robot).reward == {"constant": 2.0, "energy": 0.0}
    assert plugin_notes(contract) == []

    write(TWICE)  # the reward term is gone
    assert task_from_contract(contract, robot).reward == {"energy": 0.0}
    changed, skipped = plugin_notes(contract)
    assert changed == f"plug-in {path} has changed since the policy was trained with it"
    assert skipped == "returns are without 'constant'; to include them, name the plug-in: --plugin 'mine.py'"

    remove_plugins()
    with pytest.raises(
        SurefootError, match=r"needs observation 'twice' of a plug-in; name the file: --plugin 'mine\.py'"
    ):
        task_from_contract(contract, robot)


def test_a_policy_without_plugins_records_none() -> None:
    contract = make_contract(LocomotionEnv(TASK, 1, ScriptedWorld))
    assert Contract.from_json(contract.to_json()).plugins == ()


def test_another_process_registers_the_same_plugin(write) -> None:
    write(CONSTANT)
    (sent,) = pickle.loads(pickle.dumps(registered_plugins()))
    remove_plugins()
    Path(sent.path).unlink()  # the file does not exist on another computer
    register_plugin(sent)
    assert TERMS["constant"].unit == "1"
    assert [plugin.rewards for plugin in registered_plugins()] == [["constant"]]


def test_columns_of_motors_and_of_sides_are_mirrored(write, robot) -> None:
    columns = "lambda robot: ['force.' + leg for leg in robot.leg_names] + ['lean']"
    text = OBSERVATION.format(columns, "0").replace('frame="motor"', 'frame="motor", flipped=["lean"]')
    write(text)
    source, sign = mirror_columns(Observer(robot, ("twice",)).columns, extra_flipped=PARTS["twice"].flipped)
    legs = robot.leg_names
    assert [legs[k] for k in source[:-1]] == [
        leg.replace("left", "*").replace("right", "left").replace("*", "right") for leg in legs
    ]
    assert sign.tolist() == [1.0] * len(legs) + [-1.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("def broken(:", r"mine\.py, line 4: SyntaxError: "),
        ("import nothing_like_it", r"mine\.py, line 4: ModuleNotFoundError: No module named 'nothing_like_it'"),
        ("x = 1", r"mine\.py: registers no reward term and no observation"),
        (TERM.replace("constant", "progress"), "reward term 'progress': surefoot has one of this name; choose another"),
        (CONSTANT + CONSTANT, r"line 9: reward term 'constant': \S+mine\.py has one of this name"),
        (TERM.replace('"constant"', '"a b"'), "name of the reward term is 'a b'; a name has letters"),
        (
            TERM.replace('"1"', '"1", needs="stride_eror"'),
            "'constant': needs 'stride_eror'; did you mean stride_error",
        ),
    ],
)
def test_an_invalid_plugin_is_rejected_and_registers_nothing(write, text: str, message: str) -> None:
    with pytest.raises(SurefootError, match=message):
        write(text)
    assert registered_plugins() == []


def test_an_empty_file_is_no_plugin(tmp_path: Path) -> None:
    (tmp_path / "mine.py").touch()
    with pytest.raises(SurefootError, match=r"mine\.py: registers no reward term and no observation"):
        load_plugins([tmp_path / "mine.py"])


def test_names_of_two_plugins_must_differ(write) -> None:
    write(CONSTANT)
    with pytest.raises(SurefootError, match=r"other\.py, line \d+: reward term 'constant': .*mine\.py has one"):
        write(CONSTANT, name="other.py")


@pytest.mark.parametrize(
    ("term", "observation", "message"),
    [
        ("np.zeros(3)", None, r"mine\.py: reward term 'constant' has shape \(3,\); it must have \(2,\)"),
        ("np.full(2, np.nan)", None, r"mine\.py: reward term 'constant' is not finite"),
        ("'much'", None, r"mine\.py: reward term 'constant' is 'much'; it must be an array"),
        ("motion.foot_force", None, r"mine\.py, line 7: reward term 'constant': AttributeError: "),
        (None, "np.zeros(2)", r"mine\.py: observation 'twice' has shape \(2,\); it must have \(2, 1\)"),
        (None, "np.full((2, 1), np.inf)", r"mine\.py: observation 'twice' is not finite"),
        (None, "inputs.truth", r"mine\.py, line 11: observation 'twice': AttributeError: "),
    ],
)
def test_a_function_that_fails_is_named_in_one_line(write, term, observation, message: str) -> None:
    write(
        TERM.format(term) if term else CONSTANT,
        OBSERVATION.format("('twice',)", observation) if observation else TWICE,
    )
    with pytest.raises(SurefootError, match=message) as caught:
        make_env().step(np.zeros((2, 8)))
    assert "\n" not in str(caught.value)


def test_an_installed_plugin_is_named_by_its_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gaits_of_mine.py").write_text(HEAD + CONSTANT)
    info = tmp_path / "gaits_of_mine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: gaits_of_mine\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[surefoot.plugins]\nmine = gaits_of_mine\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(SurefootError, match=r"plug-in 'mein' is neither .* nor an installed one; .*choices: mine"):
        load_plugins(["mein"])
    assert "constant" not in TERMS  # installed, but not named by the user
    load_plugins(["mine"])
    sha256 = hashlib.sha256((tmp_path / "gaits_of_mine.py").read_bytes()).hexdigest()
    assert used_plugins(["constant"], []) == (PluginRecord("mine", sha256, ("constant",), ()),)
    (tmp_path / "gaits_of_mine.py").write_text(HEAD + CONSTANT + "# a word\n")
    load_plugins(["mine"])
    assert changed_plugins([PluginRecord("mine", sha256, ("constant",), ())]) == [
        "plug-in mine has changed since the policy was trained with it"
    ]
    sys.modules.pop("gaits_of_mine")
