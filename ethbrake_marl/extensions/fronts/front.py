"""The front of a list of worlds: for each set of weights the least weighted harm, and who bears what then.

For the mean harm over a list, weighted searches give the convex part of the Pareto front, world by world independently;
it is exact as far as the searches are. No bound is proven for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.protocol import Driver
from ethbrake_marl.engine.profiles import ProfileProblem, Profiles
from ethbrake_marl.errors import InvalidInput, check_one_learner
from ethbrake_marl.evaluation.lineup import make_agents
from ethbrake_marl.extensions.fronts.hypervolume import nondominated
from ethbrake_marl.extensions.fronts.weights import checked_weights
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
from ethbrake_marl.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.game.objectives import weighted_harm
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.policies.shipped import shipped_policies
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.task import Task

BUDGET = 3_000  # candidates per world and weight

CONSTANTS = 101  # constant commands of which the front is never worse

CHUNK = 1_000  # worlds that are searched together

FIRST_SHARE = 0.6  # share of the budget for the first round; the second one starts from the best of all weights

Borne = Mapping[HarmCount, Floats]

Progress = Callable[[int, int], None]  # called with the number of searches done and their total


class Front(NamedTuple):
    """For each of W sets of weights a command profile of each of n worlds, and the harm that each vehicle bears."""

    weights: Floats  # [W, N] weights of the vehicles' harm
    harm_count: HarmCount  # harm that is weighted: of each pair's ``first`` impact, or ``total``
    borne: Borne  # count of harm -> [W, n, N] harm of each vehicle, m2/s2
    profiles: tuple[Profiles, ...]  # W times [n]: the commands of the controlled vehicles
    agents: Mapping[str, Borne]  # agent -> harm of each vehicle where this agent drives for each set of weights

    @property
    def amounts(self) -> Floats:
        """Weighted harm of each world, [W, n] m2/s2: ``N sum_i w_i h_i / sum_i w_i``, as ``weighted:...`` has it."""
        return np.stack(
            [amounts_of(each, row) for each, row in zip(self.borne[self.harm_count], self.weights, strict=True)]
        )

    def mean(self, harm_count: HarmCount | None = None) -> Floats:
        """Return the mean harm of each vehicle over the worlds, [W, N] m2/s2; None: in the count that is weighted."""
        mean: Floats = self.borne[harm_count or self.harm_count].mean(axis=1)
        return mean

    def nondominated(self) -> Bools:
        """Return which of the W profiles of each world no other one of this world beats, [W, n] bool."""
        return nondominated(self.borne[self.harm_count].transpose(1, 0, 2)).T


def amounts_of(borne: Floats, weights: Floats) -> Floats:
    """Return the weighted harm of n worlds, [n] m2/s2.

    ``borne``: harm of each vehicle, [n, N] m2/s2; ``weights``: [N].
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
    """Search the least weighted harm of every world under every set of weights.

    The result is in every world at least as good, under its weights, as ``CONSTANTS`` constant commands, as what was
    found for any other weights, as the shipped profile of least harm, as ``agents``, and, with one learner, as every
    shipped policy that can drive it. It does not depend on ``threads`` or on the other worlds.

    >>> import ethbrake_marl as eb
    >>> from ethbrake_marl.extensions.fronts.front import search_front
    >>> scenario = eb.load_scenario("paper-random")
    >>> front = search_front(scenario, scenario.sample(3, 7).worlds, [[1, 1, 1], [1, 0, 0]], budget=300)
    >>> bool((front.borne["first"][1, :, 0] <= front.borne["first"][0, :, 0]).all())
    True

    Args:
        scenario: the scenario of the worlds; its learners are controlled.
        worlds: the worlds at t = 0, [n].
        weights: [W, N] weights of the vehicles' harm.
        harm_count: harm that is weighted, ``first`` or ``total``.
        budget: candidates per world and set of weights.
        seed: seed of the random search.
        threads: number of threads.
        agents: specs of agents of the one learner, such as ``universal``. Each drives every world once for each
            set of weights, as the scenario's ``harm_weight`` and objective ``preference``.
        on_progress: called with the number of searches done and their total, two for each world and set of weights.

    Raises ``InvalidInput`` for weights that ``checked_weights`` refuses or agents beside several learners, and what
    ``best_harm`` and ``make_agents`` raise.

    """
    weights = checked_weights(weights, scenario.vehicles)
    task = Task(scenario, scenario.learners, harm_count)
    effort = {"budget": budget, "seed": seed, "threads": threads}
    if agents:
        check_one_learner(scenario.name, [scenario.vehicle_names[i] for i in scenario.learners], "agents drive one")
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
    """Return the harm of each vehicle where whoever bears most bears least: count of harm -> [n, N] m2/s2.

    It is searched like ``best_harm`` under the objective ``maximin``, and never worse by it than a point of the front.

    Args:
        scenario: the scenario of the worlds.
        worlds: the worlds at t = 0, [n].
        front: their front.
        budget: candidates per world.
        threads: number of threads.

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
    """A scenario in which the harm of the vehicles has given weights, and agents made for it."""

    scenario: Scenario  # with fixed ``harm_weight`` and the objective ``preference``
    agents: Mapping[str, Driver]  # spec -> agent, to be shown
    silent: Mapping[str, Driver]  # spec -> further agents, whose episodes count as candidates only

    @classmethod
    def of(
        cls, scenario: Scenario, weights: Floats, agents: Sequence[str], silent: Sequence[str], harm_count: HarmCount
    ) -> Preferring:
        """Return the scenario with ``weights`` [N], and the agents with these specs for it."""
        fixed = scenario.replace(harm_weight=weights.tolist(), objective="preference")
        made = (make_agents(specs, fixed, harm_count=harm_count) for specs in (agents, silent))
        return cls(fixed, *made)

    def weighted(self, worlds: Worlds) -> Worlds:
        """Return the worlds with their ``harm_weight`` replaced by that of this scenario."""
        weight = np.broadcast_to(np.array(self.scenario.harm_weight, np.float64), worlds.speeds_mps.shape).copy()
        return replace(worlds, vehicles=replace(worlds.vehicles, harm_weight=weight))


def _shipped_specs(scenario: Scenario) -> list[str]:
    """Return the specs of all shipped policies that can drive the one learner of the scenario."""
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
    """Return the front of a few worlds, from two rounds of searches, one per set of weights each.

    Args:
        worlds: the worlds at t = 0, [n].
        task: scenario, controlled vehicles and harm that is weighted.
        weights: [W, N] weights.
        effort: keywords ``budget``, ``seed`` and ``threads`` of ``search_profiles``.
        preferring: for each set of weights the agents whose episodes count too.
        tell: called after each search with the number of worlds.

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
    """Return whether an agent may heed the weights: all but trained policies that do not observe them."""
    manifest = getattr(agent, "manifest", None)
    return manifest is None or any("harm_weight" in name for name in manifest.observation.features)


class Pool:
    """Profiles that are known in a few worlds, from which the best one of each world is chosen for any weights."""

    def __init__(self) -> None:
        self._profiles: list[Profiles] = []
        self._borne: dict[HarmCount, list[Floats]] = {count: [] for count in HARM_COUNTS}

    def add(self, problem: ProfileProblem, profiles: Profiles) -> Borne:
        """Add one profile for each world of ``problem``, and return the harm of each vehicle, [n, N] by count."""
        self._profiles.append(profiles)
        all_borne = problem.borne(profiles)
        for count, borne in all_borne.items():
            self._borne[count].append(borne)
        return all_borne

    def choice(self, weights: Floats, harm_count: HarmCount) -> Ints:
        """Return the number of the profile of least weighted harm in each world, [n]; of equals, of least harm in all.

        ``weights`` [N] weigh the harm of each vehicle in the given count.
        """
        borne = np.stack(self._borne[harm_count])
        amounts = amounts_of(borne.reshape(-1, len(weights)), weights).reshape(borne.shape[:2])
        whole = borne.sum(axis=2)
        least = amounts.min(axis=0)
        return np.asarray(np.where(amounts == least, whole, np.inf).argmin(axis=0))

    def best(self, weights: Floats, harm_count: HarmCount) -> Profiles:
        """Return the profile of least weighted harm of each world, [n]; arguments as of ``choice``."""
        chosen = self.choice(weights, harm_count)
        parts = [(k, np.flatnonzero(chosen == k)) for k in np.unique(chosen)]
        padded = Profiles.padded([self._profiles[k].take(rows) for k, rows in parts], 1)
        back = np.argsort(np.concatenate([rows for _, rows in parts]), kind="stable")
        return Profiles(*(np.concatenate(each)[back] for each in zip(*padded, strict=True)))

    def least(self, weights: Floats, harm_count: HarmCount) -> tuple[Borne, tuple[Profiles, ...]]:
        """Return harm and profiles of the best choice for each row of ``weights`` [W, N]: [W, n, N] and W times [n]."""
        chosen = [self.choice(row, harm_count) for row in weights]
        at = np.arange(len(chosen[0]))
        borne = {count: np.stack([np.stack(each)[k, at] for k in chosen]) for count, each in self._borne.items()}
        return borne, tuple(self.best(row, harm_count) for row in weights)
