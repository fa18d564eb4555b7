"""Gymnasium ids of the tasks that ship with surefoot, such as `surefoot/Gallop-v0`."""

from __future__ import annotations

import re

import gymnasium

from surefoot.task.config import preset_names


def env_id(task: str) -> str:
    """Return the Gymnasium id of a preset: `trot-robust` is `surefoot/TrotRobust-v0`."""
    return f"surefoot/{''.join(word.capitalize() for word in re.split('[-_]', task))}-v0"


def register_envs(single: str, vector: str) -> list[str]:
    """Register every preset; returns the ids.

    Args:
        single: entry point (`module:function`) that makes one robot's environment of `task`.
        vector: entry point that makes the environment of `num_envs` robots of `task`.
    """
    for task in preset_names():
        # No `max_episode_steps`: the task itself truncates episodes.
        gymnasium.register(
            env_id(task),
            entry_point=single,
            vector_entry_point=vector,
            kwargs={"task": task},
            nondeterministic=False,
        )
    return [env_id(task) for task in preset_names()]
