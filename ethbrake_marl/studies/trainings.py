"""Trainings as jobs: one that is finished is kept, one that is begun goes on; what it costs, and what it reached."""

from __future__ import annotations

import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.errors import AlreadyExists, InvalidInput, OnProgress, Progress
from ethbrake_marl.evaluation.inputs import load_runnable
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.files.store import remove_folder
from ethbrake_marl.learning.progress import OBJECTIVE, chosen_by
from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe, read_settings
from ethbrake_marl.learning.train import StopAt, resume, train
from ethbrake_marl.learning.training import (
    RunDirectory,
    Training,
    check_same,
    is_finished,
    load_team,
    progress_rows,
    read_object,
    wait_for_others,
)
from ethbrake_marl.policies.bundle import Policy, has_bundle, read_trained
from ethbrake_marl.scenario import Sample, Scenario, load_scenario
from ethbrake_marl.studies.jobs import Attempt, Job, each, run_jobs

# Scenario and recipe of a training that a file asks for, and which part of it a refusal is about.


def load_parts(scenario: str, recipe: str, settings: Sequence[str]) -> tuple[Scenario, TrainingRecipe]:
    """Scenario and recipe, each a name or a path, with the settings ``KEY=VALUE`` in them.

    Raises ``InvalidInput`` for what is not known, and for a value that is not allowed.
    """
    loaded = load_recipe(recipe)
    given = read_settings(settings, [loaded])
    return load_runnable(scenario, given.scenario), given.change(loaded)


def refused_part(scenario: str, recipe: str, settings: Sequence[str]) -> str:
    """The part that is refused by itself where ``load_parts`` refuses: ``recipe``, ``scenario`` or a setting's key.

    Empty where each by itself is in order.
    """
    tried: dict[str, Callable[[], object]] = {
        "recipe": partial(load_recipe, recipe),
        "scenario": partial(load_scenario, scenario),
        **{text.partition("=")[0]: partial(load_parts, scenario, recipe, (text,)) for text in settings},
    }
    for part, load in tried.items():
        try:
            load()
        except InvalidInput:
            return part
    return ""


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
        check_same(self.folder, self.training)
        if status.get("status") == "finished":
            return 0
        steps = status.get("steps", 0)
        return max(total - (steps if isinstance(steps, int) else 0), 1)

    def finish(self, tell: OnProgress | None = None, *, stop_at: StopAt | None = None) -> bool | None:
        """Bring it to its end; None where it was stopped before, by ``stop_at`` too, as ``train`` has it.

        Raises what ``train`` and ``resume`` raise.
        """
        if is_finished(self.folder):
            return True
        if RunDirectory(self.folder).status.is_file():
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
    run: Callable[[Iterable[Job], int, Callable[[Attempt], None]], bool] = run_jobs,
) -> bool:
    """Bring every training to its end, ``processes`` at a time; False when Ctrl-C stopped it.

    The policies do not depend on ``processes`` or on interruptions. ``run`` runs the jobs, that of a ``JobFolder`` for
    instance. Raises, before any is begun, what ``steps_left`` raises, and what the first training raises that fails.
    """
    say = tell or (lambda progress: None)
    left = [training for training in trainings if training.steps_left()]
    if processes == 1 or len(left) < 2:
        told = [partial(_tell_named, say, each.folder.name) for each in left]
        jobs = [Job(one.folder.name, one.finish, (who,)) for one, who in zip(left, told, strict=True)]
        return run(jobs, 1, lambda attempt: None)
    done = 0

    def count(job: Job, found: Any) -> None:
        nonlocal done
        done += 1
        say(Progress("trainings", done, len(left)))

    say(Progress("trainings", 0, len(left)))
    return run([Job(one.folder.name, one.finish, ()) for one in left], processes, each(count))


def _tell_named(tell: OnProgress, name: str, progress: Progress) -> None:
    tell(replace(progress, name=name))


# A training whose figures go into a table: train to the end, then read what the run's folder says of it.

_MEASURED = ("first_impact_harm", "total_harm", "collision_rate")
RESULTS = (
    "steps",  # decisions of learners in whole updates
    "policy_steps",  # decisions after which the kept policy was taken: the best one on the recipe's list
    *_MEASURED,  # of the kept policy on that list
    OBJECTIVE,  # likewise, where a learner has another objective than total
    *(f"last_{name}" for name in _MEASURED),  # of the last one
    "policy_sha256",  # of the kept policy's manifest, of several vehicle_i=... each
)
_FREE_S = 60.0  # a worker that has lost its driver may hold the folder for a moment


def reach_results(job: TrainingJob, log: Path, stop_at: StopAt | None = None) -> list[str] | None:
    """The values of ``RESULTS``, as text; None where the training was stopped before its end, by ``stop_at`` too.

    What is printed goes to ``log``, which is deleted at a good end. Raises what a training raises, ``InvalidInput``
    where the folder of all cannot be seen or the run's folder holds another training, and ``BlockingIOError`` where
    another worker has just begun it.
    """
    if not log.parent.is_dir():
        raise InvalidInput(
            f"{log.parent}: is not there on {os.uname().nodename}; every computer of a cluster must see the sweep's"
            " folder"
        )
    with _printing_to(log):
        if RunDirectory(job.folder).status.is_file():
            wait_for_others(job.folder, _FREE_S)
            check_same(job.folder, job.training)
            if is_finished(job.folder) and not all(
                has_bundle(job.folder / place) for place in job.training.drivers.values()
            ):
                remove_folder(job.folder)  # a finished run has no checkpoint: it is trained anew
        try:
            finished = job.finish(stop_at=stop_at)
        except AlreadyExists as error:  # begun in this moment by a worker that has lost its driver
            raise BlockingIOError(str(error)) from None
        found = read_results(job) if finished else None
    if found is not None:
        log.unlink(missing_ok=True)
    return found


def read_results(job: TrainingJob) -> list[str]:
    """The values of ``RESULTS`` of a finished training, in the text that its table has."""
    run = RunDirectory(job.folder)
    table = [row for row in progress_rows(job.folder) if row.get(f"eval/{_MEASURED[0]}")]
    if not table:
        raise InvalidInput(f"{run.progress}: holds no evaluation; delete its folder to train anew")
    harm = chosen_by(table, job.training.recipe.reward.harm_count, "eval/")
    kept, last = min(table, key=lambda row: float(row[harm])), table[-1]
    trained = read_trained(run.policy)
    if isinstance(trained, Policy):
        sha256 = trained.manifest.manifest_sha256
    else:
        sha256 = " ".join(f"{name}={policy.manifest.manifest_sha256}" for name, policy in trained.members.items())
    measured, later = ([row[f"eval/{name}"] for name in _MEASURED] for row in (kept, last))
    return [last["steps"], kept["steps"], *measured, kept.get(f"eval/{OBJECTIVE}", ""), *later, sha256]


@contextmanager
def _printing_to(log: Path) -> Iterator[None]:
    """What this process prints inside goes to a file, from every library, and the end of an error with it."""
    sys.stdout.flush()
    sys.stderr.flush()
    before = os.dup(1), os.dup(2)
    with log.open("ab", buffering=0) as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            yield
        except BaseException:
            traceback.print_exc(file=os.fdopen(os.dup(file.fileno()), "w"))
            raise
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for descriptor, kept in enumerate(before, 1):
                os.dup2(kept, descriptor)
                os.close(kept)


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
