"""surefoot: agile gaits for quadruped robots, learned in simulation and deployed on the robot.

    import surefoot

    run = surefoot.train("trot", robot="go2", steps=500_000)
    surefoot.evaluate(run.policy)
    surefoot.play(run.policy)

Importing the package takes milliseconds and needs no simulator: each function imports its dependencies when it is
called. Invalid input raises `SurefootError`, whose one-line message states the value, the rule and the choices.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from surefoot.api.facade import drive, evaluate, export, load, play, robots, train
    from surefoot.api.results import Drive, Evaluation, Policy, Run, Video
    from surefoot.errors import SurefootError

__version__ = "0.13.0"
__all__ = [
    "Drive",
    "Evaluation",
    "Policy",
    "Run",
    "SurefootError",
    "Video",
    "drive",
    "evaluate",
    "export",
    "load",
    "play",
    "robots",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'surefoot' has no attribute '{name}'")
    module = "errors" if name == "SurefootError" else "api.facade" if name.islower() else "api.results"
    return getattr(import_module(f"surefoot.{module}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
