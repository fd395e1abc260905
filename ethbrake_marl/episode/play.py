"""Predicts what would happen, with the physics of the episode. ``played`` and ``hold`` are the two functions.

``played`` follows a plan, decision by decision, with the same bits as the episode. ``hold`` keeps constant commands
without stops at decisions: fast, but rounded differently.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ethbrake_marl.episode.counts import Count, amount_so_far, other_count, weights_of
from ethbrake_marl.episode.state import ENDED, STEPS, State, check_exact
from ethbrake_marl.episode.step import advance, command, note_motion
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.drive import FAILED, drive
from ethbrake_marl.motion.layout import BRAKING, LINE_ROWS, Floats, scratch_for

if TYPE_CHECKING:
    from ethbrake_marl.episode.game import Game


def working_memory(bodies: int) -> tuple[Floats, Floats, Floats]:
    return scratch_for(bodies), np.zeros((LINE_ROWS, bodies)), np.zeros(bodies)


@large
def play_worlds(line, car, clock, wanted, plans, most, learners, time_step_s, count, scratch, out):
    """Follow plans [n, T, L] of the L learners, in place; write the harm to ``out`` [n].

    An episode stops above the harm ``most`` [n]. After T decisions the last one repeats. The other arguments are those
    of ``step.step_worlds``.
    """
    for k in range(len(out)):
        harm = amount_so_far(line[k], count)
        while clock[k, ENDED] == 0.0 and harm <= most[k]:
            command(car[k], wanted[k], learners, plans[k, min(int(clock[k, STEPS]), plans.shape[1] - 1)])
            met, _ = advance(line[k], car[k], clock[k], wanted[k], scratch, time_step_s)
            harm = math.inf if met == FAILED else amount_so_far(line[k], count)
        out[k] = harm


@large
def hold_worlds(line, car, wanted, bodies, tried, time, until, count, other, memory, out):
    """Write the harm to ``out`` [2, n, C] if ``bodies`` [B] hold the commands ``tried`` [n, C, B] (m/s2).

    The other bodies hold ``wanted``. Row 0 of ``out`` counts by the weights ``count`` [6], row 1 by ``other``. ``time``
    and ``until`` [n] (s): from when to when they hold. ``line``, ``car`` and ``wanted`` are arrays of a ``State``;
    ``memory``: ``working_memory``, overwritten.
    """
    scratch, here, commands = memory
    for k in range(tried.shape[0]):
        for i in range(len(commands)):
            commands[i] = wanted[k, i]
        for j in range(tried.shape[1]):
            for row in range(here.shape[0]):
                for i in range(len(commands)):
                    here[row, i] = line[k, row, i]
            for b in range(len(bodies)):
                commands[bodies[b]] = tried[k, j, b]
            failed = drive(here, car[k], commands, scratch, time[k], until[k]) == FAILED
            note_motion(here)
            out[0, k, j] = math.inf if failed else amount_so_far(here, count)
            out[1, k, j] = math.inf if failed else amount_so_far(here, other)


def played(
    game: Game, state: State, plans: Floats, count: Count, most: Any = math.inf, *, donate: bool = False
) -> tuple[State, Floats]:
    """Last states of episodes whose learners follow plans from ``state`` on, and the harm, [n] m2/s2.

    ``plans`` [n, T, L] are the learners' actions at every decision; the last one repeats. An episode stops when its
    harm is above ``most`` [n]. If a check of the physics fails, the harm is infinite; but in games with scripts that
    look at the state, ``PhysicsError`` is raised. ``donate``: the arrays of ``state`` may be overwritten.
    """
    most = np.full(len(plans), most)
    if game.scripts or game.physics is not None:
        rows = np.arange(len(plans))
        while (~state.ended & (state.harm(count) <= most)).any():
            now = np.minimum(state.steps, plans.shape[1] - 1)
            state, _ = game.follow(state, plans[rows, now])
        return state, state.harm(count)
    line, car, clock, know, wanted, memories = state
    if not donate:
        line, clock, wanted = line.copy(), clock.copy(), wanted.copy()
    out, rules = np.empty(len(plans)), game.rules
    play_worlds(
        line, car, clock, wanted, plans, most, rules.learners, rules.time_step_s, weights_of(count),
        scratch_for(wanted.shape[1]), out,
    )  # fmt: skip
    return State(line, car, clock, know, wanted, memories), out


def price(game: Game, state: State, plans: Floats, count: Count, most: Any = math.inf) -> Floats:
    """Harm of every episode, [n] m2/s2, if its learners follow ``plans`` from now on (arguments of ``played``)."""
    return played(game, state, plans, count, most)[1]


def hold(
    state: State, wanted: Floats, bodies: Sequence[int], tried: Floats, until_s: float | Floats, count: Count
) -> Floats:
    """Harm if ``bodies`` hold constant commands until ``until_s`` (one time or [n]), [2, n, C] m2/s2.

    The first row is the harm in ``count``, the second in the count that decides ties. ``tried`` [n, C, B] are C sets of
    commands for the B bodies (m/s2); the other bodies hold ``wanted`` [n, N + 1].
    """
    others = "e_v2x_bm other than pairwise, shields other than episode:pairwise, shaping"
    check_exact(state, f"a plan of constant commands ({others})")
    out, counts = np.empty((2, *tried.shape[:2])), (weights_of(count), weights_of(other_count(count)))
    hold_worlds(
        state.line, state.car, wanted, np.asarray(bodies, np.int64), np.ascontiguousarray(tried),
        state.time_s.copy(), np.full(state.n, until_s, np.float64), *counts, working_memory(wanted.shape[1]), out,
    )  # fmt: skip
    return out


def descend(
    state: State, bodies: Sequence[int], shares: Floats, rounds: int, until_s: float | Floats, count: Count
) -> tuple[Floats, Floats]:
    """Choose the best constant share of each body's brakes, one body after the other, while all others brake fully.

    ``shares`` are the candidates, in [0, 1]. The bodies take turns in ``rounds`` rounds, each with the others' latest
    choice. Returns the commands of all bodies, [n, N + 1] m/s2, and the harm of the episode, [n] m2/s2.
    """
    wanted, least = -state.car[:, BRAKING], np.zeros(state.n)
    for body in list(bodies) * rounds:
        tried = -state.car[:, BRAKING, [body]] * shares
        harm = hold(state, wanted, [body], tried[:, :, np.newaxis], until_s, count)[0]
        wanted[:, body] = np.take_along_axis(tried, harm.argmin(axis=1)[:, np.newaxis], 1)[:, 0]
        least = harm.min(axis=1)
    return wanted, least
