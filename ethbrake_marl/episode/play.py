"""What would happen? Two functions answer, with the motion of the episode itself; nothing else is ever asked.

``price``: the harm of every episode that follows a plan, decision by decision. To the last bit this is the harm that
happens if the plan is followed. ``hold``: the harm if bodies hold constant commands, for many commands, in one piece:
fast, but rounded differently.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ethbrake_marl.episode.state import CLOCK_COLUMNS, ENDED, STEPS, State, harm_so_far
from ethbrake_marl.episode.step import advance, command
from ethbrake_marl.motion.compiling import large
from ethbrake_marl.motion.drive import FAILED, drive
from ethbrake_marl.motion.layout import BRAKING, LINE_ROWS, Floats, scratch_for

if TYPE_CHECKING:
    from ethbrake_marl.episode.game import Game


def working_memory(bodies: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return working memory: of the physics, and for one world's line, commands and clock."""
    return scratch_for(bodies), np.zeros((LINE_ROWS, bodies)), np.zeros(bodies), np.zeros(CLOCK_COLUMNS)


@large
def copy(source, target):
    """Copy one row."""
    for i in range(target.shape[0]):
        target[i] = source[i]


@large
def play_worlds(line, car, clock, wanted, plans, most, learners, time_step_s, horizon_s, total, memory, out):
    """Write the harm of every plan [T, L] to ``out`` [n]; a plan's last decision repeats; stop above ``most`` [n]."""
    scratch, here, commands, now = memory
    for k in range(len(out)):
        for row in range(here.shape[0]):
            copy(line[k, row], here[row])
        copy(wanted[k], commands)
        copy(clock[k], now)
        harm = harm_so_far(here, total)
        while now[ENDED] == 0.0 and harm <= most[k]:
            command(car[k], commands, learners, plans[k, min(int(now[STEPS]), plans.shape[1] - 1)])
            met, _ = advance(here, car[k], now, commands, scratch, time_step_s, horizon_s)
            harm = math.inf if met == FAILED else harm_so_far(here, total)
        out[k] = harm


@large
def hold_worlds(line, car, wanted, bodies, tried, time, until, total, memory, out):
    """Write both counts of harm to ``out`` [2, n, C], if ``bodies`` hold the commands ``tried`` [n, C, B]."""
    scratch, here, commands, _ = memory
    for k in range(tried.shape[0]):
        copy(wanted[k], commands)
        for j in range(tried.shape[1]):
            for row in range(here.shape[0]):
                copy(line[k, row], here[row])
            for b in range(len(bodies)):
                commands[bodies[b]] = tried[k, j, b]
            failed = drive(here, car[k], commands, scratch, time[k], until) == FAILED
            out[0, k, j] = math.inf if failed else harm_so_far(here, total)
            out[1, k, j] = math.inf if failed else harm_so_far(here, not total)


def price(game: Game, state: State, plans: Floats, count: str, most: Any = math.inf) -> Floats:
    """Return the harm of every episode, [n] m2/s2, if its learners follow their plan from now on.

    ``plans`` [n, T, L] are the learners' actions at every decision; the last one repeats. A play may stop once its harm
    is above ``most``. Scripts that look at the state are asked as in the episode.
    """
    if game.scripts:
        rows = np.arange(len(plans))
        while not state.ended.all():
            now = np.minimum(state.steps, plans.shape[1] - 1)
            state, _ = game.follow(state, plans[rows, now])
        return state.harm(count)
    out, rules = np.empty(len(plans)), game.rules
    most = np.broadcast_to(np.float64(most), out.shape).copy()
    play_worlds(
        *state[:3], state.wanted, plans, most, rules.learners, rules.time_step_s, rules.horizon_s, count == "total",
        working_memory(state.wanted.shape[1]), out,
    )  # fmt: skip
    return out


def hold(state: State, wanted: Floats, bodies: Sequence[int], tried: Floats, until_s: float, count: str) -> Floats:
    """Return the harm of both counts, first the one asked for, [2, n, C] m2/s2, if ``bodies`` hold commands until then.

    ``tried`` [n, C, B] are C commands of the bodies (m/s2); the others hold ``wanted`` [n, N + 1].
    """
    out = np.empty((2, *tried.shape[:2]))
    hold_worlds(
        state.line, state.car, wanted, np.asarray(bodies, np.int64), tried, np.ascontiguousarray(state.time_s), until_s,
        count == "total", working_memory(wanted.shape[1]), out,
    )  # fmt: skip
    return out


def descend(
    state: State, bodies: Sequence[int], shares: Floats, rounds: int, horizon_s: float, count: str
) -> tuple[Floats, Floats]:
    """Let bodies choose constant shares of their brakes, one after the other; all others brake fully.

    Returns the commands of all bodies, [n, N + 1] m/s2, and the harm of the episode, [n] m2/s2.
    """
    wanted, least = -state.car[:, BRAKING], np.zeros(state.n)
    for body in list(bodies) * rounds:
        tried = -state.car[:, BRAKING, [body]] * shares
        harm = hold(state, wanted, [body], tried[:, :, np.newaxis], horizon_s, count)[0]
        wanted[:, body] = np.take_along_axis(tried, harm.argmin(axis=1)[:, np.newaxis], 1)[:, 0]
        least = harm.min(axis=1)
    return wanted, least
