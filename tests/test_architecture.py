"""The rooms and the arrows between them: read from the imports, and tried without MuJoCo and torch."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "surefoot"

# What each room may import besides itself and the modules at the root of the package. An entry allows a room,
# or one module of a room ("world.interface"), and nothing beyond: arrows do not chain.
ARROWS: dict[str, set[str]] = {
    "robot": set(),
    "actuator": {"robot"},
    "world": {"actuator", "robot"},
    "task": {"robot", "policy", "world.interface", "world.ground"},
    "learn": {"task", "policy", "evaluate", "robot", "world.interface"},
    "policy": {"robot"},
    "evaluate": {"task", "policy", "world", "robot"},
    "identify": {"world", "deploy", "robot", "actuator", "task.trace"},
    "deploy": {
        *("robot", "policy", "world.interface"),
        *("task.contract_mapping", "task.commands", "task.observation", "task.gait"),
        *("task.trace", "task.partial_trace"),
    },
    "emulator": {"deploy", "world", "actuator", "robot"},
    "report": {"evaluate", "task", "robot", "world.ground", "identify.result", "identify.logs.errors"},
    "studies": {"report", "learn", "evaluate", "task", "policy", "world", "robot"},
}
WIRING = "cli"  # the one room that may import anything, and that only `python -m surefoot` imports

# What the robot's computer runs, and the import names of what it does not have: all outside the bare install.
ROBOT_SIDE = [
    "surefoot.policy.runtime",
    "surefoot.task.gait",
    "surefoot.task.observation",
    "surefoot.task.trace",
    "surefoot.robot",
    "surefoot.cli.helpers.policies",
    "surefoot.cli.doctor",
    "surefoot.cli.emulate",
    "surefoot.cli.deploy",
    "surefoot.cli.identify",
    "surefoot.identify.experiment_runner",
    "surefoot.identify.registry",
    "surefoot.identify.ground.plans",
]
NOT_ON_THE_ROBOT = {
    *("mujoco", "numba", "llvmlite", "gymnasium", "scipy", "pandas", "pybullet"),
    *("torch", "tensordict", "rsl_rl", "tensorboard", "onnx", "stable_baselines3"),
    *("matplotlib", "imageio_ffmpeg", "PIL", "viser", "websockets"),
}


def modules(package: Path) -> dict[str, Path]:
    """Return the file of every module under a package, by dotted name from the package on."""
    found = {}
    for file in sorted(package.rglob("*.py")):
        parts = [package.name, *file.relative_to(package).with_suffix("").parts]
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imports(source: str, module: str, is_package: bool, known: set[str]) -> Iterator[tuple[int, str]]:
    """Yield (line, dotted name) for each import of ours in a module, wherever in the file it stands."""
    for node in ast.walk(ast.parse(source)):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                up = node.level - is_package
                above = module.split(".")[: -up or None]
                base = ".".join([*above, base] if base else above)
            # `from a import b` imports module a.b where there is one, and otherwise something that a defines.
            whole = [f"{base}.{alias.name}" for alias in node.names]
            names = [name if name in known else base for name in whole]
        elif (
            isinstance(node, ast.Call)
            and ast.unparse(node.func) in {"__import__", "import_module", "importlib.import_module"}
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            names = [str(node.args[0].value)]
        for name in dict.fromkeys(names):
            if name.split(".")[0] == "surefoot":
                yield node.lineno, name


def room_of(module: str, known: set[str]) -> str | None:
    """Return the room a module belongs to, or None for the package itself and the modules at its root."""
    parts = module.split(".")
    if len(parts) == 1:
        return None
    planned = len(parts) > 2 or parts[1] in {*ARROWS, WIRING}
    return parts[1] if planned or any(name.startswith(module + ".") for name in known) else None


def allowed(module: str, target: str, known: set[str]) -> bool:
    """Return whether the plan lets a module import a target."""
    room, aim = room_of(module, known), room_of(target, known)
    if aim is None or room in (aim, WIRING):
        return True
    if room is None:
        return module == "surefoot.__main__" and aim == WIRING
    path = target.removeprefix("surefoot.") + "."
    return any(path.startswith(arrow + ".") for arrow in ARROWS.get(room, ()))


def violations(sources: dict[str, str], packages: set[str]) -> list[str]:
    """Return one line for each import, and each room, that the plan does not have."""
    known = set(sources)
    rooms = {room for module in known if (room := room_of(module, known))}
    found = [f"surefoot.{room} is no room of the plan" for room in sorted(rooms - {*ARROWS, WIRING})]
    for module, source in sources.items():
        for line, target in imports(source, module, module in packages, known):
            if not allowed(module, target, known):
                room = room_of(module, known)
                choices = ", ".join(sorted(ARROWS.get(room or "", ()))) or "nothing of ours"
                rule = f"{room or 'the root'} may import {choices}"
                found.append(f"{module}, line {line}: imports {target}; {rule}")
    return found


def package_sources() -> tuple[dict[str, str], set[str]]:
    """Return the source of every module, and which of them are packages."""
    files = modules(PACKAGE)
    sources = {name: file.read_text(encoding="utf-8") for name, file in files.items()}
    return sources, {name for name, file in files.items() if file.name == "__init__.py"}


def test_every_import_follows_an_arrow_of_the_plan():
    found = violations(*package_sources())
    assert not found, "\n".join(found)


def test_the_arrows_have_no_way_back():
    graph = {room: {arrow.split(".")[0] for arrow in arrows} for room, arrows in ARROWS.items()}
    order = graphlib.TopologicalSorter(graph).static_order()  # raises CycleError where there is a way back
    assert set(order) == set(ARROWS)


def cycle(sources: dict[str, str], packages: set[str]) -> list[str]:
    """Return modules that import each other in a circle, wherever in the file; empty if there is none."""
    known = set(sources)
    graph = {
        # A package's own file may import its modules, and they it.
        module: {target for _, target in imports(source, module, module in packages, known) if target in known}
        - {module, *packages}
        for module, source in sources.items()
    }
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def test_no_modules_import_each_other_in_a_circle():
    assert cycle(*package_sources()) == []


def test_a_circle_is_found():
    circle = {
        "surefoot.robot.leg": "from surefoot.robot import sheet",
        "surefoot.robot.sheet": "if TYPE_CHECKING:\n    from .leg import Leg",
    }
    assert set(cycle(LAYOUT | circle, LAYOUT_PACKAGES)) == set(circle)
    assert cycle(LAYOUT | circle | {"surefoot.robot.sheet": "from .. import errors"}, LAYOUT_PACKAGES) == []


LAYOUT_PACKAGES = {"surefoot", *(f"surefoot.{room}" for room in ("robot", "world", "task", "deploy", "cli"))}
_MODULES = ("errors", "robot.leg", "world.interface", "world.simulated", "task.env", "task.gait", "cli.main")
LAYOUT = dict.fromkeys([*sorted(LAYOUT_PACKAGES), *(f"surefoot.{name}" for name in _MODULES)], "")


@pytest.mark.parametrize(
    ("module", "source", "target"),
    [
        ("surefoot.robot.leg", "import numpy, surefoot.task as t", "surefoot.task"),
        ("surefoot.robot.leg", "from surefoot import world", "surefoot.world"),
        ("surefoot.robot.leg", "from .. import errors, task", "surefoot.task"),
        ("surefoot.robot", "from ..task import Env", "surefoot.task"),
        ("surefoot.robot.leg", "def f():\n    from surefoot.task import env", "surefoot.task.env"),
        ("surefoot.robot.leg", "if TYPE_CHECKING:\n    from surefoot.task import Env", "surefoot.task"),
        ("surefoot.robot.leg", "import importlib\nimportlib.import_module('surefoot.task')", "surefoot.task"),
        ("surefoot.task.env", "from surefoot.world import interface, simulated", "surefoot.world.simulated"),
        ("surefoot.task.env", "from ..world.simulated import SimWorld", "surefoot.world.simulated"),
        ("surefoot.task.env", "from surefoot.cli.main import main", "surefoot.cli.main"),
        ("surefoot.deploy", "from ..task.env import Env", "surefoot.task.env"),
        ("surefoot.errors", "from .robot import leg", "surefoot.robot.leg"),
    ],
)
def test_an_import_against_the_arrows_is_found(module: str, source: str, target: str):
    found = violations(LAYOUT | {module: source}, LAYOUT_PACKAGES)
    assert len(found) == 1
    assert found[0].startswith(f"{module}, line ")
    assert f"imports {target};" in found[0]


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("surefoot.robot.leg", "from surefoot.errors import SurefootError"),
        ("surefoot.robot.leg", "from .. import __version__\nimport surefoot\nfrom . import sheet"),
        ("surefoot.robot", "from .leg import to_motors"),
        ("surefoot.task.env", "from surefoot.world.interface import World\nfrom ..world import interface"),
        ("surefoot.deploy", "from ..task import gait\nimport surefootage.world"),
        ("surefoot.cli.main", "from ..world.simulated import SimWorld\nimport surefoot.deploy"),
    ],
)
def test_an_import_along_the_arrows_passes(module: str, source: str):
    assert violations(LAYOUT | {module: source}, LAYOUT_PACKAGES) == []


def test_a_room_outside_the_plan_is_found():
    assert violations(LAYOUT | {"surefoot.attic": "", "surefoot.attic.box": ""}, LAYOUT_PACKAGES) == [
        "surefoot.attic is no room of the plan"
    ]


def import_on_the_robot(names: list[str]) -> subprocess.CompletedProcess[str]:
    """Import modules, one after another, in a new process that has only the bare install."""
    script = f"""
import importlib, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {sorted(NOT_ON_THE_ROBOT)!r}:
            raise ImportError(f"the robot's computer has no {{name}}", name=name)

sys.meta_path.insert(0, Absent())
for name in {names!r}:
    importlib.import_module(name)
"""
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)


def test_what_the_robot_runs_imports_without_simulation_and_learning():
    deploy = [name for name in modules(PACKAGE) if name.startswith("surefoot.deploy") and not name.endswith("__main__")]
    assert "surefoot.deploy.loop" in deploy
    # The last one shows that the robot of these tests truly lacks a simulator.
    done = import_on_the_robot([*ROBOT_SIDE, *deploy, "mujoco"])
    assert done.returncode != 0
    assert done.stderr.endswith("ImportError: the robot's computer has no mujoco\n")
