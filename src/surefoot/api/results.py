"""Return types of `import surefoot`: policies, runs, evaluations, videos and pages."""

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
    """A policy with its robot and task; `surefoot.load` returns one."""

    name: str
    """Name of the policy."""
    path: Path
    """Policy file."""
    robot: RobotDescription
    """Robot on which the policy runs."""
    task: TaskConfig
    """Task for which the policy was trained, on that robot."""
    controller: Controller
    """Computation of the feedback: a `PolicyRuntime`, or a handcrafted gait."""
    config_hash: str
    """Hash of the training configuration."""

    def feedback(self, observation: ArrayLike) -> Array:
        """Return the feedback (N, A) in leg space for observations (N, O * history) in SI units.

        The columns and bounds of a policy file are in its contract, `policy.controller.contract`.

        Raises:
            SurefootError: the observations have another shape, or are not finite.
        """
        return self.controller.feedback(observation)

    def __repr__(self) -> str:
        return f"<policy {self.name} for robot {self.robot.name}: {self.path}>"


@dataclass(frozen=True, repr=False)
class Run:
    """A finished or interrupted training. Its folder has the same content as a run of the command line."""

    path: Path
    """Run folder."""
    figures: dict[str, dict[str, Any]]
    """Metrics of the trained policy, by kind of evaluation, such as `without_pushes`; see `summarize`."""

    @property
    def policy(self) -> Policy:
        """Best policy of the run, according to its evaluations.

        Raises:
            SurefootError: the run was interrupted before its first evaluation.
        """
        return load(self.path / "policy.onnx")

    @property
    def log(self) -> pd.DataFrame:
        """Training log, one row per update: steps, mean return, losses, and `evaluation` (a dict, if there was one)."""
        import pandas as pd

        from surefoot.learn.run_folder import RunFolder

        return pd.DataFrame(RunFolder(self.path).rows())

    def __repr__(self) -> str:
        return f"<run {self.path}>" + (f"\n{_table(self.figures).to_string()}" if self.figures else "")

    def _repr_html_(self) -> str:
        return f"<p>{escape(str(self.path))}</p>" + (_table(self.figures).to_html() if self.figures else "")


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Metrics and traces of episodes of a policy in one world."""

    runs: pd.DataFrame
    """One row per episode: return, distance [m], speed [m/s], power [W], steps, fell, balanced; see `measure_runs`."""
    summary: dict[str, Any]
    """Means, standard deviations, falls and gait, in the format of JSON; see `surefoot.evaluation.runs.summarize`."""
    traces: list[EpisodeTrace]
    """One trace per episode, with arrays by control step; `surefoot show` shows a trace that was saved with `save`."""

    @classmethod
    def from_traces(cls, traces: list[EpisodeTrace], robot: RobotDescription) -> Evaluation:
        """Compute the metrics of episodes of one policy in one world, simulated or recorded."""
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
    """Return the metrics of evaluations as text, one row per metric."""
    import pandas as pd

    from surefoot.api.episodes import summary_rows

    return pd.DataFrame(summary_rows({name.replace("_", " "): one for name, one in summaries.items()})).set_index("")


@dataclass(frozen=True)
class Video:
    """Video of a run, which a notebook plays."""

    path: Path
    """Video file (.mp4)."""

    def _repr_html_(self) -> str:
        data = base64.b64encode(self.path.read_bytes()).decode()
        return f'<video controls autoplay loop muted width="640" src="data:video/mp4;base64,{data}"></video>'


class Drive:
    """Page to steer a simulated robot, served in the background until `close` or the end of the program.

    Args:
        page: simulation behind the page.
        host: address at which other machines can open the page; by default only this machine can.
        port: TCP port; 0 selects a free one.

    Raises:
        SurefootError: the port can't be opened.
    """

    def __init__(self, page: DrivePage, host: str | None, port: int) -> None:
        from surefoot.report.pages.server import robot_page

        self.page = page
        """Simulation behind the page."""
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
        policy: name of a released policy, such as "go2-steer"; path of a policy file (.onnx), handcrafted gait (.yaml)
            or run folder; or a run.
        robot: name or folder of another robot with the same kind of legs; defaults to the policy's.

    Raises:
        SurefootError: the policy does not exist, is damaged, or is not compatible with the robot.
    """
    from surefoot.api.policies import find_policy, load_gait

    if isinstance(policy, Policy):
        if robot is None:
            return policy
        policy = policy.path
    path = find_policy(str(policy.path if isinstance(policy, Run) else policy))
    controller, description, task, origin = load_gait(path, None if robot is None else str(robot))
    return Policy(origin["name"], path, description, task, controller, origin["config_hash"])
