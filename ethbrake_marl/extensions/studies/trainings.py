"""Training runs of a study: do several at once, continue them after an interruption, and measure their speed."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from ethbrake_marl.errors import EthBrakeError, InvalidInput, plain_text
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.team import load_team
from ethbrake_marl.first_edition.training.training import Training, check_same_training
from ethbrake_marl.parallel import run_each
from ethbrake_marl.progress import OnProgress, Progress


def train_all(trainings: Sequence[TrainingJob], jobs: int = 1, tell: OnProgress | None = None) -> bool:
    """Start or continue every training run until it ends. Return False if one was stopped before its end.

    ``jobs`` is the number of training runs at the same time, each in a process of its own. The trained policies depend
    neither on ``jobs`` nor on interruptions. Before any run begins, raises the exceptions of ``steps_left``. If a
    training run fails later, raises the exception of the first run that fails.
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
    """A training run of a study, and its folder."""

    training: Training  # recipe and scenario
    folder: Path  # folder of the run; it need not exist yet
    noted: tuple[str, ...] = ()  # settings ``KEY=VALUE`` that changed scenario and recipe, for ``config.json``

    @property
    def per_update(self) -> int:
        """Number of decisions of all learners together between two updates of the policy."""
        return self.training.recipe.n_envs * len(self.training.scenario.learners) * self.training.recipe.rounds

    def steps_left(self) -> int:
        """Return the number of decisions until the end of the training run; 0 if the run has finished.

        Raises ``InvalidInput`` if the folder exists but contains no training run, or a training run with other
        settings.
        """
        run, total = RunDirectory(self.folder), self.training.recipe.total_steps
        if not run.status.exists():
            if self.folder.exists():
                raise InvalidInput(
                    f"{self.folder}: the folder was not written by a training run; move it, or give another --output"
                )
            return total
        try:
            status = read_object(run.status)
        except InvalidInput as error:
            raise InvalidInput(f"{error}; delete the run's folder to train again") from None
        check_same_training(run, self.training)
        if status.get("status") == "finished":
            return 0
        steps = status.get("steps", 0)
        return max(total - (steps if isinstance(steps, int) else 0), 1)

    def finish(self, tell: OnProgress | None = None) -> bool | None:
        """Start or continue the training run until it ends. Return True, or None if Ctrl-C stopped it.

        Raises the exceptions of ``train`` and ``resume``.
        """
        from ethbrake_marl.first_edition.training.session import resume, train  # torch takes seconds to load

        def say(progress: Progress) -> None:
            if tell is not None:
                tell(replace(progress, name=self.folder.name))

        run, asked = RunDirectory(self.folder), self.training
        if run.is_finished:
            return True
        if run.status.is_file():
            ended = resume(self.folder, on_progress=say)
        else:
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            ended = train(asked.recipe, asked.scenario, self.folder, settings=self.noted, on_progress=say)
        return True if ended.status == "finished" else None

    def attempt(self) -> str:
        """Start or continue the training run until it ends. Return "", or the reason if the training run fails.

        A finished run with damaged results fails too. Raises ``KeyboardInterrupt`` if Ctrl-C stopped the training run.
        """
        try:
            if self.steps_left() and not self.finish():
                raise KeyboardInterrupt
            self.result()
        except EthBrakeError as error:
            return str(error)
        return ""

    def result(self) -> dict[str, float]:
        """Return the evaluation of the saved policy, the best one in the finished training run.

        The entries are ``steps``, ``harm`` (the quantity that the saved policy has least) and the measures. Raises
        ``InvalidInput`` if they cannot be read.
        """
        try:
            return self._result()
        except (OSError, ValueError, KeyError, TypeError) as error:
            progress = RunDirectory(self.folder).progress
            raise InvalidInput(
                f"{progress}: is damaged ({plain_text(str(error))}); delete the run's folder to train again"
            ) from None

    def _result(self) -> dict[str, float]:
        measured = [row for row in RunDirectory(self.folder).rows() if row.get("eval/total_harm")]
        if not measured:
            raise ValueError("it contains no evaluation")
        harm = RunDirectory.chosen_by(measured, self.training.recipe.reward.harm_count, "eval/")
        best = min(measured, key=lambda row: float(row[harm]))
        measures = ("first_impact_harm", "total_harm", "collision_rate")
        return {
            "steps": int(best["steps"]),
            "harm": float(best[harm]),
            **{name: float(best[f"eval/{name}"]) for name in measures},
        }

    def time(self, sample: Sample | None = None) -> Timed:
        """Measure the time of a few updates of this training run, and the time in which its policies drive some worlds.

        The policies drive at most 50 worlds of ``sample`` (None: of the list on which the recipe evaluates).
        """
        from ethbrake_marl.first_edition.training.session import train

        reports: list[tuple[Progress, float]] = []  # with the CPU time

        def note(progress: Progress) -> None:
            reports.append((progress, time.process_time()))

        recipe, scenario = self.training.recipe, self.training.scenario
        short = recipe.replace(evaluation={**recipe.evaluation.model_dump(), "worlds": 10, "every_updates": 1000})
        with tempfile.TemporaryDirectory(prefix="ethbrake-") as folder:
            path = Path(folder) / "timed"
            train(short, scenario, path, steps=1, on_progress=lambda _: None)  # to compile and warm up
            started = Progress("begun", 0, 0), time.process_time()
            train(short, scenario, path, steps=4 * self.per_update, force=True, on_progress=note)
            updates = [one for one in reports if one[0].updates >= 1]
            last, last_s = updates[-1]
            first, first_s = updates[0] if updates[0][0].done < last.done else started
            decision_s = (last_s - first_s) / (last.done - first.done)
            worlds = scenario.sample(50, recipe.evaluation.seed) if sample is None else sample
            return Timed(self, decision_s, replace(self, folder=path).world_seconds(worlds))

    def world_seconds(self, sample: Sample) -> float:
        """Return the time in s that the trained policies need for one world of ``sample``."""
        team = {"team": load_team(self.folder, self.training.scenario)}
        drive = partial(evaluate, agents=team, scenario=self.training.scenario, aftermath=False)
        return Timed.each_s(sample.worlds, drive)


class Timed(NamedTuple):
    """Measured speed of a training run on one core, in CPU time, which other programs on the machine hardly affect."""

    job: TrainingJob  # the measured training
    decision_s: float  # training time divided by the number of decisions, s
    world_s: float  # time to evaluate the policies in one world, s

    def seconds(self, steps: int) -> float:
        """Estimate how long (s) this training run takes for ``steps`` decisions, including its evaluations.

        Policies are evaluated at the start, every few updates and at the end, on the recipe's list of worlds.
        """
        recipe = self.job.training.recipe
        times = recipe.total_steps // self.job.per_update // recipe.evaluation.every_updates + 2
        return steps * self.decision_s + steps / recipe.total_steps * times * recipe.evaluation.worlds * self.world_s

    @staticmethod
    def each_s(worlds: Worlds, work: Callable[[Worlds], object], most: int = 50) -> float:
        """Return the CPU time per world (s) that ``work`` needs, measured in the first ``most`` of ``worlds``.

        ``work`` first runs once with one world, so the measured time does not include compilation.
        """
        work(worlds.take([0]))
        some, started = worlds.take(range(min(worlds.n, most))), time.process_time()
        work(some)
        return (time.process_time() - started) / some.n

    @staticmethod
    def in_words(seconds: float) -> str:
        """Return a duration as text in seconds, minutes or hours: ``40 s``, ``12 min``."""
        if seconds < 90.0:
            return f"{seconds:.0f} s"
        return f"{seconds / 60.0:.0f} min" if seconds < 36_000.0 else f"{seconds / 3600.0:.0f} h"
