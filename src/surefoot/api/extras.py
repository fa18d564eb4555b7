"""Packages outside the bare install, and the extra of surefoot that installs each."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from surefoot.errors import SurefootError

P = ParamSpec("P")
T = TypeVar("T")

_EXTRAS = {
    "sim": ("mujoco", "numba", "llvmlite", "gymnasium", "scipy", "pandas", "trimesh", "collada", "fast_simplification"),
    "train": ("torch", "tensordict", "rsl_rl", "onnx", "tensorboard"),
    "report": ("matplotlib", "imageio_ffmpeg", "PIL"),
    "search": ("optuna", "ray", "grpc"),
    "tune": ("cma",),
    "bags": ("rosbags",),
    "page": ("viser", "websockets"),
    "wandb": ("wandb",),
}


def describe_missing(error: ModuleNotFoundError) -> str | None:
    """Return what to install, for a package of one of surefoot's extras that is missing; None for any other."""
    from surefoot.world.registry import WORLDS

    module = (error.name or "").split(".")[0]
    engines = [(entry.extra, (entry.package,)) for entry in WORLDS.values()]
    for extra, modules in [*_EXTRAS.items(), *engines]:
        if module in modules:
            return f"this needs {module}, which is not installed: pip install 'surefoot[{extra}]'"
    return None


def report_missing_extras(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function that says which extra to install where a package is missing, as the commands do."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return function(*args, **kwargs)
        except ModuleNotFoundError as error:
            if hint := describe_missing(error):
                raise SurefootError(hint) from error
            raise

    return call
