"""Trainings as jobs: one that is finished is kept, one that is begun goes on from its newest checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from ethbrake_marl.learning.loop import StopAt
from ethbrake_marl.learning.run_folder import RunDirectory, is_finished
from ethbrake_marl.learning.train import resume, train
from ethbrake_marl.learning.training import Training
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.studies.jobs.local import run_all
from ethbrake_marl.studies.jobs.work import pack


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """A training and its folder."""

    training: Training
    folder: Path
    noted: tuple[str, ...] = ()  # by which scenario and recipe differ from their files, for ``config.json``


def finish_training(job: TrainingJob, tell: OnProgress | None = None, *, stop_at: StopAt | None = None) -> bool | None:
    """Bring a training to its end; None where it was stopped before, by ``stop_at`` too, as ``train`` has it.

    Raises what ``train`` and ``resume`` raise.
    """
    if is_finished(job.folder):
        return True
    if RunDirectory(job.folder).status.is_file():
        ended = resume(job.folder, stop_at=stop_at, on_progress=tell).status
    else:
        job.folder.parent.mkdir(parents=True, exist_ok=True)
        training = job.training
        ended = train(
            training.recipe,
            training.scenario,
            job.folder,
            settings=job.noted,
            stop_at=stop_at,
            on_progress=tell,
        ).status
    return True if ended == "finished" else None


def finish_trainings(jobs: Sequence[TrainingJob], processes: int = 1, tell: OnProgress | None = None) -> bool:
    """Bring every training to its end, ``processes`` at a time; False when Ctrl-C stopped it.

    The policies do not depend on ``processes`` or on interruptions. Raises what the first training raises that fails.
    """
    say = tell or (lambda progress: None)
    if processes == 1 or len(jobs) < 2:
        return all(finish_training(job, partial(_tell_named, say, job.folder.name)) for job in jobs)
    found = run_all(lambda number: pack(finish_training, jobs[number]), len(jobs), processes, "trainings", say)
    return found is not None


def _tell_named(tell: Callable[[Progress], None], name: str, progress: Progress) -> None:
    tell(replace(progress, name=name))
