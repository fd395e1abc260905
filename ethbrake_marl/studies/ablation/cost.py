"""The cost of an ablation, measured on this machine before it starts."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.learning.team_file import load_team
from ethbrake_marl.learning.train import train
from ethbrake_marl.limits.best_harm import best_harm
from ethbrake_marl.progress import Progress
from ethbrake_marl.scenario import Sample, Scenario
from ethbrake_marl.studies.ablation.joint_optimum import parts_left, questions
from ethbrake_marl.studies.ablation.plan import Plan, Training, common_worlds

_UPDATES = 4  # of the training that is timed; the first one, which compiles and warms up, does not count
_TIMED_DRIVES, _TIMED_WORLDS = 50, 4  # worlds of the evaluation and of the search that are timed


@dataclass(frozen=True, slots=True)
class Cost:
    """Seconds of one core for what is left to do."""

    trainings: int
    decisions: int
    training_s: float
    driving_s: float
    search_s: float
    damaged: tuple[Path, ...]  # kept parts of a search that will be searched again

    @property
    def whole_s(self) -> float:
        """Everything."""
        return self.training_s + self.driving_s + self.search_s

    def __str__(self) -> str:
        """The cost in one line, and a line for each damaged part."""
        speed = f" at {self.decisions / self.training_s:,.0f}/s" if self.training_s > 0.0 else ""
        line = (
            f"to do: {self.trainings} trainings, {self.decisions:,} decisions{speed}: {_minutes(self.training_s)};"
            f" joint optima {_minutes(self.search_s)}; driving the common worlds {_minutes(self.driving_s)};"
            f" together about {_minutes(self.whole_s)} of one core"
        )
        return "\n".join([line, *(f"{file}: is damaged; its worlds are searched again" for file in self.damaged)])


def cost_of(plan: Plan) -> Cost:
    """Time a short training of each level and recipe, an evaluation and a search, and reckon up what is left.

    Other work on the machine counts as well: seconds are of the clock. Raises as ``Training.steps_left``.
    """
    left = [(training, training.steps_left()) for training in plan.trainings()]
    lists = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    samples = {level.name: _first(sample) for level, sample in zip(plan.levels, lists, strict=True)}
    training_s, worlds_s = 0.0, []
    for kind in {training.folder.name.rpartition("-seed")[0]: training for training, _ in left}.values():
        same = (kind.level.name, kind.algorithm)
        steps = sum(number for training, number in left if (training.level.name, training.algorithm) == same)
        if not steps:
            continue
        per_step_s, world_s = _time(kind, samples[kind.level.name])
        worlds_s.append(world_s)
        runs = steps / kind.recipe.total_steps
        training_s += steps * per_step_s + runs * _measurements(kind) * kind.recipe.evaluation.worlds * world_s
    if not worlds_s:
        worlds_s.append(_driving_s(left[0][0].folder, left[0][0].level.scenario, samples[left[0][0].level.name]))
    driving_s = sum(worlds_s) / len(worlds_s) * plan.episodes * (len(left) + len(plan.levels))
    trainings, decisions = sum(1 for _, steps in left if steps), sum(steps for _, steps in left)
    return Cost(trainings, decisions, training_s, driving_s, *_search(plan, lists))


def _first(sample: Sample) -> Sample:
    """The worlds that are timed."""
    rows = np.arange(min(_TIMED_DRIVES, sample.worlds.n))
    return sample.take(rows)


def _time(training: Training, sample: Sample) -> tuple[float, float]:
    """Seconds per decision, and per world that the policy drives."""
    told: list[Progress] = []
    recipe, scenario = training.recipe, training.level.scenario
    short = recipe.replace(evaluation={**recipe.evaluation.model_dump(), "worlds": 10, "every_updates": 1000})
    with tempfile.TemporaryDirectory(prefix="ethbrake-") as folder:
        path = Path(folder) / "timed"
        train(short, scenario, path, steps=1, on_progress=told.append)
        once = told[-1].done  # decisions of one update
        told.clear()
        train(short, scenario, path, steps=_UPDATES * once, force=True, on_progress=told.append)
        return _per_step(told), _driving_s(path, scenario, sample)


def _driving_s(folder: Path, scenario: Scenario, sample: Sample) -> float:
    """Seconds per world that a trained team drives."""
    team = load_team(folder, scenario)
    evaluate(sample.worlds.take(np.arange(min(5, sample.worlds.n))), {"warm": team}, scenario=scenario, aftermath=False)
    started = time.monotonic()
    evaluate(sample, {"team": team}, scenario=scenario, aftermath=False)
    return (time.monotonic() - started) / sample.worlds.n


def _per_step(told: Sequence[Progress]) -> float:
    """Seconds per decision between the first and the last update that was told."""
    updates = [one for one in told if one.updates >= 1]
    first, last = updates[0], updates[-1]
    if last.done == first.done:
        return last.wall_s / last.done
    return (last.wall_s - first.wall_s) / (last.done - first.done)


def _measurements(training: Training) -> int:
    """How often a training measures its policies on the fixed list: at first, now and then, and at the end."""
    recipe = training.recipe
    learners = len(training.level.scenario.learners)
    per_update = recipe.n_envs * learners * recipe.rounds
    return recipe.total_steps // per_update // recipe.evaluation.every_updates + 2


def _search(plan: Plan, samples: Sequence[Sample]) -> tuple[float, tuple[Path, ...]]:
    """Seconds for the worlds that are still to be searched, and the kept parts that are damaged."""
    seconds, damaged = 0.0, []
    for level, part, _ in questions(plan, samples):
        left, broken = parts_left(plan, level, part)
        damaged += broken
        if left:
            worlds = part.worlds.take(np.arange(min(_TIMED_WORLDS, part.worlds.n)))
            best_harm(level.scenario, worlds.take(np.arange(1)), budget=100, threads=1)
            started = time.monotonic()
            best_harm(level.scenario, worlds, budget=plan.budget, threads=1)
            seconds += (time.monotonic() - started) / worlds.n * left
    return seconds, tuple(damaged)


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90.0 else f"{seconds / 60.0:.0f} min"
