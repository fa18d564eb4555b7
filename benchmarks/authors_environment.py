"""Physics steps per second of the authors' own PyBullet environment, one process; needs `pybullet`.

It was written in 2018 for gym, setuptools and protobuf of its time. What it misses of them is put in place here.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
import types
from typing import Any

import numpy as np


def put_the_past_in_place() -> None:
    """Stand-ins for what that environment imports and this time no longer has; none of it is in the timed loop."""
    os.environ["PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION"] = "python"
    for name in ("", ".spaces", ".utils", ".utils.seeding", ".envs"):
        sys.modules[f"gym{name}"] = importlib.import_module(f"gymnasium{name}")
    registration: Any = types.ModuleType("gym.envs.registration")
    registration.registry = types.SimpleNamespace(env_specs={})
    registration.register = registration.make = registration.spec = lambda *_, **__: None
    sys.modules["gym.envs.registration"] = registration
    resources: Any = types.ModuleType("pkg_resources")
    resources.parse_version = importlib.import_module("packaging.version").Version
    sys.modules["pkg_resources"] = resources


def main(seconds: float = 5.0) -> int:
    """Run the environment for some seconds and print its rate."""
    put_the_past_in_place()
    try:
        from pybullet_envs.minitaur.envs import minitaur_gym_env

        env: Any = minitaur_gym_env.MinitaurGymEnv(render=False, log_path=None)
        env.reset()
    except Exception as error:
        print(f"the authors' environment does not run here: {error!r}", file=sys.stderr)
        return 1
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        _, _, done, _ = env.step(np.array([0.1 * np.sin(0.1 * steps)] * 4 + [0.0] * 4))
        steps += 1
        if done:
            env.reset()
    print(steps * env._action_repeat / (time.perf_counter() - start))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
