"""Let the trained teams of all levels drive the same worlds, perhaps behind a shield, and search the joint optima."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.drive import Team
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.objectives import Objective, amounts, objectives_of
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.evaluate import Result, evaluate
from ethbrake_marl.evaluation.identity import about_scenario
from ethbrake_marl.evaluation.measures import Given, Measure
from ethbrake_marl.evaluation.statistics import Clusters
from ethbrake_marl.extensions.cooperation.levels import Level, Plan, common_worlds
from ethbrake_marl.extensions.cooperation.optimum import least_known, search_all
from ethbrake_marl.faces.shield import shield
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.names import make_agent, open_game, team_of
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.sampling import Drawn
from ethbrake_marl.worlds.scenario import Scenario

HARM = {"first": "first_impact_harm", "total": "total_harm"}  # count -> column
COUNTS = tuple(HARM)

Columns = dict[str, Floats]  # column of an evaluation -> [seeds, n]


class Measured(NamedTuple):
    """Results of one level with one algorithm, in the same worlds as all other levels."""

    level: Level
    algorithm: str | None  # None: the level has no learner
    reached: Columns  # with the trained teams, or with the scripts if there is no learner
    braking: Columns  # if all vehicles brake fully, [1, n]
    best: Mapping[str, Floats] | None = None  # count -> [1, m] least known harm in the first m worlds (m2/s2)
    shielded: Mapping[str, Columns] = MappingProxyType({})  # count that the shield bounds -> results
    goal: str = ""  # what the training minimises, in words; "": the level has no learner
    clusters: Clusters = None
    about: Mapping[str, Any] = MappingProxyType({})  # plain data: digests of worlds, scenario, policies; versions


def measure(plan: Plan, jobs: int, tell: OnProgress) -> list[Measured]:
    """Evaluate all levels and algorithms, and search the joint optimum of each level. All trainings are finished.

    Levels come in the order of the plan, each with the algorithms in theirs.
    """
    teams: dict[tuple[str, str], dict[str, Team]] = {}
    trainings: dict[tuple[str, str], Training] = {}
    for level, algorithm, seed, training, folder in plan.trainings():
        team = team_of(make_agent(f"team@{folder}", scenario=level.scenario), level.scenario)
        teams.setdefault((level.name, algorithm), {})[f"{algorithm} seed {seed}"] = team
        trainings[level.name, algorithm] = training
    worlds = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    answers = search_all(plan, worlds, jobs, tell)
    measured: list[Measured] = []
    for level, drawn in zip(plan.levels, worlds, strict=True):
        braking = level.scenario.replace(roles=dict.fromkeys(level.scenario.vehicle_names, "full_brake"))
        for algorithm in plan.algorithms if level.scenario.learners else (None,):
            tell(Progress(f"driving {level.name}", len(measured), len(plan.levels) * len(plan.algorithms)))
            own, training = {"scripts": Team("scripts", {})}, None
            if algorithm is not None:
                own, training = teams[level.name, algorithm], trainings[level.name, algorithm]
            result, reached = driven(level.scenario, drawn, own, training)
            _, full = driven(braking, all_braking(drawn), {"full_brake": Team("full_brake", {})}, training)
            behind = {}
            for count in COUNTS if plan.shield and training else ():
                guarded = {name: shield(team, mode=plan.shield, harm_count=count) for name, team in own.items()}
                behind[count] = driven(level.scenario, drawn, guarded, training)[1]
            if training is not None:
                for count, column in HARM.items():
                    answers[level.name].driven[count].extend(reached[column][:, : plan.search_episodes])
            policies = [dict(result.policies[name]) for name in own]
            measured.append(
                Measured(
                    level, algorithm, reached, full, None, behind, goal_of(training), result.clusters,
                    {**result.about, "policy_sha256": policies},
                )
            )  # fmt: skip
    best = {
        name: {count: least_known(answer, answers.values(), count)[np.newaxis] for count in COUNTS}
        for name, answer in answers.items()
    }
    return [each._replace(best=best.get(each.level.name)) for each in measured]


def driven(
    scenario: Scenario, drawn: Drawn, teams: Mapping[str, Team], training: Training | None
) -> tuple[Result, Columns]:
    """Let teams drive the worlds; return the result, and each column of numbers, [teams, n]."""
    measures = (Measure("bound", bound), Measure("decisions", decisions))
    if training is not None:
        measures += (Measure("goal", partial(minimised, training)),)
    result = evaluate(drawn, teams, open_game(scenario)[1], measures, about=about_scenario(scenario))
    columns = [result[name] for name in teams]
    numbers = [name for name in columns[0] if columns[0][name].dtype.kind in "fib" and all(name in c for c in columns)]
    return result, {name: np.stack([each[name] for each in columns]) for name in numbers}


def all_braking(drawn: Drawn) -> Drawn:
    """Return the worlds with the command of full braking for every vehicle."""
    worlds = drawn.worlds
    wanted = np.pad(-worlds.braking_capacity_mps2, ((0, 0), (1, 0)))
    return drawn._replace(worlds=worlds._replace(wanted=wanted))


def goal_of(training: Training | None) -> str:
    """Return what a training minimises, in words; "" without training."""
    if training is None:
        return ""
    count = "first-impact harm" if training.recipe.reward.harm_count == "first" else "total harm"
    return "objective" if own_objectives(training) else count


def own_objectives(training: Training) -> tuple[Objective, ...]:
    """Return the objectives of the vehicles; nothing if the learners minimise the harm of the line."""
    scenario = training.scenario
    objectives = objectives_of(training.recipe.reward.objective or scenario.objective, scenario.vehicles)
    forms = [objectives[body - 1].kind.form for body in scenario.learners]
    return () if set(forms) == {"total"} else tuple(objectives)


def bound(game: Game, alert: State, last: State) -> Given:
    """Harm that the step shield promises at the alert, [n] m2/s2."""
    memory: Any = last.memories.get("shield")
    return None if memory is None else memory.first


def decisions(game: Game, alert: State, last: State) -> Given:
    """Number of decisions of an episode, [n]."""
    return last.steps


def minimised(training: Training, game: Game, alert: State, last: State) -> Given:
    """What the training minimises, the mean over the learners, [n] m2/s2."""
    objectives, count = own_objectives(training), training.recipe.reward.harm_count
    if not objectives:
        return last.harm(count)
    each = amounts(objectives, None, last, count)
    return np.asarray(each[:, np.array(training.scenario.learners) - 1].mean(axis=1))
