"""Trainings as jobs: one that is finished is kept, one that is begun goes on from its newest checkpoint."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from ethbrake_marl.errors import OnProgress, Progress
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.learning.recipe import TrainingRecipe
from ethbrake_marl.learning.train import StopAt, resume, train
from ethbrake_marl.learning.training import RunDirectory, Training, is_finished, load_team
from ethbrake_marl.scenario import Sample, Scenario
from ethbrake_marl.studies.jobs import pack, run_all


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


# The cost of a training on this machine, measured by a short one.

_UPDATES = 4  # of the training that is timed; the first one, which compiles and warms up, does not count


@dataclass(frozen=True, slots=True)
class Timed:
    """Seconds of one core, by the clock."""

    decision_s: float  # of a learner, its share of the learning included
    world_s: float  # that the policy drives


def time_training(recipe: TrainingRecipe, scenario: Scenario, sample: Sample) -> Timed:
    """Time a few updates of a training, and its policy on the worlds of ``sample``."""
    told: list[Progress] = []
    short = recipe.replace(evaluation={**recipe.evaluation.model_dump(), "worlds": 10, "every_updates": 1000})
    with tempfile.TemporaryDirectory(prefix="ethbrake-") as folder:
        path = Path(folder) / "timed"
        train(short, scenario, path, steps=1, on_progress=told.append)
        once = told[-1].done  # decisions of one update
        told.clear()
        train(short, scenario, path, steps=_UPDATES * once, force=True, on_progress=told.append)
        return Timed(_per_step(told), world_seconds(path, scenario, sample))


def training_seconds(recipe: TrainingRecipe, scenario: Scenario, timed: Timed, steps: int) -> float:
    """Seconds of ``steps`` decisions, of as many trainings as they make, with what is measured on the way."""
    measured = _measurements(recipe, len(scenario.learners)) * recipe.evaluation.worlds
    return steps * timed.decision_s + steps / recipe.total_steps * measured * timed.world_s


def world_seconds(folder: Path, scenario: Scenario, sample: Sample) -> float:
    """Seconds per world that a trained team drives."""
    team = load_team(folder, scenario)
    evaluate(sample.worlds.take(np.arange(min(5, sample.worlds.n))), {"warm": team}, scenario=scenario, aftermath=False)
    started = time.monotonic()
    evaluate(sample, {"team": team}, scenario=scenario, aftermath=False)
    return (time.monotonic() - started) / sample.worlds.n


def told_seconds(seconds: float) -> str:
    """Seconds, minutes or hours, in words."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 36_000.0 else f"{seconds / 3600.0:.0f} h"


def _per_step(told: Sequence[Progress]) -> float:
    """Seconds per decision between the first and the last update that was told."""
    updates = [one for one in told if one.updates >= 1]
    first, last = updates[0], updates[-1]
    if last.done == first.done:
        return last.wall_s / last.done
    return (last.wall_s - first.wall_s) / (last.done - first.done)


def _measurements(recipe: TrainingRecipe, learners: int) -> int:
    """How often a training measures its policies on the fixed list: at first, now and then, and at the end."""
    per_update = recipe.n_envs * learners * recipe.rounds
    return recipe.total_steps // per_update // recipe.evaluation.every_updates + 2
