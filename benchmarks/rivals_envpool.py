"""Process of `rivals.py` that times EnvPool's own Go1; it runs in the Python that has EnvPool.

The environment is EnvPool's port of MuJoCo Playground's `Go1JoystickFlatTerrain`: control steps of 20 ms with five
steps of the physics. surefoot is not imported: this interpreter need not have it.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import sys
from functools import cache
from typing import Any

import numpy as np
from processor_time import time_turn
from rivals_inputs import BLOCK, random_actions
from worker_process import WorkerError, serve

TASK = "Go1JoystickFlatTerrain-v1"
PHYSICS_STEPS = 5
"""Steps of the physics in a control step."""


def about() -> dict[str, str]:
    """Return the version; reject an interpreter without EnvPool, or an EnvPool without this environment."""
    try:
        _environment(2, 1)[0].step(np.zeros((2, 12)))
    except Exception as error:  # EnvPool raises various kinds
        text = " ".join(str(error).split())
        raise WorkerError(
            f"--envpool-python {sys.executable}: can't make {TASK}: {text}; install envpool 1.2.7 there, or leave the "
            "option out"
        ) from error
    return {"envpool": importlib.metadata.version("envpool")}


@cache
def _environment(num_envs: int, threads: int) -> tuple[Any, Any]:
    """Return an environment after its reset, and random actions (BLOCK, N, A)."""
    envpool = importlib.import_module("envpool")
    env = envpool.make_gymnasium(TASK, num_envs=num_envs, num_threads=threads, seed=0)
    env.reset()
    return env, random_actions(num_envs, env.action_space.shape[-1])


def turn(num_envs: int, threads: int, seconds: float) -> dict[str, Any]:
    """Time control steps for some wall time; see `time_turn`."""
    env, actions = _environment(num_envs, threads)
    return time_turn(lambda k: env.step(actions[k % BLOCK]), num_envs * PHYSICS_STEPS, seconds)


if __name__ == "__main__":
    serve({one.__name__: one for one in (about, turn)})
