"""The front of a list of worlds: for each set of weights the least weighted harm, and who bears what then.

For the mean harm over a list, weighted searches give the convex part of the Pareto front, world by world independently;
it is exact as far as the searches are. No bound is proven for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.protocol import Driver
from ethbrake_marl.engine.profiles import ProfileProblem, Profiles
from ethbrake_marl.extensions.fronts.hypervolume import nondominated
from ethbrake_marl.extensions.fronts.weights import checked_weights
from ethbrake_marl.extensions.search.best_harm import (
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
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.task import Task

BUDGET = 3_000  # candidates per world and weight

CONSTANTS = 101  # constant commands of which the front is never worse

CHUNK = 250  # worlds that are searched together

FIRST_SHARE = 0.6  # share of the budget for the first round; the second one starts from the best of all weights

Progress = Callable[[int, int], None]  # called with the number of worlds done and their total


class Front(NamedTuple):
    """For each of W sets of weights a command profile of each of n worlds, and the harm that each vehicle bears."""

    weights: Floats  # [W, N] weights of the vehicles' harm
    harm_count: HarmCount  # harm that is weighted: of each pair's ``first`` impact, or ``total``
    borne: Mapping[HarmCount, Floats]  # count of harm -> [W, n, N] harm of each vehicle, m2/s2
    profiles: tuple[Profiles, ...]  # W times [n]: the commands of the controlled vehicles

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
    agents: Sequence[Driver] = (),
    on_progress: Progress | None = None,
) -> Front:
    """Search the least weighted harm of every world under every set of weights.

    The result is in every world at least as good, under its weights, as ``CONSTANTS`` constant commands, as what was
    found for any other weights, as the shipped profile of least harm, and as ``agents``. It does not depend on
    ``threads`` or on the other worlds.

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
        agents: agents of the one learner, whose episodes count as candidates for all weights.
        on_progress: called with the number of worlds done and their total.

    Raises ``InvalidInput`` for weights that ``checked_weights`` refuses, and what ``best_harm`` raises.

    """
    weights = checked_weights(weights, scenario.vehicles)
    task = Task(scenario, scenario.learners, harm_count)
    effort = {"budget": budget, "seed": seed, "threads": threads}
    parts = []
    for first in range(0, worlds.n, CHUNK):
        some = worlds.take(np.arange(first, min(first + CHUNK, worlds.n)))
        parts.append(_searched(some, task, weights, effort, agents))
        if on_progress is not None:
            on_progress(first + some.n, worlds.n)
    borne = {count: np.concatenate([part.borne[count] for part in parts], axis=1) for count in HARM_COUNTS}
    profiles = []
    for several in zip(*(part.profiles for part in parts), strict=True):
        padded = Profiles.padded(several, 1)
        profiles.append(Profiles(*(np.concatenate(each) for each in zip(*padded, strict=True))))
    return Front(weights, harm_count, borne, tuple(profiles))


def _searched(
    worlds: Worlds, task: Task, weights: Floats, effort: Mapping[str, int], agents: Sequence[Driver]
) -> Front:
    """Return the front of a few worlds, from two rounds of searches, one per set of weights each.

    Args:
        worlds: the worlds at t = 0, [n].
        task: scenario, controlled vehicles and harm that is weighted.
        weights: [W, N] weights.
        effort: keywords ``budget``, ``seed`` and ``threads`` of ``search_profiles``.
        agents: agents whose episodes count too.

    """
    problem, pool = task_problem(worlds, task), Pool()
    starts = starting_profiles(problem, worlds, task, scripted_commands(worlds, task))
    constants = problem.constant(problem.even_grid(CONSTANTS))
    for q in range(CONSTANTS):
        pool.add(problem, constants.take(slice(q, None, CONSTANTS)))
    if len(task.vehicles) == 1:
        pool.add(problem, shipped_profiles(problem, task.harm_count)[0])
    for agent in agents:
        pool.add(problem, driven_profiles(agent, worlds, task, problem.last_step))
    aims = [problem.minimising(np.broadcast_to(row / row.sum(), (worlds.n, len(row)))) for row in weights]
    for k, share in enumerate((FIRST_SHARE, 1.0 - FIRST_SHARE)):
        spent = {**effort, "budget": max(int(share * effort["budget"]), 1)}
        for row, aim in zip(weights, aims, strict=True):
            given = [startable(pool.best(row, task.harm_count)), *(starts if k == 0 else ())]
            pool.add(problem, search_profiles(aim, joined(given, worlds.n), **spent)[0])
    return pool.front(weights, task.harm_count)


class Pool:
    """Profiles that are known in a few worlds, from which the best one of each world is chosen for any weights."""

    def __init__(self) -> None:
        self._profiles: list[Profiles] = []
        self._borne: dict[HarmCount, list[Floats]] = {count: [] for count in HARM_COUNTS}

    def add(self, problem: ProfileProblem, profiles: Profiles) -> None:
        """Add one profile for each world of ``problem``."""
        self._profiles.append(profiles)
        for count, borne in problem.borne(profiles).items():
            self._borne[count].append(borne)

    def choice(self, weights: Floats, harm_count: HarmCount) -> Ints:
        """Return the number of the profile of least weighted harm in each world, [n]; of equals, of least harm in all.

        ``weights`` [N] weigh the harm of each vehicle in the given count.
        """
        amounts = np.stack([amounts_of(borne, weights) for borne in self._borne[harm_count]])
        whole = np.stack([borne.sum(axis=1) for borne in self._borne[harm_count]])
        least = amounts.min(axis=0)
        return np.asarray(np.where(amounts == least, whole, np.inf).argmin(axis=0))

    def best(self, weights: Floats, harm_count: HarmCount) -> Profiles:
        """Return the profile of least weighted harm of each world, [n]; arguments as of ``choice``."""
        chosen = self.choice(weights, harm_count)
        parts = [(k, np.flatnonzero(chosen == k)) for k in np.unique(chosen)]
        padded = Profiles.padded([self._profiles[k].take(rows) for k, rows in parts], 1)
        back = np.argsort(np.concatenate([rows for _, rows in parts]), kind="stable")
        return Profiles(*(np.concatenate(each)[back] for each in zip(*padded, strict=True)))

    def front(self, weights: Floats, harm_count: HarmCount) -> Front:
        """Return the best known front for the rows of ``weights`` [W, N]."""
        chosen = [self.choice(row, harm_count) for row in weights]
        at = np.arange(len(chosen[0]))
        borne = {count: np.stack([np.stack(each)[k, at] for k in chosen]) for count, each in self._borne.items()}
        return Front(weights, harm_count, borne, tuple(self.best(row, harm_count) for row in weights))
