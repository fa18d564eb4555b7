"""Search spaces: reading, applying to a configuration, and rejected files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from surefoot.errors import SurefootError
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.studies.search_space import (
    Dimension,
    get_value,
    load_space,
    suggest_values,
    to_optuna_params,
    with_values,
)

SPACE = """
ppo.learning_rate: {low: 0.0001, high: 0.01, log: true}
ppo.policy_hidden.1: {low: 8, high: 64, int: true}
ppo.value_hidden: {choices: [[16, 16], [32, 32]]}
task.reference.swing.frequency: {low: 1.0, high: 3, also: [task.reference.extension.frequency]}
"""


def space_file(folder: Path, text: str = SPACE) -> Path:
    path = folder / "space.yaml"
    path.write_text(text)
    return path


def test_with_values_changes_only_the_fields_of_the_space(tmp_path: Path) -> None:
    trot = load_train_config("trot")
    space = load_space(space_file(tmp_path), trot)
    values = {
        "ppo.learning_rate": 0.002,
        "ppo.policy_hidden.1": 33,
        "ppo.value_hidden": [32, 32],
        "task.reference.swing.frequency": 2.5,
    }
    config = with_values(trot, space, values)
    assert config.ppo == replace(trot.ppo, learning_rate=0.002, policy_hidden=(125, 33), value_hidden=(32, 32))
    reference = trot.task.reference
    swing, extension = replace(reference.swing, frequency=2.5), replace(reference.extension, frequency=2.5)
    assert config.task == replace(trot.task, reference=replace(reference, swing=swing, extension=extension))
    assert replace(config, ppo=trot.ppo, task=trot.task) == trot
    assert {name: get_value(config, name) for name in space} == values
    assert to_optuna_params(space, config) == values | {"ppo.value_hidden": "[32, 32]"}
    # Outside of the space: a learning rate above the range, layers that are not a choice.
    assert set(to_optuna_params(space, trot)) == {"ppo.learning_rate", "task.reference.swing.frequency"}


def test_a_number_of_a_configuration_is_the_choice_of_the_same_value(tmp_path: Path) -> None:
    trot = load_train_config("trot")
    space = load_space(space_file(tmp_path, "ppo.entropy_coefficient: {choices: [0, 0.01]}"), trot)
    assert get_value(trot, "ppo.entropy_coefficient") == 0.0
    assert to_optuna_params(space, trot) == {"ppo.entropy_coefficient": "0"}


def test_released_spaces_fit_released_tasks() -> None:
    gallop, trot = load_train_config("gallop"), load_train_config("trot")
    without, with_reference = load_space(None, gallop), load_space(None, trot)
    searched = {"ppo.policy_hidden.0", "ppo.value_hidden", "ppo.learning_rate", "ppo.gamma", "ppo.clip", "num_envs"}
    assert searched | {"ppo.entropy_coefficient", "ppo.init_std", "task.reward.energy"} < set(without)
    assert set(with_reference) - set(without) == {
        "task.reference.swing.frequency",
        "task.reference.swing.amplitude",
        "task.reference.extension.amplitude",
    }
    # The paper's layers are within the space.
    assert {"ppo.policy_hidden.0": 185, "ppo.policy_hidden.1": 95}.items() <= to_optuna_params(without, gallop).items()


def test_a_logarithmic_range_of_negative_values_is_sampled_by_magnitude(tmp_path: Path) -> None:
    optuna = pytest.importorskip("optuna")
    gallop = load_train_config("gallop")
    space = load_space(space_file(tmp_path, "task.reward.energy: {low: -0.02, high: -0.002, log: true}"), gallop)
    trial = optuna.trial.FixedTrial({"task.reward.energy": 0.004})
    values = suggest_values(space, trial)
    assert values == {"task.reward.energy": -0.004}
    (distribution,) = trial.distributions.values()
    assert (distribution.low, distribution.high, distribution.log) == (0.002, 0.02, True)
    assert to_optuna_params(space, with_values(gallop, space, values)) == trial.params


def test_energy_costs_are_searched_if_the_reward_has_them() -> None:
    terms = {"gallop": {"task.reward.energy"}, "go2-trot": {"task.reward.transport_cost"}, "go2-steer": set()}
    for task, searched in terms.items():
        space = load_space(None, load_train_config(task))
        assert {name for name in space if name.startswith("task.reward.")} == searched


BAD = [
    ("ppo.leg: {low: 0, high: 1}", "ppo.leg is not a key; choices: policy_hidden"),
    ("pppo.gamma: {low: 0, high: 1}", "pppo is not a key; did you mean ppo\\? choices: task, name"),
    ("steps_per_update.first: {low: 1, high: 2}", "steps_per_update.first is not a field"),
    (
        "ppo.policy_hidden.2: {low: 8, high: 9, int: true}",
        "ppo.policy_hidden.2 is not a field .*; it has 2 elements, numbered from 0",
    ),
    ("ppo.gamma: {low: 0.99, high: 0.9}", "ppo.gamma: low is 0.99 and high is 0.9; low must be below high"),
    ("ppo.gamma: {low: 0.5, high: 1.5}", "ppo.gamma is 1.5; it must be 1 or less"),
    (
        "ppo.learning_rate: {low: 0, high: 1, log: true}",
        "ppo.learning_rate: low is 0 and high is 1; with log both must be on one side of 0",
    ),
    (
        "ppo.epochs: {low: 1.5, high: 3, int: true}",
        "ppo.epochs: low is 1.5 and high is 3; with int they must be integers",
    ),
    ("ppo.epochs: {low: 1, high: 3}", r"ppo.epochs is 1.0; it must be a whole number"),
    ("ppo.gamma: {low: 0.9}", "ppo.gamma: it needs low and high, or choices"),
    ("ppo.activation: {choices: [elu, sigh]}", "ppo.activation is 'sigh'; did you mean swish\\? choices: elu"),
    ("ppo.activation: {choices: [elu], low: 1}", "it has choices and parts of a range"),
    ("ppo.activation: {choices: [elu, elu]}", r"choices is \['elu', 'elu'\]; each choice must be different"),
    ("ppo.gamma: 0.9", "ppo.gamma: Dimension is 0.9; it must be a table with keys from: low, high"),
    ("ppo.gamma: {lowest: 0.9}", "ppo.gamma: lowest is not a key; did you mean low\\? choices: low"),
    ("ppo.gamma: {low: a, high: 1}", "ppo.gamma: low is 'a'; it must be a number or nothing"),
    ("seed: {low: 0, high: 9, int: true}", "seed is not searched: the search sets it itself"),
    ("ppo.gamma: {low: 0.9, high: 1, also: [ppo.gamma]}", "ppo.gamma is listed twice"),
    ("evaluation_reward.progress: {low: 0.5, high: 2}", "evaluation_reward.progress is not searched"),
    (
        "{ppo.policy_hidden.0: {low: 8, high: 9, int: true}, ppo.policy_hidden: {choices: [[8, 8]]}}",
        "ppo.policy_hidden and ppo.policy_hidden.0 set the same values",
    ),
    ("{}", "it is empty; a search needs 1 field or more"),
]


@pytest.mark.parametrize(("text", "message"), BAD, ids=[text for text, _ in BAD])
def test_load_space_rejects_an_invalid_space(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SurefootError, match=rf"^\S*space\.yaml: .*{message}") as refused:
        load_space(space_file(tmp_path, text), TrainConfig())
    assert "\n" not in str(refused.value)


def test_samples_are_the_ends_of_a_range_or_all_choices() -> None:
    assert Dimension(low=1, high=3, int=True).samples == (1, 3)
    assert all(isinstance(end, int) for end in Dimension(low=1.0, high=3.0, int=True).samples)
    assert Dimension(choices=([1, 2], "a")).samples == ([1, 2], "a")
