"""Examination of an adopted policy in simulation, with an optional report."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from surefoot.api.policies import find_policy, load_policy
from surefoot.check_result import CheckResult
from surefoot.errors import SurefootError
from surefoot.progress import ProgressBar
from surefoot.robot import RobotDescription


class ExaminationResult(NamedTuple):
    """Name, robot and checks of an examined policy, and the files that were written."""

    name: str
    robot: RobotDescription
    checks: list[CheckResult]
    files: list[Path]


def examine_policy(
    policy: str,
    robot: str | None = None,
    world: str = "mujoco",
    seed: int = 0,
    threads: int = 0,
    out: Path | None = None,
    correct: Path | None = None,
) -> ExaminationResult:
    """Simulate an adopted policy as it is, with common mistakes in its configuration corrected, and on other robots.

    Args:
        policy: name or path, see `find_policy`.
        robot: name or folder of the robot; defaults to the policy's.
        world: name of the world.
        seed: seed of noise and initial states.
        threads: threads of the simulation; 0: one per core.
        out: folder for a report with videos.
        correct: file for the corrected specification (.yaml), which is written if a mistake is found.

    Raises:
        SurefootError: the policy was not adopted, or the world does not exist.
    """
    from surefoot.adopt.builder import adopted_notes
    from surefoot.adopt.diagnosis import check_answers, diagnose
    from surefoot.adopt.examination import require_specification
    from surefoot.adopt.formats import manual
    from surefoot.adopt.mistakes import Correction
    from surefoot.world.registry import find_world

    find_world(world)
    if correct is not None and correct.suffix not in (".yaml", ".yml"):
        raise SurefootError(f"--correct is {correct}; the name of the specification must end in .yaml")
    runtime, description, task = load_policy(find_policy(policy), robot)
    if runtime.contract.commands is None:
        raise SurefootError(f"policy '{runtime.contract.name}' follows no commands; only policies that do are examined")
    with ProgressBar("usual mistakes") as bar:
        diagnosis = diagnose(runtime, description, task, world, seed, threads, bar.advance)
    checks, files = check_answers(diagnosis, adopted_notes(runtime.contract)), []
    if correct is not None and diagnosis.mistake is not None and diagnosis.mistake.correction is not None:
        manual.write(correct, diagnosis.mistake.correction.specification)
        files = [correct]
    if out is not None:
        from surefoot.adopt.examination import CorrectedPolicy, run_task
        from surefoot.api.episodes import film
        from surefoot.evaluation.rollout import run_episodes
        from surefoot.report.pages.adopted import write_page

        out.mkdir(parents=True, exist_ok=True)
        videos = []
        variants: list[tuple[str, Correction | None]] = [("as it is", None)]
        if diagnosis.mistake is not None and diagnosis.mistake.correction is not None:
            variants.append((f"corrected: {diagnosis.mistake.correction.text}", diagnosis.mistake.correction))
        for k, (title, correction) in enumerate(variants):
            specification = require_specification(runtime.contract) if correction is None else correction.specification
            corrected = CorrectedPolicy(runtime, description, [specification])
            demo = run_task(task, corrected.makers[0], diagnosis.baseline)
            (trace,) = run_episodes(
                corrected,
                demo,
                1,
                find_world(world),
                seed,
                1,
                world_name=world,
                policy_name=runtime.contract.name,
            )
            path = film(description, trace, out / f"{('as-it-is', 'corrected')[k]}.mp4")
            videos.append((f"{title}; the robot fell after {trace.duration:.1f} s" if trace.fell else title, path))
        page = write_page(out / "examination.html", runtime.contract.name, world, diagnosis, checks, videos)
        files += [page, *(path for _, path in videos)]
    return ExaminationResult(runtime.contract.name, description, checks, files)
