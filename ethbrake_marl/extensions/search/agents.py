"""The agent ``best_harm``, which chooses all its commands at the alert."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agent_names import AgentSettings, make_agent, open_game, team_of
from ethbrake_marl.agents.e_v2x_bm import Predicting
from ethbrake_marl.episode.counts import BUILT_IN_COUNTS, HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import MODEL
from ethbrake_marl.episode.state import FIRST_DECISION, State
from ethbrake_marl.errors import InvalidInput, Unfamiliar
from ethbrake_marl.extensions.search.best_harm import (
    SEARCH_BUDGET,
    best_harm as search_best_harm,
    driven_profiles,
    e_v2x_bm_profiles,
)
from ethbrake_marl.extensions.search.in_game import GAME_CANDIDATES, search_in_game
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, have_one_objective, problem_of, with_braking
from ethbrake_marl.extensions.search.search import search_profiles
from ethbrake_marl.extensions.search.tables import best_stored, outdated_tables
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part
from ethbrake_marl.worlds.open_game import game_of
from ethbrake_marl.worlds.roles import HOLDING_SCRIPTS, LEARNER
from ethbrake_marl.worlds.scenario import Scenario

MOST_CANDIDATES = 1_000_000
START = {"honest": "plan"}  # name of a count -> agent with whose commands a search begins
OTHER_START = "ppo"  # the agent for every other count
DECISION_ROUNDING = 1e-6  # part of a step: a time this close before a decision counts as the decision


class SearchMemory(NamedTuple):
    commands_mps2: Floats  # [n, T] at every decision
    start_s: Floats  # [n] time of the first decision
    predicted_harm: Floats  # [n] m2/s2


class BestHarm(Predicting):
    """Drives the best known commands: from a shipped table, or from a search, as if other learners braked fully.

    If they do, the harm that happens is the memory's ``predicted_harm``, to the last bit. If it is the only learner, it
    never does more harm than E-V2X-BM and the agent of ``START``, with whose commands its search begins. Several
    learners with one objective follow the joint optimum of an ablation: the best known commands of all of them
    together. Where scripts react, the search plays its candidates in the game (``search_in_game``).
    """

    knows = MODEL

    def __init__(
        self, scenario: Scenario, harm_count: AnyCount = HONEST, budget: int | None = None, name: str = "best_harm"
    ) -> None:
        """``budget``: candidates per world; None: ``SEARCH_BUDGET``, or ``GAME_CANDIDATES`` where scripts react."""
        self.name, self.scenario, self.harm_count = name, scenario, HarmCount.of(harm_count)
        self.budget, self.game_candidates = budget or SEARCH_BUDGET, budget or GAME_CANDIDATES
        self.last_plan: tuple[bytes, SearchMemory] | None = None  # worlds, and plan of all learners, who ask in turn

    def begin(self, alert: State, body: int) -> SearchMemory:
        """Choose all commands. Raises ``InvalidInput`` if several learners plan jointly and a script reacts."""
        learners = self.scenario.learners
        is_joint = len(learners) > 1 and body in learners
        if is_joint and have_one_objective(alert, self.scenario.objective, learners):
            plan = self.joint_plan(alert)
            return plan._replace(commands_mps2=plan.commands_mps2[:, :, learners.index(body)])
        if reacting_scripts(self.scenario, [body]):
            return self.plan_in_game(alert, body)
        game, alert = single_learner_game(self.scenario, alert, body)
        problem = problem_of(game, alert, harm_count=self.harm_count, objective=self.scenario.objective)
        commands, harm = self.choose(game, alert, problem, body)
        return SearchMemory(commands, problem.state.clock[:, FIRST_DECISION].copy(), harm)

    def act(self, state: State, memory: SearchMemory, body: int) -> tuple[Floats, SearchMemory]:
        step = np.floor((state.time_s - memory.start_s) / self.scenario.time_step_s + DECISION_ROUNDING).astype(
            np.int64
        )
        at = np.clip(step, 0, memory.commands_mps2.shape[1] - 1)
        return memory.commands_mps2[np.arange(state.n), at], memory

    def plan_in_game(self, alert: State, body: int) -> SearchMemory:
        scenario, game = open_game(self.scenario, [self.scenario.vehicle_names[body - 1]])
        start = START.get(self.harm_count.name, OTHER_START)
        commands, harm = search_in_game(
            game, alert, candidates=self.game_candidates, harm_count=self.harm_count, objective=scenario.objective,
            teams=[team_of(make_agent(start, scenario=scenario), scenario)],
        )  # fmt: skip
        return SearchMemory(commands, game.reset(alert).clock[:, FIRST_DECISION].copy(), harm)

    def joint_plan(self, alert: State) -> SearchMemory:
        """[n, T, L] m/s2."""
        for vehicle, role in reacting_scripts(self.scenario, self.scenario.learners).items():
            raise InvalidInput(
                f"scenario {self.scenario.name!r}: vehicle_{vehicle} is driven by {role!r}, whose commands are not"
                " known at the alert; a joint search of several learners needs scripts that hold one command"
            )
        game, objective = game_of(self.scenario, {}, "first-impact-harm")[1], self.scenario.objective
        problem = problem_of(game, alert, harm_count=self.harm_count, objective=objective)
        worlds = problem.identity.tobytes()
        if self.last_plan is None or self.last_plan[0] != worlds:
            known_harm, profiles = best_stored(problem, self.harm_count)
            commands = profiles.stepwise(int(problem.last_step.max()))
            some = (np.isinf(known_harm) | (objective != "total")).nonzero()[0]
            if len(some):
                counts = BUILT_IN_COUNTS if self.harm_count in BUILT_IN_COUNTS else (self.harm_count,)
                table = search_best_harm(
                    game, alert.take(some), harm_counts=counts, budget=self.budget, objective=objective
                )
                commands[some] = table.profiles[self.harm_count.name].stepwise(commands.shape[1])
            harm = problem.value(problem.follow(Profiles.of_steps(commands, problem.last_step)))
            self.last_plan = worlds, SearchMemory(commands, problem.state.clock[:, FIRST_DECISION].copy(), harm)
        return self.last_plan[1]

    def check(self, game: Game, body: int) -> None:
        """Warn (``Unfamiliar``) if the scenario's table was made for other physics and is not used."""
        outdated = outdated_tables()
        if game.name in outdated:
            warnings.warn(f"{self.name}: searches every world: {outdated[game.name]}", Unfamiliar, stacklevel=2)

    def choose(self, game: Game, alert: State, problem: Problem, body: int) -> tuple[Floats, Floats]:
        """At all T decisions, [n, T] m/s2, and what they cost, [n] m2/s2."""
        known_harm, profiles = best_stored(problem, self.harm_count)
        commands = profiles.stepwise(int(problem.last_step.max()))[:, :, 0]
        harm = problem.value(problem.follow(profiles))
        some = (np.isinf(known_harm) | (self.scenario.objective != "total")).nonzero()[0]
        if len(some):
            commands[some], harm[some] = self.search(
                game, alert.take(some), problem.take(some), body, commands.shape[1]
            )
        return commands, harm

    def search(self, game: Game, alert: State, problem: Problem, body: int, steps: int) -> tuple[Floats, Floats]:
        """[n, ``steps``] m/s2, and what they cost, [n] m2/s2."""
        starts = [e_v2x_bm_profiles(problem, alert)]
        if self.scenario.learners == (body,):
            start = START.get(self.harm_count.name, OTHER_START)
            team = team_of(make_agent(start, scenario=self.scenario), self.scenario)
            starts.append(driven_profiles(problem, game, alert, team))
        profiles, values = search_profiles(problem, starts, budget=self.budget)
        return profiles.stepwise(steps)[:, :, 0], values[self.harm_count.name]


def single_learner_game(scenario: Scenario, alert: State, body: int) -> tuple[Game, State]:
    """Game whose only learner is vehicle ``body``, and its worlds at the alert, in which other learners brake fully."""
    braking_learners = [learner for learner in scenario.learners if learner != body]
    alone = scenario.with_learners([scenario.vehicle_names[body - 1]])
    _, game = game_of(alone, {}, "first-impact-harm")  # the reward is not used
    return game, with_braking(alert, braking_learners)


def reacting_scripts(scenario: Scenario, bodies: Sequence[int]) -> dict[int, str]:
    """Vehicle (1: Vehicle 1) -> script, for scripts whose commands are not known at the alert; without ``bodies``."""
    return {
        vehicle: role
        for vehicle, role in enumerate(scenario.roles.values(), 1)
        if vehicle not in bodies and role.partition(":")[0] not in (LEARNER, *HOLDING_SCRIPTS)
    }


def make_best_harm(argument: str | None, settings: AgentSettings) -> BestHarm:
    budget = None if argument is None else int(argument) if re.fullmatch("[0-9]{1,7}", argument) else 0
    if budget is not None and not 1 <= budget <= MOST_CANDIDATES:
        raise InvalidInput(
            f"agent {settings.spec!r}: after the colon, give the number of profiles to try in each world, from 1 to"
            f" {MOST_CANDIDATES:,}, for instance best_harm:{SEARCH_BUDGET}"
        )
    return BestHarm(settings.needed_scenario(), settings.harm_count, budget, settings.spec)


BEST_HARM = Part(
    make_best_harm,
    form="best_harm[:CANDIDATES]",
    about="drives the best known profile; searches at the alert if no profile is stored",
    knows=MODEL,
)
SEARCH_LADDER = ("best_harm",)  # what `--agents ladder` adds to the core's
