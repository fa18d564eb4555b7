"""Power of learned trots and of the authors' handcrafted trot at the same speed, in the authors' simulator.

    python benchmarks/raibert.py

PyBullet contains the paper authors' simulator of their identified robot, and a trot with Raibert's controller that they
wrote for it. That trot runs at the settings below, which were fixed before the first run, with the authors' gains. The
trots of the study results/reality-gap that were trained with motor model, latencies and pushes (group III of the paper)
are compared with it. A harder baseline runs next to them: the foot trajectories of results/handcrafted, which CMA-ES
tuned for little power in MuJoCo.

All run in one simulator, with the settings of the authors' own example. An episode lasts 6 s. The desired speed of
Raibert's controller rises linearly in the first second. Speed and power are means from 2 s to the end. Speed is along
the heading, because no gait here controls its heading. Settings that fall in an episode are left out. The power of a
baseline at a learned trot's speed is interpolated between a slower and a faster setting: the pair with the minimum.
Means over the gaits that go 0.55 to 0.62 m/s were added after the runs.

Definitions of power, as in benchmarks/power.py, from each servo step of 1 ms:

    duty       sum of |t' w|, with the torque t' that follows from the duty (`reported_each` in results/power)
    absolute   sum of |t w|, with the torque t that acts
    reward     |sum of t w|, as in the reward of surefoot (`mechanical`)
    published  |sum of t' w|, as in the reward of the authors' simulator (`reported`)

Runs are stored in runs.csv; a second call runs only missing ones.
"""

from __future__ import annotations

import itertools
import math
import tarfile
import tempfile
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from authors_environment import has_fallen, make_identified_environment, read_state, settle
from handcrafted import at_equal_speed
from power import Meter, attach

from surefoot.api.policies import find_policy, load_gait
from surefoot.arrays import Array
from surefoot.deploy.controller import Controller
from surefoot.evaluation.statistics import t_interval
from surefoot.policy.contract import Contract
from surefoot.policy.runtime import PolicyRuntime
from surefoot.report.figures.style import COLORS, MARKERS, new_figure
from surefoot.robot import RobotDescription
from surefoot.tables import print_table, read_csv, write_csv
from surefoot.task.config import load_task
from surefoot.task.contract_mapping import contract_from_task

DESIRED_SPEEDS = (0.3, 0.45, 0.6, 0.75, 0.9, 1.05)
STANCE_DURATIONS = (0.15, 0.2, 0.25, 0.3)
STANDING_HEIGHTS = (0.18, 0.21, 0.24)
"""The grid of desired forward speeds [m/s], durations of stance [s] and standing heights [m]."""
AUTHORS_SETTING = (0.25, 0.21)
"""Duration of stance and standing height that the authors' controller has by default."""
SPEED_RANGE = (0.55, 0.62)
"""Range of speeds [m/s] around the paper's trots (0.56 and 0.60 m/s), for means over settings."""
RAMP, SETTLED, END = 1.0, 2.0, 6.0
"""Times of an episode [s]: end of the desired speed's rise, begin of the measurement, end."""
DEFINITIONS = {"duty": "reported_each", "absolute": "absolute", "reward": "mechanical", "published": "reported"}
"""Definitions of power, and their names in `Meter`."""
GROUP = "runs/improved_pushes"
"""Folder of group III in the study's archive."""
FAMILIES = {"raibert": "authors' Raibert trot", "tuned": "tuned by CMA-ES", "learned": "learned, group III"}

Target = Callable[[float], Array]
"""Function from the time in an episode [s] to motor targets (M,) [rad]."""


@dataclass(frozen=True)
class Command:
    """Run missing gaits, write the tables and the figure."""

    folder: Annotated[Path, tyro.conf.Positional] = Path("results/raibert")
    """Folder of the results."""
    archive: Path = Path("results/reality-gap/runs.tar.xz")
    """Archive of the study with the learned trots."""
    tuned: tuple[Path, ...] = tuple(Path(f"results/handcrafted/trot-{speed}.yaml") for speed in (40, 60, 80, 100))
    """Handcrafted gaits that a search tuned."""
    policies: tuple[str, ...] = ("trot",)
    """Other policies, which are in gaits.csv and in no comparison."""
    episodes: int = 3
    """Episodes of each gait, without the grid."""
    grid_episodes: int = 2
    """Episodes of each setting of the grid."""
    seed: int = 1
    """The one seed."""


@dataclass(frozen=True)
class RaibertTrot:
    """The authors' trot at a setting."""

    stance_duration: float
    standing_height: float
    desired_speed: float
    family = "raibert"

    @property
    def name(self) -> str:
        """Name of the setting: duration of stance, height and speed."""
        return f"raibert-{self.stance_duration:g}-{self.standing_height:g}-{self.desired_speed:g}"

    def start(self, env: Any, start: Callable[[Array], None]) -> Target:
        """Let the robot settle in the controller's pose; return the controller."""
        from pybullet_envs.minitaur.envs import minitaur_raibert_controller as authors

        def behavior(speed: float) -> Any:
            return authors.BehaviorParameters(self.stance_duration, speed, standing_height=self.standing_height)

        _, extension = authors.foot_position_to_leg_pose((0, -self.standing_height))
        swing = authors.foot_horizontal_position_to_leg_swing(0, extension)
        start(authors.leg_pose_to_motor_angles([swing] * 4 + [extension] * 4))
        controller = authors.MinitaurRaibertTrottingController(env.minitaur, behavior(0.0))

        def target(moment: float) -> Array:
            controller.behavior_parameters = behavior(self.desired_speed * min(moment / RAMP, 1.0))
            controller.update(moment)
            angles: Array = controller.get_action()
            return angles

        return target


@dataclass(frozen=True)
class PolicyGait:
    """A policy file, or a handcrafted gait (.yaml), with the controller of the robot's computer."""

    name: str
    path: Path
    family: str

    def load(self) -> Any:
        """Return the policy with its contract."""
        if self.path.suffix != ".yaml":
            return PolicyRuntime.load(self.path)
        gait, robot, task, _ = load_gait(self.path, None)
        return types.SimpleNamespace(contract=contract_from_task(task, robot), feedback=gait.feedback)

    def start(self, env: Any, start: Callable[[Array], None]) -> Target:
        """Let the robot settle in the policy's resting pose; return the controller."""
        policy = self.load()
        robot = RobotDescription.load(policy.contract.robot)
        controller = Controller(policy, robot)
        start(robot.pose_angles(*policy.contract.rest))
        return lambda moment: controller.compute_target(moment, controller.observe(moment, read_state(env)))


def gaits(command: Command, folder: Path) -> list[RaibertTrot | PolicyGait]:
    """Return all gaits; the study's policies are unpacked into a folder."""
    with tarfile.open(command.archive) as archive:
        members = [one for one in archive if one.name.startswith(GROUP) and one.name.endswith("policy.onnx")]
        archive.extractall(folder, members, filter="data")
    learned = [folder / one.name for one in sorted(members, key=lambda one: one.name)]
    return [
        *(PolicyGait(f"group-3-{path.parent.name}", path, "learned") for path in learned),
        *(PolicyGait(path.stem, path, "tuned") for path in command.tuned),
        *(PolicyGait(name, find_policy(name), "other") for name in command.policies),
        *itertools.starmap(RaibertTrot, itertools.product(STANCE_DURATIONS, STANDING_HEIGHTS, DESIRED_SPEEDS)),
    ]


def nominal_contract() -> Contract:
    """Return a contract with the gains and delays of the data sheet, as in the authors' example."""
    task, _ = load_task("trot")
    return contract_from_task(task, RobotDescription.load(task.robot))


def run_episode(env: Any, gait: RaibertTrot | PolicyGait, draw: np.random.Generator) -> dict[str, Any]:
    """Return speed and powers of an episode, which are NaN after a fall."""
    task, _ = load_task("trot")
    meter, speeds, step = Meter(), [], env.control_time_step
    target = gait.start(env, lambda pose: settle(env, pose, task, draw))
    for k in range(round(END / step)):
        if k == round(SETTLED / step):
            attach(env, meter)  # Until the next reset, which makes another motor model.
        env.minitaur.Step(target(k * step))
        if has_fallen(env, task):
            return {"fell": 1, "speed": math.nan, "turned": math.nan, **dict.fromkeys(DEFINITIONS, math.nan)}
        yaw = env.minitaur.GetTrueBaseRollPitchYaw()[2]
        velocity, _ = env._pybullet_client.getBaseVelocity(env.minitaur.quadruped)
        speeds.append(velocity[0] * math.cos(yaw) + velocity[1] * math.sin(yaw))
    means, speed = meter.means(), np.mean(speeds[round(SETTLED / step) :])
    return {"fell": 0, "speed": speed, "turned": yaw, **{name: means[one] for name, one in DEFINITIONS.items()}}


def run_gait(env: Any, gait: RaibertTrot | PolicyGait, episodes: int, seed: int) -> list[dict[str, Any]]:
    """Return one row per episode; the starts are the same for all gaits."""
    row = {
        **{"gait": gait.name, "family": gait.family},
        **{name: getattr(gait, name, math.nan) for name in ("stance_duration", "standing_height", "desired_speed")},
    }
    draws = (np.random.default_rng([seed, episode]) for episode in range(episodes))
    return [{**row, "episode": k, **run_episode(env, gait, draw)} for k, draw in enumerate(draws)]


def gait_rows(runs: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per gait: falls, and means over the episodes without a fall."""
    rows = []
    for name in dict.fromkeys(run["gait"] for run in runs):
        own = [run for run in runs if run["gait"] == name]
        whole = [run for run in own if not run["fell"]]
        row = {**own[0], "episodes": len(own), "falls": len(own) - len(whole)}
        for column in ("speed", "turned", *DEFINITIONS):
            row[column] = np.mean([run[column] for run in whole]) if whole else math.nan
        rows.append({column: value for column, value in row.items() if column not in ("episode", "fell")})
    return rows


def comparison(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return how much less power [%] learned trots need than the authors', by each definition.

    `less_power`: at the speed of each training, with its 95 % interval over the trainings, relative to the minimum over
    the grid. `less_in_range`: means of learned trots and of settings of the grid that go `SPEED_RANGE`.
    """
    grid, learned = (
        [row for row in rows if row["family"] == family and not row["falls"]] for family in ("raibert", "learned")
    )
    near_grid, near_learned = (
        [row for row in some if SPEED_RANGE[0] <= row["speed"] <= SPEED_RANGE[1]] for some in (grid, learned)
    )
    table = []
    for definition in DEFINITIONS:
        points = [{**row, "power": row[definition]} for row in grid]
        best = [at_equal_speed(row["speed"], points)[0] for row in learned]
        less = [100 * (1 - row[definition] / power) for row, power in zip(learned, best, strict=True)]
        in_range = [float(np.mean([row[definition] for row in some])) for some in (near_learned, near_grid)]
        table.append(
            {
                "definition": definition,
                **{"learned": np.mean([row[definition] for row in learned]), "best": np.mean(best)},
                **t_interval(less).columns("less_power"),
                "less_power_of_each": ", ".join(f"{one:.0f}" for one in less),
                **{"trots_in_range": len(near_learned), "settings_in_range": len(near_grid)},
                **{"learned_in_range": in_range[0], "settings_power": in_range[1]},
                "least_in_range": min(row[definition] for row in near_grid),
                "less_in_range": 100 * (1 - in_range[0] / in_range[1]),
            }
        )
    return table


def figure(rows: list[dict[str, Any]], path: Path) -> Path:
    """Plot power over speed, one panel per definition; a line connects the authors' default setting."""
    titles = {"duty": "Torque from the duty, each motor", "absolute": "Each motor", "reward": "As in the reward"}
    with new_figure(path, (11.0, 3.6), columns=len(titles)) as (_, axes):
        for ax, definition in zip(axes, titles, strict=True):
            for number, (family, label) in enumerate(FAMILIES.items()):
                own = [row for row in rows if row["family"] == family and not row["falls"]]
                ax.plot(*columns(own, "speed", definition), MARKERS[number], color=COLORS[number], ms=4, label=label)
            default = [row for row in rows if (row["stance_duration"], row["standing_height"]) == AUTHORS_SETTING]
            ax.plot(*columns(default, "speed", definition), color=COLORS[0], label="its default stance and height")
            ax.set(title=titles[definition], xlabel="Speed (m/s)", ylim=(0, None))
        axes[0].set_ylabel("Power (W)")
        axes[0].legend()
    return path


def columns(rows: list[dict[str, Any]], *names: str) -> list[list[float]]:
    """Return columns of a table."""
    return [[row[name] for row in rows] for name in names]


def read_runs(path: Path) -> list[dict[str, Any]]:
    """Return the stored runs."""
    words = ("gait", "family")
    return [{key: one if key in words else float(one or "nan") for key, one in row.items()} for row in read_csv(path)]


def main(command: Command) -> None:
    path = command.folder / "runs.csv"
    with tempfile.TemporaryDirectory() as folder:
        selected = gaits(command, Path(folder))
        env = make_identified_environment(nominal_contract(), remove_default_joint_damping=True, num_steps_to_log=1)
        for gait in selected:
            runs = read_runs(path)
            episodes = command.grid_episodes if gait.family == "raibert" else command.episodes
            if sum(run["gait"] == gait.name for run in runs) < episodes:
                kept = [run for run in runs if run["gait"] != gait.name]
                write_csv(path, [*kept, *run_gait(env, gait, episodes, command.seed)])
                print(f"ran {gait.name}", flush=True)
    names = [gait.name for gait in selected]
    rows = gait_rows(sorted(read_runs(path), key=lambda run: names.index(run["gait"])))
    write_csv(command.folder / "gaits.csv", rows)
    table = comparison(rows)
    write_csv(command.folder / "comparison.csv", table)
    print_table([{key: f"{one:.3g}" if isinstance(one, float) else one for key, one in row.items()} for row in table])
    print(f"wrote {figure(rows, command.folder / 'power.png')}")


if __name__ == "__main__":
    main(tyro.cli(Command))
