"""Tuning of handcrafted gaits with CMA-ES: foot trajectories, and the gains of Raibert's controller.

Covariance matrix adaptation (Hansen 2016, "The CMA Evolution Strategy: A Tutorial", in the package `cma`) minimizes the
mean power at a required speed without falls. All candidates of a generation run in parallel, each on several robots of
one simulation. Lengths are searched relative to the legs' reach, and frequencies in multiples of
sqrt(g / reach) / (2 pi), so that the ranges apply to robots of any size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import Seed, Threads, Within, is_number, to_mapping
from surefoot.errors import SurefootError, choices, quote
from surefoot.evaluation.footfalls import FEET
from surefoot.evaluation.rollout import run_to_end
from surefoot.robot import DEFAULT_ROBOT, GRAVITY, RobotDescription
from surefoot.seeding import generator
from surefoot.tables import read_csv
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.foot_paths import FootPaths
from surefoot.task.gait import HybridGait
from surefoot.task.handcrafted import HandcraftedGait, OpenLoop
from surefoot.task.leg_config import FootConfig
from surefoot.task.observation import IMU_4D
from surefoot.task.periodic_references import FootReference
from surefoot.task.raibert import HISTORY, OBSERVATIONS, RaibertConfig, RaibertController
from surefoot.task.reference_config import FootReferenceConfig
from surefoot.world.interface import SimulationFactory

Gait = Literal["trot", "bound", "gallop", "free"]
Ranges = dict[str, tuple[float, float, float]]
"""Minimum, maximum and initial value of each searched parameter."""

PATH_RANGES: Ranges = {
    "frequency": (1.0, 9.0, 2.5),
    "duty_factor": (0.2, 0.8, 0.5),
    "stride": (0.5, 3.0, 1.3),
    "clearance": (0.02, 0.3, 0.12),
    "front_height": (0.5, 0.95, 0.72),
    "back_height": (0.5, 0.95, 0.72),
    "front_offset": (-0.3, 0.3, 0.0),
    "back_offset": (-0.3, 0.3, 0.0),
    "depth": (0.0, 0.15, 0.02),
}
"""Ranges of the foot trajectories. `stride` is the distance that feet move backward in stance, relative to the distance
of the body in that time; `frequency` is relative to the legs' natural frequency; lengths are relative to the legs'
reach."""
PHASE_RANGES: dict[Gait, Ranges] = {
    "trot": {},
    "bound": {"back_phase": (0.25, 0.75, 0.5)},
    "gallop": {"back_phase": (0.3, 0.7, 0.5), "front_lead": (0.08, 0.22, 0.12), "back_lead": (-0.22, 0.22, 0.12)},
    "free": {"back_phase": (0.0, 1.0, 0.5), "front_lead": (-0.5, 0.5, 0.5), "back_lead": (-0.5, 0.5, -0.5)},
}
"""Ranges of phases [cycles]: lag of the hind legs behind the fore legs, and of the right legs behind the left. A
gallop's hind phase is measured between the middles of both pairs, so that pairs do not mix; otherwise between the left
legs."""
GAIN_RANGES: Ranges = {
    "speed": (-0.15, 0.3, 0.0),
    "pitch": (0.0, 3.0, 0.3),
    "pitch_rate": (0.0, 0.3, 0.03),
    "roll": (0.0, 3.0, 0.3),
    "roll_rate": (0.0, 0.3, 0.03),
}
"""Ranges of the gains of Raibert's controller."""
MAX_STROKE_RATIO = 0.5
"""Maximum stroke relative to the legs' reach, which keeps starts at high speeds feasible."""
FEEDBACK_BOUNDS = {
    "rad": FeedbackConfig(swing=(-0.25, 0.25), extension=(-0.25, 0.25)),
    "1": FeedbackConfig(swing=(-0.25, 0.25), extension=(-0.1, 0.1)),
}
"""Bounds of the controller's feedback by the unit of leg extension; the paper's bounds for the learned trot."""
_SPEED_PENALTY = 300.0
"""Cost [W] at zero speed; it is proportional to the missing speed."""
_FALL_PENALTY = 1000.0
"""Cost [W] of a fall; up to as much again is added in proportion to the missing time."""
_MAX_RESAMPLES = 200
_FINAL_EPISODES = 20
"""Minimum number of episodes per candidate in the final selection."""
_MIN_IMPROVEMENT = 0.02
"""Relative decrease of the cost below which a search has converged."""


@dataclass(frozen=True)
class TuneConfig:
    """Settings of a tuning."""

    gait: Gait = "trot"
    """trot: diagonal legs in pairs; bound: fore and hind legs in pairs; gallop: the same, a little apart; free: any."""
    speed: Annotated[float, Within(0.05, 10)] = 0.6
    """Speed that the gait must reach [m/s]."""
    raibert: bool = False
    """Also tune Raibert's controller."""
    robot: str = DEFAULT_ROBOT
    """Name of the robot, or the folder of its description."""
    generations: Annotated[int, Within(1, 10_000)] = 40
    """Maximum number of generations."""
    patience: Annotated[int, Within(0, 10_000)] = 0
    """Stop if the last PATIENCE generations reduced the minimum cost by less than 2 %; 0 never stops."""
    population: Annotated[int, Within(4, 1000)] = 16
    """Candidates per generation."""
    starts: Annotated[int, Within(1, 100)] = 3
    """Episodes per candidate, from different starts."""
    duration: Annotated[float, Within(0.5, 60)] = 4.0
    """Length of an episode [s]."""
    sigma: Annotated[float, Within(0, 1, exclusive=True)] = 0.2
    """Initial standard deviation, relative to each parameter's range."""
    seed: Seed = 0
    threads: Threads = 0
    """Threads of the simulation; 0 means one per core. The result does not depend on it."""

    @property
    def ranges(self) -> Ranges:
        """Ranges of the searched parameters."""
        return {**PATH_RANGES, **PHASE_RANGES[self.gait], **(GAIN_RANGES if self.raibert else {})}


def foot_config(values: Mapping[str, float], gait: Gait, speed: float, reach: float) -> FootConfig:
    """Return foot trajectories.

    Args:
        values: parameters by name, in the units of `PATH_RANGES` and `PHASE_RANGES`.
        gait: the gait, which determines the phases that are not searched.
        speed: speed of the gait [m/s].
        reach: maximum distance of a foot from its motor axis [m].
    """
    frequency = values["frequency"] * math.sqrt(GRAVITY / reach) / (2 * math.pi)
    fore, back, hind = (values.get(name, 0.0) for name in ("front_lead", "back_lead", "back_phase"))
    phase = {
        "trot": (0.0, 0.5, 0.5, 0.0),
        "bound": (0.0, 0.0, hind, hind),
        "gallop": (-fore / 2, fore / 2, hind - back / 2, hind + back / 2),
        "free": (0.0, fore, hind, hind + back),
    }[gait]
    legs = ("front_left", "front_right", "back_left", "back_right")

    def by_leg(name: str) -> dict[str, float]:
        return {leg: reach * values[f"{leg.split('_')[0]}_{name}"] for leg in legs}

    return FootConfig(
        frequency=frequency,
        stroke=min(values["stride"] * speed * values["duty_factor"] / frequency, MAX_STROKE_RATIO * reach),
        clearance=reach * values["clearance"],
        duty_factor=values["duty_factor"],
        phase=dict(zip(legs, phase, strict=True)),
        height=by_leg("height"),
        offset=by_leg("offset"),
        depth=reach * values["depth"],
    )


def curve_path(gait: Path) -> Path:
    """Return the CSV file with the tuning curve of a gait file."""
    return gait.with_name(f"{gait.stem}-tuning.csv")


def read_curve(gait: Path) -> list[dict[str, str]]:
    """Return the tuning curve of a gait file, one row per generation; empty without a curve."""
    return read_csv(curve_path(gait))


def has_converged(curve: Sequence[float], patience: int) -> bool:
    """Return whether the minimum cost of the last generations is less than 2 % below that of as many before.

    Args:
        curve: minimum cost of each generation (G,) [W].
        patience: number of generations that are compared, above 0.
    """
    before = curve[-2 * patience : -patience]
    return len(before) == patience and min(curve[-patience:]) > (1.0 - _MIN_IMPROVEMENT) * min(before)


class Tuner:
    """Tuner of a gait: `step` runs one generation, `gait` returns the best gait so far.

    Args:
        config: settings.
        make_world: creates the simulation.
        start: initial parameters by name, which override the defaults; clipped to the ranges.

    Raises:
        SurefootError: the robot lacks the legs of `FEET`, or the start is out of the legs' reach.
    """

    def __init__(
        self, config: TuneConfig, make_world: SimulationFactory, start: Mapping[str, float] | None = None
    ) -> None:
        self.config, self.ranges, self.robot = config, config.ranges, RobotDescription.load(config.robot)
        if set(self.robot.leg_names) != set(FEET):
            raise SurefootError(
                f"{self.robot.name} has legs {choices(self.robot.leg_names)}; handcrafted gaits need {choices(FEET)}"
            )
        self.feedback = FEEDBACK_BOUNDS[self.robot.leg_geometry.units[-1]]
        level = [0.0] * (len(self.robot.coordinates) - 1)
        straight = self.robot.pose_angles(*level, self.robot.leg_space["extension"][1])
        feet = self.robot.leg_geometry.foot_in_plane(straight[self.robot.leg_motor_index])
        self.reach = float(np.linalg.norm(feet, axis=-1).mean())
        start = start or {}
        for name, value in start.items():
            if not is_number(value):
                raise SurefootError(
                    f"parameter {name} of the gait to start from is {quote(value)}; it must be a number"
                )
        # A start that is feasible at one speed may be out of reach at another: move it towards the default gait.
        for fraction in np.linspace(1.0, 0.0, 21).tolist():
            self.best = {
                name: default + fraction * (min(max(start.get(name, default), low), high) - default)
                for name, (low, high, default) in self.ranges.items()
            }
            """Parameters of the best gait so far."""
            if not self._infeasibility(self.best):
                break
        self.cost = math.inf
        self.curve: list[float] = []
        """Minimum cost of each generation [W]."""
        self._generation_best: list[dict[str, float]] = []
        self._low, high, _ = np.array(list(self.ranges.values())).T
        self._width = high - self._low
        inside = np.clip((np.array(list(self.best.values())) - self._low) / self._width, 0.02, 0.98)
        seed = int(generator(config.seed, "tune").integers(1, 2**31))
        options = {"bounds": [0, 1], "popsize": config.population, "seed": seed, "verbose": -9}
        # The import takes seconds; user errors are raised first.
        import cma

        self._search = cma.CMAEvolutionStrategy(inside, config.sigma, options)
        task, count = self.gait().task, config.population * config.starts
        steps = round(config.duration / float(task.nominal(self.robot).control_step[0]))
        task = replace(task, max_steps=max(steps, 1))
        self.steps = count * task.max_steps
        """Control steps of a generation without falls."""
        self._env = LocomotionEnv(task, count, make_world, config.seed, autoreset=False, threads=config.threads)

    def gait(self) -> HandcraftedGait:
        """Return the best gait so far, with the tuning's settings and its parameters."""
        config = self.config
        foot = foot_config(self.best, config.gait, config.speed, self.reach)
        name = f"{config.gait}-{round(100 * config.speed)}{'-raibert' if config.raibert else ''}"
        observations, history = (OBSERVATIONS, HISTORY) if config.raibert else (IMU_4D, 1)
        task = TaskConfig(
            name=name,
            robot=config.robot,
            observations=observations,
            history=history,
            reference=FootReferenceConfig(foot=foot),
            feedback=self.feedback,
            rest=self.robot.rest,
        )
        gains = RaibertConfig(**{name: self.best[name] for name in GAIN_RANGES}) if config.raibert else None
        return HandcraftedGait(task, gains, {**to_mapping(config), "parameters": dict(self.best)})

    def step(self) -> None:
        """Run one generation."""
        points = [self._within_reach(point) for point in self._search.ask()]
        candidates = [self._values(point) for point in points]
        costs = self.costs(candidates).mean(axis=1)
        self._search.tell(points, costs.tolist())
        first = int(np.argmin(costs))
        self._generation_best.append(candidates[first])
        self.curve.append(float(costs[first]))
        if costs[first] < self.cost:
            self.cost, self.best = float(costs[first]), candidates[first]

    def finish(self) -> None:
        """Select among the best candidates of the last generations by their mean cost in new episodes.

        This removes the selection bias of the minimum of many noisy costs, and reveals rare falls.
        """
        finalists = [*self._generation_best[-self.config.population :], self.best]
        finalists = (finalists * self.config.population)[-self.config.population :]
        rounds = math.ceil(_FINAL_EPISODES / self.config.starts)
        costs = np.mean([self.costs(finalists).mean(axis=1) for _ in range(rounds)], axis=0)
        self.cost, self.best = float(costs.min()), finalists[int(np.argmin(costs))]

    def costs(self, candidates: Sequence[Mapping[str, float]]) -> Array:
        """Return the costs of all candidates' episodes (C, starts) [W]: power, and penalties for low speed or falls."""
        config, env, starts = self.config, self._env, self.config.starts
        each = [self._paths(values) for values in candidates for _ in range(starts)]
        paths = FootPaths.stack(each)
        env.gait = HybridGait(self.robot, FootReference(paths), *self.feedback.bounds(self.robot.coordinates))
        policy: OpenLoop | RaibertController = OpenLoop(len(env.gait.action_names))
        if config.raibert:
            gains: dict[str, Any] = {
                name: np.repeat([values[name] for values in candidates], starts)[:, None] for name in GAIN_RANGES
            }
            policy = RaibertController(self.robot, paths, RaibertConfig(**gains))
        observation, _ = env.reset()
        runs = run_to_end(lambda rows: env.gait.action(policy.feedback(rows)), env, observation)
        done = runs.power + _SPEED_PENALTY * np.maximum(1.0 - runs.speed / config.speed, 0.0)
        return np.where(runs.balanced, done, _FALL_PENALTY * (2.0 - runs.steps / env.task.max_steps)).reshape(
            -1, starts
        )

    def _within_reach(self, point: Array) -> Array:
        """Return a point of the search; resample it while feet would leave the legs' reach."""
        for _ in range(_MAX_RESAMPLES):
            reason = self._infeasibility(self._values(point))
            if not reason:
                return point
            point = self._search.ask(1)[0]
        raise SurefootError(
            f"{_MAX_RESAMPLES} gaits in a row were infeasible, the last one because {reason}; choose a lower speed"
        )

    def _infeasibility(self, values: Mapping[str, float]) -> str:
        """Return the reason that a gait is out of the legs' reach, or an empty string."""
        try:
            HybridGait(self.robot, FootReference(self._paths(values)), *self.feedback.bounds(self.robot.coordinates))
        except SurefootError as error:
            return str(error)
        return ""

    def _values(self, point: Array) -> dict[str, float]:
        return dict(zip(self.ranges, (self._low + self._width * point).tolist(), strict=True))

    def _paths(self, values: Mapping[str, float]) -> FootPaths:
        return foot_config(values, self.config.gait, self.config.speed, self.reach).paths(self.robot)
