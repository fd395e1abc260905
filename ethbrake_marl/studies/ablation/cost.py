"""The cost of an ablation, measured on this machine before it starts."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ethbrake_marl.agents.registry import make_single_agent
from ethbrake_marl.harm import HARM_COUNTS
from ethbrake_marl.limits.best_harm import best_harm
from ethbrake_marl.scenario import Sample, Task
from ethbrake_marl.shield.behind import drive_chunks
from ethbrake_marl.studies.ablation.joint_optimum import parts_left, questions
from ethbrake_marl.studies.ablation.plan import Plan, common_worlds
from ethbrake_marl.studies.jobs.cost import time_training, told_seconds, training_seconds, world_seconds

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
            f"to do: {self.trainings} trainings, {self.decisions:,} decisions{speed}: {told_seconds(self.training_s)};"
            f" joint optima {told_seconds(self.search_s)}; driving the common worlds {told_seconds(self.driving_s)};"
            f" together about {told_seconds(self.whole_s)} of one core"
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
        timed = time_training(kind.recipe, kind.level.scenario, samples[kind.level.name])
        worlds_s.append(timed.world_s)
        training_s += training_seconds(kind.recipe, kind.level.scenario, timed, steps)
    if not worlds_s:
        worlds_s.append(world_seconds(left[0][0].folder, left[0][0].level.scenario, samples[left[0][0].level.name]))
    driving_s = sum(worlds_s) / len(worlds_s) * plan.episodes * (len(left) + len(plan.levels))
    driving_s += 0.0 if plan.shield is None else _shielding_s(plan, samples)
    trainings, decisions = sum(1 for _, steps in left if steps), sum(steps for _, steps in left)
    return Cost(trainings, decisions, training_s, driving_s, *_search(plan, lists))


def _shielding_s(plan: Plan, samples: Mapping[str, Sample]) -> float:
    """Seconds behind the shield, of both counts; timed with learners that brake fully, which it replaces most often."""
    seconds = 0.0
    for level in plan.levels:
        if level.trained:
            worlds, task = samples[level.name].worlds, Task(level.scenario, level.scenario.learners)
            braking = make_single_agent("full_brake")
            drive_chunks(braking, worlds.take(np.arange(1)), task)  # compiles
            started = time.monotonic()
            drive_chunks(braking, worlds, task)
            each = (time.monotonic() - started) / worlds.n
            seconds += each * plan.episodes * plan.seeds * len(plan.recipes) * len(HARM_COUNTS)
    return seconds


def _first(sample: Sample) -> Sample:
    """The worlds that are timed."""
    rows = np.arange(min(_TIMED_DRIVES, sample.worlds.n))
    return sample.take(rows)


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
