"""Everybody on the same worlds: what was trained, full braking, and the joint optimum of each level's learners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.ablation.joint_optimum import Answer, best_known, search_all
from ethbrake_marl.ablation.levels import Level, common_worlds
from ethbrake_marl.ablation.plan import Plan
from ethbrake_marl.agents.team import Team
from ethbrake_marl.evaluation.rollout import Outcome, evaluate
from ethbrake_marl.harm import COUNTS, HarmCount
from ethbrake_marl.learning.teams import load_team
from ethbrake_marl.lineup import PROGRESS_EVERY
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.scenario import Sample, Scenario

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
    full_brake: Harms  # of all vehicles, whatever their roles
    best: dict[HarmCount, Floats] | None  # [1, search_episodes] joint optimum, best known; None: nobody to control


def load_teams(plan: Plan) -> dict[tuple[str, str], list[Team]]:
    """What was trained, by level and algorithm, seed by seed; raises what ``load_team`` raises."""
    teams: dict[tuple[str, str], list[Team]] = {}
    for training in plan.trainings():
        team = load_team(training.folder, training.level.scenario, training.folder.name)
        teams.setdefault((training.level.name, training.algorithm), []).append(team)
    return teams


def measure(plan: Plan, jobs: int = 1, tell: Tell | None = None) -> list[Measured]:
    """Let everything that was trained drive the common worlds, and search the joint optima (parts found are kept).

    Level by level in the plan's order, algorithm by algorithm. What some policy does better than the search becomes
    the best known of that world. Raises what loading teams and ``common_worlds`` raise, before any long work.
    """
    say = tell or (lambda name, done, total: None)
    teams = load_teams(plan)
    samples = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    tables = search_all(plan, samples, jobs, say)
    answers = {}
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.trained:
            own = [team for algorithm in plan.algorithms for team in teams[level.name, algorithm]]
            part = sample.worlds.take(np.arange(plan.search_episodes))
            answers[level.name] = Answer(level, part, tables[level.name], tuple(own))
    found: list[Measured] = []
    for level, sample in zip(plan.levels, samples, strict=True):
        braking = _driven(_all_brake(level.scenario), sample, [Team({}, f"full braking in {level.name}")], say)
        if not level.trained:
            scripts = _driven(level.scenario, sample, [Team({}, f"scripts of {level.name}")], say)
            found.append(Measured(level, None, scripts, braking, None))
            continue
        known = best_known(answers[level.name], list(answers.values()))
        best = {count: harm[np.newaxis] for count, harm in known.items()}
        for algorithm in plan.algorithms:
            reached = _driven(level.scenario, sample, teams[level.name, algorithm], say)
            found.append(Measured(level, algorithm, reached, braking, best))
    return found


def _all_brake(scenario: Scenario) -> Scenario:
    """The scenario with every vehicle braking fully."""
    return scenario.replace(roles=dict.fromkeys(scenario.vehicle_names, "full_brake"))


def _driven(scenario: Scenario, sample: Sample, teams: Sequence[Team], tell: Tell) -> Harms:
    """Harms of several teams of one level."""
    outcomes = []
    for team in teams:
        result = evaluate(sample, {team.name: team}, scenario=scenario, chunk=PROGRESS_EVERY).complete()
        outcomes.append(result.outcome(team.name))
        tell(f"driving {team.name}", sample.worlds.n, sample.worlds.n)
    return harms_of(outcomes)


def harms_of(outcomes: Sequence[Outcome]) -> Harms:
    """The outcomes of several seeds on the same worlds, stacked."""
    return Harms(
        {count: np.stack([o.ledger.world_harm(count) for o in outcomes]) for count in COUNTS},
        {count: np.stack([o.ledger.vehicle_harm(count) for o in outcomes]) for count in COUNTS},
        np.stack([o.collided for o in outcomes]),
    )
