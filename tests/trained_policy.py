"""A very short training of the trot, shared by all tests; it is repeated if the sources or pinned versions change."""

from __future__ import annotations

import fcntl
import hashlib
import shutil
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
# These few updates include noise, pushes, ends of episodes and an evaluation.
TINY: dict[str, Any] = {
    "num_envs": 16,
    "steps_per_update": 16,
    "steps": 16 * 16 * 5,
    "evaluate_every": 600,
    "evaluation_episodes": 2,
    "checkpoint_every": 512,
    "threads": 1,
    "learning_threads": 1,
    "task": {
        "max_steps": 40,
        "params": {"imu_noise": 0.02},
        "pushes": {"enabled": True, "period": 0.1, "duration": 0.03},
    },
}
"""Settings of `trot`."""


def digest() -> str:
    """Return a hash of the package's sources, the pinned versions and this file."""
    content = hashlib.sha256()
    sources = (path for path in (ROOT / "src").rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    for path in sorted([*sources, ROOT / "constraints.txt", Path(__file__)]):
        content.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return content.hexdigest()[:16]


def trained_run(folder: Path) -> Path:
    """Return the run folder, in a folder of such runs; one process trains while others wait for it."""
    from surefoot.configuration import from_mapping
    from surefoot.learn.config import TrainConfig, load_train_config
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop
    from surefoot.world.sim_world import SimWorld

    run = folder / digest()
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not run.exists():
            for former in filter(Path.is_dir, folder.iterdir()):
                shutil.rmtree(former)
            config = from_mapping(TrainConfig, TINY, base=load_train_config("trot"))
            training = RunFolder.create_at(config, folder / "training")
            TrainingLoop.create(config, training, SimWorld).run(lambda *_: None)
            training.path.rename(run)
    return run
