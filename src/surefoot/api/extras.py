"""Optional packages, and the extras of surefoot that install them."""

from __future__ import annotations

import functools
import json
import shlex
from collections.abc import Callable
from typing import ParamSpec, TypeVar
from urllib.parse import unquote, urlsplit

from surefoot.errors import SurefootError

P = ParamSpec("P")
T = TypeVar("T")

_EXTRAS = {
    "sim": (
        *("mujoco", "numba", "llvmlite", "gymnasium", "scipy", "pandas", "tomli_w"),
        *("trimesh", "collada", "fast_simplification"),
    ),
    "train": ("torch", "tensordict", "rsl_rl", "onnx", "tensorboard", "filelock"),
    "report": ("matplotlib", "imageio_ffmpeg", "PIL"),
    "search": ("optuna", "ray", "grpc"),
    "tune": ("cma",),
    "bags": ("rosbags",),
    "page": ("viser", "websockets"),
    "wandb": ("wandb",),
}


def install_command(extra: str) -> str:
    """Return the pip command that installs an extra, from the same source as this installation of surefoot."""
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        origin = json.loads(distribution("surefoot").read_text("direct_url.json") or "{}")
    except PackageNotFoundError:
        origin = {}
    path = unquote(urlsplit(origin.get("url", "")).path) or "surefoot"
    editable = "-e " if origin.get("dir_info", {}).get("editable") else ""
    return f"pip install {editable}{shlex.quote(f'{path}[{extra}]')}"


def describe_missing(error: ModuleNotFoundError) -> str | None:
    """Return a message with the command that installs a missing optional package; None for other packages."""
    from surefoot.world.registry import WORLDS

    module = (error.name or "").split(".")[0]
    engines = [(entry.extra, (entry.package,)) for entry in WORLDS.values()]
    for extra, modules in [*_EXTRAS.items(), *engines]:
        if module in modules:
            return f"this needs {module}, which is not installed: {install_command(extra)}"
    return None


def report_missing_extras(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator that converts a missing optional package to a `SurefootError` with the command that installs it."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return function(*args, **kwargs)
        except ModuleNotFoundError as error:
            if hint := describe_missing(error):
                raise SurefootError(hint) from error
            raise

    return call
