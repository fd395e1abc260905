"""Equilibria of several learners: each learner in turn improves its own commands, until no learner can improve.

A learner's profile is fixed at the alert (open loop), so no learner reacts to what the other learners do. The learners
know the whole world. One learner after the other searches for the profile that is best for its own objective while the
other learners keep their profiles. The search ends if no learner finds a better profile.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number, renumbered
from ethbrake_marl.extensions.search.best_harm import (
    SEARCH_BUDGET,
    best_harm,
    joined,
    scripted_commands,
    starting_profiles,
    task_problem,
)
from ethbrake_marl.extensions.search.problem import minimising, search_profiles, seeded
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.engine.profiles import MOST_PHASES, ProfileProblem, Profiles, profile_problem
from ethbrake_marl.first_edition.evaluation.statistics import relative_decrease
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.game.objectives import Declared
from ethbrake_marl.first_edition.physics.episode import CLOCK
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Vehicles, Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task

STARTS = ("braking", "driving", "random")  # names of the constant commands with which the search begins

BUDGET = 10_000  # number of candidate profiles that one search tries per world

ROUNDS = 12  # largest number of rounds; every learner searches once in a round

TOLERANCE = 0.01  # m2/s2; a learner changes its profile only if it gains more than this


class Equilibrium(NamedTuple):
    """Result of ``find_equilibria`` from one start, in n worlds with N vehicles and C learners."""

    profiles: Profiles  # commands of the learners, with one phase for each decision
    borne: dict[HarmCount, Floats]  # count of harm -> [n, N] harm of each vehicle, m2/s2
    converged: Bools  # [n] whether no learner gained more than the tolerance in the last round
    rounds: Ints  # [n] number of rounds, including the last round


class Spread(NamedTuple):
    """How much the equilibria from different starts differ in each world; starts that did not converge are left out."""

    found: Ints  # [n] number of starts that converged
    differs: Bools  # [n] whether the harm of a vehicle differs by more than the tolerance between two equilibria
    best: Floats  # [n, N] harm of each vehicle in the equilibrium with the least harm of the line, m2/s2; NaN: none
    worst: Floats  # [n, N] harm of each vehicle in the equilibrium with the greatest harm of the line, m2/s2; NaN: none


class _Game(NamedTuple):
    """Worlds, and the objective that each learner minimises in these worlds."""

    worlds: Worlds
    task: Task  # task of the learners
    declared: Declared  # objectives of the learners
    joint: ProfileProblem  # search problem of all learners together
    others: Floats  # [n, N] commands of the scripts, m/s2

    def take(self, rows: Ints) -> _Game:
        return self._replace(worlds=self.worlds.take(rows), joint=self.joint.take(rows), others=self.others[rows])

    def together(self, own: list[Profiles]) -> Profiles:
        """Join the profiles ``own``, one for each learner, into one profile with a phase for each decision."""
        steps = np.arange(int(self.joint.last_step.max()))
        at = [np.concatenate([each.at(np.full(self.joint.n, step)) for each in own], axis=1) for step in steps]
        return Profiles(np.minimum(steps + 1, self.joint.last_step[:, np.newaxis]), np.stack(at, axis=1))

    def amount(self, c: int, own: list[Profiles]) -> Floats:
        """Return the objective of learner ``c`` (from 0), [n] m2/s2, if all learners follow ``own``."""
        problem = minimising(self.joint, self.worlds, self.declared, self.task.vehicles[c : c + 1])
        return problem.values(self.together(own))[self.task.harm_count]

    def response(self, c: int, own: list[Profiles], effort: Mapping[str, int]) -> Profiles:
        """Search for the profile with the lowest objective of learner ``c`` (from 0) if the others follow ``own``.

        ``effort`` are keyword arguments of ``search_profiles``. For the same commands, the search for one learner and
        the search for all learners (``joint``) may compute slightly different harms, because of rounding.
        """
        task, others = replace(self.task, vehicles=self.task.vehicles[c : c + 1]), self.others
        problem = profile_problem(
            replace(self.worlds, vehicles=self._following(c, own)), task.vehicles, harm_count=task.harm_count,
            horizon_s=task.scenario.horizon_s, time_step_s=task.scenario.time_step_s, others_mps2=others,
            deciders=self.task.vehicles,
        )  # fmt: skip
        problem = minimising(problem, self.worlds, self.declared, task.vehicles)
        starts = starting_profiles(problem, self.worlds, task, others, [own[c]])
        return search_profiles(problem, joined(starts, problem.n), **effort)[0]

    def _following(self, c: int, own: list[Profiles]) -> Vehicles:
        """Return vehicle parameters that make all learners except ``c`` (from 0) follow their profiles in ``own``."""
        vehicles, clock, old = self.worlds.vehicles, self.joint.clock, self.worlds.vehicles.pieces
        count = old.shape[2] // 2
        pieces = np.full((*old.shape[:2], 2, max(count, MOST_PHASES)), np.inf)
        pieces[:, :, :, :count] = old.reshape(*old.shape[:2], 2, count)
        for d, vehicle in enumerate(self.task.vehicles):
            pieces[:, vehicle] = np.inf
            if d != c:
                begin = np.pad(own[d].ends, ((0, 0), (1, 0)))[:, :MOST_PHASES]
                used = begin < self.joint.last_step[:, np.newaxis]
                time = clock[:, [CLOCK.START]] + begin * clock[:, [CLOCK.TIME_STEP]] - vehicles.latency_s[:, [vehicle]]
                pieces[:, vehicle, 0, :MOST_PHASES] = np.where(used, np.maximum(time, 0.0), np.inf)
                pieces[:, vehicle, 1, :MOST_PHASES] = np.where(used, own[d].commands_mps2[:, :, 0], np.inf)
        return replace(vehicles, pieces=pieces.reshape(*old.shape[:2], -1))


def find_equilibria(
    scenario: Scenario,
    worlds: Worlds,
    objective: Declared | None = None,
    *,
    harm_count: HarmCount = "first",
    budget: int = BUDGET,
    rounds: int = ROUNDS,
    tolerance: float = TOLERANCE,
    seed: int = 0,
    threads: int = 1,
) -> dict[str, Equilibrium]:
    """Search equilibria of the scenario's learners by alternating best responses, once from each start in ``STARTS``.

    In every round, each learner searches for a profile that lowers its own objective, and adopts this profile if the
    objective falls by more than ``tolerance``. If no learner changes its profile in a round, the result is an
    equilibrium of open-loop profiles; it is only approximate because a search tries only ``budget`` profiles. A world
    may have further equilibria. The result for a world does not depend on the other worlds or on ``threads``.

    >>> import ethbrake_marl.first_edition as eb
    >>> from ethbrake_marl.extensions.cooperation import compare_starts, find_equilibria
    >>> level = eb.load_scenario("cooperation-3-pair")
    >>> ends = find_equilibria(level, level.sample(5, seed=7).worlds, "own", budget=300)
    >>> [*ends], compare_starts(ends, "first").differs.shape
    (['braking', 'driving', 'random'], (5,))

    Args:
        scenario: scenario of the worlds, with at least one learner.
        worlds: the n worlds at the alert.
        objective: objective of each learner: one for all, such as ``own``, or one for each vehicle of the line; None:
            the objective of the scenario.
        harm_count: ``first`` or ``total``.
        budget: number of profiles that one search tries per world.
        rounds: largest number of rounds; every learner searches once in a round.
        tolerance: gain that a learner must exceed to change its profile, m2/s2.
        seed: seed of the random start and of the searches.
        threads: number of threads of the searches.

    Returns an equilibrium for each name in ``STARTS``.

    Raises ``InvalidInput`` for a scenario without learners; for a script whose command is not fixed at the alert; for
    an objective that is neither a weighted sum of the vehicles' harm nor ``maximin``; and for a number out of range.
    Raises ``PhysicsError`` with the worlds in which a check of the physics failed.

    """
    check_whole_number("rounds", rounds, 1)
    if not 0.0 <= tolerance < math.inf:
        raise InvalidInput(f"tolerance = {tolerance!r}: the tolerance must be a finite number of m2/s2, at least 0")
    if not scenario.learners:
        raise InvalidInput(
            f"scenario {scenario.name!r}: the scenario has no learner; give at least one vehicle the role learner"
        )
    task, declared = (
        Task(scenario, scenario.learners, harm_count),
        scenario.objective if objective is None else objective,
    )
    game = _Game(worlds, task, declared, task_problem(worlds, task), scripted_commands(worlds, task))
    low, high = np.moveaxis(game.joint.bounds, 2, 0)
    draws = [seeded(game.joint.identity, seed + c) >> np.uint64(11) for c in range(low.shape[1])]
    share = np.stack(draws, axis=1) * 2.0**-53
    starts = dict(zip(STARTS, (low, high, np.clip(low + share * (high - low), low, high)), strict=True))
    equilibria = {}
    for k, (name, commands) in enumerate(starts.items()):
        own = [game.joint.constant(commands[:, np.newaxis, [c]]) for c in range(low.shape[1])]
        effort = {"budget": budget, "threads": threads, "seed": seed + k * rounds}
        equilibria[name] = _settle(game, own, rounds, tolerance, effort)
    return equilibria


def _settle(game: _Game, own: list[Profiles], rounds: int, tolerance: float, effort: Mapping[str, int]) -> Equilibrium:
    """Let the learners in turn improve the profiles ``own``, until no objective falls by more than ``tolerance``."""
    active, taken = np.arange(game.joint.n), np.zeros(game.joint.n, np.int64)
    for turn in range(rounds):
        part, mine = game.take(active), [each.take(active) for each in own]
        moved = np.zeros(len(active), np.bool_)
        with renumbered(active):
            for c in range(len(mine)):
                new = part.response(c, mine, {**effort, "seed": effort["seed"] + turn})  # new draws in each round
                better = part.amount(c, [*mine[:c], new, *mine[c + 1 :]]) < part.amount(c, mine) - tolerance
                mine[c].ends[better], mine[c].commands_mps2[better] = new.ends[better], new.commands_mps2[better]
                moved |= better
        for each, now in zip(own, mine, strict=True):
            each.ends[active], each.commands_mps2[active] = now.ends, now.commands_mps2
        taken[active] += 1
        active = active[moved]
        if not active.size:
            break
    together = game.together(own)
    return Equilibrium(together, game.joint.borne(together), ~np.isin(np.arange(game.joint.n), active), taken)


def compare_starts(ends: Mapping[str, Equilibrium], harm_count: HarmCount, tolerance: float = 0.1) -> Spread:
    """Compare, in each world, the equilibria that were reached from different starts.

    ``ends`` is the result of ``find_equilibria``. Two equilibria count as equal if the harm of each vehicle differs by
    at most ``tolerance`` (m2/s2).
    """
    converged = np.stack([each.converged for each in ends.values()])
    borne = np.where(converged[:, :, np.newaxis], np.stack([each.borne[harm_count] for each in ends.values()]), np.nan)
    line, rows = borne.sum(axis=2), np.arange(borne.shape[1])
    best, worst = np.where(converged, line, np.inf).argmin(axis=0), np.where(converged, line, -np.inf).argmax(axis=0)
    differs = (np.fmax.reduce(borne) - np.fmin.reduce(borne) > tolerance).any(axis=1)
    return Spread(converged.sum(axis=0), differs, borne[best, rows], borne[worst, rows])


def best_joint_harm(
    scenario: Scenario,
    worlds: Worlds,
    ends: Iterable[Equilibrium] = (),
    *,
    harm_count: HarmCount = "first",
    budget: int = SEARCH_BUDGET,
    seed: int = 0,
    threads: int = 1,
) -> dict[HarmCount, Floats]:
    """Return the harm of each vehicle in the joint optimum: count of harm -> [n, N] harm (m2/s2).

    In each world, the joint optimum is the result with the least harm of the line among the equilibria ``ends`` and the
    result of ``best_harm``, which searches the commands of all learners together.

    Args:
        scenario: scenario of the worlds.
        worlds: the n worlds at the alert.
        ends: equilibria of the scenario's learners in ``worlds``, for any objectives of the learners.
        harm_count: count that the search minimises, ``first`` or ``total``.
        budget: number of profiles that ``best_harm`` tries per world.
        seed: seed of the random numbers in ``best_harm``.
        threads: number of threads of ``best_harm``.

    """
    problem = task_problem(worlds, Task(scenario, scenario.learners, harm_count))
    table = best_harm(scenario, worlds, counts=(harm_count,), budget=budget, seed=seed, threads=threads)
    best = problem.borne(table.best[harm_count].profiles)
    for end in ends:
        better = end.borne[harm_count].sum(axis=1) < best[harm_count].sum(axis=1)
        for each in HARM_COUNTS:
            best[each][better] = end.borne[each][better]
    return best


def price_of_anarchy(borne: Floats, optimum: Floats) -> Estimate | None:
    """Return (line's mean harm in equilibrium) / (line's mean harm in the joint optimum) and its confidence interval.

    For the worst equilibria (``Spread.worst``), the ratio is called the price of anarchy. For the best equilibria
    (``Spread.best``), the ratio is called the price of stability. The result is None if the harm of the joint optimum
    is 0 in every world.

    Args:
        borne: [n, N] harm of each vehicle in equilibrium, m2/s2. Worlds with NaN (no equilibrium) are left out.
        optimum: [n, N] harm of each vehicle in the joint optimum, m2/s2.

    """
    rows = np.isfinite(borne).all(axis=1)
    saved = relative_decrease(borne[rows].sum(axis=1), optimum[rows].sum(axis=1))
    if saved is None:
        return None
    low, high = saved.ends
    return Estimate(1.0 - saved.value, saved.interval and (1.0 - high, 1.0 - low))
