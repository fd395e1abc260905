"""Compiled: the least closing speed of a pair's first contact, whatever its vehicles and those around it do.

The leader goes as far ahead as it can (full drive where it is controlled, else full braking), the follower stays as
far behind as it can (full braking). Where these extremes meet, every run of the pair meets no later.
docs/avoidability.md, "Teams", has the proof.
"""

from __future__ import annotations

import math

from ethbrake_marl.extensions.proofs.line import TOUCH_HARM
from ethbrake_marl.extensions.proofs.plans import empty_plan, fill_braking, fill_plan, time_to_limit, walk
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.state import Floats

# one pair: its gap; speed, onset and brakes of both; the leader's drive and speed limit where it is controlled
PAIR_GAP, LEADER_V, LEADER_ONSET, LEADER_A, LEADER_FREE, LEADER_U, LEADER_LIMIT = range(7)

FOLLOWER_V, FOLLOWER_ONSET, FOLLOWER_A, PAIR_WIDTH = range(7, 11)


@compiled(apart=True)
def least_on_piece(constant: float, pressing: float, since: float, until: float) -> float:
    """Least value of ``constant / t + pressing t / 2`` from ``since`` to ``until``."""
    least = constant / until + 0.5 * pressing * until
    if since > 0.0:
        least = min(least, constant / since + 0.5 * pressing * since)
    elif constant <= 0.0:
        least = min(least, 0.0) if constant == 0.0 else -math.inf
    if constant > 0.0 and pressing > 0.0:
        turn = math.sqrt(2.0 * constant / pressing)
        if since < turn < until:
            least = min(least, math.sqrt(2.0 * constant * pressing))
    return least


@compiled(apart=True)
def least_before(at: Floats, met: float, squared: float) -> float:
    """Least closing speed of a pair's first contact up to ``met``, where both extremes meet; a scripted leader.

    ``c(t) + g(t) / t``: the extremes' closing speed, and what must be added to it to be through their gap by then.
    """
    if met <= 0.0:
        return math.sqrt(squared)
    least, now = math.sqrt(squared), 0.0
    gap, v_l, v_f = at[PAIR_GAP], at[LEADER_V], at[FOLLOWER_V]
    rest = at[LEADER_ONSET] + at[LEADER_V] / at[LEADER_A]
    for _ in range(4):
        end = met
        for turn in (at[LEADER_ONSET], at[FOLLOWER_ONSET], rest):
            if now < turn < end:
                end = turn
        u_l = -at[LEADER_A] if at[LEADER_ONSET] <= now < rest else 0.0
        u_f = -at[FOLLOWER_A] if now >= at[FOLLOWER_ONSET] else 0.0
        w, b, step = v_f - v_l, u_f - u_l, end - now
        least = min(least, least_on_piece(gap + (w - 0.5 * b * now) * now, b, now, end))
        gap -= (w + 0.5 * b * step) * step
        v_l = 0.0 if end >= rest else v_l + u_l * step
        v_f += u_f * step
        now = end
        if now >= met:
            break
    return max(least, 0.0)


@compiled(apart=True)
def least_closing_of_pair(at: Floats, until: float, plan: Floats, other: Floats) -> tuple[float, float]:
    """Least closing speed at a pair's first contact, and its latest time; 0, inf where none is forced by ``until``."""
    onset = at[LEADER_ONSET]
    if at[LEADER_FREE] > 0.0:
        full = onset + time_to_limit(at[LEADER_V], at[LEADER_U], at[LEADER_LIMIT])
        fill_plan(plan, onset, 0.0, full, at[LEADER_U], full, 0.0, 0.0)
    else:
        fill_braking(plan, onset, at[LEADER_A])
    fill_braking(other, at[FOLLOWER_ONSET], at[FOLLOWER_A])
    _, met, squared = walk(at[PAIR_GAP], at[LEADER_V], plan, at[FOLLOWER_V], other, until)
    if not met < until:
        return 0.0, math.inf
    return math.sqrt(squared) if at[LEADER_FREE] > 0.0 else least_before(at, met, squared), met


@compiled
def bound_pairs(pairs: Floats, until: Floats, out: Floats) -> None:
    """Bounds of pairs ``pairs`` [n, PAIR_WIDTH] into ``out`` [n]; a touch counts as 0."""
    plan, other = empty_plan(), empty_plan()
    for k in range(pairs.shape[0]):
        closing = least_closing_of_pair(pairs[k], until[k], plan, other)[0]
        out[k] = closing * closing if closing * closing > TOUCH_HARM else 0.0
