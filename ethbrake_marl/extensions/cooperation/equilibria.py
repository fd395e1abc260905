"""Equilibria of several learners: in turn, each improves its own plan, until none can.

A plan holds the commands of every decision and is fixed at the alert (open loop), so no learner reacts to what the
others do; the learners know the whole world. In its turn, a learner searches for the plan that is best for its own
objective while the others keep theirs. n worlds, N vehicles, L learners, T decisions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.objectives import Declared
from ethbrake_marl.episode.state import NUMBER, State
from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number
from ethbrake_marl.evaluation.statistics import decrease
from ethbrake_marl.extensions.search.best_harm import BUDGET as JOINT_BUDGET, best_harm
from ethbrake_marl.extensions.search.kernels import PLAN, gather, improve
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, aimed, problem_of
from ethbrake_marl.extensions.search.search import field_for, prepared, seeded
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.names import open_game
from ethbrake_marl.worlds.scenario import Scenario

STARTS = ("braking", "driving", "random")  # constant commands with which the search begins
BUDGET = 10_000  # plans that a learner tries in its turn, in each world
ROUNDS = 12  # in each of which every learner has its turn once
TOLERANCE = 0.01  # m2/s2; a learner changes its plan only if it gains more than this
APART = 0.1  # m2/s2; equilibria differ if the harm of a vehicle differs by more than this
SHARES, BORDERS = np.linspace(0.0, 1.0, 9), (3, 8, 15)  # of plans of two commands that every turn tries
FIELD, SAME = 4, 1e-3  # plans that are improved; those closer in value (m2/s2) count as the same
DRAWING = np.array([PLAN, 40, 25, 25])  # changes begin within 40 decisions, and last up to 25


class Equilibrium(NamedTuple):
    profiles: Profiles  # commands of the learners, with one phase for each decision
    borne: Floats  # harm of each vehicle, [n, N] m2/s2
    converged: Bools  # [n] whether no learner gained more than the tolerance in the last round
    rounds: Ints  # [n] number of rounds, the last one included


class Spread(NamedTuple):
    """How much the equilibria from different starts differ in each world; starts that did not converge are left out."""

    found: Ints  # [n] number of starts that converged
    differs: Bools  # [n] whether the harm of a vehicle differs
    best: Floats  # [n, N] harm of each vehicle in the equilibrium with the least harm of the line, m2/s2; NaN: none
    worst: Floats  # [n, N] the same with the most harm


def find_equilibria(
    scenario: Scenario,
    worlds: State,
    objective: Declared | None = None,
    *,
    count: str = "first",
    budget: int = BUDGET,
    rounds: int = ROUNDS,
) -> dict[str, Equilibrium]:
    """Search equilibria of the scenario's learners by best responses in turn, once from each start in ``STARTS``.

    If no learner changes its plan in a round, the result is an equilibrium of plans. It is approximate, because a turn
    tries only ``budget`` plans, and a world may have other equilibria. A world's result depends on no other world.

    >>> import ethbrake_marl as eb
    >>> from ethbrake_marl.extensions.cooperation import compare_starts, find_equilibria
    >>> level = eb.load_scenario("cooperation-3-pair")
    >>> ends = find_equilibria(level, level.sample(5, seed=7), "own", budget=300)
    >>> [*ends], compare_starts(ends).differs.shape
    (['braking', 'driving', 'random'], (5,))

    Args:
        scenario: with at least one learner.
        worlds: at the alert.
        objective: of each learner: one for all, such as ``own``, or one for each vehicle; None: the scenario's.
        count: what counts as harm (``episode.counts``).
        budget: number of plans that a learner tries in each turn, in each world.
        rounds: largest number of rounds; in a round, every learner has one turn.

    Raises ``InvalidInput`` for a scenario without learners, a script that looks at the state, and an objective that is
    neither a weighted sum of the vehicles' harm nor ``maximin``.

    """
    check_whole_number("rounds", rounds, 1)
    check_whole_number("budget", budget, 1)
    if not scenario.learners:
        raise InvalidInput(f"scenario {scenario.name!r} has no learner; give at least one vehicle the role learner")
    game, declared = open_game(scenario)[1], scenario.objective if objective is None else objective
    joint = problem_of(game, worlds, count=count)
    turns = [turn_of(game, worlds, body, declared, count) for body in scenario.learners]
    low, high = np.moveaxis(joint.bounds, 2, 0)
    draws = [seeded(joint.identity, c) >> np.uint64(11) for c in range(len(turns))]
    drawn = np.clip(low + np.stack(draws, axis=1) * 2.0**-53 * (high - low), low, high)
    ends = {}
    for k, (name, commands) in enumerate(zip(STARTS, (low, high, drawn), strict=True)):
        plans = np.repeat(commands[:, np.newaxis], int(joint.last_step.max()), axis=1)
        converged, taken = _settle(turns, plans, budget, rounds, k * rounds)
        profiles = Profiles.of_steps(plans, joint.last_step)
        ends[name] = Equilibrium(profiles, joint.follow(profiles).borne_harm(count), converged, taken)
    return ends


def turn_of(game: Game, worlds: State, body: int, declared: Declared, count: str) -> Problem:
    bodies = [body, *(other for other in game.rules.learners.tolist() if other != body)]
    problem = problem_of(game, worlds, bodies, count=count)
    return aimed(problem._replace(bodies=problem.bodies[:1]), declared)._replace(bodies=problem.bodies)


def _settle(turns: list[Problem], plans: Floats, budget: int, rounds: int, seed: int) -> tuple[Bools, Ints]:
    """Improve ``plans`` [n, T, L] in place; return whether the learners converged, [n], and the rounds used, [n].

    ``turns``: for each learner, the problem with its objective and this learner first.
    """
    active, taken = np.arange(len(plans)), np.zeros(len(plans), np.int64)
    for turn in range(rounds):
        moved = np.zeros(len(active), np.bool_)
        for c, whole in enumerate(turns):
            problem, others = whole.take(active), [d for d in range(len(turns)) if d != c]
            now = plans[active][:, :, [c, *others]]
            new = respond(problem, now, budget, seed + turn)  # new draws in each round
            profiles = (Profiles.of_steps(each, problem.last_step) for each in (now, new))
            before, after = (problem.value(problem.follow(each)) for each in profiles)
            better = after < before - TOLERANCE
            plans[active[better], :, c] = new[better, :, 0]
            moved |= better
        taken[active] += 1
        active = active[moved]
        if not active.size:
            break
    return ~np.isin(np.arange(len(plans)), active), taken


def respond(problem: Problem, plans: Floats, budget: int, seed: int) -> Floats:
    """Return plans [n, T, B] in which only the first of B vehicles has new commands: the best that a search finds.

    The search improves the best of its present plan, of plans with two commands and of random ones, by changing a few
    decisions at a time. Raises ``PhysicsError`` for a world in which no plan can be simulated.
    """
    random, found = seeded(problem.identity, seed), plans.copy()
    shape = T, _ = plans.shape[1:]
    for k, plan in enumerate(plans):
        world, room = prepared(problem, k, random, T, True)
        world = world._replace(
            bounds=np.ascontiguousarray(world.bounds[:1])
        )  # only the first vehicle's commands change
        ends, tried = (
            np.minimum(np.arange(1, T + 1), problem.last_step[k]),
            other_plans(plan, world.bounds[0], budget // 3),
        )
        field = field_for(FIELD, *shape)
        steps = np.repeat(ends[np.newaxis], len(tried), axis=0)
        gather(world, room, steps, tried, np.full(len(tried), T), 0, DRAWING, SAME, field)
        each = max((budget - len(tried)) // (2 * FIELD), 1)
        for m in np.flatnonzero(field.phases):
            field.values[m], _ = improve(world, room, ends, field.commands[m], each, DRAWING, 0.0)
        best = field.commands[int(field.values.argmin())]
        value, _ = improve(world, room, ends, best, FIELD * each, DRAWING, 0.0)
        if not value < np.inf:
            raise PhysicsError({int(problem.state.clock[k, NUMBER]): "no plan can be simulated"})
        found[k] = best
    return found


def other_plans(plan: Floats, bounds: Floats, number: int) -> Floats:
    """Return the plan [T, B], and copies with other commands of its first vehicle, [Q, T, B].

    These commands are two values of a grid, or up to four random values; full braking, full driving and short phases
    are likely. ``bounds``: its smallest and largest command (m/s2). ``number``: how many copies, at least the whole
    grid.
    """
    low, high = bounds
    steps, rng = np.arange(len(plan)), np.random.default_rng(number)
    grid = low + SHARES * (high - low)
    mine = [np.full(len(plan), one) for one in grid]
    mine += [np.where(steps < border, one, two) for border in BORDERS for one in grid for two in grid if one != two]
    more = max(number - len(mine), 0)
    commands = low + rng.choice([0.0, 0.0, 1.0, -1.0], (more, 4)).clip(0.0) * (high - low)
    commands = np.where(rng.random((more, 4)) < 0.5, low + rng.random((more, 4)) * (high - low), commands)
    ends = np.cumsum(1 + (rng.random((more, 3)) ** 2 * 25.0).astype(np.int64), axis=1)
    phases = (ends[:, np.newaxis] <= steps[:, np.newaxis]).sum(axis=2)
    tried = np.repeat(plan[np.newaxis], 1 + len(mine) + more, axis=0)
    tried[1 : 1 + len(mine), :, 0] = mine
    tried[1 + len(mine) :, :, 0] = np.take_along_axis(commands, phases, 1)
    tried[1:, :, 0] = np.clip(tried[1:, :, 0], low, high)  # rounding
    return tried


def compare_starts(ends: Mapping[str, Equilibrium]) -> Spread:
    converged = np.stack([each.converged for each in ends.values()])
    borne = np.where(converged[:, :, np.newaxis], np.stack([each.borne for each in ends.values()]), np.nan)
    line, rows = borne.sum(axis=2), np.arange(borne.shape[1])
    best, worst = np.where(converged, line, np.inf).argmin(axis=0), np.where(converged, line, -np.inf).argmax(axis=0)
    differs = (np.fmax.reduce(borne) - np.fmin.reduce(borne) > APART).any(axis=1)
    return Spread(converged.sum(axis=0), differs, borne[best, rows], borne[worst, rows])


def best_joint_harm(
    scenario: Scenario, worlds: State, ends: Iterable[Equilibrium], *, budget: int = JOINT_BUDGET, count: str = "first"
) -> Floats:
    """Return the harm of each vehicle in the joint optimum, [n, N] m2/s2.

    In each world this is the result with the least harm of the line, among the equilibria ``ends`` (of any objectives)
    and ``best_harm``, a search over the commands of all learners together.
    """
    game = open_game(scenario)[1]
    table = best_harm(game, worlds, counts=(count,), budget=budget, threads=1)
    best = problem_of(game, worlds).follow(table.profiles[count]).borne_harm(count)
    for end in ends:
        better = end.borne.sum(axis=1) < best.sum(axis=1)
        best[better] = end.borne[better]
    return best


def price_of_anarchy(borne: Floats, optimum: Floats) -> Estimate | None:
    """Return (line's mean harm in equilibrium) / (line's mean harm in the joint optimum), with a confidence interval.

    For the worst equilibria (``Spread.worst``) this is the price of anarchy, for the best ones the price of stability.
    Both arguments are [n, N] m2/s2; worlds with NaN (no equilibrium) are left out. None if the joint optimum does no
    harm.
    """
    rows = np.isfinite(borne).all(axis=1)
    saved = decrease(borne[rows].sum(axis=1), optimum[rows].sum(axis=1))
    if saved is None:
        return None
    low, high = saved.ends
    return Estimate(1.0 - saved.value, saved.interval and (1.0 - high, 1.0 - low))
