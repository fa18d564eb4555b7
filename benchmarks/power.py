"""Power of gaits by several definitions, compared with the paper.

    python benchmarks/power.py

The paper reports 189 W at 1.18 m/s (gallop) and 72 W at 0.60 m/s (trot). It does not say how it measured its robot's
power. All definitions here are computed from the same servo steps of 1 ms, with duty d, current I, speed w and torque t
of each motor, and are means over time:

    mechanical     |sum of t w|, as in surefoot's reward and evaluations
    positive       sum of t w over motors with positive power
    absolute       sum of |t w|
    copper         sum of R I^2
    electrical     sum of d V I: net power from the battery
    reported       |sum of t' w| with t' = K_t d V / R, at most 5.7 N m: the torque that the authors' simulator reports
                   (`observed_torque` in its motor.py) and uses in its reward, without back-EMF and saturation
    reported_end   the same, only in the last servo step of each control step
    reported_each  sum of |t' w|

A row is called GAIT, or GAIT/CONDITION. `published-trot` and `published-gallop` are the paper authors' policies in
`pybullet_data`, in the simulator that they published (needs `pybullet`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from authors_environment import install_legacy_stubs

from surefoot.actuator.motor import motor_current, servo_duty
from surefoot.api.policies import find_policy, load_gait
from surefoot.arrays import Array
from surefoot.evaluation.conditions import undisturbed_task
from surefoot.evaluation.rollout import run_to_end
from surefoot.tables import print_table, read_csv, write_csv
from surefoot.task.env import LocomotionEnv
from surefoot.world.registry import find_world

CONDITIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "mujoco": ("mujoco", {}),
    "friction": ("mujoco", {"motor_friction": 0.05}),  # the upper end of table I
    "bullet": ("bullet", {}),
    "ensemble": ("ensemble", {}),
}
"""World and physical parameters of each condition."""
IN_ALL = ("trot", "gallop")
"""Gaits that run in all conditions; other gaits run only in MuJoCo."""
LIMIT = 5.7
"""Maximum torque that the authors' simulator reports [N m]."""
PUBLISHED = {
    "published-trot": ("minitaur_trotting_env", "MinitaurTrottingEnv"),
    "published-gallop": ("minitaur_reactive_env", "MinitaurReactiveEnv"),
}
"""The authors' policies: folder, module and environment of each."""


@dataclass(frozen=True)
class Command:
    """Measure, print the table and write it."""

    gaits: Annotated[tuple[str, ...], tyro.conf.Positional] = (
        *("trot", "trot-robust", "gallop", "gallop-robust"),
        "results/handcrafted/gallop-120.yaml",
        *(f"results/handcrafted/{name}.onnx" for name in ("gallop-hybrid-seed_0", "gallop-120-learned")),
        *PUBLISHED,
    )
    """Names of released policies, policy files, handcrafted gaits (.yaml), published-trot and published-gallop. The
    table keeps its rows for other gaits."""
    out: Path = Path("results/power.csv")
    episodes: int = 20
    """Episodes in each condition, of 1000 control steps or until a fall."""
    seed: int = 1
    """The one seed."""


class Meter:
    """Sums over servo steps of power by all definitions [W], for a batch of robots with M motors."""

    def __init__(self) -> None:
        self._sums: dict[str, Any] = defaultdict(float)

    def add(self, duty: Array, speed: Array, torque: Array, motor: Any, going: Any = True, last: Any = True) -> None:
        """Add a servo step; arrays are (N, M).

        Args:
            duty: duty of the servo, -1 to 1.
            speed: motor speeds [rad/s].
            torque: motor torques before friction [N m].
            motor: K_t [N m/A], R [Ohm] and V [V], numbers or (N, 1); limit of the net voltage [V].
            going: whether a robot counts (N,).
            last: whether this is a robot's last servo step of a control step (N,).
        """
        constant, resistance, voltage, clip = motor
        current = motor_current(duty, speed, voltage, constant, resistance, clip)
        reported = np.clip(constant * duty * voltage / resistance, -LIMIT, LIMIT)
        work = torque * speed
        powers = {
            "mechanical": np.abs(work.sum(1)),
            "positive": work.clip(0).sum(1),
            "absolute": np.abs(work).sum(1),
            "copper": (resistance * current**2).sum(1),
            "electrical": (duty * voltage * current).sum(1),
            "reported": np.abs((reported * speed).sum(1)),
            "reported_each": np.abs(reported * speed).sum(1),
        }
        for name, power in powers.items():
            self._sums[name] += power * going
        self._sums["reported_end"] += powers["reported"] * last
        self._sums["steps"] += going
        self._sums["ends"] += last

    def means(self) -> dict[str, float]:
        """Return the means over time and robots."""
        sums = dict(self._sums)
        steps, ends = sums.pop("steps"), sums.pop("ends")
        return {name: float(np.mean(one / (ends if name == "reported_end" else steps))) for name, one in sums.items()}


def measure(path: Path, condition: str, command: Command) -> dict[str, Any]:
    """Return the row of a gait in a condition."""
    name, params = CONDITIONS[condition]
    policy, _, task, _ = load_gait(path, None)
    task = undisturbed_task(replace(task, params={**task.params, **params}))
    env = LocomotionEnv(task, command.episodes, find_world(name), command.seed, autoreset=False, threads=1)
    observation, _ = env.reset()
    meter = Meter()
    world: Any = env.world
    state, motors, advance = world.actuation, world.robot.num_motors, world.engine.advance
    each = (state.torque_constant, state.resistance, state.voltage, state.voltage_clip)
    motor = tuple(one[:, None] for one in each)

    def advance_and_measure(servo_steps: Array) -> None:
        for k in range(int(servo_steps.max(initial=0))):
            speed = state.sample[:, motors : 2 * motors].copy()
            advance((servo_steps > k).astype(np.int64))
            angle, read_speed = state.servo_sample[:, :motors], state.servo_sample[:, motors:]
            duty = servo_duty(state.target, angle, read_speed, state.kp, state.kd)
            meter.add(duty, speed, state.motor_torque, motor, servo_steps > k, servo_steps == k + 1)

    world.engine.advance = advance_and_measure
    runs = run_to_end(lambda seen: env.gait.action(policy.feedback(seen)), env, observation)
    del world.engine.advance  # Its cycle of references would keep the world, and a client of Bullet for each robot.
    falls = int(runs.fell.sum())
    name = path.stem if condition == "mujoco" else f"{path.stem}/{condition}"
    return {"name": name, "episodes": len(runs), "falls": falls, "speed": runs.speed.mean(), **meter.means()}


def read_checkpoint(path: Path) -> dict[str, Array]:
    """Return the tensors of a TensorFlow checkpoint (path of its .index) as flat float32 arrays.

    The index is a LevelDB table of blocks: keys with common prefixes, and protocol buffers as values.
    """
    index = path.read_bytes()
    data = path.with_suffix(".data-00000-of-00001").read_bytes()

    def varint(at: int) -> tuple[int, int]:
        value = shift = 0
        while True:
            byte, at = index[at], at + 1
            value, shift = value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value, at

    def block(at: int, size: int) -> dict[bytes, int]:
        """Return the start of each key's value in a block."""
        end, key, places = at + size - 4 - 4 * int.from_bytes(index[at + size - 4 : at + size], "little"), b"", {}
        while at < end:
            shared, at = varint(at)
            own, at = varint(at)
            length, at = varint(at)
            key = key[:shared] + index[at : at + own]
            places[key] = at + own
            at += own + length
        return places

    _, at = varint(len(index) - 48)
    _, at = varint(at)
    start, at = varint(at)
    size, _ = varint(at)
    tensors = {}
    for place in block(start, size).values():
        start, place = varint(place)
        for key, at in block(start, varint(place)[0]).items():
            if key:  # The entry without a name is of the whole checkpoint.
                # Type (2 bytes), shape (its length in the second byte), then offset and size behind their tags.
                at += 4 + index[at + 3]
                offset, at = varint(at + 1) if index[at] == 0x20 else (0, at)
                size, _ = varint(at + 1)
                tensors[key.decode()] = np.frombuffer(data[offset : offset + size], "<f4")
    return tensors


def measure_published(name: str, command: Command) -> dict[str, Any]:
    """Return the row of an authors' policy in their environment, with its own starts and fall angle (0.3 rad)."""
    import pybullet_data

    module, class_name = PUBLISHED[name]
    folder = Path(pybullet_data.getDataPath()) / "policies/ppo" / module
    env = getattr(import_module(f"pybullet_envs.minitaur.envs.{module}"), class_name)(urdf_version="rainbow_dash_v0")
    tensors = read_checkpoint(next(folder.glob("*.index")))
    count = tensors["normalize_observ/Variable"].view("<i4")[0]
    mean, squares = (tensors[f"normalize_observ/Variable_{k}"] for k in (1, 2))
    deviation = np.sqrt(squares / (count - 1) + 1e-4) + 1e-8
    layers = []
    for layer in ("fully_connected", "fully_connected_1", "fully_connected_2"):
        weights, biases = (tensors[f"network/rnn/policy/{layer}/{part}"] for part in ("weights", "biases"))
        layers.append((weights.reshape(-1, len(biases)), biases))
    low, high = env.observation_space.low, env.observation_space.high
    meter, runs = Meter(), []
    for _ in range(command.episodes):
        observation, done, steps = env.reset(), False, 0
        detach = attach(env, meter)
        start = env.minitaur.GetBasePosition()[0]
        while not done and steps < 1000:
            x = np.clip((2 * (observation - low) / (high - low) - 1 - mean) / deviation, -5, 5)
            for number, (weights, biases) in enumerate(layers, start=1):
                x = x @ weights + biases
                x = np.tanh(x) if number == len(layers) else np.maximum(x, 0)
            observation, _, done, _ = env.step(x * env.action_space.high)
            steps += 1
        detach()
        runs.append(((env.minitaur.GetBasePosition()[0] - start) / (steps * env.control_time_step), done))
    speed, falls = np.mean([one for one, _ in runs]), sum(fell for _, fell in runs)
    return {"name": name, "episodes": len(runs), "falls": falls, "speed": speed, **meter.means()}


def attach(env: Any, meter: Meter) -> Callable[[], None]:
    """Make the authors' motor model report each servo step to the meter; return a function that detaches the meter."""
    from pybullet_envs.minitaur.envs import motor as constants

    model, steps = env.minitaur._motor_model, env._action_repeat
    convert, calls = type(model)._convert_to_torque_from_pwm, [0]
    motor = (constants.MOTOR_TORQUE_CONSTANT, constants.MOTOR_RESISTANCE, constants.MOTOR_VOLTAGE)

    def convert_and_measure(duty: Array, speed: Array) -> tuple[Array, Array]:
        torque, reported = convert(model, duty, speed)
        calls[0] += 1
        rows = np.array([[duty], [speed], [torque]])
        meter.add(rows[0], rows[1], rows[2], (*motor, constants.VOLTAGE_CLIPPING), last=calls[0] % steps == 0)
        return torque, reported

    model._convert_to_torque_from_pwm = convert_and_measure
    return partial(delattr, model, "_convert_to_torque_from_pwm")


def main(command: Command) -> None:
    table = read_csv(command.out)
    kept = [{key: one if key == "name" else float(one) for key, one in row.items()} for row in table]
    rows: list[dict[str, Any]] = []
    install_legacy_stubs()
    for gait in command.gaits:
        if gait in PUBLISHED:
            rows.append(measure_published(gait, command))
            continue
        path = Path(gait) if Path(gait).suffix else find_policy(gait)
        rows += [measure(path, one, command) for one in CONDITIONS if one == "mujoco" or path.stem in IN_ALL]
    done = {row["name"].partition("/")[0] for row in rows}
    rows = [row for row in kept if str(row["name"]).partition("/")[0] not in done] + rows
    write_csv(command.out, rows)
    print_table([{key: f"{one:.3g}" if isinstance(one, float) else one for key, one in row.items()} for row in rows])


if __name__ == "__main__":
    main(tyro.cli(Command))
