"""What one thread of a search does: it improves one profile of one world, with the kernels of the extension ``search``.

Many threads search one world, each with random numbers of its own. n: worlds, B: bodies, C: controlled vehicles, K:
phases of a profile.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.state import CLOCK_COLUMNS, LAST
from ethbrake_marl.extensions.search.kernels import CHANGE, Field, Room, World, gather, improve
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
    bodies: Any  # [C]
    numbers: Any  # [NUMBERS] of `World`
    weights: Any  # [2, 6]


class Plans(NamedTuple):
    """The best profile of each of m threads: thread t searches world t modulo n."""

    ends: Any  # [K, m] int64
    commands: Any  # [K, C, m]
    phases: Any  # [m] number of phases in use; 0: none is known
    values: Any  # [m]
    random: Any  # [m] int64, the bits of the random stream's state


class Own(NamedTuple):
    """A thread's own memory."""

    car: Any  # this and the following: float64
    clock: Any
    wanted: Any
    bounds: Any
    shares: Any
    scratch: Any
    lines: Any
    tried: Any
    commands: Any
    best_commands: Any
    given_commands: Any
    change: Any
    best_value: Any
    ends: Any  # int64
    best_ends: Any
    best_phases: Any
    given_ends: Any
    given_phases: Any
    random: Any  # uint64


def shapes_of(bodies: int, controlled: int) -> Own:
    """Return the shapes of a thread's own memory."""
    K = MOST_PHASES
    return Own(
        car=(CAR_ROWS, bodies),
        clock=(CLOCK_COLUMNS,),
        wanted=(bodies,),
        bounds=(controlled, 2),
        shares=(3, bodies),
        scratch=(ROWS, bodies),
        lines=(K + 1, LINE_ROWS, bodies),
        tried=(K + 1, LINE_ROWS, bodies),
        commands=(K, controlled),
        best_commands=(1, K, controlled),
        given_commands=(1, K, controlled),
        change=(CHANGE,),
        best_value=(1,),
        ends=(K,),
        best_ends=(1, K),
        best_phases=(1,),
        given_ends=(1, K),
        given_phases=(1,),
        random=(1,),
    )


@large
def load(k, searched, own):
    """Copy world k into a thread's own memory."""
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
    for c in range(own.bounds.shape[0]):
        own.bounds[c, 0], own.bounds[c, 1] = searched.bounds[c, 0, k], searched.bounds[c, 1, k]


@large
def search(t, own, searched, plans, drawing, drawn, budget):
    """Improve the plan of thread t by ``budget`` changes, after trying ``drawn`` random profiles.

    ``drawing`` [D, DRAWING] are ways to draw; the thread has one of them.
    """
    n = searched.wanted.shape[1]
    load(t % n, searched, own)
    for p in range(own.given_ends.shape[1]):
        own.given_ends[0, p] = plans.ends[p, t]
        for c in range(own.given_commands.shape[2]):
            own.given_commands[0, p, c] = plans.commands[p, c, t]
    own.given_phases[0], own.best_phases[0], own.best_value[0] = plans.phases[t], 0, np.inf
    own.random[0] = np.uint64(plans.random[t])
    world = World(
        own.car, own.clock, own.wanted, searched.bodies, own.bounds, own.shares, searched.numbers, searched.weights,
        own.random, own.scratch,
    )  # fmt: skip
    room = Room(own.lines, own.tried, own.ends, own.commands, own.change)
    field = Field(own.best_ends, own.best_commands, own.best_phases, own.best_value)
    way = drawing[(t // n) % drawing.shape[0]]
    gather(world, room, own.given_ends, own.given_commands, own.given_phases, drawn, way, 0.0, field)
    used = own.best_phases[0]
    if used > 0:
        ends, commands = own.best_ends[0, :used], own.best_commands[0, :used]
        plans.values[t], active = improve(world, room, ends, commands, budget, way, 0.0)
        for p in range(own.best_ends.shape[1]):
            here = min(p, used - 1)
            plans.ends[p, t] = own.best_ends[0, here] if p < active - 1 else int(own.clock[LAST])
            for c in range(own.best_commands.shape[2]):
                plans.commands[p, c, t] = own.best_commands[0, here, c]
        plans.phases[t] = used
    plans.random[t] = np.int64(own.random[0])


@large
def search_each(own, searched, plans, drawing, drawn, budget, n):
    """Do the work of n threads of ``search`` on a processor."""
    for t in range(n):
        search(t, own, searched, plans, drawing, drawn, budget)
