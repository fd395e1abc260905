"""The cost of what is left of a sweep, told before anything is begun."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.errors import count_of
from ethbrake_marl.learning.run_folder import RunDirectory
from ethbrake_marl.learning.training import Training
from ethbrake_marl.studies.jobs.cost import Timed, time_training, told_seconds, training_seconds
from ethbrake_marl.studies.sweep.plan import Row, SweepPlan
from ethbrake_marl.studies.sweep.run import RUNS, kept_results

_TIMED_DRIVES = 50  # worlds that each timed policy drives


@dataclass(frozen=True, slots=True)
class SweepCost:
    """Seconds of one core for what is left to do; begun jobs are reckoned whole."""

    rows: Sequence[Row]  # what is left
    decisions: int
    work_s: float
    processes: int
    recipes: int  # one job of each was timed

    def __str__(self) -> str:
        """The cost in one line."""
        if not self.rows:
            return "to do: nothing"
        return (
            f"to do: {count_of(len(self.rows), 'job')}, {self.decisions:,} decisions: about {told_seconds(self.work_s)}"
            f" of one core, {told_seconds(self.work_s / self.processes)} with {self.processes} at once"
            f" (a few updates of {count_of(self.recipes, 'recipe')} timed on this machine)"
        )


def cost_of(plan: SweepPlan, folder: Path, processes: int) -> SweepCost:
    """Time a short training of the first job of each recipe, and reckon up what is left."""
    left = kept_results(plan, folder)[1]
    steps: Counter[Row] = Counter()
    first: dict[object, Row] = {}
    for row in left:
        steps[first.setdefault(row.asked.kind, row)] += row.steps
    timed: dict[str, Timed] = {}
    work_s = 0.0
    for row, decisions in steps.items():
        training = plan.training(row)
        if row.asked.recipe not in timed:
            timed[row.asked.recipe] = _time(training)
        work_s += training_seconds(training.recipe, training.scenario, timed[row.asked.recipe], decisions)
    return SweepCost(left, sum(steps.values()), work_s, processes, len(timed))


def _time(training: Training) -> Timed:
    sample = training.scenario.sample(_TIMED_DRIVES, training.recipe.evaluation.seed)
    return time_training(training.recipe, training.scenario, sample)


def state_of(folder: Path, row: Row) -> str:
    """How far a job is that is not finished, in a word."""
    return "begun" if RunDirectory(folder / RUNS / row.name).status.is_file() else "new"
