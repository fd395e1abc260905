"""The front of a list of worlds: for each choice of weights, the least weighted harm and the harm of each vehicle.

A point of the front consists of the mean harm of each vehicle over the list of worlds, for one choice of weights. The
points approximate the convex part of the Pareto front. A search computes the points; there is no proof that no better
points exist.

N is the number of vehicles and W the number of choices of weights.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_one_learner
from ethbrake_marl.extensions.fronts.hypervolume import nondominated
from ethbrake_marl.extensions.search.best_harm import (
    best_harm,
    driven_profiles,
    joined,
    scripted_commands,
    startable,
    starting_profiles,
    task_problem,
)
from ethbrake_marl.extensions.search.problem import search_profiles
from ethbrake_marl.extensions.search.shipped import shipped_profiles
from ethbrake_marl.first_edition.agents.protocol import Driver
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem, Profiles
from ethbrake_marl.first_edition.evaluation.lineup import make_agents
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.game.objectives import weighted_harm
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds, checked_numbers
from ethbrake_marl.first_edition.policies.shipped import shipped_policies
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task

BUDGET = 3_000  # number of candidates per world and choice of weights

CONSTANTS = 101  # number of constant commands that every search tries

CHUNK = 1_000  # number of worlds that are searched together

# fraction of the budget for the first round; the second round starts from the best results of all choices of weights
FIRST_SHARE = 0.6

Borne = Mapping[HarmCount, Floats]  # harm that each vehicle bears, by harm count

Progress = Callable[[int, int], None]  # called with the number of finished searches and the number of all searches


class Front(NamedTuple):
    """Best profiles in n worlds for each of W choices of weights, and the resulting harm of each vehicle."""

    weights: Floats  # [W, N] weights of the vehicles' harm
    harm_count: HarmCount  # harm count that is weighted, ``first`` or ``total``
    borne: Borne  # harm of each vehicle, [W, n, N] m2/s2, by harm count
    profiles: tuple[Profiles, ...]  # commands of the controlled vehicles, [n] for each of the W choices of weights
    agents: Mapping[str, Borne]  # harm of each vehicle if an agent drives, [W, n, N] m2/s2 by count, by agent

    @property
    def amounts(self) -> Floats:
        """Weighted harm of each world, [W, n] m2/s2: ``N sum_i w_i h_i / sum_i w_i``, as in the objective ``weighted``.

        Here ``w_i`` is the weight of vehicle i and ``h_i`` its harm.
        """
        return np.stack(
            [amounts_of(each, row) for each, row in zip(self.borne[self.harm_count], self.weights, strict=True)]
        )

    def mean(self, harm_count: HarmCount | None = None) -> Floats:
        """Return the mean harm of each vehicle over the worlds, [W, N] m2/s2.

        ``harm_count`` None means the harm count that the search minimised.
        """
        mean: Floats = self.borne[harm_count or self.harm_count].mean(axis=1)
        return mean

    def nondominated(self) -> Bools:
        """Return a mask [W, n]: True for each profile that no other profile for the same world dominates.

        Profile A dominates profile B if no vehicle bears more harm under A than under B, and at least one bears less.
        """
        return nondominated(self.borne[self.harm_count].transpose(1, 0, 2)).T


def amounts_of(borne: Floats, weights: Floats) -> Floats:
    """Return the weighted harm of n worlds, [n] m2/s2, as in ``Front.amounts``.

    ``borne`` is the harm of each vehicle, [n, N] m2/s2; ``weights`` is [N].
    """
    return weighted_harm(borne, np.broadcast_to(weights, borne.shape))


def search_front(
    scenario: Scenario,
    worlds: Worlds,
    weights: Sequence[Sequence[float]] | Floats,
    *,
    harm_count: HarmCount = "first",
    budget: int = BUDGET,
    seed: int = 0,
    threads: int = 1,
    agents: Sequence[str] = (),
    on_progress: Progress | None = None,
) -> Front:
    """Search every world for the commands with the least weighted harm, for every choice of weights.

    For each choice of weights, the weighted harm of the result in a world is at most the weighted harm of each of
    ``CONSTANTS`` constant commands, and of the results for all other choices of weights. With one learner, this also
    holds for the shipped profile of this world, each of ``agents``, and every shipped policy that can drive the
    learner. The result for a world depends neither on ``threads`` nor on the other worlds. Raises the exceptions of
    ``best_harm`` and ``make_agents``, and ``InvalidInput`` if ``agents`` are given but the scenario has several
    learners, if ``weights`` is not a table of numbers with a column for each vehicle, or if a row of it cannot be the
    scenario's ``harm_weight``.

    >>> import ethbrake_marl.first_edition as eb
    >>> from ethbrake_marl.extensions.fronts.front import search_front
    >>> scenario = eb.load_scenario("paper-random")
    >>> front = search_front(scenario, scenario.sample(3, 7).worlds, [[1, 1, 1], [1, 0, 0]], budget=300)
    >>> bool((front.borne["first"][1, :, 0] <= front.borne["first"][0, :, 0]).all())
    True

    Args:
        scenario: scenario of the worlds; its learners are controlled.
        worlds: worlds at t = 0, [n].
        weights: weights of the vehicles' harm, [W, N].
        harm_count: harm count that is weighted, ``first`` or ``total``.
        budget: number of profiles to try for each world and choice of weights.
        seed: seed of the random search.
        threads: number of threads of the search.
        agents: specs of agents for the one learner, such as ``universal``. For each choice of weights, the agents drive
            every world, in the scenario with these weights as ``harm_weight`` and with the objective ``preference``.
        on_progress: called with the number of finished searches and of all searches, two for each world and choice of
            weights.

    """
    weights = checked_numbers("weights", weights)
    if weights.ndim != 2 or weights.shape[1] != scenario.vehicles:
        raise InvalidInput(
            f"weights has shape {weights.shape}: give one or more choices of weights, each with one number for each of"
            f" the {scenario.vehicles} vehicles, for instance {','.join(['1', '4', *'1' * (scenario.vehicles - 2)])}"
        )
    task = Task(scenario, scenario.learners, harm_count)
    effort = {"budget": budget, "seed": seed, "threads": threads}
    if agents:
        check_one_learner(
            scenario.name, [scenario.vehicle_names[i] for i in scenario.learners], "agents can drive only one learner"
        )
    silent = [spec for spec in _shipped_specs(scenario) if spec not in agents] if len(scenario.learners) == 1 else []
    preferring = [Preferring.of(scenario, row, agents, silent, harm_count) for row in weights]
    parts, done = [], 0

    def tell(more: int) -> None:
        nonlocal done
        done += more
        if on_progress is not None:
            on_progress(done, 2 * len(weights) * worlds.n)

    for first in range(0, worlds.n, CHUNK):
        some = worlds.take(np.arange(first, min(first + CHUNK, worlds.n)))
        parts.append(_searched(some, task, weights, effort, preferring, tell))
    profiles = []
    for several in zip(*(part.profiles for part in parts), strict=True):
        padded = Profiles.padded(several, 1)
        profiles.append(Profiles(*(np.concatenate(each) for each in zip(*padded, strict=True))))
    driven = {name: _joined_borne([part.agents[name] for part in parts]) for name in parts[0].agents}
    return Front(weights, harm_count, _joined_borne([part.borne for part in parts]), tuple(profiles), driven)


def least_largest(scenario: Scenario, worlds: Worlds, front: Front, *, budget: int = BUDGET, threads: int = 1) -> Borne:
    """Search for commands that minimise the largest harm of a vehicle; return each vehicle's harm.

    The result has [n, N] m2/s2 by harm count. In every world, the largest harm of a vehicle is at most the largest harm
    of a vehicle under any profile of ``front``, which was searched in the same worlds.
    """
    count, task = front.harm_count, Task(scenario, scenario.learners, front.harm_count)
    parts = []
    for first in range(0, worlds.n, CHUNK):
        some = worlds.take(np.arange(first, min(first + CHUNK, worlds.n)))
        table = best_harm(scenario, some, counts=(count,), budget=budget, threads=threads, objective="maximin")
        parts.append(task_problem(some, task).borne(table.best[count].profiles))
    searched = {each: np.concatenate([part[each] for part in parts])[np.newaxis] for each in HARM_COUNTS}
    every = {each: np.concatenate([searched[each], front.borne[each]]) for each in HARM_COUNTS}
    chosen = every[count].max(axis=2).argmin(axis=0)
    return {each: borne[chosen, np.arange(worlds.n)] for each, borne in every.items()}


def _joined_borne(parts: Sequence[Borne]) -> Borne:
    return {count: np.concatenate([part[count] for part in parts], axis=1) for count in HARM_COUNTS}


class Preferring(NamedTuple):
    """Scenario in which the weights of the vehicles' harm are fixed, and agents for this scenario."""

    scenario: Scenario  # scenario with fixed ``harm_weight`` and the objective ``preference``
    agents: Mapping[str, Driver]  # agents that are compared with the front, by spec
    silent: Mapping[str, Driver]  # further agents, whose commands are only candidates of the search, by spec

    @classmethod
    def of(
        cls, scenario: Scenario, weights: Floats, agents: Sequence[str], silent: Sequence[str], harm_count: HarmCount
    ) -> Preferring:
        """Return ``scenario`` with the fixed ``weights`` [N], and agents with the specs ``agents`` and ``silent``."""
        fixed = scenario.replace(harm_weight=weights.tolist(), objective="preference")
        made = (make_agents(specs, fixed, harm_count=harm_count) for specs in (agents, silent))
        return cls(fixed, *made)

    def weighted(self, worlds: Worlds) -> Worlds:
        """Return a copy of ``worlds`` in which each vehicle has the ``harm_weight`` of this scenario."""
        weight = np.broadcast_to(np.array(self.scenario.harm_weight, np.float64), worlds.speeds_mps.shape).copy()
        return replace(worlds, vehicles=replace(worlds.vehicles, harm_weight=weight))


def _shipped_specs(scenario: Scenario) -> list[str]:
    specs = []
    for name in shipped_policies():
        with suppress(InvalidInput):
            make_agents([name], scenario)
            specs.append(name)
    return specs


def _searched(
    worlds: Worlds,
    task: Task,
    weights: Floats,
    effort: Mapping[str, int],
    preferring: Sequence[Preferring],
    tell: Callable[[int], None],
) -> Front:
    """Search ``worlds`` (at t = 0, [n]) for every choice of weights [W, N], and return the front.

    There are two searches for each choice of weights. For each world and choice of weights, the second search starts
    from the profile with the least weighted harm among all that were already tried in this world. ``effort`` are the
    arguments ``budget``, ``seed`` and ``threads`` of ``search_profiles``. ``preferring`` has an element for each choice
    of weights. ``tell`` is called after each search with its number of worlds.
    """
    problem, pool = task_problem(worlds, task), Pool()
    starts = starting_profiles(problem, worlds, task, scripted_commands(worlds, task))
    constants = problem.constant(problem.even_grid(CONSTANTS))
    for q in range(CONSTANTS):
        pool.add(problem, constants.take(slice(q, None, CONSTANTS)))
    if len(task.vehicles) == 1:
        pool.add(problem, shipped_profiles(problem, task.harm_count)[0])
    driven: dict[str, list[Borne]] = {name: [] for name in (*preferring[0].agents, *preferring[0].silent)}
    for each in preferring:
        theirs = Task(each.scenario, task.vehicles, task.harm_count)
        for name, agent in (*each.agents.items(), *each.silent.items()):
            if driven[name] and not observes_weights(agent):
                driven[name].append(driven[name][0])
                continue
            profiles = driven_profiles(agent, each.weighted(worlds), theirs, problem.last_step)
            driven[name].append(pool.add(problem, profiles))
    aims = [problem.minimising(np.broadcast_to(row / row.sum(), (worlds.n, len(row)))) for row in weights]
    for k, share in enumerate((FIRST_SHARE, 1.0 - FIRST_SHARE)):
        spent = {**effort, "budget": max(int(share * effort["budget"]), 1)}
        for row, aim in zip(weights, aims, strict=True):
            first_profiles = [startable(pool.best(row, task.harm_count)), *(starts if k == 0 else ())]
            pool.add(problem, search_profiles(aim, joined(first_profiles, worlds.n), **spent)[0])
            tell(worlds.n)
    borne, best = pool.least(weights, task.harm_count)
    values = {
        name: {count: np.stack([each[count] for each in driven[name]]) for count in HARM_COUNTS}
        for name in preferring[0].agents
    }
    return Front(weights, task.harm_count, borne, best, values)


def observes_weights(agent: Driver) -> bool:
    """Return False if an agent is a trained policy that does not observe the weights of the vehicles' harm.

    For every other agent the result is True, because its commands may depend on the weights.
    """
    manifest = getattr(agent, "manifest", None)
    return manifest is None or any("harm_weight" in name for name in manifest.observation.features)


class Pool:
    """Profiles that were tried in the same worlds; for given weights, the methods choose each world's best profile."""

    def __init__(self) -> None:
        self._profiles: list[Profiles] = []
        self._borne: dict[HarmCount, list[Floats]] = {count: [] for count in HARM_COUNTS}

    def add(self, problem: ProfileProblem, profiles: Profiles) -> Borne:
        """Add ``profiles``, one for each world of ``problem``; return each vehicle's harm, [n, N] m2/s2 by count."""
        self._profiles.append(profiles)
        all_borne = problem.borne(profiles)
        for count, borne in all_borne.items():
            self._borne[count].append(borne)
        return all_borne

    def choice(self, weights: Floats, harm_count: HarmCount) -> Ints:
        """Return the number (from 0, in the order of ``add``) of each world's best profile, [n].

        This is the profile with the least harm weighted by ``weights`` [N]; among profiles with equal weighted harm, it
        is the profile with the least unweighted harm of the line.
        """
        borne = np.stack(self._borne[harm_count])
        amounts = amounts_of(borne.reshape(-1, len(weights)), weights).reshape(borne.shape[:2])
        whole = borne.sum(axis=2)
        least = amounts.min(axis=0)
        return np.asarray(np.where(amounts == least, whole, np.inf).argmin(axis=0))

    def best(self, weights: Floats, harm_count: HarmCount) -> Profiles:
        """Return each world's best profile (see ``choice``), [n]."""
        chosen = self.choice(weights, harm_count)
        parts = [(k, np.flatnonzero(chosen == k)) for k in np.unique(chosen)]
        padded = Profiles.padded([self._profiles[k].take(rows) for k, rows in parts], 1)
        back = np.argsort(np.concatenate([rows for _, rows in parts]), kind="stable")
        return Profiles(*(np.concatenate(each)[back] for each in zip(*padded, strict=True)))

    def least(self, weights: Floats, harm_count: HarmCount) -> tuple[Borne, tuple[Profiles, ...]]:
        """Choose the best profile of each world for each of W choices of weights, ``weights`` [W, N].

        Returns the harm of each vehicle, [W, n, N] m2/s2 by harm count, and the profiles [n] for each choice of
        weights.
        """
        chosen = [self.choice(row, harm_count) for row in weights]
        at = np.arange(len(chosen[0]))
        borne = {count: np.stack([np.stack(each)[k, at] for k in chosen]) for count, each in self._borne.items()}
        return borne, tuple(self.best(row, harm_count) for row in weights)
