"""Process of `rivals.py` that trains mjbatch's Go1 and times bare MuJoCo; it runs in the Python that has mjbatch.

It imports the example `go1_joystick.py` from a clone of mjbatch that the user names, and calls its functions unchanged:
its simulated robots, reward, networks and PPO. Three of its names get other values: `Batch` gets a number of threads,
`POLICY` another file, and `update` is followed by a look at the clock. The module `mujoco_menagerie`, from which the
example takes its robot, is replaced by the robot's file. Nothing of mjbatch is in this repository.

surefoot is not imported: this interpreter need not have it.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import sys
import types
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from processor_time import Stopwatch, time_turn
from rivals_inputs import BLOCK, EVALUATION_SEED, random_targets
from worker_process import WorkerError, serve

EXAMPLE = "go1_joystick"
NAMES = (
    *("Batch", "Go1", "ActorCritic", "build_model", "train", "update", "progress", "SEED", "POLICY", "TIMESTEP"),
    *("CTRL_DT", "HORIZON", "NUM_ENVS", "STAND"),
)
"""What the example must have."""
_ROLLOUT = 10
"""Control steps in one call of `mujoco.rollout`, which plans ahead; the other layers receive one at a time."""


class _Enough(Exception):
    """Ends a training."""


def about(clone: str, model: str) -> dict[str, str]:
    """Return the versions of this side; reject a clone without the example, or an example of another kind."""
    _example(clone, model)
    return {name: importlib.metadata.version(name) for name in ("mjbatch", "mujoco", "torch")}


@cache
def _example(clone: str, model: str) -> Any:
    """Return the example's module, whose robot is a given MJCF."""
    import mujoco

    folder = Path(clone) / "examples"
    if not (folder / f"{EXAMPLE}.py").is_file():
        raise WorkerError(f"--mjbatch {clone}: it has no examples/{EXAMPLE}.py; name a clone of mjbatch 0.1.4")
    menagerie: Any = types.ModuleType("mujoco_menagerie")
    robot = types.SimpleNamespace(spec=lambda *_: mujoco.MjSpec.from_file(model))
    menagerie.get = lambda *_: robot
    sys.modules["mujoco_menagerie"] = menagerie
    sys.path.insert(0, str(folder))
    try:
        example: Any = importlib.import_module(EXAMPLE)
    except ImportError as error:
        raise WorkerError(
            f"--mjbatch-python {sys.executable}: can't import {folder / EXAMPLE}.py: {error}; install mjbatch 0.1.4, "
            "torch and what else its examples need"
        ) from error
    if missing := [name for name in NAMES if not hasattr(example, name)]:
        raise WorkerError(
            f"{folder / EXAMPLE}.py: has no {', '.join(missing)}; this benchmark knows the example of mjbatch 0.1.4"
        )
    example.progress = lambda *_, **__: None
    return example


def train(
    clone: str,
    model: str,
    seed: int,
    threads: int,
    times: list[float],
    commands: list[tuple[float, float, float]],
    seconds: float,
    folder: str,
) -> list[dict[str, Any]]:
    """Train with the example's own loop, and write what the deterministic policy does at points of its clock.

    Its weights are kept at these points, which takes a millisecond that is not counted, and evaluated after the
    training. The clock begins before the robots are made.

    Args:
        clone: folder of the clone.
        model: MJCF of the robot.
        seed: seed of the training.
        threads: threads of simulation and learning.
        times: wall times of training [s].
        commands: a command for each evaluated robot [m/s, m/s, rad/s].
        seconds: duration of a command [s].
        folder: where poses are written; see `command_following.command_errors`.

    Returns:
        One row per point; fewer than times if the example's own number of iterations ends earlier.
    """
    import torch

    example = _example(clone, model)
    torch.set_num_threads(threads)
    example.Batch = partial(example.Batch, num_threads=threads)
    example.SEED, example.POLICY = seed, str(Path(folder) / "policy.pt")
    watch, left, iterations = Stopwatch(), list(times), 0
    points: list[tuple[dict[str, Any], dict[str, Any]]] = []
    own_update = example.update

    def update(network: Any, *others: Any) -> Any:
        nonlocal left, iterations
        result = own_update(network, *others)
        iterations += 1
        if watch.wall >= left[0]:
            watch.stop()
            row = {**watch.times(), "samples": iterations * example.HORIZON * example.NUM_ENVS}
            points.append((row, {name: values.clone() for name, values in network.state_dict().items()}))
            left = [time for time in left if time > watch.wall]
            if not left:
                raise _Enough
            watch.start()
        return result

    example.update = update
    watch.start()
    with suppress(_Enough):
        example.train()
    for k, (row, weights) in enumerate(points):
        row["nominal"] = str(Path(folder) / f"nominal-{k}.npz")
        _write_poses(example, weights, commands, seconds, row["nominal"])
    return [row for row, _ in points]


def _write_poses(
    example: Any, weights: dict[str, Any], commands: list[tuple[float, float, float]], seconds: float, path: str
) -> None:
    """Write time (T + 1, N) [s], position (T + 1, N, 3) [m] and orientation (T + 1, N, 4) of robots with commands.

    The robots are those of the example's training, from its own start; they observe the true velocity of the base. No
    robot is reset after a fall.
    """
    import torch

    actor = example.ActorCritic()
    actor.load_state_dict(weights)
    env = example.Go1(len(commands), seed=EVALUATION_SEED)
    env.command[:], env.until[:] = commands, np.inf
    poses = [env.qpos[:, :7].copy()]
    with torch.no_grad():
        for _ in range(round(seconds / example.CTRL_DT)):
            action, _ = actor(torch.as_tensor(env.obs()))
            env.step(action.numpy())
            poses.append(env.qpos[:, :7].copy())
    rows = np.array(poses, float)
    time = np.repeat(example.CTRL_DT * np.arange(len(rows))[:, None], len(commands), axis=1)
    np.savez(path, time=time, position=rows[:, :, :3], quat=rows[:, :, 3:])


def turn(
    layer: str, clone: str, model: str, timestep: float, num_envs: int, threads: int, seconds: float
) -> dict[str, Any]:
    """Time control steps of a layer (`mjbatch` or `rollout`) for some wall time; return physics steps and times.

    Args:
        layer: `mjbatch` or `rollout`.
        clone: folder of the clone.
        model: MJCF of the robot.
        timestep: step of the physics [s].
        num_envs: number of robots.
        threads: threads of the simulation.
        seconds: wall time [s].
    """
    step, physics_steps = _layer(layer, clone, model, timestep, num_envs, threads)
    return time_turn(step, physics_steps, seconds)


@cache
def _layer(
    layer: str, clone: str, model: str, timestep: float, num_envs: int, threads: int
) -> tuple[Callable[[int], object], int]:
    """Return a function that runs the k-th control step of all robots, and the steps of physics in it.

    Both layers have the example's own model, start at its keyframe, and receive the same random motor angles.
    """
    import mujoco
    import mujoco.rollout

    example = _example(clone, model)
    count = round(example.CTRL_DT / timestep)
    own_timestep, example.TIMESTEP = example.TIMESTEP, timestep
    try:
        compiled = example.build_model()
    finally:
        example.TIMESTEP = own_timestep
    targets = random_targets(example.STAND, num_envs)
    if layer == "mjbatch":
        batch = example.Batch(compiled, num_envs, num_threads=threads)
        batch.reset(np.arange(num_envs), keyframe=0)
        ctrl = batch.bind("ctrl")

        def step(k: int) -> None:
            ctrl[:] = targets[k % BLOCK]
            batch.step(nstep=count)
    else:
        kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
        datas = [mujoco.MjData(compiled) for _ in range(threads)]
        mujoco.mj_resetDataKeyframe(compiled, datas[0], 0)
        size = mujoco.mj_stateSize(compiled, kind)
        start = np.empty(size)
        mujoco.mj_getState(compiled, datas[0], start, kind)
        length = _ROLLOUT * count
        states, initial = np.empty((num_envs, length, size)), np.tile(start, (num_envs, 1))
        sensors = np.empty((num_envs, length, compiled.nsensordata))
        held = np.repeat(targets[:_ROLLOUT].transpose(1, 0, 2), count, axis=1)
        roll = mujoco.rollout.Rollout(nthread=threads)
        models = [compiled] * num_envs

        def step(k: int) -> None:
            roll.rollout(models, datas, initial, held, nstep=length, state=states, sensordata=sensors)
            initial[:] = states[:, -1]

        count = length

    step(0)
    return step, num_envs * count


if __name__ == "__main__":
    serve({one.__name__: one for one in (about, train, turn)})
