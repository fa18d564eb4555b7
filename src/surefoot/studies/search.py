"""Hyperparameter search with Optuna, which proposes settings of trials, prunes poor trials and keeps a journal.

A trial's training depends on the search's seed, the trial's number and its settings. Optuna's proposals depend on the
results so far: with one worker every trial is reproducible, with several only the first ones, whose settings are
random.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from surefoot.configuration import Seed, from_mapping, read_yaml, write_yaml
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors
from surefoot.files import atomic_write
from surefoot.learn.config import Steps, TrainConfig
from surefoot.seeding import generator
from surefoot.studies.search_space import Dimension, load_space, suggest_values, to_optuna_params, with_values
from surefoot.studies.training import Training, base_config, first_difference
from surefoot.studies.workers import ProgressReport

EVALUATIONS = 10
"""Number of evenly spaced evaluations of a trial, at which pruning compares trials."""
EVALUATION_EPISODES = 8
RANDOM_TRIALS = 12
"""Number of first trials with random settings, from which the sampler starts."""
PRUNING_START = 1 / 3
"""Fraction of a trial's steps before which it is not pruned."""
MIN_TRIALS_FOR_IMPORTANCE = 8
"""Minimum number of complete trials for computing the importance of fields."""
CONFIG_FILE = "search.yaml"
"""Configuration in a search's folder."""
_NAME = "search"


@dataclass(frozen=True)
class SearchConfig:
    """Configuration of a search, on which all its trials depend."""

    train: TrainConfig
    """Base configuration of the trials, with the values of all fields that are not searched."""
    space: dict[str, Dimension] = field(default_factory=dict)
    """Fields that are searched, by dotted name."""
    seed: Seed = 0

    @property
    def evaluations(self) -> int:
        """Number of evaluations of a trial."""
        return -(-self.train.steps // self.train.evaluate_every)


def check_search_folder(folder: Path) -> None:
    """Raise SurefootError for a folder without a search."""
    if not (folder / CONFIG_FILE).is_file():
        raise SurefootError(f"{folder}: has no search to resume; leave --resume out to begin one")


def make_config(task: str, space: Path | None, seed: int, steps: Steps) -> SearchConfig:
    """Return the configuration of a search.

    Args:
        task: name of a preset, or path of a task file.
        space: file of the search space; defaults to the one that ships.
        seed: seed of the search.
        steps: control steps of each trial.

    Raises:
        SurefootError: the task or the space is invalid.
    """
    base = base_config(task)
    train = replace(
        base,
        steps=steps,
        evaluate_every=max(1, steps // EVALUATIONS),
        evaluation_episodes=EVALUATION_EPISODES,
        # Trials may be trained with other reward weights, and are compared by the task's.
        evaluation_reward=base.task.reward,
    )
    return SearchConfig(train, load_space(space, train), seed)


class Search:
    """Search in a folder: `search.yaml`, the journal `trials.log`, and a run folder for each trial in `trials/`.

    Args:
        config: configuration of the search.
        folder: folder of the search, which this process has locked.
        resume: resume the search in the folder.

    Raises:
        SurefootError: the folder has a search and `resume` is not set; or the search to resume is different or damaged.
    """

    def __init__(self, config: SearchConfig, folder: Path, resume: bool) -> None:
        import optuna
        from optuna.storages.journal import JournalFileBackend, JournalStorage

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.config, self.folder = config, folder
        self.journal, self.notes = folder / "trials.log", list[str]()
        self._trials: dict[str, Any] = {}
        settings = folder / CONFIG_FILE
        if resume:
            self._check_same(settings)
            self._repair()
        elif settings.exists():
            raise SurefootError(f"{folder}: already has a search; resume it with --resume, or choose another --out")
        else:
            with describe_os_errors(settings, "written"):
                write_yaml(settings, config)
        # Since this process has locked the folder, a lock of the journal is left over from a killed process.
        Path(f"{self.journal}.lock").unlink(missing_ok=True)
        warmup_steps = math.ceil(PRUNING_START * config.evaluations)
        with _wrap_optuna_errors(self.journal):
            self.study = optuna.create_study(
                storage=JournalStorage(JournalFileBackend(str(self.journal))),
                pruner=optuna.pruners.MedianPruner(n_startup_trials=8, n_warmup_steps=warmup_steps),
                study_name=_NAME,
                direction="maximize",
                load_if_exists=True,
            )

    def _check_same(self, settings: Path) -> None:
        data = read_yaml(settings)
        with prefix_errors(settings):
            stored = from_mapping(SearchConfig, data)
        if change := first_difference(stored, self.config):
            name, was, now = change
            if name == "space":
                name = next(key for key in {**was, **now} if was.get(key) != now.get(key))
                was, now = was.get(name), now.get(name)
            raise SurefootError(
                f"{self.folder}: the search there has {name} {was!r}, this one {now!r}; use the same, or choose "
                "another --out"
            )

    def _repair(self) -> None:
        """Remove an incomplete last record from the journal.

        Raises:
            SurefootError: the journal is damaged elsewhere; it stays unchanged.
        """
        if not self.journal.exists():
            return
        with describe_os_errors(self.journal):
            content = self.journal.read_bytes()
        *lines, rest = content.split(b"\n")
        for number, line in enumerate(lines, start=1):
            try:
                is_record = isinstance(json.loads(line), dict)
            except ValueError:
                is_record = False
            if not is_record:
                raise SurefootError(
                    f"{self.journal}: line {number} of {len(lines)} is not a record of a search; restore the file, or "
                    "move it away: the same command recovers every trial from its folder"
                )
        if rest:
            atomic_write(self.journal, b"".join(line + b"\n" for line in lines))
            self.notes.append(
                f"{self.journal}: removed the last record, which was incomplete; its content is recovered from the "
                "trials' folders"
            )

    def training(self, number: int, config: TrainConfig | None = None) -> Training:
        """Return the training of a trial, which depends only on its settings, its number and the search's seed."""
        group = f"trial_{number:04d}"
        seed = int(generator(self.config.seed, "trial", number).integers(2**32))
        config = replace(config or self.config.train, name=group, seed=seed)
        return Training(group, config, self.folder / "trials" / group, trial=True)

    def importance(self) -> dict[str, float]:
        """Return each field's importance: how well it separates the best trials from the others. The sum is 1.

        PED-ANOVA: Watanabe et al. 2023, "PED-ANOVA: efficiently quantifying hyperparameter importance in arbitrary
        subspaces". Empty if fewer than `MIN_TRIALS_FOR_IMPORTANCE` trials are complete.
        """
        import optuna

        complete = [trial for trial in self.study.trials if trial.state == optuna.trial.TrialState.COMPLETE]
        return optuna.importance.get_param_importances(self.study) if len(complete) >= MIN_TRIALS_FOR_IMPORTANCE else {}

    @property
    def counts(self) -> dict[str, int]:
        """Number of trials by state: complete, pruned, fail, running."""
        states = [trial.state.name.lower() for trial in self.study.get_trials(deepcopy=False)]
        return {state: states.count(state) for state in dict.fromkeys(states)}

    def trainings(self, trials: int) -> Iterator[Training]:
        """Yield the trainings of trials up to a number of trials, interrupted trials first."""
        import optuna

        for frozen in self.study.trials:
            if frozen.state == optuna.trial.TrialState.RUNNING:
                self.study.sampler = self._sampler(frozen.number)
                # Optuna has no public function to continue a trial of another process.
                yield from self._training(optuna.trial.Trial(self.study, frozen._trial_id))
        while (number := len(self.study.get_trials(deepcopy=False))) < trials:
            self.study.sampler = self._sampler(number)
            yield from self._training(self.study.ask())

    def _sampler(self, number: int) -> Any:
        """Return the sampler of a trial, seeded by its number, so that interruptions do not change its draws.

        If the trial has a folder, its settings are taken from there, whether or not they are in the journal.
        """
        import optuna

        seed = int(generator(self.config.seed, "sampler", number).integers(2**32))
        sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=RANDOM_TRIALS)
        path = self.training(number).path / "config.yaml"
        if not path.exists():
            return sampler
        with prefix_errors(path):
            params = to_optuna_params(self.config.space, from_mapping(TrainConfig, read_yaml(path)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            return optuna.samplers.PartialFixedSampler(params, sampler)

    def _training(self, trial: Any) -> Iterator[Training]:
        """Yield the training of a trial; the trial fails without one if its settings are invalid."""
        try:
            config = with_values(self.config.train, self.config.space, suggest_values(self.config.space, trial))
        except SurefootError as error:
            self._fail(trial, str(error))
            return
        training = self.training(trial.number, config)
        self._trials[training.group] = trial
        yield training

    def _fail(self, trial: Any, why: str) -> None:
        import optuna

        trial.set_user_attr("why", why)
        self.study.tell(trial, state=optuna.trial.TrialState.FAIL)

    def on_report(self, training: Training, report: ProgressReport) -> bool:
        """Record a trial's evaluations; return whether to prune it."""
        import optuna

        trial, every = self._trials[training.group], self.config.train.evaluate_every
        recorded = self.study.trials[trial.number].intermediate_values
        for evaluation in report.evaluations:
            step = min(evaluation["steps"] // every, self.config.evaluations)
            if step not in recorded and math.isfinite(evaluation["return_mean"]):
                trial.report(evaluation["return_mean"], step)
        if not report.finished:
            # A trial that was resumed from a checkpoint may be pruned only at its next evaluation.
            is_new = report.evaluations and report.evaluations[-1]["steps"] == report.steps
            return bool(is_new and trial.should_prune())
        last = report.evaluations[-1]["return_mean"] if report.evaluations else math.nan
        if report.steps < self.config.train.steps:
            self.study.tell(trial, state=optuna.trial.TrialState.PRUNED)
        elif math.isfinite(last):
            self.study.tell(trial, last)
        else:
            self._fail(trial, f"its return is {last}")
        return False

    def on_change(self, training: Training, state: str, error: str) -> None:
        """Record the error of a trial that failed; `on_report` records all other states."""
        if state == "failed":
            self._fail(self._trials[training.group], error)


@contextmanager
def _wrap_optuna_errors(journal: Path) -> Iterator[None]:
    """Turn any error of Optuna about an unreadable journal into a SurefootError of one line."""
    try:
        yield
    except (SurefootError, OSError):
        raise
    except Exception as error:  # Optuna does not validate its records, so that they may cause any error.
        raise SurefootError(
            f"{journal}: Optuna can't read it ({type(error).__name__}: {error}); restore the file, or move it away: "
            "the same command recovers every trial from its folder"
        ) from error
