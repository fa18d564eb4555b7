"""Compare the same robot in MuJoCo and in Bullet: draw one figure per question, and write a table.

python examples/compare_worlds.py --table results/compare_worlds.csv

masses    do mass and inertia of the whole robot agree?
standing  how high does it stand after it has settled?
drop      how does it land from 0.3 m, and how much does each world differ from a simulation with a step of 0.1 ms?
sines     do legs on a rack follow sines equally?
steps     do they respond equally to steps?
squat     does the robot squat equally on its own feet?
trot      how far does an open-loop trot go, and what is the effect of spinning friction?

Columns mujoco and bullet are each world's value; `apart` is their difference, or the difference of motor angles over
time.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.figure import Figure

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.rotations import xyzw_matrix
from surefoot.tables import print_table, write_csv
from surefoot.world.bullet_model import import_pybullet
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

ENGINES = {"MuJoCo": "mujoco", "Bullet": "bullet"}
COLOURS = {"MuJoCo": "#1f6f8b", "Bullet": "#d1495b", "target": "#555555"}
MotorPath = Callable[[float], np.ndarray]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


class Comparison:
    """Runs both worlds, draws figures, and collects the rows of the table."""

    def __init__(self, folder: Path) -> None:
        self.robot = RobotDescription.load("minitaur")
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.rows: list[dict[str, object]] = []

    def add(self, quantity: str, unit: str, both: Sequence[float] = (), apart: float | None = None) -> None:
        """Add a row; `both` are the values in MuJoCo and in Bullet."""
        mujoco, bullet = both or (None, None)
        apart = both[1] - both[0] if apart is None else apart
        self.rows.append({"quantity": quantity, "unit": unit, "mujoco": mujoco, "bullet": bullet, "apart": apart})

    def worlds(self, robot: RobotDescription | None = None, rack: bool = False) -> dict[str, SimWorld]:
        robot = robot or self.robot
        params = PhysicalParams.nominal(robot).with_values(robot, control_step=0.001)
        config = WorldConfig(rack=rack, threads=1)
        return {name: SimWorld(robot, 1, params, config=config, engine=engine) for name, engine in ENGINES.items()}

    def run(self, world: SimWorld, path: MotorPath, seconds: float) -> dict[str, np.ndarray]:
        """Return time, base position, motor angles and penetration of the feet, every millisecond."""
        rows = []
        for k in range(round(seconds / 0.001)):
            world.step(path(0.001 * k))
            truth = world.truth()
            depth = self.robot.five_bar.foot_radius - world.foot_positions()[0, :, 2]
            rows.append(np.concatenate([[0.001 * (k + 1)], truth.base_position_world[0], truth.motor_angle[0], depth]))
        table = np.array(rows)
        return {"time": table[:, 0], "base": table[:, 1:4], "angles": table[:, 4:12], "depth": table[:, 12:]}

    def rest(self, _time: float) -> np.ndarray:
        return self.robot.resting_angles

    def figure(self, name: str, title: str, rows: int = 1) -> tuple[Figure, np.ndarray]:
        figure, axes = plt.subplots(rows, 1, figsize=(8, 2.2 + 1.6 * rows), sharex=True, squeeze=False)
        axes[0, 0].set_title(title, loc="left")
        axes[-1, 0].set_xlabel("time [s]")
        figure.set_label(name)
        return figure, axes[:, 0]

    def save(self, figure: Figure) -> None:
        for axes in figure.axes:
            axes.grid(alpha=0.3)
        figure.axes[0].legend(loc="upper right", fontsize=8)
        figure.tight_layout()
        figure.savefig(self.folder / f"{figure.get_label()}.png", dpi=120)
        plt.close(figure)

    def masses(self) -> None:
        bodies = {}
        for name, world in self.worlds().items():
            engine = world.engine
            engine.set_state(np.array([0]), engine.initial_state)
            bodies[name] = composite(mujoco_parts(engine) if name == "MuJoCo" else bullet_parts(engine))
        masses, centres, inertias = zip(*bodies.values(), strict=True)
        self.add("mass", "kg", masses)
        self.add("centre of mass", "m", apart=np.abs(centres[1] - centres[0]).max())
        for k, axis in enumerate(("roll", "pitch", "yaw")):
            self.add(f"{axis} inertia", "kg m2", [tensor[k, k] for tensor in inertias])
        self.add("inertia (greatest element)", "kg m2", apart=np.abs(inertias[1] - inertias[0]).max())
        figure, axes = plt.subplots(figsize=(6, 3))
        for k, (name, (_, _, tensor)) in enumerate(bodies.items()):
            axes.bar(np.arange(3) + 0.4 * k - 0.2, np.diag(tensor), 0.38, color=COLOURS[name], label=name)
        axes.set_xticks(range(3), ["roll (xx)", "pitch (yy)", "yaw (zz)"])
        axes.set_ylabel("inertia [kg m$^2$]")
        axes.set_title("Inertia of the whole robot in its resting pose", loc="left")
        figure.set_label("masses")
        self.save(figure)

    def standing(self) -> None:
        figure, axes = self.figure("standing", "Height of the base while the robot settles on its feet")
        heights, depths = [], []
        for name, world in self.worlds().items():
            run = self.run(world, self.rest, 1.0)
            axes[0].plot(run["time"], 1e3 * run["base"][:, 2], color=COLOURS[name], label=name)
            heights.append(1e3 * run["base"][-1, 2])
            depths.append(1e3 * run["depth"][-1].mean())
        self.add("height of the base", "mm", heights)
        self.add("depth of the feet", "mm", depths)
        axes[0].set_ylabel("height [mm]")
        self.save(figure)

    def drop(self) -> None:
        """Compare the landing with the data sheet's spring and damper; a step of 0.1 ms shows each world's own law."""
        fine = replace(self.robot, timing=replace(self.robot.timing, servo_step=1e-4))
        figure, axes = self.figure("drop", "A drop from 0.3 m; dashed: the same with a step of 0.1 ms", 2)
        depths, errors = [], []
        for name in ENGINES:
            runs = []
            for robot, style in ((self.robot, "-"), (fine, "--")):
                world = self.worlds(robot)[name]
                lift(world, 0.3)
                run = self.run(world, self.rest, 0.6)
                runs.append(run)
                label = name if style == "-" else None
                axes[0].plot(run["time"], 1e3 * run["base"][:, 2], style, color=COLOURS[name], label=label)
                axes[1].plot(run["time"], 1e3 * run["depth"][:, 0], style, color=COLOURS[name])
            depths.append([1e3 * run["depth"][:, :2].max(axis=0) for run in runs])
            errors.append(1e3 * rms(runs[0]["base"][:, 2] - runs[1]["base"][:, 2]))
        for leg, feet in enumerate(("front", "back")):
            for k, step in enumerate(("", " with a step of 0.1 ms")):
                self.add(f"{feet} feet in a drop{step}", "mm", [both[k][leg] for both in depths])
        self.add("base in a drop against a step of 0.1 ms (RMS)", "mm", errors)
        axes[0].set_ylabel("base [mm]")
        axes[1].set_ylabel("front foot's depth [mm]")
        axes[1].set_ylim(-5, None)
        self.save(figure)

    def compare_angles(self, name: str, title: str, path: MotorPath, rack: bool, seconds: float = 1.2) -> None:
        runs = {key: self.run(world, path, seconds) for key, world in self.worlds(rack=rack).items()}
        figure, axes = self.figure(name, title, len(self.robot.legs))
        for leg, axis in enumerate(axes):
            motor = self.robot.leg_motor_index[leg, 0]
            time = runs["MuJoCo"]["time"]
            axis.plot(time, [path(t)[motor] for t in time], color=COLOURS["target"], lw=0.8, ls=":", label="target")
            for key, run in runs.items():
                axis.plot(time, run["angles"][:, motor], color=COLOURS[key], label=key)
            axis.set_ylabel(f"{self.robot.leg_names[leg]}\nmotor 1 [rad]", fontsize=7)
        self.save(figure)
        apart = runs["Bullet"]["angles"] - runs["MuJoCo"]["angles"]
        self.add(f"{name} (RMS)", "rad", apart=rms(apart))
        self.add(f"{name} (greatest)", "rad", apart=np.abs(apart).max())

    def sines(self) -> None:
        def path(time: float) -> np.ndarray:
            phase = 2 * np.pi * np.array([1.0, 2.0, 3.0, 4.0]) * time
            return self.robot.pose_angles(0.3 * np.sin(phase), 2.0 + 0.3 * np.sin(0.7 * phase))

        self.compare_angles("sines", "Legs on a rack follow sines", path, rack=True)

    def steps(self) -> None:
        def path(time: float) -> np.ndarray:
            size = np.array([0.1, 0.2, 0.3, 0.4]) * ((time >= 0.2) - 2.0 * (time >= 0.7))
            return self.robot.pose_angles(size, 2.0 - 0.3 * size)

        self.compare_angles("steps", "Legs on a rack respond to steps", path, rack=True)

    def squat(self) -> None:
        def path(time: float) -> np.ndarray:
            return self.robot.pose_angles(np.zeros(4), np.full(4, 2.0 + 0.3 * np.sin(2 * np.pi * 2 * time)))

        self.compare_angles("squat", "The robot squats on its own feet", path, rack=False)

    def trot(self) -> None:
        def path(time: float) -> np.ndarray:
            phase = 2 * np.pi * 2.0 * time + np.array([0, np.pi, np.pi, 0])
            return self.robot.pose_angles(0.3 * np.sin(phase), 2.0 + 0.35 * np.sin(phase))

        sheet = self.robot.contact
        free = replace(self.robot, contact=replace(sheet, spinning_friction=0.0))
        figure, axes = self.figure("trot", "An open loop trot", 2)
        for robot, style, without in ((self.robot, "-", ""), (free, "--", " without spinning friction")):
            runs = {name: self.run(world, path, 3.0) for name, world in self.worlds(robot).items()}
            for name, run in runs.items():
                axes[0].plot(run["time"], run["base"][:, 0], style, color=COLOURS[name], label=name + without)
                axes[1].plot(run["time"], 1e3 * run["base"][:, 2], style, color=COLOURS[name])
            self.add(f"trot in 3 s{without}", "m", [run["base"][-1, 0] for run in runs.values()])
        axes[0].set_ylabel("forward [m]")
        axes[1].set_ylabel("height [mm]")
        self.save(figure)


def lift(world: SimWorld, height: float) -> None:
    """Raise the robot by a height [m]."""
    world.engine.move_base(np.array([0]), np.array([[0.0, 0.0, height]]))


Parts = list[tuple[float, np.ndarray, np.ndarray]]


def mujoco_parts(engine: object) -> Parts:
    """Return mass, centre and inertia in the world frame of every body."""
    model, data = engine.models[0], engine.datas[0]  # type: ignore[attr-defined]
    mujoco.mj_forward(model, data)
    turns = data.ximat.reshape(-1, 3, 3)
    return [
        (model.body_mass[b], data.xipos[b].copy(), turns[b] @ np.diag(model.body_inertia[b]) @ turns[b].T)
        for b in range(1, model.nbody)
    ]


def bullet_parts(engine: object) -> Parts:
    """Return mass, centre and inertia in the world frame of every link."""
    p, model = import_pybullet(), engine.models[0]  # type: ignore[attr-defined]
    parts = []
    for link in model.links.values():
        info = p.getDynamicsInfo(model.body, link, model.client)
        place, quat = (
            p.getBasePositionAndOrientation(model.body, model.client)
            if link < 0
            else p.getLinkState(model.body, link, computeForwardKinematics=1, physicsClientId=model.client)[:2]
        )
        turn = xyzw_matrix(np.array(quat))
        parts.append((info[0], np.array(place), turn @ np.diag(info[2]) @ turn.T))
    return parts


def composite(parts: Parts) -> tuple[float, np.ndarray, np.ndarray]:
    """Return total mass, centre of mass, and inertia about it."""
    mass = float(sum(part[0] for part in parts))
    centre = np.sum([m * at for m, at, _ in parts], axis=0) / mass
    away = [at - centre for _, at, _ in parts]
    inertias = [i + m * (d @ d * np.eye(3) - np.outer(d, d)) for (m, _, i), d in zip(parts, away, strict=True)]
    return mass, centre, np.sum(inertias, axis=0)


def main() -> int:
    """Run all comparisons."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/worlds"), help="folder for the figures")
    parser.add_argument("--table", type=Path, default=Path("out/worlds/compare_worlds.csv"), help="table to write")
    arguments = parser.parse_args()
    comparison = Comparison(arguments.out)
    for question in ("masses", "standing", "drop", "sines", "steps", "squat", "trot"):
        getattr(comparison, question)()
    rows = comparison.rows
    print_table([{key: f"{x:.5g}" if isinstance(x, float) else x or "" for key, x in row.items()} for row in rows])
    print(f"figures in {comparison.folder}, table {write_csv(arguments.table, rows)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
