"""The paper's E-V2X-BM: one vehicle's constant deceleration that does the least harm to its two pairs, taken
separately.

Assumptions: the neighbours brake fully, only the first impact of a pair does harm, and impacts change no speed, so the
pair in front and the pair behind are independent. The harm predicted for a deceleration a is

    H(a) = c_front(a)^2 + c_rear(a)^2    (m2/s2)

with the closing speeds c at the first impacts. Between a few decelerations, the candidates, H is concave, so its
minimum is at one of them. docs/proofs/constant-deceleration.md derives every line.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.departures import MAP, OBSTACLE
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.contact import contact
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.impact import TOUCH_MPS
from ethbrake_marl.motion.layout import BRAKING, GAP, LATENCY, SPEED, Floats

CLOSED_FORM_CANDIDATES = 9
RELATIVE_TIE = 1e-12  # harms closer than this, relative to 1 + harm, count as equal


class ConstantDeceleration(NamedTuple):
    """The best constant deceleration of one vehicle in each of n worlds."""

    deceleration_mps2: Floats  # [n] from 0 to the braking capacity
    harm: Floats  # [n] predicted for it (m2/s2)


@kernel
def braking_now(speed, braking, onset, now):
    """Acceleration (m/s2) at time ``now`` (s), and how long it lasts (s), of a vehicle that coasts until ``onset`` (s),
    then brakes to rest.
    """
    if now < onset:
        return 0.0, onset - now
    if speed > 0.0 and braking > 0.0:
        return -braking, speed / braking
    return 0.0, math.inf


@large
def meet(gap, front, front_braking, front_onset, rear, rear_braking, rear_onset, until):
    """Move a pair to its first impact, or to ``until`` (s); return its harm (m2/s2), the gap (m) and both speeds (m/s).

    Each vehicle coasts until its onset (s), then brakes to rest (m/s2): phases of constant acceleration, regimes A to C
    of the proof. A contact without a closing speed is no impact; if the rear vehicle then brakes less than the front
    vehicle, the two stay in contact, and the harm is 0.
    """
    now = 0.0
    while now < until:
        front_rate, front_end = braking_now(front, front_braking, front_onset, now)
        rear_rate, rear_end = braking_now(rear, rear_braking, rear_onset, now)
        piece, pressing = min(front_end, rear_end, until - now), rear_rate - front_rate
        time, closing = contact(gap, rear - front, pressing)
        if time <= piece:
            if closing > TOUCH_MPS:
                return closing * closing, 0.0, front, rear
            if pressing > 0.0:
                break
        if piece == math.inf:
            break
        gap = max(gap - (rear - front + 0.5 * pressing * piece) * piece, 0.0)
        front = 0.0 if front_rate < 0.0 and front_end <= piece else front + front_rate * piece
        rear = 0.0 if rear_rate < 0.0 and rear_end <= piece else rear + rear_rate * piece
        now += piece
    return 0.0, gap, front, rear


@large
def harm_of_deceleration(line, braking, wait, body, a):
    """Harm H (m2/s2) in one world if vehicle ``body`` decelerates with ``a`` (m/s2). Other arguments:
    ``choose_decelerations``.
    """
    gap, speed, harm = line[GAP], line[SPEED], 0.0
    if body > 1:
        i = body - 1
        harm += meet(gap[i], speed[i], braking[i], wait[i], speed[body], a, wait[body], math.inf)[0]
    if body < line.shape[1] - 1:
        i = body + 1
        harm += meet(gap[body], speed[body], a, wait[body], speed[i], braking[i], wait[i], math.inf)[0]
    return harm


@large
def find_candidates(line, braking, wait, body, at):
    """Write to ``at`` [C] the decelerations (m/s2) of vehicle ``body`` where H may be least, in one world.

    At the onset of braking: gap d, speed v, the neighbour's speed u, closing speed w, and the time s for which the
    neighbour still coasts before it brakes with b. A candidate may be outside [0, capacity], or not a number. Other
    arguments: ``choose_decelerations``.
    """
    gap, speed, onset = line[GAP], line[SPEED], wait[body]
    at[:] = 0.0
    at[1] = braking[body]
    if body > 1:
        i = body - 1
        b, s = braking[i], max(wait[i] - onset, 0.0)
        _, d, u, v = meet(gap[i], speed[i], b, wait[i], speed[body], 0.0, onset, onset)
        w = v - u
        at[2] = v * v / (2.0 * (d + u * s + u * u / (2.0 * b)))  # stops right behind the neighbour
        at[3] = (w * w + 2.0 * b * (d - w * s)) / (2.0 * d - b * s * s)  # touches it, closing at 0, while both brake
        at[4] = w * w / (2.0 * d)  # the same while the neighbour coasts
        at[5] = (w * w - 4.0 * TOUCH_MPS * TOUCH_MPS) / (2.0 * d)  # or at closing speed 2 TOUCH_MPS
        at[6] = 2.0 * (w * s - d) / (s * s)  # reaches the neighbour when it begins to brake
    if body < line.shape[1] - 1:
        i = body + 1
        b, s = braking[i], max(wait[i] - onset, 0.0)
        _, d, v, u = meet(gap[body], speed[body], 0.0, onset, speed[i], b, wait[i], onset)
        w = u - v
        at[7] = v * v / (2.0 * (u * s + u * u / (2.0 * b) - d))  # the neighbour stops right behind
        at[8] = (2.0 * b * (d - w * s) - w * w) / (b * s * s + 2.0 * d)  # it touches, closing at 0, while both brake


@large
def choose_decelerations(line, braking, wait, body, at, harm, best, least):
    """Write the best deceleration of vehicle ``body`` in each world to ``best`` [n] (m/s2), H to ``least`` [n] (m2/s2).

    ``line``: as in ``State``; ``braking`` [n, N + 1]: capacity or present deceleration of each vehicle (m/s2); ``wait``
    [n, N + 1]: time until it may brake (s); ``at``, ``harm`` [C]: working memory. Of equally good candidates from a to
    b the result is ``(a + b) / 2`` if H is as small there, otherwise a.
    """
    for k in range(line.shape[0]):
        find_candidates(line[k], braking[k], wait[k], body, at)
        least[k], first, last = math.inf, math.inf, 0.0
        for c in range(CLOSED_FORM_CANDIDATES):
            at[c] = at[c] if 0.0 <= at[c] <= braking[k, body] else 0.0
            harm[c] = harm_of_deceleration(line[k], braking[k], wait[k], body, at[c])
            least[k] = min(least[k], harm[c])
        tied = least[k] + RELATIVE_TIE * (1.0 + least[k])
        for c in range(CLOSED_FORM_CANDIDATES):
            if harm[c] <= tied:
                first, last = min(first, at[c]), max(last, at[c])
        best[k] = 0.5 * (first + last)
        least[k] = harm_of_deceleration(line[k], braking[k], wait[k], body, best[k])
        if least[k] > tied:
            best[k], least[k] = first, harm_of_deceleration(line[k], braking[k], wait[k], body, first)


def closed_form(alert: State, braking: Floats, body: int) -> ConstantDeceleration:
    """Deceleration of vehicle ``body`` with the least predicted harm H, and H, in every world.

    ``braking`` [n, N + 1] (m/s2): the constant deceleration of every other vehicle, and the capacity of ``body``.
    """
    wait = np.maximum(alert.car[:, LATENCY] - alert.time_s[:, np.newaxis], 0.0)
    choice = ConstantDeceleration(np.empty(alert.n), np.empty(alert.n))
    choose_decelerations(
        alert.line, braking, wait, body, np.empty(CLOSED_FORM_CANDIDATES), np.empty(CLOSED_FORM_CANDIDATES), *choice
    )
    return choice


def pairwise(alert: State, body: int) -> ConstantDeceleration:
    """Deceleration of vehicle ``body`` (1: Vehicle 1) that minimises the predicted harm H, and H, in every world.

    Of equally good decelerations the middle one. An obstacle is ignored. Raises ``InvalidInput`` for worlds that depart
    from the plain game other than by an obstacle or the paper's map.
    """
    require(alert, "e_v2x_bm:pairwise", {OBSTACLE, MAP})
    return closed_form(alert, np.ascontiguousarray(capacities(alert.car, BRAKING)), body)
