"""Training everything that an ablation needs, and letting it drive the common worlds."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ethbrake_marl.agents.team import Team
from ethbrake_marl.evaluation.identity import policies_by_name, result_identity
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY
from ethbrake_marl.evaluation.outcome import Outcome
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.learning.team_file import load_team
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario import Sample, Scenario, Task
from ethbrake_marl.shield.behind import Shielded, drive_chunks, stack
from ethbrake_marl.studies.ablation.joint_optimum import LevelOptimum, best_known, search_all
from ethbrake_marl.studies.ablation.plan import Level, Plan, Training, common_worlds
from ethbrake_marl.studies.jobs.training import finish_trainings


def train_all(trainings: Sequence[Training], jobs: int, tell: OnProgress | None = None) -> bool:
    """Bring every training to its end, ``jobs`` at a time; False when Ctrl-C stopped it.

    The policies do not depend on ``jobs`` or on interruptions. Raises what ``Training.steps_left`` and ``train``
    raise.
    """
    return finish_trainings([training.job() for training in trainings if training.steps_left()], jobs, tell)


def check_finished(trainings: Iterable[Training]) -> None:
    """Raise what ``load_team`` raises for a finished training that cannot drive, before anything long is begun."""
    for training in trainings:
        if not training.steps_left():
            load_team(training.folder, training.level.scenario)


@dataclass(frozen=True, slots=True)
class Harms:
    """What several trainings (or one script) did, on the same worlds."""

    world: dict[HarmCount, Floats]  # [seeds, worlds] harm of all vehicles (m2/s2)
    vehicle: dict[HarmCount, Floats]  # [seeds, worlds, N] harm of each
    collided: Bools  # [seeds, worlds]
    policies: tuple[Mapping[str, str], ...] = ()  # of each seed: vehicle -> SHA-256 of its policy's manifest


@dataclass(frozen=True, slots=True)
class Measured:
    """One level under one algorithm."""

    level: Level
    algorithm: str | None  # None: nobody learns
    reached: Harms
    full_brake: Harms  # of all vehicles, whatever their roles
    best: dict[HarmCount, Floats] | None  # [1, search_episodes] joint optimum, best known; None: nobody to control
    identity: Mapping[str, Any] = field(default_factory=dict)  # of worlds and scenario, and what computed it
    shielded: dict[HarmCount, Shielded] | None = None  # [seeds, worlds] behind the shield that guards that count


def load_teams(plan: Plan) -> dict[tuple[str, str], list[Team]]:
    """What was trained, by level and algorithm, seed by seed; raises what ``load_team`` raises."""
    teams: dict[tuple[str, str], list[Team]] = {}
    for training in plan.trainings():
        team = load_team(training.folder, training.level.scenario, training.folder.name)
        teams.setdefault((training.level.name, training.algorithm), []).append(team)
    return teams


def measure(plan: Plan, jobs: int = 1, tell: OnProgress | None = None) -> list[Measured]:
    """Let everything that was trained drive the common worlds, and search the joint optima (parts found are kept).

    Level by level in the plan's order, algorithm by algorithm. What some policy does better than the search becomes
    the best known of that world. Raises what loading teams and ``common_worlds`` raise, before any long work.
    """
    say = tell or (lambda progress: None)
    teams = load_teams(plan)
    samples = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    tables = search_all(plan, samples, jobs, say)
    answers = {}
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.trained:
            own = [team for algorithm in plan.algorithms for team in teams[level.name, algorithm]]
            part = sample.worlds.take(np.arange(plan.search_episodes))
            answers[level.name] = LevelOptimum(level, part, tables[level.name], tuple(own))
    found: list[Measured] = []
    for level, sample in zip(plan.levels, samples, strict=True):
        braking = _drive(_all_brake(level.scenario), sample, [Team({}, f"full braking in {level.name}")], say)
        about = result_identity("ablate", level.scenario, sample)
        if not level.trained:
            scripts = _drive(level.scenario, sample, [Team({}, f"scripts of {level.name}")], say)
            found.append(Measured(level, None, scripts, braking, None, about))
            continue
        known = best_known(answers[level.name], list(answers.values()))
        best = {harm_count: harm[np.newaxis] for harm_count, harm in known.items()}
        for algorithm in plan.algorithms:
            own = teams[level.name, algorithm]
            reached = _drive(level.scenario, sample, own, say)
            behind = None if plan.shield is None else _drive_behind(level.scenario, sample, own, say)
            found.append(Measured(level, algorithm, reached, braking, best, about, behind))
    return found


def _all_brake(scenario: Scenario) -> Scenario:
    """The scenario with every vehicle braking fully."""
    return scenario.replace(roles=dict.fromkeys(scenario.vehicle_names, "full_brake"))


def _drive(scenario: Scenario, sample: Sample, teams: Sequence[Team], tell: OnProgress) -> Harms:
    """Harms of several teams of one level."""
    outcomes = []
    for team in teams:
        result = evaluate(sample, {team.name: team}, scenario=scenario, chunk=PROGRESS_EVERY).complete()
        outcomes.append(result.outcome(team.name))
        tell(Progress(f"driving {team.name}", sample.worlds.n, sample.worlds.n))
    policies = tuple(policies_by_name(outcome.policies, scenario) for outcome in outcomes)
    return replace(harms_of(outcomes), policies=policies)


def _drive_behind(
    scenario: Scenario, sample: Sample, teams: Sequence[Team], tell: OnProgress
) -> dict[HarmCount, Shielded]:
    """Several teams of one level behind one step shield, once for each count, which that shield guards."""
    found: dict[HarmCount, Shielded] = {}
    for harm_count in HARM_COUNTS:
        task = Task(scenario, scenario.learners, harm_count)
        parts = []
        for team in teams:
            parts.append(drive_chunks(team, sample.worlds, task))
            tell(Progress(f"driving {team.name} behind the shield, {harm_count}", sample.worlds.n, sample.worlds.n))
        found[harm_count] = stack(parts)
    return found


def harms_of(outcomes: Sequence[Outcome]) -> Harms:
    """The outcomes of several seeds on the same worlds, stacked."""
    return Harms(
        {harm_count: np.stack([o.ledger.world_harm(harm_count) for o in outcomes]) for harm_count in HARM_COUNTS},
        {harm_count: np.stack([o.ledger.vehicle_harm(harm_count) for o in outcomes]) for harm_count in HARM_COUNTS},
        np.stack([o.collided for o in outcomes]),
    )
