"""Allowed imports between packages, and imports on the robot's computer."""

from __future__ import annotations

import ast
import functools
import graphlib
import re
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "src" / "surefoot"

ALLOWED: dict[str, set[str]] = {
    "robot": set(),
    "actuator": {"robot"},
    "world": {"actuator", "robot"},
    "task": {"robot", "policy", "estimation", "world.interface", "world.ground", "world.terrain"},
    "learn": {"task", "policy", "evaluation", "robot", "world.interface"},
    "policy": {"robot"},
    "estimation": {"robot"},
    "evaluation": {"task", "policy", "world", "robot", "estimation"},
    "identify": {"world", "deploy", "robot", "actuator", "task.trace"},
    "deploy": {
        *("robot", "policy", "estimation", "world.interface"),
        *("task.contract_mapping", "task.policy_plugins", "task.commands", "task.observation", "task.gait"),
        *("task.component", "task.gait_components", "task.state", "task.base_velocity"),
        *("task.height_scan", "task.trace", "task.partial_trace"),
    },
    "emulator": {"deploy", "world", "actuator", "robot", "task.height_scan"},
    "firmware": {"deploy", "robot"},
    "report": {
        "evaluation",
        "task",
        "robot",
        *("world.ground", "world.terrain"),
        "identify.result",
        "identify.motion.replay_errors",
        *("adopt.examination", "adopt.diagnosis"),
    },
    "adopt": {"policy", "task", "robot", "deploy.checks", "evaluation", "world"},
    "studies": {"report", "learn", "evaluation", "task", "policy", "world", "robot"},
}
"""Imports allowed to each package, in addition to itself and the top-level modules: packages, or single modules such as
"world.interface". `cli` may import anything; only `surefoot.__main__` imports it."""
FACADE = {"__init__", "api", "envs"}
"""Packages shared by `import surefoot` and the commands, which may import anything except `cli` and `studies`."""
ROBOT_SIDE = [
    "policy.runtime",
    "task.gait",
    "task.observation",
    "task.trace",
    "estimation.legged_odometry",
    "evaluation.estimated_motion",
    "robot",
    "api.policies",
    "cli.doctor",
    "cli.emulate",
    "cli.deploy",
    "cli.robot",
    "cli.robot_firmware",
    "firmware.project",
    "cli.identify",
    "identify.experiment_runner",
    "identify.registry",
    "identify.ground.plans",
]
"""Modules that run on the robot's computer, in addition to `surefoot.deploy`."""
NOT_ON_THE_ROBOT = {
    *("mujoco", "numba", "llvmlite", "gymnasium", "scipy", "pandas", "pybullet", "tomli_w"),
    *("torch", "tensordict", "rsl_rl", "tensorboard", "onnx", "stable_baselines3", "filelock"),
    *("matplotlib", "imageio_ffmpeg", "PIL", "viser", "websockets"),
}
"""Packages outside the bare install."""

FILES = {
    ".".join(file.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted(PACKAGE.rglob("*.py"))
}
"""File of each module, by its dotted name below the package."""


def imported(source: str) -> set[str]:
    """Return the dotted names below the package that a module imports, anywhere in the file."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "imports are absolute"
            module = f"{node.module}."
            # `from a import b` imports module a.b if it exists, and otherwise a name defined in a.
            whole = {f"{module}{alias.name}" for alias in node.names}
            names |= {name if name.removeprefix("surefoot.") in FILES else module[:-1] for name in whole}
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            names |= {arg.value for arg in node.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)}
    return {name.removeprefix("surefoot.") for name in names if name.startswith("surefoot.")}


@functools.cache
def imports() -> dict[str, set[str]]:
    """Return the imports of each module, by its dotted name."""
    return {name: imported(file.read_text(encoding="utf-8")) for name, file in FILES.items()}


def is_allowed(module: str, target: str) -> bool:
    package, other = module.split(".")[0], target.split(".")[0]
    is_package = (PACKAGE / other).is_dir()
    if not is_package or package in (other, "cli") or (module, other) == ("__main__", "cli"):
        return True
    if package in FACADE:
        return other not in ("cli", "studies")
    return any(f"{target}.".startswith(f"{entry}.") for entry in ALLOWED.get(package, ()))


def test_every_import_is_allowed():
    wrong = [
        (name, target) for name, targets in imports().items() for target in targets if not is_allowed(name, target)
    ]
    assert wrong == []


def test_every_package_is_in_the_table():
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert packages == {*ALLOWED, "api", "cli"}


def test_the_architecture_page_lists_the_allowed_imports():
    page = (PACKAGE.parents[1] / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)/`.*\| ([^|]+) \|$", page, re.MULTILINE)
    said = {package: set(re.findall(r"\w+", cell)) & set(ALLOWED) for package, cell in rows if package in ALLOWED}
    assert said == {package: {entry.split(".")[0] for entry in entries} for package, entries in ALLOWED.items()}


def test_the_packages_form_a_hierarchy():
    graph = {package: {entry.split(".")[0] for entry in entries} for package, entries in ALLOWED.items()}
    assert set(graphlib.TopologicalSorter(graph).static_order()) == set(ALLOWED)  # raises CycleError at a cycle


def test_modules_have_no_import_cycles():
    # A package's __init__ and its modules may import each other.
    packages = {name for name, file in FILES.items() if file.name == "__init__.py"}
    graph = {name: (targets & set(FILES)) - {name, *packages} for name, targets in imports().items()}
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError at a cycle


def test_imports_are_found_at_any_depth():
    source = (
        "import surefoot.task as t\ndef f():\n    from surefoot.world import registry, SimWorld\nif TYPE_CHECKING:\n"
    )
    source += "    from surefoot.errors import SurefootError\nimportlib.import_module('surefoot.cli.main')"
    assert imported(source) == {"task", "world.registry", "world", "errors", "cli.main"}
    assert not is_allowed("robot.leg", "task.env")
    assert is_allowed("task.env", "world.interface")
    assert not is_allowed("errors", "robot")
    assert not is_allowed("api.policies", "studies.training")
    assert is_allowed("api.policies", "task.handcrafted")


def import_on_the_robot(names: list[str]) -> subprocess.CompletedProcess[str]:
    """Import modules in sequence in a new process that has only the bare install."""
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


def test_modules_on_the_robot_import_without_simulation_and_learning():
    deploy = [name for name in FILES if name.startswith("deploy.") and not name.endswith("__main__")]
    assert "deploy.loop" in deploy
    # The last module proves that the simulator is not available in this process.
    done = import_on_the_robot([*(f"surefoot.{name}" for name in (*ROBOT_SIDE, *deploy)), "mujoco"])
    assert done.returncode != 0
    assert done.stderr.endswith("ImportError: the robot's computer has no mujoco\n")
