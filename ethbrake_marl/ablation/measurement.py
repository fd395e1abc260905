"""Everybody on the same worlds: what was trained, full braking, and the joint optimum of each level's learners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.ablation.levels import Level, common_worlds
from ethbrake_marl.ablation.plan import OPTIMUM, Plan
from ethbrake_marl.agents.team import Driver, Team
from ethbrake_marl.analysis.best_harm import search_list, world_identity
from ethbrake_marl.evaluation.rollout import Outcome, evaluate
from ethbrake_marl.harm import COUNTS, HarmCount
from ethbrake_marl.learning.teams import load_team
from ethbrake_marl.lineup import PROGRESS_EVERY, make_agent
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.scenario import Sample

Tell = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Harms:
    """What several trainings (or one script) did, on the same worlds."""

    world: dict[HarmCount, Floats]  # [seeds, worlds] harm of all vehicles (m2/s2)
    vehicle: dict[HarmCount, Floats]  # [seeds, worlds, N] harm of each
    collided: Bools  # [seeds, worlds]


@dataclass(frozen=True, slots=True)
class Measured:
    """One level under one algorithm."""

    level: Level
    algorithm: str | None  # None: nobody learns
    reached: Harms
    full_brake: Harms
    best: dict[HarmCount, Floats] | None  # [1, search_episodes] joint optimum, best known; None: nobody to control


def measure(plan: Plan, jobs: int = 1, tell: Tell | None = None) -> list[Measured]:
    """Let everything that was trained drive the common worlds, and search the joint optima (parts found are kept).

    Level by level in the plan's order, algorithm by algorithm. What some policy does better than the search becomes
    the best known of that world. Raises what loading teams and ``common_worlds`` raise.
    """
    samples = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    optimum = _Optimum(plan, jobs, tell or (lambda name, done, total: None))
    found: list[Measured] = []
    for level, sample in zip(plan.levels, samples, strict=True):
        searched = optimum.of(level, sample)
        braking = _driven(level, sample, [Team({}, "scripts") if not level.trained else make_agent("full_brake")], tell)
        if not level.trained:
            found.append(Measured(level, None, braking, braking, None))
            continue
        assert searched is not None
        for recipe, algorithm in zip(plan.recipes, plan.algorithms, strict=True):
            folders = [plan.training(level, recipe, seed).folder for seed in range(plan.seeds)]
            teams = [load_team(folder, level.scenario, folder.name) for folder in folders]
            reached = _driven(level, sample, teams, tell)
            found.append(Measured(level, algorithm, reached, braking, _with(searched, reached, plan.search_episodes)))
    return found


def _driven(level: Level, sample: Sample, drivers: Sequence[Driver], tell: Tell | None) -> Harms:
    """Harms of several drivers of one level."""
    outcomes = []
    for driver in drivers:
        result = evaluate(sample, {driver.name: driver}, scenario=level.scenario, chunk=PROGRESS_EVERY)
        outcomes.append(result.outcome(driver.name))
        if tell is not None:
            tell(f"driving {level.name}: {driver.name}", sample.worlds.n, sample.worlds.n)
    return harms_of(outcomes)


def harms_of(outcomes: Sequence[Outcome]) -> Harms:
    """The outcomes of several seeds on the same worlds, stacked."""
    return Harms(
        {count: np.stack([o.ledger.world_harm(count) for o in outcomes]) for count in COUNTS},
        {count: np.stack([o.ledger.vehicle_harm(count) for o in outcomes]) for count in COUNTS},
        np.stack([o.collided for o in outcomes]),
    )


def _with(searched: dict[HarmCount, Floats], reached: Harms, episodes: int) -> dict[HarmCount, Floats]:
    """The least of what was searched and what any training reached, world by world."""
    return {
        count: np.minimum(harm, reached.world[count][:, :episodes].min(axis=0))[np.newaxis]
        for count, harm in searched.items()
    }


class _Optimum:
    """Searches the joint optimum of each level, once for levels that ask the same question."""

    def __init__(self, plan: Plan, jobs: int, tell: Tell) -> None:
        self._plan, self._jobs, self._tell = plan, jobs, tell
        self._known: dict[bytes, dict[HarmCount, Floats]] = {}

    def of(self, level: Level, sample: Sample) -> dict[HarmCount, Floats] | None:
        """Best known harm [search_episodes] of each count; None without learners."""
        if not level.trained:
            return None
        plan, rows = self._plan, np.arange(self._plan.search_episodes)
        part = Sample(sample.worlds.take(rows), sample.index[rows], 0)
        question = world_identity(level.scenario, part.worlds).tobytes()
        if question not in self._known:
            table = search_list(
                level.scenario,
                part,
                budget=plan.budget,
                threads=self._jobs,
                chunks=plan.folder / OPTIMUM / level.name,
                on_progress=lambda done, total: self._tell(f"joint optimum of {level.name}", done, total),
            )
            self._known[question] = {count: best.harm for count, best in table.best.items()}
        return self._known[question]
