"""One trial, wherever it runs: train, tell the study every measurement, and stop where the study would not go on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.progress import HARM_METRIC, OBJECTIVE
from ethbrake_marl.learning.run_folder import RunDirectory
from ethbrake_marl.studies.jobs.training import TrainingJob
from ethbrake_marl.studies.sweep.job import RESULTS, do_job, read_results
from ethbrake_marl.studies.tuning.study import Place, TuningStudy

PRUNED = "pruned: too much harm for so many decisions"


@dataclass(frozen=True, slots=True)
class TrialJob:
    """A trial that was asked for, and its training."""

    training: TrainingJob
    place: Place
    number: int  # of the trial
    times: int  # measurements of a whole training
    updates: int  # of a whole training


@dataclass(frozen=True, slots=True)
class TrialEnd:
    """What came of a trial."""

    pruned: bool
    results: tuple[str, ...]  # the values of a sweep's ``RESULTS``

    def harm(self, training_harm: str) -> float:
        """Least harm on the tuning's list, of the kept policy, by the learners' objectives, m2/s2."""
        return float(self.results[RESULTS.index(OBJECTIVE)] or self.results[RESULTS.index(training_harm)])


def do_trial(job: TrialJob, log: Path) -> TrialEnd | None:
    """Train to the end, or to where the trial is pruned; None where it was stopped from outside.

    Raises what ``do_job`` of a sweep raises.
    """
    judge = _Judge(job)
    folder = job.training.folder
    if RunDirectory(folder).progress.is_file() and judge.prunes():  # it was killed before it could say so
        return TrialEnd(True, read_results(job.training.training, folder))
    found = do_job(job.training, log, judge)
    if found is not None:
        return TrialEnd(False, found)
    if not judge.pruned:
        return None
    log.unlink(missing_ok=True)
    return TrialEnd(True, read_results(job.training.training, folder))


def repeat_end(end: TrialEnd) -> TrialEnd:
    """A trial of which the same training has ended before."""
    return end


def refuse_trial(reason: str) -> TrialEnd:
    """A trial whose values do not go together; raises ``InvalidInput``."""
    raise InvalidInput(reason)


class _Judge:
    """Tells the study what is measured, and asks it whether to go on."""

    def __init__(self, job: TrialJob) -> None:
        self._job, self._study = job, TuningStudy(job.place)
        self._harm = HARM_METRIC[job.training.training.recipe.reward.harm_count]
        self.pruned = False

    def __call__(self, evaluation: Mapping[str, float]) -> str | None:
        step = int(self._job.times * evaluation["updates"]) // self._job.updates
        self._study.report(self._job.number, step, evaluation.get(OBJECTIVE, evaluation[self._harm]))
        self.pruned = step < self._job.times and self.prunes()
        return PRUNED if self.pruned else None

    def prunes(self) -> bool:
        """Whether the study would not go on."""
        return self._study.prunes(self._job.number)
