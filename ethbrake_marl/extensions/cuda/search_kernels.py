"""Kernels in which each thread improves one profile of one world, with the kernels of the extension ``search``.

Many threads search one world, each with random numbers of its own. n: worlds, B: bodies, C: controlled vehicles, K:
phases of a profile.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.state import CLOCK_COLUMNS, LAST
from ethbrake_marl.extensions.proofs.line import COLUMNS
from ethbrake_marl.extensions.search.extremes import (
    EXTREME_PHASES,
    LATEST_S,
    ROUNDS,
    TIMES,
    WAYS,
    meeting_of,
    write_extreme,
)
from ethbrake_marl.extensions.search.kernels import (
    CHANGE,
    TIME_STEP,
    Room,
    World,
    copy_profile,
    draw,
    draw_profile,
    follow,
    improve,
)
from ethbrake_marl.extensions.search.pricing import MOST_PHASES
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.layout import CAR_ROWS, LINE_ROWS, ROWS


class Searched(NamedTuple):
    """n worlds at the first decision, and what is minimised in them."""

    line: Any  # [LINE_ROWS, B, n]
    car: Any  # [CAR_ROWS, B, n]
    clock: Any  # [CLOCK_COLUMNS, n]
    wanted: Any  # [B, n] commands of all bodies
    bounds: Any  # [C, 2, n] smallest and largest command of each controlled vehicle
    shares: Any  # [3, B, n], as in `Problem`
    at: Any  # [COLUMNS, n] as the proofs see them
    has_extremes: Any  # [n] whether extreme profiles are tried
    bodies: Any  # [C]
    numbers: Any  # [NUMBERS] of `World`
    weights: Any  # [2, 6]


class Plans(NamedTuple):
    """The best profile of each of m threads. Thread t searches world t modulo n."""

    ends: Any  # [K, m] int64
    commands: Any  # [K, C, m]
    phases: Any  # [m] number of phases in use; 0: none is known
    values: Any  # [m]
    random: Any  # [m] int64, the bits of the random stream's state


class Own(NamedTuple):
    car: Any  # this and the following: float64
    clock: Any
    wanted: Any
    bounds: Any
    shares: Any
    at: Any
    scratch: Any
    lines: Any
    tried: Any
    commands: Any
    best_commands: Any
    change: Any
    ends: Any  # this and the following: int64
    best_ends: Any
    kind: Any
    random: Any  # uint64


def shapes_of(bodies: int, controlled: int) -> Own:
    K = MOST_PHASES
    return Own(
        car=(CAR_ROWS, bodies),
        clock=(CLOCK_COLUMNS,),
        wanted=(bodies,),
        bounds=(controlled, 2),
        shares=(3, bodies),
        at=(COLUMNS,),
        scratch=(ROWS, bodies),
        lines=(K + 1, LINE_ROWS, bodies),
        tried=(K + 1, LINE_ROWS, bodies),
        commands=(K, controlled),
        best_commands=(K, controlled),
        change=(CHANGE,),
        ends=(K,),
        best_ends=(K,),
        kind=(1,),
        random=(1,),
    )


@large
def load(k, searched, own):
    for i in range(own.wanted.shape[0]):
        for row in range(own.lines.shape[1]):
            own.lines[0, row, i] = searched.line[row, i, k]
        for row in range(own.car.shape[0]):
            own.car[row, i] = searched.car[row, i, k]
        for row in range(3):
            own.shares[row, i] = searched.shares[row, i, k]
        own.wanted[i] = searched.wanted[i, k]
    for row in range(own.clock.shape[0]):
        own.clock[row] = searched.clock[row, k]
    for row in range(own.at.shape[0]):
        own.at[row] = searched.at[row, k]
    for c in range(own.bounds.shape[0]):
        own.bounds[c, 0], own.bounds[c, 1] = searched.bounds[c, 0, k], searched.bounds[c, 1, k]


@large
def begin_with(t, own, plans, world, room, drawing, drawn):
    """Put the best of a thread's first profiles into its memory ``own``; return its number of phases, 0: none.

    These are its profile so far (column t of ``plans``), extreme profiles of one kind and ``drawn`` random ones.
    Extreme ones are tried as in ``extreme_profiles``, but at random times, so that no two threads try the same.
    ``world``, ``room``, ``drawing``: as for the extension ``search``.
    """
    n, best_used, least, low, high, kind = world.wanted.shape[0], 0, np.inf, 0.0, LATEST_S, own.kind[0]
    in_round, best_change, change, meeting, of_round = TIMES * len(WAYS), 0.0, 0.0, 0.0, np.inf
    extremes, last = 0 if kind < 0 else ROUNDS * in_round, int(world.clock[LAST])
    ends, commands, begin = room.ends, room.commands, min(0, n)  # begin is no literal: numba would compile more
    for s in range(1 + extremes + drawn):
        used, i = EXTREME_PHASES, s - 1
        if s == 0:
            used = plans.phases[t]
            for p in range(used):
                ends[p] = plans.ends[p, t]
                for c in range(commands.shape[1]):
                    commands[p, c] = plans.commands[p, c, t]
        elif s <= extremes:
            if i > 0 and i % in_round == 0:  # closer to the best change so far
                around = 1.5 * (high - low) / TIMES
                low, high, of_round = max(best_change - around, 0.0), best_change + around, np.inf
            if i % len(WAYS) == 0:
                change = low + (high - low) * ((i % in_round) // len(WAYS) + draw(world.random)) / TIMES
                meeting = meeting_of(own.at, kind, change)
            early, share = WAYS[i % len(WAYS)]
            write_extreme(
                kind, change, meeting, int(early), share, world.numbers[TIME_STEP], last, world.bounds[0, 0],
                world.bounds[0, 1], ends, commands,
            )  # fmt: skip
        else:
            used = draw_profile(world, drawing, ends, commands)
        if used == 0:
            continue
        most = of_round if 0 < s <= extremes else least
        value, reached = follow(world, room.lines, ends[:used], commands[:used], begin, most)
        if reached <= 0 or not value < most:
            continue
        if 0 < s <= extremes:
            of_round, best_change = value, change
        if value < least:
            least, best_used = value, used
            copy_profile(ends[:used], commands[:used], own.best_ends, own.best_commands)
    return best_used


@large
def search(t, own, searched, plans, drawing, drawn, budget):
    """Improve the profile of thread t by ``budget`` changes; if ``drawn`` is above 0, first choose it among new ones.

    ``own``: memory of this thread. ``searched``: the worlds. ``plans``: the profiles of all threads, changed in place.
    ``drawing``: how random profiles and changes are drawn.
    """
    n = searched.wanted.shape[1]
    load(t % n, searched, own)
    own.kind[0] = (t // n) % 2 if drawn > 0 and searched.has_extremes[t % n] else -1
    own.random[0] = np.uint64(plans.random[t])
    world = World(
        own.car, own.clock, own.wanted, searched.bodies, own.bounds, own.shares, searched.numbers, searched.weights,
        own.random, own.scratch,
    )  # fmt: skip
    room = Room(own.lines, own.tried, own.ends, own.commands, own.change)
    used = begin_with(t, own, plans, world, room, drawing, drawn)
    plans.phases[t], plans.values[t] = used, np.inf
    if used > 0:
        ends, commands = own.best_ends[:used], own.best_commands[:used]
        plans.values[t], active = improve(world, room, ends, commands, budget, drawing, 0.0)
        for p in range(own.best_ends.shape[0]):
            here = min(p, used - 1)
            plans.ends[p, t] = own.best_ends[here] if p < active - 1 else int(own.clock[LAST])
            for c in range(own.best_commands.shape[1]):
                plans.commands[p, c, t] = own.best_commands[here, c]
    plans.random[t] = np.int64(own.random[0])


@large
def search_each(own, searched, plans, drawing, drawn, budget, n):
    for t in range(n):
        search(t, own, searched, plans, drawing, drawn, budget)
