"""Plug-ins: reward terms and observations of a user's own, from a Python file or an installed package.

A plug-in registers functions with `reward_term` and `observation`, in the same tables as the built-in ones. Only what a
user names by `--plugin` is executed: policies and run folders record names and digests of plug-ins, never paths.
"""

from __future__ import annotations

import hashlib
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, check_name, describe_os_errors, quote, suggest
from surefoot.files import read_configuration
from surefoot.policy.contract import PluginRecord
from surefoot.robot import RobotDescription
from surefoot.task.observation import PARTS, ObservationPart
from surefoot.task.reward import TERMS, RewardTerm
from surefoot.task.state import EnvState, RobotState

GROUP = "surefoot.plugins"
"""Entry points by which an installed package offers plug-ins: the name of each is what `--plugin` takes."""


@dataclass
class Plugin:
    """A plug-in; it can be sent to another process and registered there."""

    name: str
    """Name of the file, or of the entry point."""
    path: str
    """Path of the file, for messages and its own `__file__`; of an entry point the same as its name."""
    source: bytes
    """The file's text; empty for an entry point."""
    sha256: str
    """Digest of the source."""
    rewards: list[str] = field(default_factory=list)
    """Names of its reward terms."""
    observations: list[str] = field(default_factory=list)
    """Names of its observations."""

    def record(self, rewards: Iterable[str], observations: Iterable[str]) -> PluginRecord | None:
        """Return the record of those of its terms that are in use; None if none is."""
        used = tuple(set(self.rewards) & set(rewards)), tuple(set(self.observations) & set(observations))
        return PluginRecord(self.name, self.sha256, *map(tuple, map(sorted, used))) if any(used) else None


_plugins: dict[str, Plugin] = {}
"""Plug-ins that are registered, by path."""
_registering: list[Plugin] = []
"""The plug-in whose file is being executed."""


def reward_term(
    name: str, unit: str, source: str = "", is_sum: bool = False
) -> Callable[[Callable[[EnvState], Any]], Callable[[EnvState], Any]]:
    """Register a function as a reward term: it takes the `EnvState` of N robots and returns values (N,).

    Args:
        name: name of the term, for a task's `reward`.
        unit: what its weight multiplies.
        source: where it comes from.
        is_sum: whether it is a sum over the control step; else it is a rate.
    """

    def register(function: Callable[[EnvState], Any]) -> Callable[[EnvState], Any]:
        plugin, what = _registering_plugin(), f"reward term '{name}'"
        _check_new("reward term", name, TERMS)

        def value(state: EnvState) -> Array:
            values = _call(plugin, what, function, state)
            return _check_values(plugin, what, values, state.duration.shape, ~state.truth.diverged)

        TERMS[name] = RewardTerm(unit, value, source or plugin.name, is_sum)
        plugin.rewards.append(name)
        return function

    return register


def observation(
    name: str,
    unit: str,
    frame: str,
    columns: Sequence[str] | Callable[[RobotDescription], Sequence[str]],
    flipped: Sequence[str] = (),
) -> Callable[[Callable[[RobotState], Any]], Callable[[RobotState], Any]]:
    """Register a function as an observation: it takes the `RobotState` of N robots and returns (N, C) numbers.

    It must depend on nothing else: the robot's control computer calls it too.

    Args:
        name: name of the observation, for a task's `observations`.
        unit: unit of its numbers.
        frame: the frame that they refer to.
        columns: names of its C numbers, or a function of the robot that returns them. NAME.MOTOR and names with left
            and right are exchanged with the other side in the mirror image, for `ppo.symmetry`.
        flipped: columns that change their sign in the mirror image.
    """

    def register(function: Callable[[RobotState], Any]) -> Callable[[RobotState], Any]:
        plugin, widths, what = _registering_plugin(), set[int](), f"observation '{name}'"
        _check_new("observation", name, PARTS)

        def names(robot: RobotDescription) -> list[str]:
            result = _call(plugin, what, columns, robot) if callable(columns) else columns
            if isinstance(result, str) or not result or not all(isinstance(column, str) for column in result):
                raise SurefootError(f"plug-in {plugin.path}: {what}: columns are {quote(result)}; they must be names")
            widths.add(len(result))
            return [*result]

        def read(state: RobotState) -> Array:
            # What only a simulation knows is hidden: the function must do the same on a robot.
            values, readings = _call(plugin, what, function, state.without_truth()), state.readings
            width = next((width for width in widths if np.shape(values)[1:] == (width,)), min(widths))
            angles = np.hstack([readings.roll_pitch_yaw, readings.angular_velocity_base, readings.motor_angle])
            rows = np.asarray(np.isfinite(angles).all(axis=1))
            return _check_values(plugin, what, values, (len(rows), width), rows)

        PARTS[name] = ObservationPart(unit, frame, names, read, tuple(flipped))
        plugin.observations.append(name)
        return function

    return register


def _registering_plugin() -> Plugin:
    if not _registering:
        raise SurefootError("reward_term and observation register in a plug-in's file; name it by --plugin")
    return _registering[-1]


def _check_new(what: str, name: str, table: Mapping[str, object]) -> None:
    """Refuse a name that is unsafe, or taken by a built-in term or another plug-in."""
    check_name(f"name of the {what}", name)
    if name in table:
        others = [
            plugin.path
            for plugin in [*_plugins.values(), *_registering]
            if name in (*plugin.rewards, *plugin.observations)
        ]
        owner = others[0] if others else "surefoot"
        raise SurefootError(f"{what} '{name}': {owner} has one of this name; choose another")


def _call(plugin: Plugin, what: str, function: Callable[[Any], Any], argument: Any) -> Any:
    try:
        return function(argument)
    except Exception as error:  # the code is the user's
        raise SurefootError(f"plug-in {_place(plugin, error)}: {what}: {type(error).__name__}: {error}") from error


def _place(plugin: Plugin, error: BaseException) -> str:
    """Return the path of a plug-in, with the line in which an error arose where it is known."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == plugin.path]
    if isinstance(error, SyntaxError):
        lines = [error.lineno]
    return f"{plugin.path}, line {lines[-1]}" if lines else plugin.path


def _check_values(plugin: Plugin, what: str, values: Any, shape: tuple[int, ...], rows: NDArray[np.bool_]) -> Array:
    """Return the values of a plug-in's function; refuse another shape, and numbers in `rows` that are not finite."""
    try:
        array = np.asarray(values, float)
    except (TypeError, ValueError):
        raise SurefootError(f"plug-in {plugin.path}: {what} is {quote(values)}; it must be an array") from None
    if array.shape != shape:
        raise SurefootError(f"plug-in {plugin.path}: {what} has shape {array.shape}; it must have {shape}")
    if not np.isfinite(array[rows]).all():
        raise SurefootError(f"plug-in {plugin.path}: {what} is not finite")
    return array


def load_plugins(names: Iterable[str | Path]) -> None:
    """Execute plug-ins that the user names, by path or by the name of an entry point, and register their terms.

    A plug-in that is registered already is not executed again, unless its source has changed.

    Raises:
        SurefootError: no such file or entry point, an error in it, no term, or a term whose name is taken.
    """
    for name in names:
        register_plugin(_read(str(name)))


def _read(name: str) -> Plugin:
    if name.endswith(".py"):
        with describe_os_errors(f"plug-in {name}"):
            source = read_configuration(Path(name))
        return Plugin(Path(name).name, name, source, hashlib.sha256(source).hexdigest())
    entry = _entry_point(name)
    spec = find_spec(entry.module)
    source = Path(spec.origin).read_bytes() if spec is not None and spec.origin else b""
    return Plugin(name, name, b"", hashlib.sha256(source).hexdigest())


def _entry_point(name: str) -> metadata.EntryPoint:
    entries = {entry.name: entry for entry in metadata.entry_points(group=GROUP)}
    if name not in entries:
        more = f"; {suggest(name, entries)}" if entries else ""
        raise SurefootError(f"plug-in '{name}' is neither a file whose name ends in .py nor an installed one{more}")
    return entries[name]


def register_plugin(plugin: Plugin) -> None:
    """Execute a plug-in and register its terms, in place of those of an earlier source of the same file.

    Raises:
        SurefootError: as `load_plugins`.
    """
    before = _plugins.get(plugin.path)
    if before is not None and before.sha256 == plugin.sha256:
        return
    if before is not None:
        _remove(before)
    plugin = replace(plugin, rewards=[], observations=[])
    _registering.append(plugin)
    try:
        _execute(plugin)
    except Exception as error:  # the code is the user's
        _remove(plugin)
        what = "" if isinstance(error, SurefootError) else f"{type(error).__name__}: "
        raise SurefootError(f"plug-in {_place(plugin, error)}: {what}{error}") from error
    finally:
        _registering.pop()
    if not (plugin.rewards or plugin.observations):
        raise SurefootError(f"plug-in {plugin.path}: registers no reward term and no observation")
    _plugins[plugin.path] = plugin


def remove_plugins() -> None:
    """Take all plug-ins out of the tables."""
    for plugin in registered_plugins():
        _remove(plugin)


def _remove(plugin: Plugin) -> None:
    """Take the terms of a plug-in out of the tables."""
    for name in plugin.rewards:
        TERMS.pop(name)
    for name in plugin.observations:
        PARTS.pop(name)
    _plugins.pop(plugin.path, None)


def _execute(plugin: Plugin) -> None:
    if not plugin.path.endswith(".py"):
        entry = _entry_point(plugin.name)
        sys.modules.pop(entry.module, None)
        entry.load()
        return
    module = ModuleType(f"surefoot_plugin_{Path(plugin.path).stem}")
    module.__file__ = plugin.path
    sys.modules[module.__name__] = module  # dataclasses look their module up
    exec(compile(plugin.source, plugin.path, "exec"), module.__dict__)


def registered_plugins() -> list[Plugin]:
    """Return the plug-ins that are registered, to register them in another process."""
    return list(_plugins.values())


def used_plugins(rewards: Iterable[str], observations: Iterable[str]) -> tuple[PluginRecord, ...]:
    """Return records of the plug-ins whose terms are in use: names of reward terms and of observations."""
    rewards, observations = set(rewards), set(observations)
    records = (plugin.record(rewards, observations) for plugin in _plugins.values())
    return tuple(record for record in records if record is not None)


def changed_plugins(records: Iterable[PluginRecord]) -> list[str]:
    """Return a line for each plug-in whose source is not the recorded one."""
    return [
        f"plug-in {plugin.path} has changed since the policy was trained with it"
        for record in records
        for plugin in _plugins.values()
        if plugin.record(record.rewards, record.observations) is not None and plugin.sha256 != record.sha256
    ]
