"""The front of a list of worlds: for each choice of weights, the least weighted harm and the harm of each vehicle.

A point of the front is the mean harm of each vehicle over the worlds, for one choice of weights. A search finds these
points; they approximate the convex part of the Pareto front, without a proof that no better ones exist. N vehicles, W
choices of weights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.drive import Team
from ethbrake_marl.episode.counts import COUNTS, check_count
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, check_one_learner
from ethbrake_marl.extensions.fronts.weights import weight_table
from ethbrake_marl.extensions.search.best_harm import best_harm, driven_profiles, starting_profiles
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, problem_of
from ethbrake_marl.extensions.search.search import search_profiles
from ethbrake_marl.extensions.search.tables import best_known
from ethbrake_marl.motion.layout import WEIGHT, Floats, Ints
from ethbrake_marl.names import make_teams, open_game
from ethbrake_marl.policies.bundle import shipped_policies
from ethbrake_marl.worlds.scenario import Scenario

BUDGET = 3_000  # candidates per world and choice of weights
CONSTANTS = 101  # constant commands that every search tries
CHUNK = 1_000  # worlds that are searched together
FIRST_SHARE = 0.6  # of the budget; the second round starts from the best results of all choices of weights

Borne = Mapping[str, Floats]  # count of harm -> harm that each vehicle bears
Progress = Callable[[int, int], None]  # called with the number of finished searches and of all


class Front(NamedTuple):
    """The harm of each vehicle in n worlds, with the best commands for each of W choices of weights."""

    weights: Floats  # [W, N] weights of the vehicles' harm
    harm_count: str  # count that is weighted (``episode.counts``)
    borne: Borne  # [W, n, N] m2/s2 by count
    agents: Mapping[str, Borne]  # agent -> harm of each vehicle if it drives, [W, n, N] m2/s2 by count

    @property
    def amounts(self) -> Floats:
        """Weighted harm of each world, [W, n] m2/s2."""
        return np.stack(
            [weighted(each, row) for each, row in zip(self.borne[self.harm_count], self.weights, strict=True)]
        )


def weighted(borne: Floats, weights: Floats) -> Floats:
    """Return the weighted harm ``N sum_i w_i h_i / sum_i w_i``, [...] m2/s2, as of the objective ``weighted``.

    ``borne`` [..., N] is the harm h of each vehicle, ``weights`` [N].
    """
    total, whole = np.zeros(borne.shape[:-1]), 0.0
    for i, weight in enumerate(weights.tolist()):
        total, whole = total + weight * borne[..., i], whole + weight
    return np.asarray(len(weights) * total / whole)


def search_front(
    scenario: Scenario,
    worlds: State,
    weights: Sequence[Sequence[float]] | Floats,
    *,
    count: str = "honest",
    budget: int = BUDGET,
    threads: int = 1,
    agents: Sequence[str] = (),
    on_progress: Progress | None = None,
) -> Front:
    """Search every world for the commands with the least weighted harm, for every choice of weights.

    This harm is at most that of ``CONSTANTS`` constant commands, and of the results for all other choices. With one
    learner it is also at most that of the shipped profile of this world, of each of ``agents``, and of every shipped
    policy that can drive here. A world's result depends on no other world.

    >>> import ethbrake_marl as eb
    >>> from ethbrake_marl.extensions.fronts.front import search_front
    >>> scenario = eb.load_scenario("paper-random")
    >>> front = search_front(scenario, scenario.sample(2, 7), [[1, 1, 1], [1, 0, 0]], budget=60)
    >>> bool((front.borne["honest"][1, :, 0] <= front.borne["honest"][0, :, 0]).all())
    True

    Args:
        scenario: its learners are controlled.
        worlds: n worlds at the alert.
        weights: weights of the vehicles' harm, [W, N].
        count: what is weighted (``episode.counts``).
        budget: number of profiles that are tried for each world and choice of weights.
        threads: number of threads.
        agents: names of agents that also drive, with each choice of weights as the scenario's ``harm_weight`` and the
            objective ``preference``; only with one learner.
        on_progress: called with the number of finished searches and of all, two for each world and choice.

    Raises ``InvalidInput`` for ``agents`` with several learners, and for weights that are no table of numbers with a
    column for each vehicle, or cannot be a ``harm_weight``.

    """
    check_count("count", count)
    weights = weight_table(weights.tolist() if isinstance(weights, np.ndarray) else weights)
    if weights.shape[1] != scenario.vehicles:
        raise InvalidInput(
            f"weights has shape {weights.shape}: give one or more choices of weights, each with one number for each of"
            f" the {scenario.vehicles} vehicles, for instance {','.join(['1', '4', *'1' * (scenario.vehicles - 2)])}"
        )
    learners = [scenario.vehicle_names[body - 1] for body in scenario.learners]
    if not learners:
        raise InvalidInput(f"scenario {scenario.name!r} has no learner, whose commands could be searched")
    if agents:
        check_one_learner(scenario.name, learners, "agents can drive only one learner")
    preferring = [scenario.replace(harm_weight=row.tolist(), objective="preference") for row in weights]
    silent = [name for name in shipped_policies() if name not in agents] if len(learners) == 1 else []
    teams = [make_teams([*agents, *silent], each, harm_count=count) for each in preferring]
    effort, parts, done = {"budget": budget, "threads": threads}, [], 0

    def tell(more: int) -> None:
        nonlocal done
        done += more
        if on_progress is not None:
            on_progress(done, 2 * len(weights) * worlds.n)

    game = open_game(scenario)[1]
    games = [open_game(each)[1] for each in preferring]
    for first in range(0, worlds.n, CHUNK):
        some = worlds.take(slice(first, first + CHUNK))
        pool = Pool(problem_of(game, some, count=count), count)
        driven = _tried(pool, some, weights, list(zip(games, teams, strict=True)))
        _search(pool, some, weights, effort, tell)
        parts.append((pool.least(weights), driven))
    borne = _joined([least for least, _ in parts])
    return Front(weights, count, borne, {name: _joined([driven[name] for _, driven in parts]) for name in agents})


def _joined(parts: Sequence[Borne]) -> Borne:
    return {count: np.concatenate([part[count] for part in parts], axis=1) for count in COUNTS}


def _tried(
    pool: Pool, worlds: State, weights: Floats, preferring: Sequence[tuple[Game, Mapping[str, Team]]]
) -> dict[str, Borne]:
    problem = pool.problem
    constants = problem.constant(problem.even_grid(CONSTANTS))
    for q in range(CONSTANTS):
        pool.add(constants.take(slice(q, None, CONSTANTS)))
    if len(problem.bodies) == 1:
        pool.add(best_known(problem, pool.count)[1])
    driven: dict[str, list[Borne]] = {name: [] for name in preferring[0][1]}
    for row, (game, teams) in zip(weights, preferring, strict=True):
        car = worlds.car.copy()
        car[:, WEIGHT, 1:] = row
        for name, team in teams.items():
            if driven[name] and not observes_weights(team):
                driven[name].append(driven[name][0])
            else:
                profiles = driven_profiles(problem, game, worlds._replace(car=car), team)
                driven[name].append(pool.add(profiles))
    return {name: {count: np.stack([one[count] for one in each]) for count in COUNTS} for name, each in driven.items()}


def observes_weights(team: Team) -> bool:
    """Return whether commands may depend on the weights of harm: no if there are only policies without this feature."""
    policies = [getattr(agent, "policy", None) for agent in team.drivers.values()]
    seen = [() if policy is None else policy.observation.names for policy in policies]
    return team.shield is not None or any(not names or any("harm_weight" in name for name in names) for names in seen)


def _search(pool: Pool, worlds: State, weights: Floats, effort: Mapping[str, int], tell: Callable[[int], None]) -> None:
    problem = pool.problem
    starts = starting_profiles(problem, worlds)
    aims = [problem.minimising(row / row.sum()) for row in weights]
    for k, share in enumerate((FIRST_SHARE, 1.0 - FIRST_SHARE)):
        spent = {**effort, "budget": max(int(share * effort["budget"]), 1)}
        for row, aim in zip(weights, aims, strict=True):
            given = [pool.best(row), *(starts if k == 0 else ())]
            pool.add(search_profiles(aim, given, **spent)[0])
            tell(problem.n)


class Pool:
    def __init__(self, problem: Problem, count: str) -> None:
        self.problem, self.count = problem, count
        self.profiles: list[Profiles] = []
        self.borne: dict[str, list[Floats]] = {each: [] for each in COUNTS}

    def add(self, profiles: Profiles) -> Borne:
        self.profiles.append(profiles)
        last = self.problem.follow(profiles)
        for count, each in self.borne.items():
            each.append(last.borne_harm(count))
        return {count: each[-1] for count, each in self.borne.items()}

    def choice(self, weights: Floats) -> Ints:
        """Return the number of the profile with the least weighted harm in each world, [n]; ties: the least harm."""
        borne = np.stack(self.borne[self.count])
        amounts = weighted(borne, weights)
        least = amounts.min(axis=0)
        return np.asarray(np.where(amounts == least, borne.sum(axis=2), np.inf).argmin(axis=0))

    def best(self, weights: Floats) -> Profiles:
        chosen, rows = self.choice(weights), np.arange(self.problem.n)
        used = np.unique(chosen)
        ends, commands = zip(*Profiles.padded([self.profiles[k] for k in used]), strict=True)
        place = np.searchsorted(used, chosen)
        return Profiles(np.stack(ends)[place, rows], np.stack(commands)[place, rows])

    def least(self, weights: Floats) -> Borne:
        """Return each vehicle's harm under the best profiles for all ``weights`` [W, N]: count -> [W, n, N]."""
        chosen, rows = [self.choice(row) for row in weights], np.arange(self.problem.n)
        return {count: np.stack([np.stack(each)[k, rows] for k in chosen]) for count, each in self.borne.items()}


def least_largest(scenario: Scenario, worlds: State, front: Front, *, budget: int = BUDGET, threads: int = 1) -> Borne:
    """Search for commands that minimise the largest harm of a vehicle; return each vehicle's harm.

    It is count -> [n, N] m2/s2. The largest harm is at most that under any profile of ``front``, which was searched in
    the same worlds.
    """
    game, parts = open_game(scenario)[1], []
    for first in range(0, worlds.n, CHUNK):
        some = worlds.take(slice(first, first + CHUNK))
        table = best_harm(game, some, counts=(front.harm_count,), budget=budget, threads=threads, objective="maximin")
        last = problem_of(game, some).follow(table.profiles[front.harm_count])
        parts.append({count: last.borne_harm(count)[np.newaxis] for count in COUNTS})
    every = {count: np.concatenate([_joined(parts)[count], front.borne[count]]) for count in COUNTS}
    chosen = every[front.harm_count].max(axis=2).argmin(axis=0)
    return {count: borne[chosen, np.arange(worlds.n)] for count, borne in every.items()}
