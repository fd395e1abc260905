"""Trainings of a study: a finished one is kept, one that was begun goes on; several at a time; and what they cost."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.parallel import run_each
from ethbrake_marl.physics.state import Worlds
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.team import load_team
from ethbrake_marl.training.training import Training, check_same_training

if TYPE_CHECKING:
    from ethbrake_marl.training.callback import StopAt


def train_all(trainings: Sequence[TrainingJob], jobs: int = 1, tell: OnProgress | None = None) -> bool:
    """Bring every training to its end, ``jobs`` at a time; False when Ctrl-C stopped one.

    The policies do not depend on ``jobs`` or on interruptions. Raises, before any is begun, what ``steps_left`` raises,
    and what the first training raises that fails.
    """
    left = [training for training in trainings if training.steps_left()]
    if jobs == 1 or len(left) < 2:
        return all(training.finish(tell) for training in left)
    say = tell or (lambda progress: None)
    say(Progress("trainings", 0, len(left)))
    for done, finished in enumerate(run_each(((training.finish,) for training in left), jobs), 1):
        if not finished:
            return False
        say(Progress("trainings", done, len(left)))
    return True


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """A training and its folder."""

    training: Training
    folder: Path
    noted: tuple[str, ...] = ()  # by which scenario and recipe differ from their files, for ``config.json``

    @property
    def per_update(self) -> int:
        """Decisions of all learners between two updates."""
        return self.training.recipe.n_envs * len(self.training.scenario.learners) * self.training.recipe.rounds

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
        check_same_training(run, self.training)
        if status.get("status") == "finished":
            return 0
        steps = status.get("steps", 0)
        return max(total - (steps if isinstance(steps, int) else 0), 1)

    def finish(self, tell: OnProgress | None = None, *, stop_at: StopAt | None = None) -> bool | None:
        """Bring it to its end; None where it was stopped before, by ``stop_at`` too, as ``train`` has it.

        Raises what ``train`` and ``resume`` raise.
        """
        from ethbrake_marl.training.session import resume, train  # torch takes seconds to load

        def say(progress: Progress) -> None:
            if tell is not None:
                tell(replace(progress, name=self.folder.name))

        run, asked = RunDirectory(self.folder), self.training
        if run.is_finished:
            return True
        if run.status.is_file():
            ended = resume(self.folder, stop_at=stop_at, on_progress=say)
        else:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            ended = train(
                asked.recipe, asked.scenario, self.folder, settings=self.noted, stop_at=stop_at, on_progress=say
            )
        return True if ended.status == "finished" else None

    def time(self, sample: Sample | None = None) -> Timed:
        """Time a few updates, and the policy on the first worlds of ``sample``; None: of the recipe's list."""
        from ethbrake_marl.training.session import train

        told: list[Progress] = []
        recipe, scenario = self.training.recipe, self.training.scenario
        short = recipe.replace(evaluation={**recipe.evaluation.model_dump(), "worlds": 10, "every_updates": 1000})
        with tempfile.TemporaryDirectory(prefix="ethbrake-") as folder:
            path = Path(folder) / "timed"
            train(short, scenario, path, steps=1)  # compiles and warms up
            train(short, scenario, path, steps=4 * self.per_update, force=True, on_progress=told.append)
            updates = [one for one in told if one.updates >= 1]
            last = updates[-1]
            first = updates[0] if updates[0].done < last.done else Progress("begun", 0, 0)
            decision_s = (last.wall_s - first.wall_s) / (last.done - first.done)
            worlds = scenario.sample(50, recipe.evaluation.seed) if sample is None else sample
            return Timed(self, decision_s, replace(self, folder=path).world_seconds(worlds))

    def world_seconds(self, sample: Sample) -> float:
        """Seconds per world that its team drives."""
        team = {"team": load_team(self.folder, self.training.scenario)}
        drive = partial(evaluate, agents=team, scenario=self.training.scenario, aftermath=False)
        return Timed.each_s(sample.worlds, drive)


class Timed(NamedTuple):
    """Seconds of one core, by the clock, that a training takes."""

    job: TrainingJob
    decision_s: float  # of a learner, its share of the learning included
    world_s: float  # that the policy drives

    def seconds(self, steps: int) -> float:
        """Of ``steps`` decisions, of as many trainings as they make, with what is measured on the way.

        A training measures its policies on the fixed list at first, now and then, and at the end.
        """
        recipe = self.job.training.recipe
        times = recipe.total_steps // self.job.per_update // recipe.evaluation.every_updates + 2
        return steps * self.decision_s + steps / recipe.total_steps * times * recipe.evaluation.worlds * self.world_s

    @staticmethod
    def each_s(worlds: Worlds, work: Callable[[Worlds], object], most: int = 50) -> float:
        """Seconds per world of some work on at most so many, which one world has done before: it compiles."""
        work(worlds.take([0]))
        some, started = worlds.take(range(min(worlds.n, most))), time.monotonic()
        work(some)
        return (time.monotonic() - started) / some.n

    @staticmethod
    def in_words(seconds: float) -> str:
        """Seconds, minutes or hours."""
        if seconds < 90.0:
            return f"{seconds:.0f} s"
        return f"{seconds / 60.0:.0f} min" if seconds < 36_000.0 else f"{seconds / 3600.0:.0f} h"
