"""The Pareto front of harm: for each choice of weights, the least weighted harm and the harm of each vehicle.

A *choice of weights* has one weight for the harm of each vehicle. A point of the front is the mean harm of each vehicle
over the worlds, for one choice of weights. A search finds these points; they approximate the convex part of the Pareto
front, without a proof that no better ones exist. N vehicles, W choices of weights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import comb
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agent_names import make_teams, open_game
from ethbrake_marl.agents.team import Team
from ethbrake_marl.episode.counts import HONEST, AnyCount, HarmCount, all_counts
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.search.best_harm import best_harm, driven_profiles, starting_profiles
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, beside_braking, problem_of, with_braking
from ethbrake_marl.extensions.search.search import search_profiles
from ethbrake_marl.extensions.search.tables import best_stored
from ethbrake_marl.motion.layout import WEIGHT, Floats, Ints
from ethbrake_marl.policies.bundle import shipped_policies
from ethbrake_marl.worlds.scenario import Scenario

FRONT_BUDGET = 3_000  # candidates per world and choice of weights
FRONT_CONSTANTS = 101  # constant commands that every search tries
FRONT_CHUNK = 125  # worlds that are searched together; after each, a search may stop
MOST_CHOICES = 1_000  # choices of weights in a grid
SLIGHT = 1e-4  # weight of the other vehicles in a corner; their harm decides between equal choices
FIRST_SHARE = 0.6  # of the budget; the second round starts from the best results of all choices of weights

BorneHarm = Mapping[str, Floats]  # name of a count of harm -> harm that each vehicle bears
OnSearch = Callable[[int, int], None]  # called with the number of finished searches and of all


class Front(NamedTuple):
    """The harm of each vehicle in n worlds, under the best commands for each of W choices of weights."""

    weights: Floats  # [W, N] weights of the vehicles' harm
    harm_count: HarmCount  # which is weighted
    borne: BorneHarm  # [W, n, N] m2/s2 by count
    agents: Mapping[str, BorneHarm]  # agent -> harm of each vehicle if it drives, [W, n, N] m2/s2 by count

    @property
    def amounts(self) -> Floats:
        return np.stack(
            [weighted_harm(harm, row) for harm, row in zip(self.borne[self.harm_count.name], self.weights, strict=True)]
        )


def weighted_harm(borne: Floats, weights: Floats) -> Floats:
    """Weighted harm ``N sum_i w_i h_i / sum_i w_i``, [...] m2/s2, the same as in the objective ``weighted``.

    ``borne`` [..., N] is the harm h_i of each vehicle (m2/s2), ``weights`` [N] are the w_i.
    """
    total, weight_sum = np.zeros(borne.shape[:-1]), 0.0
    for i, weight in enumerate(weights.tolist()):
        total, weight_sum = total + weight * borne[..., i], weight_sum + weight
    return np.asarray(len(weights) * total / weight_sum)


def weight_grid(vehicles: int, steps: int) -> Floats:
    """W evenly spaced choices of weights, [W, N], with sum 1; from row to row 1 / ``steps`` moves from one vehicle to
    another.

    Raises ``InvalidInput`` for more than ``MOST_CHOICES`` choices.

    >>> from ethbrake_marl.extensions.cooperation import weight_grid
    >>> weight_grid(3, 1).tolist()
    [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    """
    number = comb(steps + vehicles - 1, steps)
    if number > MOST_CHOICES:
        raise InvalidInput(
            f"steps = {steps}: the grid has {number:,} choices of weights for {vehicles} vehicles, but at most"
            f" {MOST_CHOICES:,} are allowed; give fewer steps, or give the choices of weights yourself"
        )
    return np.array(_divisions(vehicles, steps)) / steps


def _divisions(vehicles: int, steps: int) -> list[list[int]]:
    """All ways to divide ``steps`` parts among the vehicles; consecutive ways differ in the place of one part."""
    if vehicles == 1:
        return [[steps]]
    divisions: list[list[int]] = []
    for first in range(steps + 1):
        rest_divisions = _divisions(vehicles - 1, steps - first)
        divisions += [[first, *rest] for rest in rest_divisions[:: -1 if first % 2 else 1]]
    return divisions


def corners(vehicles: int) -> Floats:
    """One choice of weights for each vehicle, [N, N]: 1 for it, ``SLIGHT`` for others, which decides between equals."""
    return np.where(np.eye(vehicles) == 1.0, 1.0, SLIGHT)


def weight_table(rows: Sequence[Sequence[Any]]) -> Floats:
    """Choices of weights, [W, N]. Raises ``InvalidInput`` for unequal rows, and for what is not a number."""
    numbers = all(isinstance(weight, int | float) and not isinstance(weight, bool) for row in rows for weight in row)
    if not numbers or len({len(row) for row in rows}) != 1:
        text = "; ".join(",".join(map(str, row)) for row in rows)
        raise InvalidInput(f"weights {text:.80}: must be numbers, the same count in each choice, for instance 1,4,1")
    return np.array(rows, np.float64)


def search_front(
    scenario: Scenario,
    worlds: State,
    weights: Sequence[Sequence[float]] | Floats,
    *,
    harm_count: AnyCount = HONEST,
    budget: int = FRONT_BUDGET,
    threads: int = 1,
    agents: Sequence[str] = (),
    on_progress: OnSearch | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Front:
    """Search every world for the commands with the least weighted harm, for every choice of weights.

    The result is at most the weighted harm of ``FRONT_CONSTANTS`` constant commands, the shipped profiles of this
    world, ``agents``, ``plan``, every shipped policy, and the results for all other choices; and, with several learners
    that decide at the same times, what the same search reaches with each of them alone. No world depends on another.

    >>> import ethbrake_marl as eb
    >>> from ethbrake_marl.extensions.cooperation import search_front
    >>> scenario = eb.load_scenario("paper-random")
    >>> front = search_front(scenario, scenario.sample(2, 7), [[1, 1, 1], [1, 0, 0]], budget=60)
    >>> bool((front.borne["honest"][1, :, 0] <= front.borne["honest"][0, :, 0]).all())
    True

    Args:
        scenario: its learners are controlled.
        worlds: n worlds at the alert.
        weights: weights of the vehicles' harm, [W, N].
        harm_count: count of harm that is weighted (``episode.counts``).
        budget: number of profiles (commands over time) that are tried for each world and choice of weights.
        threads: number of threads.
        agents: names of agents to compare. Each drives all learners, with each choice of weights as the scenario's
            ``harm_weight`` and the objective ``preference``.
        on_progress: called with the number of finished searches and of all searches: two for each world and choice,
            and, with several learners, two more for each learner.
        stop: called after every 125 worlds; if it returns True, the front has only the worlds searched so far.

    Raises ``InvalidInput`` if the weights are no table of numbers with a column for each vehicle, or cannot be a
    ``harm_weight``.

    """
    count = HarmCount.of(harm_count)
    weights = weight_table(weights.tolist() if isinstance(weights, np.ndarray) else weights)
    if weights.shape[1] != scenario.vehicles:
        raise InvalidInput(
            f"weights has shape {weights.shape}: give one or more choices of weights, each with one number for each of"
            f" the {scenario.vehicles} vehicles, for instance {','.join(['1', '4', *'1' * (scenario.vehicles - 2)])}"
        )
    if not scenario.learners:
        raise InvalidInput(f"scenario {scenario.name!r} has no learner, whose commands could be searched")
    names = [*agents, *(name for name in ("plan", *shipped_policies()) if name not in agents)]
    together = Drivers.of(scenario, weights, names, count)
    done, searches = 0, 2 * len(weights) * worlds.n * (1 + len(together.alone))

    def tell(more: int) -> None:
        nonlocal done
        done += more
        if on_progress is not None:
            on_progress(done, searches)

    tell(0)
    effort, parts = {"budget": budget, "threads": threads}, []
    for first in range(0, worlds.n, FRONT_CHUNK):
        pool, driven = _search_chunk(
            together, worlds.take(slice(first, first + FRONT_CHUNK)), weights, count, effort, tell
        )
        parts.append((pool.least(weights), driven))
        if stop():
            break
    borne = _join_chunks([least for least, _ in parts])
    return Front(weights, count, borne, {name: _join_chunks([driven[name] for _, driven in parts]) for name in agents})


def _join_chunks(parts: Sequence[BorneHarm]) -> BorneHarm:
    return {count: np.concatenate([part[count] for part in parts], axis=1) for count in parts[0]}


class Drivers(NamedTuple):
    game: Game
    preferring: Sequence[tuple[Game, Mapping[str, Team]]]  # for each choice: the game with these weights, and agents
    alone: Mapping[int, Drivers]  # body -> the same for each of several learners, while the others brake fully

    @staticmethod
    def of(scenario: Scenario, weights: Floats, names: Sequence[str], count: HarmCount) -> Drivers:
        """The learners, and for each choice of weights (row of ``weights`` [W, N]) the agents that minimise the
        weighted harm.

        ``alone``: the same for each of several learners by itself, with only the agents that can drive it.
        """
        chosen = [scenario.replace(harm_weight=row.tolist(), objective="preference") for row in weights]
        teams = [make_teams(names, variant, harm_count=count) for variant in chosen]
        preferring = [(open_game(variant)[1], agents) for variant, agents in zip(chosen, teams, strict=True)]
        alone = {}
        for body in scenario.learners if len(scenario.learners) > 1 else ():
            single = scenario.with_learners([scenario.vehicle_names[body - 1]])
            able = [name for name, team in make_teams(names, single).items() if [*team.drivers] == [body]]
            alone[body] = Drivers.of(single, weights, able, count)
        return Drivers(open_game(scenario)[1], preferring, alone)


def _search_chunk(
    drivers: Drivers,
    worlds: State,
    weights: Floats,
    count: HarmCount,
    effort: Mapping[str, int],
    tell: Callable[[int], None],
) -> tuple[ProfilePool, dict[str, BorneHarm]]:
    """Pool of the best profiles (commands over time) of all searches, and the harm of each vehicle if agents drive.

    Each of several learners is first searched alone. Then every choice of weights is searched twice; the second search
    starts from the best profiles of all choices.
    """
    pool = ProfilePool(problem_of(drivers.game, worlds, harm_count=count), count)
    driven, problem = _try_known_commands(pool, worlds, weights, drivers.preferring), pool.problem
    starts: list[list[Profiles]] = [[*starting_profiles(problem, worlds)] for _ in weights]
    for body, single in drivers.alone.items():
        braking_worlds = with_braking(worlds, [learner for learner in drivers.alone if learner != body])
        single_pool, _ = _search_chunk(single, braking_worlds, weights, count, effort, tell)
        for row_starts, row in zip(starts, weights, strict=True):
            row_starts.append(beside_braking(problem, single_pool.problem, single_pool.best(row)))
            pool.add(row_starts[-1])
    for k, share in enumerate((FIRST_SHARE, 1.0 - FIRST_SHARE)):
        spent = {**effort, "budget": max(int(share * effort["budget"]), 1)}
        for row_starts, row in zip(starts, weights, strict=True):
            aim = problem.with_weights(row / row.sum())
            pool.add(search_profiles(aim, [pool.best(row), *(row_starts if k == 0 else ())], **spent)[0])
            tell(problem.n)
    return pool, driven


def _try_known_commands(
    pool: ProfilePool, worlds: State, weights: Floats, preferring: Sequence[tuple[Game, Mapping[str, Team]]]
) -> dict[str, BorneHarm]:
    """Add constant commands, the shipped profiles, and the commands of agents to ``pool``.

    Returns agent -> count -> [W, n, N] m2/s2. ``preferring``: for each choice of weights, the game and its agents.
    """
    problem = pool.problem
    constants = problem.constant(problem.even_grid(FRONT_CONSTANTS))
    for q in range(FRONT_CONSTANTS):
        pool.add(constants.take(slice(q, None, FRONT_CONSTANTS)))
    pool.add(best_stored(problem, pool.harm_count)[1])
    driven: dict[str, list[BorneHarm]] = {name: [] for name in preferring[0][1]}
    for row, (game, teams) in zip(weights, preferring, strict=True):
        car = worlds.car.copy()
        car[:, WEIGHT, 1:] = row
        for name, team in teams.items():
            if driven[name] and not observes_weights(team):
                driven[name].append(driven[name][0])
            else:
                profiles = driven_profiles(problem, game, worlds._replace(car=car), team)
                driven[name].append(pool.add(profiles))
    return {
        name: {count: np.stack([borne[count] for borne in results]) for count in pool.borne}
        for name, results in driven.items()
    }


def observes_weights(team: Team) -> bool:
    """Whether a team's commands may depend on the weights: not if all drivers are policies that do not observe them."""
    policies = [getattr(agent, "policy", None) for agent in team.drivers.values()]
    feature_names = [() if policy is None else policy.observation.names for policy in policies]
    return team.shield is not None or any(
        not names or any("harm_weight" in name for name in names) for names in feature_names
    )


class ProfilePool:
    """Profiles (commands over time) that have been tried in n worlds, with the harm of each vehicle."""

    def __init__(self, problem: Problem, count: HarmCount) -> None:
        self.problem, self.harm_count = problem, count
        self.profiles: list[Profiles] = []
        self.counts = all_counts(count)
        self.borne: dict[str, list[Floats]] = {each.name: [] for each in self.counts}

    def add(self, profiles: Profiles) -> BorneHarm:
        self.profiles.append(profiles)
        last = self.problem.follow(profiles)
        for count in self.counts:
            self.borne[count.name].append(last.borne_harm(count))
        return {count: harms[-1] for count, harms in self.borne.items()}

    def choice(self, weights: Floats) -> Ints:
        """Number of the profile with the least weighted harm in each world, [n]; among equals, with the least total
        harm.
        """
        borne = np.stack(self.borne[self.harm_count.name])
        amounts = weighted_harm(borne, weights)
        least = amounts.min(axis=0)
        return np.asarray(np.where(amounts == least, borne.sum(axis=2), np.inf).argmin(axis=0))

    def best(self, weights: Floats) -> Profiles:
        """The profile with the least weighted harm in each world. ``weights`` [N]."""
        chosen, rows = self.choice(weights), np.arange(self.problem.n)
        numbers = np.unique(chosen)
        ends, commands = zip(*Profiles.pad([self.profiles[k] for k in numbers]), strict=True)
        place = np.searchsorted(numbers, chosen)
        return Profiles(np.stack(ends)[place, rows], np.stack(commands)[place, rows])

    def least(self, weights: Floats) -> BorneHarm:
        """Harm of each vehicle under the best profiles for each row of ``weights`` [W, N]: count -> [W, n, N] m2/s2."""
        chosen, rows = [self.choice(row) for row in weights], np.arange(self.problem.n)
        return {count: np.stack([np.stack(harms)[k, rows] for k in chosen]) for count, harms in self.borne.items()}


def least_largest(
    scenario: Scenario, worlds: State, front: Front, *, budget: int = FRONT_BUDGET, threads: int = 1
) -> BorneHarm:
    """Search for the commands that minimise the largest harm of a vehicle (maximin): count -> [n, N] m2/s2.

    The largest harm is at most that under any profile of ``front``, which must come from the same worlds.
    """
    game, parts = open_game(scenario)[1], []
    for first in range(0, worlds.n, FRONT_CHUNK):
        some = worlds.take(slice(first, first + FRONT_CHUNK))
        table = best_harm(
            game, some, harm_counts=(front.harm_count,), budget=budget, threads=threads, objective="maximin"
        )
        last = problem_of(game, some).follow(table.profiles[front.harm_count.name])
        parts.append({count.name: last.borne_harm(count)[np.newaxis] for count in all_counts(front.harm_count)})
    every = {count: np.concatenate([_join_chunks(parts)[count], front.borne[count]]) for count in front.borne}
    chosen = every[front.harm_count.name].max(axis=2).argmin(axis=0)
    return {count: borne[chosen, np.arange(worlds.n)] for count, borne in every.items()}
