"""Plug-ins: custom reward terms and observations from a Python file or an installed package.

A plug-in registers functions with `reward_term` and `observation`, in the same tables as the built-in ones. Only
plug-ins that the user names with `--plugin` are executed: policies and run folders record names and digests of
plug-ins, never paths.
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
from surefoot.task.reward import ON_REQUEST, TERMS, RewardTerm
from surefoot.task.state import EnvState, RobotState

GROUP = "surefoot.plugins"
"""Group of entry points with which installed packages provide plug-ins. `--plugin` takes the name of an entry point."""


@dataclass
class Plugin:
    """A plug-in, which can be sent to another process and registered there."""

    name: str
    """Name of the file or of the entry point."""
    path: str
    """Path of the file, for messages and its `__file__`, or name of the entry point."""
    source: bytes
    """Content of the file; empty for an entry point."""
    sha256: str
    """Digest of the source."""
    rewards: list[str] = field(default_factory=list)
    """Names of its reward terms."""
    observations: list[str] = field(default_factory=list)
    """Names of its observations."""

    def record(self, rewards: Iterable[str], observations: Iterable[str]) -> PluginRecord | None:
        """Return a record of the plug-in's terms that are in use, or None if none is.

        Args:
            rewards: names of the reward terms in use.
            observations: names of the observations in use.
        """
        used = tuple(set(self.rewards) & set(rewards)), tuple(set(self.observations) & set(observations))
        return PluginRecord(self.name, self.sha256, *map(tuple, map(sorted, used))) if any(used) else None


_plugins: dict[str, Plugin] = {}
"""Registered plug-ins by path."""
_registering: list[Plugin] = []
"""The plug-in whose file is being executed."""


def reward_term(
    name: str, unit: str, source: str = "", is_sum: bool = False, needs: str = ""
) -> Callable[[Callable[[EnvState], Any]], Callable[[EnvState], Any]]:
    """Register a function as a reward term. It receives the `EnvState` of N robots and returns values (N,).

    Args:
        name: name of the term in a task's `reward`.
        unit: quantity and unit that the weight multiplies.
        source: origin of the term, such as a paper.
        is_sum: whether values are sums over the control step; otherwise rates.
        needs: field of the state that the function reads and that is zero unless a term needs it, from
            `reward.ON_REQUEST`.
    """

    def register(function: Callable[[EnvState], Any]) -> Callable[[EnvState], Any]:
        plugin, what = _registering_plugin(), f"reward term '{name}'"
        _check_new("reward term", name, TERMS)
        if needs and needs not in ON_REQUEST:
            raise SurefootError(f"plug-in {plugin.path}: {what}: needs '{needs}'; {suggest(needs, ON_REQUEST)}")

        def value(state: EnvState) -> Array:
            values = _call(plugin, what, function, state)
            return _check_values(plugin, what, values, state.duration.shape, ~state.truth.diverged)

        TERMS[name] = RewardTerm(unit, value, source or plugin.name, is_sum, needs)
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
    """Register a function as an observation. It receives the `RobotState` of N robots and returns values (N, C).

    It must not depend on anything else, because the robot's control computer also calls it.

    Args:
        name: name of the observation in a task's `observations`.
        unit: unit of its values.
        frame: reference frame of its values.
        columns: names of its C columns, or a function of the robot that returns them. For `ppo.symmetry`, columns
            NAME.MOTOR and columns with left or right in their name are swapped with the other side.
        flipped: columns that change sign in the mirror image.
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
            # The true state is hidden, so that the function does the same on a robot.
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
        raise SurefootError("reward_term and observation must be called in a plug-in's file; name it with --plugin")
    return _registering[-1]


def _check_new(what: str, name: str, table: Mapping[str, object]) -> None:
    """Reject an unsafe name, and a name that a built-in term or another plug-in already has."""
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
    """Return the path of a plug-in and, if known, the line of an error in it."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == plugin.path]
    if isinstance(error, SyntaxError):
        lines = [error.lineno]
    return f"{plugin.path}, line {lines[-1]}" if lines else plugin.path


def _check_values(plugin: Plugin, what: str, values: Any, shape: tuple[int, ...], rows: NDArray[np.bool_]) -> Array:
    """Return the values of a plug-in's function as an array.

    Args:
        plugin: the plug-in.
        what: name of the term in messages.
        values: returned values.
        shape: required shape.
        rows: robots whose values must be finite (N,).

    Raises:
        SurefootError: values of another shape, or values that are not finite.
    """
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
    """Execute plug-ins, named by path or entry point, and register their terms.

    A registered plug-in is executed again only if its source has changed.

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
    """Execute a plug-in and register its terms, which replace the terms of an earlier version of the same file.

    Raises:
        SurefootError: see `load_plugins`.
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
    """Unregister all plug-ins."""
    for plugin in registered_plugins():
        _remove(plugin)


def _remove(plugin: Plugin) -> None:
    """Unregister the terms of a plug-in."""
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
    sys.modules[module.__name__] = module  # dataclasses look up their module
    exec(compile(plugin.source, plugin.path, "exec"), module.__dict__)


def registered_plugins() -> list[Plugin]:
    """Return the registered plug-ins, for example to register them in another process."""
    return list(_plugins.values())


def used_plugins(rewards: Iterable[str], observations: Iterable[str]) -> tuple[PluginRecord, ...]:
    """Return records of the plug-ins whose reward terms or observations are in use.

    Args:
        rewards: names of the reward terms in use.
        observations: names of the observations in use.
    """
    rewards, observations = set(rewards), set(observations)
    records = (plugin.record(rewards, observations) for plugin in _plugins.values())
    return tuple(record for record in records if record is not None)


def changed_plugins(records: Iterable[PluginRecord]) -> list[str]:
    """Return one note for each plug-in whose source differs from its record."""
    return [
        f"plug-in {plugin.path} has changed since the policy was trained with it"
        for record in records
        for plugin in _plugins.values()
        if plugin.record(record.rewards, record.observations) is not None and plugin.sha256 != record.sha256
    ]
