"""Trainings as jobs: one that is finished is kept, one that is begun goes on; what it costs, and what it reached."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from ethbrake_marl.errors import InvalidInput, OnProgress, Progress
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.learning import RunDirectory, StopAt, Training, read_object, resume, train
from ethbrake_marl.scenario import Sample, Scenario
from ethbrake_marl.studies.jobs import Job, JobFolder, each, run_jobs


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """A training and its folder."""

    training: Training
    folder: Path
    noted: tuple[str, ...] = ()  # by which scenario and recipe differ from their files, for ``config.json``

    def steps_left(self) -> int:
        """Decisions that are still to do; raises ``InvalidInput`` for a folder that holds another training."""
        run, total = RunDirectory(self.folder), self.training.recipe.total_steps
        if not run.status.exists():
            if self.folder.exists():
                raise InvalidInput(f"{self.folder}: is no training; move it away, or give another --output")
            return total
        try:
            status = read_object(run.status)
        except InvalidInput as error:
            raise InvalidInput(f"{error}; delete its folder to train anew") from None
        run.check_same(self.training)
        if status.get("status") == "finished":
            return 0
        steps = status.get("steps", 0)
        return max(total - (steps if isinstance(steps, int) else 0), 1)

    def finish(self, tell: OnProgress | None = None, *, stop_at: StopAt | None = None) -> bool | None:
        """Bring it to its end; None where it was stopped before, by ``stop_at`` too, as ``train`` has it.

        Raises what ``train`` and ``resume`` raise.
        """
        run = RunDirectory(self.folder)
        if run.is_finished:
            return True
        if run.status.is_file():
            ended = resume(self.folder, stop_at=stop_at, on_progress=tell)
        else:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            asked = self.training
            ended = train(
                asked.recipe, asked.scenario, self.folder, settings=self.noted, stop_at=stop_at, on_progress=tell
            )
        return True if ended.status == "finished" else None


def finish_trainings(
    trainings: Sequence[TrainingJob],
    processes: int = 1,
    tell: OnProgress | None = None,
    *,
    kept: JobFolder | None = None,
) -> bool:
    """Bring every training to its end, ``processes`` at a time; False when Ctrl-C stopped it.

    The policies do not depend on ``processes`` or on interruptions. ``kept`` keeps a journal of them. Raises, before
    any is begun, what ``steps_left`` raises, and what the first training raises that fails.
    """
    run, say = run_jobs if kept is None else kept.run, tell or (lambda progress: None)
    left = [training for training in trainings if training.steps_left()]
    if processes == 1 or len(left) < 2:
        jobs = []
        for one in left:
            named = partial(_tell_named, say, one.folder.name)
            jobs.append(Job(one.folder.name, one.finish, (named,)))
        return run(jobs, 1, lambda attempt: None)
    done = count(1)
    say(Progress("trainings", 0, len(left)))
    jobs = [Job(one.folder.name, one.finish, ()) for one in left]
    return run(jobs, processes, each(lambda job, found: say(Progress("trainings", next(done), len(left)))))


def _tell_named(tell: OnProgress, name: str, progress: Progress) -> None:
    tell(replace(progress, name=name))


# The cost of a training on this machine, measured by a short one.

_UPDATES = 4  # of the training that is timed; the first one, which compiles and warms up, does not count
TIMED_DRIVES = 50  # worlds that the timed policy drives


@dataclass(frozen=True, slots=True)
class Timed:
    """Seconds of one core, by the clock."""

    decision_s: float  # of a learner, its share of the learning included
    world_s: float  # that the policy drives

    def seconds(self, training: Training, steps: int) -> float:
        """Of ``steps`` decisions, of as many trainings as they make, with what is measured on the way.

        A training measures its policies on the fixed list at first, now and then, and at the end.
        """
        recipe = training.recipe
        per_update = recipe.n_envs * len(training.scenario.learners) * recipe.rounds
        times = recipe.total_steps // per_update // recipe.evaluation.every_updates + 2
        return steps * self.decision_s + steps / recipe.total_steps * times * recipe.evaluation.worlds * self.world_s


def time_training(training: Training, sample: Sample | None = None) -> Timed:
    """Time a few updates of a training, and its policy on the worlds of ``sample``; None: some of the recipe's list."""
    told: list[Progress] = []
    recipe, scenario = training.recipe, training.scenario
    if sample is None:
        sample = scenario.sample(TIMED_DRIVES, recipe.evaluation.seed)
    short = recipe.replace(evaluation={**recipe.evaluation.model_dump(), "worlds": 10, "every_updates": 1000})
    with tempfile.TemporaryDirectory(prefix="ethbrake-") as folder:
        path = Path(folder) / "timed"
        train(short, scenario, path, steps=1, on_progress=told.append)
        once = told[-1].done  # decisions of one update
        told.clear()
        train(short, scenario, path, steps=_UPDATES * once, force=True, on_progress=told.append)
        updates = [one for one in told if one.updates >= 1]
        first, last = updates[0], updates[-1]
        if last.done == first.done:
            decision_s = last.wall_s / last.done
        else:
            decision_s = (last.wall_s - first.wall_s) / (last.done - first.done)
        return Timed(decision_s, world_seconds(path, scenario, sample))


def world_seconds(folder: Path, scenario: Scenario, sample: Sample) -> float:
    """Seconds per world that a trained team drives."""
    team = RunDirectory(folder).load_team(scenario)
    evaluate(sample.worlds.take(np.arange(min(5, sample.worlds.n))), {"warm": team}, scenario=scenario, aftermath=False)
    started = time.monotonic()
    evaluate(sample, {"team": team}, scenario=scenario, aftermath=False)
    return (time.monotonic() - started) / sample.worlds.n


def told_seconds(seconds: float) -> str:
    """Seconds, minutes or hours, in words."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 36_000.0 else f"{seconds / 3600.0:.0f} h"
