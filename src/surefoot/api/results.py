"""What the functions of `import surefoot` return: policies, runs, evaluations, videos and pages."""

from __future__ import annotations

import base64
import threading
from contextlib import ExitStack
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from surefoot.api.extras import report_missing_extras

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import ArrayLike

    from surefoot.api.drive_page import DrivePage
    from surefoot.arrays import Array
    from surefoot.evaluation.rollout import Controller
    from surefoot.robot import RobotDescription
    from surefoot.task.config import TaskConfig
    from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True, repr=False)
class Policy:
    """A policy with its robot and task. Make it with `surefoot.load`."""

    name: str
    """Name of the policy."""
    path: Path
    """Its file."""
    robot: RobotDescription
    """The robot that it runs on."""
    task: TaskConfig
    """The task that it was trained for, on that robot."""
    controller: Controller
    """What computes: a `PolicyRuntime`, or a handcrafted gait."""
    config_hash: str
    """Hash of the configuration that it was trained with."""

    def feedback(self, observation: ArrayLike) -> Array:
        """Return feedback (N, A) in leg space for observations (N, O * history) in SI units.

        A policy file's columns and bounds stand in its contract: `policy.controller.contract`.

        Raises:
            SurefootError: observations of another shape, or numbers that are not finite.
        """
        return self.controller.feedback(observation)

    def __repr__(self) -> str:
        return f"<policy {self.name} for robot {self.robot.name}: {self.path}>"


@dataclass(frozen=True, repr=False)
class Run:
    """A training that is over, or was interrupted. Its folder holds all that the command line's runs hold."""

    path: Path
    """The run folder."""
    figures: dict[str, dict[str, Any]]
    """Figures of the policy after the training, by kind of evaluation, such as `without_pushes`; see `summarize`."""

    @property
    def policy(self) -> Policy:
        """The best evaluated policy of the run.

        Raises:
            SurefootError: the run was interrupted before it had one.
        """
        return load(self.path / "policy.onnx")

    @property
    def log(self) -> pd.DataFrame:
        """A row an update: steps so far, mean return, losses; a row's `evaluation` is a dict, where there was one."""
        import pandas as pd

        from surefoot.learn.run_folder import RunFolder

        return pd.DataFrame(RunFolder(self.path).rows())

    def __repr__(self) -> str:
        return f"<run {self.path}>" + (f"\n{_table(self.figures).to_string()}" if self.figures else "")

    def _repr_html_(self) -> str:
        return f"<p>{escape(str(self.path))}</p>" + (_table(self.figures).to_html() if self.figures else "")


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Episodes of a policy in one world, measured."""

    runs: pd.DataFrame
    """A row an episode: return, distance [m], speed [m/s], power [W], steps, fell, balanced; see `measure_runs`."""
    summary: dict[str, Any]
    """Means, deviations, falls and gait, as JSON holds them; see `surefoot.evaluation.runs.summarize`."""
    traces: list[EpisodeTrace]
    """What happened, an episode each, in arrays by control step; `save` writes one that `surefoot show` shows."""

    @classmethod
    def from_traces(cls, traces: list[EpisodeTrace], robot: RobotDescription) -> Evaluation:
        """Measure episodes of one policy in one world, which were run or recorded."""
        from surefoot.evaluation.runs import measure_runs, summarize

        return cls(measure_runs(traces), summarize(traces, robot.urdf.total_mass), traces)

    def __repr__(self) -> str:
        return _table({self._title: self.summary}).to_string()

    def _repr_html_(self) -> str:
        return _table({self._title: self.summary}).to_html()

    @property
    def _title(self) -> str:
        return f"{self.summary['policy']} in {self.summary['world']}"


def _table(summaries: dict[str, dict[str, Any]]) -> pd.DataFrame:
    """Return the figures of evaluations as text, a row a measure."""
    import pandas as pd

    from surefoot.api.episodes import summary_rows

    return pd.DataFrame(summary_rows({name.replace("_", " "): one for name, one in summaries.items()})).set_index("")


@dataclass(frozen=True)
class Video:
    """A video of a run; a notebook plays it."""

    path: Path
    """The MP4."""

    def _repr_html_(self) -> str:
        data = base64.b64encode(self.path.read_bytes()).decode()
        return f'<video controls autoplay loop muted width="640" src="data:video/mp4;base64,{data}"></video>'


class Drive:
    """A page on which a simulated robot is driven, served in the background until `close`, or the end of the program.

    Args:
        page: the simulation behind it.
        host: address to listen at; this machine only, if None.
        port: TCP port; 0 for a free one.

    Raises:
        SurefootError: a port that can't be opened.
    """

    def __init__(self, page: DrivePage, host: str | None, port: int) -> None:
        from surefoot.report.pages.server import robot_page

        self.page = page
        """The simulation behind it."""
        self._stack = ExitStack()
        self._server, view = self._stack.enter_context(robot_page(host, port, in_notebook=True))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=page.run, args=(self._server, view, self._stop), daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """URL of the page."""
        return self._server.address

    def close(self) -> None:
        """Stop the simulation and the page."""
        self._stop.set()
        self._thread.join(timeout=10.0)
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<drive page at {self.address}>"

    def _repr_html_(self) -> str:
        address = escape(self.address)
        frame = f'<iframe src="{address}" width="100%" height="640" style="border:0"></iframe>'
        return f'<p><a href="{address}" target="_blank">{address}</a></p>{frame}'


@report_missing_extras
def load(policy: str | Path | Run | Policy, *, robot: str | Path | None = None) -> Policy:
    """Load a policy.

    Args:
        policy: name of one that ships, such as "go2-steer"; a policy file (.onnx), handcrafted gait (.yaml) or run
            folder; or a run.
        robot: another robot of the policy's legs, by name or folder; the policy's own, if None.

    Raises:
        SurefootError: no such policy, a damaged file, or a policy that does not fit the robot.
    """
    from surefoot.api.policies import find_policy, load_gait

    if isinstance(policy, Policy):
        if robot is None:
            return policy
        policy = policy.path
    path = find_policy(str(policy.path if isinstance(policy, Run) else policy))
    controller, description, task, origin = load_gait(path, None if robot is None else str(robot))
    return Policy(origin["name"], path, description, task, controller, origin["config_hash"])
