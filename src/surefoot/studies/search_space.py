"""Search space: fields of a training's configuration, each with a range or choices."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surefoot.configuration import from_mapping, is_number, read_yaml, to_mapping
from surefoot.errors import SurefootError, choices, prefix_errors, quote
from surefoot.learn.config import TrainConfig

if TYPE_CHECKING:
    from optuna.trial import Trial

_SPACES = Path(__file__).parent / "spaces"
_RESERVED_FIELDS = (
    *("name", "seed", "steps", "evaluate_every", "evaluation_episodes", "evaluation_reward"),
    *("checkpoint_every", "threads", "learning_threads"),
)
"""Fields that the search sets itself; all but the seed are the same for all trials."""


@dataclass(frozen=True)
class Dimension:
    """Values of a field among which a search chooses."""

    low: float | None = None
    high: float | None = None
    log: bool = False
    """Whether to sample on a logarithmic scale; negative ranges are sampled by magnitude."""
    int: bool = False
    """Whether values are integers."""
    choices: tuple[Any, ...] = ()
    """Values to choose from, instead of a range."""
    also: tuple[str, ...] = ()
    """Other fields that get the same value."""

    def __post_init__(self) -> None:
        """Check that there is either a valid range or distinct choices."""
        if self.choices:
            if self.low is not None or self.high is not None or self.log or self.int:
                raise SurefootError("it has choices and parts of a range (low, high, log, int); use one or the other")
            texts = [json.dumps(choice) for choice in self.choices]
            if len(set(texts)) < len(texts):
                raise SurefootError(f"choices is {quote(list(self.choices))}; each choice must be different")
            return
        if self.low is None or self.high is None:
            raise SurefootError("it needs low and high, or choices")
        if not self.low < self.high:
            raise SurefootError(f"low is {self.low:g} and high is {self.high:g}; low must be below high")
        if self.log and self.low <= 0 <= self.high:
            raise SurefootError(
                f"low is {self.low:g} and high is {self.high:g}; with log both must be on one side of 0"
            )
        if self.int and (self.low % 1 or self.high % 1):
            raise SurefootError(f"low is {self.low:g} and high is {self.high:g}; with int they must be integers")

    @property
    def samples(self) -> tuple[Any, ...]:
        """Values with which a space is checked: both ends of the range, or all choices."""
        ends = (self.low, self.high)
        return self.choices or (tuple(round(end or 0.0) for end in ends) if self.int else ends)

    @property
    def draws_magnitudes(self) -> bool:
        """Whether negative values are sampled by magnitude."""
        return self.log and self.high is not None and self.high < 0


Space = dict[str, Dimension]
"""Dimensions of a search by the dotted name of their field, such as `ppo.policy_hidden.0`."""


def load_space(path: Path | None, config: TrainConfig) -> Space:
    """Read a search space for a configuration.

    Args:
        path: YAML file. Defaults to the spaces that ship: for learning, including the weights of the task's reward
            terms, and for the sinusoidal reference if the task has one.
        config: configuration with the values of all fields that are not searched.

    Raises:
        SurefootError: the file can't be read, a field is unknown, a range is reversed, or a value is invalid.
    """
    paths = [path] if path is not None else [_SPACES / "learning.yaml"]
    if path is None and config.task.reference.kind == "sine":
        paths.append(_SPACES / "sine.yaml")
    space: Space = {}
    for one in paths:
        with prefix_errors(one):
            for name, entry in read_yaml(one).items():
                term = str(name).removeprefix("task.reward.")
                if path is None and term != name and term not in config.task.reward:
                    continue  # a reward term of other tasks
                with prefix_errors(name):
                    space[str(name)] = from_mapping(Dimension, entry)
            check_space(space, config)
    return space


def check_space(space: Space, config: TrainConfig) -> None:
    """Check a space for unknown fields, and for values that a field can't have.

    Raises:
        SurefootError: with the first problem.
    """
    if not space:
        raise SurefootError("it is empty; a search needs 1 field or more")
    names: set[str] = set()
    for name, dimension in space.items():
        for field in (name, *dimension.also):
            if any(_overlap(field, reserved) for reserved in _RESERVED_FIELDS):
                raise SurefootError(
                    f"{field} is not searched: the search sets it itself, as it does {choices(_RESERVED_FIELDS)}"
                )
            if others := [other for other in names if _overlap(field, other)]:
                what = "is listed twice" if others[0] == field else f"and {others[0]} set the same values"
                raise SurefootError(f"{field} {what}; each field takes one entry")
            names.add(field)
        for value in dimension.samples:
            with_values(config, {name: dimension}, {name: value})


def _overlap(one: str, other: str) -> bool:
    """Return whether two dotted names are equal, or one is part of the other."""
    return f"{one}.".startswith(f"{other}.") or f"{other}.".startswith(f"{one}.")


def with_values(config: TrainConfig, space: Space, values: Mapping[str, Any]) -> TrainConfig:
    """Return a configuration with other values for some fields of a space.

    Raises:
        SurefootError: a field does not exist, or a value is invalid.
    """
    data = to_mapping(config)
    for name, value in values.items():
        for field in (name, *space[name].also):
            _set(data, field, value)
    return from_mapping(TrainConfig, data)


def _set(data: Any, field: str, value: Any) -> None:
    """Set the value at a dotted name in nested dictionaries and lists; unknown fields are detected later."""
    *parents, last = field.split(".")
    for part in parents:
        data = data.setdefault(part, {}) if isinstance(data, dict) else None
    if isinstance(data, list) and last.isdigit() and int(last) < len(data):
        data[int(last)] = value
    elif isinstance(data, dict):
        data[last] = value
    else:
        count = f"; it has {len(data)} elements, numbered from 0" if isinstance(data, list) else ""
        raise SurefootError(f"{field} is not a field of a training's configuration{count}")


def get_value(config: TrainConfig, field: str) -> Any:
    """Return the value at a dotted name, as plain dictionaries, lists and values.

    Raises:
        KeyError, IndexError, TypeError: no such field.
    """
    data: Any = to_mapping(config)
    for part in field.split("."):
        data = data[int(part)] if isinstance(data, list) else data[part]
    return data


def short_name(field: str) -> str:
    """Return the dotted name of a field without its first part, for tables and figures."""
    return field.removeprefix("task.").removeprefix("ppo.")


def suggest_values(space: Space, trial: Trial) -> dict[str, Any]:
    """Return the values of a trial; Optuna's sampler proposes those that the trial does not have yet.

    Choices are passed to Optuna as JSON, since it does not accept lists.
    """
    values: dict[str, Any] = {}
    for name, one in space.items():
        if one.choices:
            values[name] = json.loads(trial.suggest_categorical(name, [json.dumps(choice) for choice in one.choices]))
        else:
            sign = -1 if one.draws_magnitudes else 1
            low, high = sorted(sign * end for end in one.samples)
            suggest_number = trial.suggest_int if one.int else trial.suggest_float
            values[name] = sign * suggest_number(name, low, high, log=one.log)
    return values


def to_optuna_params(space: Space, config: TrainConfig) -> dict[str, Any]:
    """Return the values of a configuration as Optuna parameters; values outside of the space are left out."""
    params = {}
    for name, dimension in space.items():
        value = get_value(config, name)
        if not dimension.choices:
            inside = is_number(value) and dimension.low <= value <= dimension.high
            value = -value if inside and dimension.draws_magnitudes else value
        else:
            # The text of the choice, since 0.0 is the choice 0.
            inside = value in dimension.choices
            value = json.dumps(dimension.choices[dimension.choices.index(value)]) if inside else ""
        if inside:
            params[name] = value
    return params
