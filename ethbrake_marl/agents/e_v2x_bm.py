"""E-V2X-BM: the constant deceleration of one vehicle that does the least harm. (A stand-in for another branch's.)"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.play import hold
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import begin
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    FAR_M,
    GAP,
    LATENCY,
    LIMIT,
    MASS,
    RELEASE_RATE,
    SPEED,
    Floats,
)

FOREVER_S, TIE, GRID, MINIMA, ROUNDS = 1e6, 1e-9, 161, 4, 7
TOUCH_MPS = 0.05
AROUND = np.linspace(-1.0, 1.0, 17)


class Choice(NamedTuple):
    """Decelerations, and the harm that the method expects of them."""

    deceleration_mps2: Floats  # [n]
    harm: Floats  # [n] m2/s2


def _pair(alert: State, p: int, body: int) -> Any:
    line, car = np.zeros((alert.n, 7, 3)), np.zeros((alert.n, 10, 3))
    line[:, SPEED, 1:], line[:, GAP, 0], line[:, GAP, 1] = alert.line[:, SPEED, p : p + 2], FAR_M, alert.line[:, GAP, p]
    car[:, [LIMIT, BRAKE_RATE, RELEASE_RATE]] = np.inf
    car[:, MASS, 0], car[:, MASS, 1:] = np.inf, 1.0
    car[:, LATENCY, 1:] = alert.car[:, LATENCY, p : p + 2]
    wanted = np.zeros((alert.n, 3))
    wanted[:, 1:] = -alert.car[:, BRAKING, p : p + 2]
    state = alert._replace(line=line, car=car)

    def harm(a: Floats) -> Floats:
        return hold(state, wanted, [body - p + 1], -a[:, :, np.newaxis], FOREVER_S, "first")[0]

    return harm


def _border(harm: Any, most: Floats, above: bool) -> Floats:
    low, high, none = np.zeros_like(most), most.copy(), np.inf if above else -np.inf
    ends = harm(np.concatenate([low, most], axis=1)) == 0.0
    never, always = ~ends[:, [1 if above else 0]], ends[:, [0 if above else 1]]
    for _ in range(60):
        middle = 0.5 * (low + high)
        inside = (harm(middle) == 0.0) == above
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    return np.where(never, none, np.where(always, 0.0 if above else most, high if above else low))


def pairwise(alert: State, body: int) -> Choice:
    """Return the paper's choice."""
    most, (line, car) = alert.car[:, BRAKING, [body]], alert[:2]
    low, high, at, pairs = np.zeros_like(most), np.full_like(most, np.inf), [np.zeros_like(most), most], []
    if body > 1:
        pairs.append(_pair(alert, body - 1, body))
        low, lead = _border(pairs[0], most, True), car[:, LATENCY, [body - 1]] - car[:, LATENCY, [body]]
        closing = line[:, SPEED, [body]] - line[:, SPEED, [body - 1]]
        gap = line[:, GAP, [body - 1]] - closing * car[:, LATENCY, [body]]
        with np.errstate(all="ignore"):
            early = [2.0 * (closing * lead - gap) / lead**2, (closing**2 - 4.0 * TOUCH_MPS**2) / (2.0 * gap)]
        at += [np.where(lead > 0.0, a, 0.0) for a in early]
    if body < line.shape[2] - 1:
        pairs.append(_pair(alert, body, body))
        high = _border(pairs[-1], most, False)
    at = np.concatenate([*at, low, high], axis=1)
    at[~((at >= 0.0) & (at <= most))] = 0.0
    values = sum(harm(at) for harm in pairs)
    best = values.min(axis=1, keepdims=True)
    tied = values <= best + TIE
    first = np.where(tied, at, np.inf).min(axis=1, keepdims=True)
    middle = 0.5 * (first + np.where(tied, at, 0.0).max(axis=1, keepdims=True))
    a = np.where(sum(harm(middle) for harm in pairs) <= best + TIE, middle, first)
    top = np.minimum(high, most)
    return Choice(np.where(low <= top, 0.5 * (low + top), a)[:, 0], np.where(low <= top, 0.0, best)[:, 0])


def coupled(alert: State, body: int, count: str, horizon_s: float) -> Choice:
    """Return the best choice in the episode's own physics; the other bodies hold ``alert.wanted``."""
    most, wanted = alert.car[:, BRAKING, [body]], alert.wanted.copy()
    wanted[:, body] = 0.0
    state = begin(alert._replace(wanted=wanted), np.array([body]), 1.0, horizon_s)

    def harms(a: Floats, rows: Any = slice(None)) -> Floats:
        return hold(state.take(rows), wanted[rows], [body], -a[:, :, np.newaxis], horizon_s, count)

    best = pairwise(alert, body).deceleration_mps2[:, np.newaxis]
    harm = harms(best)
    rows = np.flatnonzero(harm[0, :, 0] > 0.0)
    if not len(rows):
        return Choice(best[:, 0], harm[0, :, 0])
    most, a = most[rows], np.concatenate([best[rows], most[rows] * np.linspace(0.0, 1.0, GRID)], axis=1)
    value = harms(a, rows)
    padded = np.pad(value[0, :, 1:], ((0, 0), (1, 1)), constant_values=np.inf)
    lowest = (value[0, :, 1:] <= padded[:, :-2]) & (value[0, :, 1:] <= padded[:, 2:])
    order = 1 + np.argsort(np.where(lowest, value[0, :, 1:], np.inf), axis=1, kind="stable")[:, :MINIMA]
    centre, width = np.take_along_axis(a, order, 1), most / (GRID - 1)
    for _ in range(ROUNDS):
        near = np.clip(centre[:, :, np.newaxis] + (width * AROUND)[:, np.newaxis], 0.0, most[:, :, np.newaxis])
        new = harms(near.reshape(len(rows), -1), rows)
        pick = new[0].reshape(near.shape).argmin(axis=2)[:, :, np.newaxis]
        centre, width = np.take_along_axis(near, pick, 2)[:, :, 0], width * 2.0 / (len(AROUND) - 1)
        a, value = np.concatenate([a, near.reshape(len(rows), -1)], axis=1), np.concatenate([value, new], axis=2)
    tied = value[0] <= value[0].min(axis=1, keepdims=True) + TIE
    other = np.where(tied, value[1], np.inf)
    tied &= other <= other.min(axis=1, keepdims=True) + TIE
    first, last = np.where(tied, a, np.inf).min(axis=1), np.where(tied, a, -np.inf).max(axis=1)
    two = np.stack([0.5 * (first + last), first], axis=1)
    new = harms(two, rows)
    pick = (new[0, :, 0] > value[0].min(axis=1) + TIE).astype(int)[:, np.newaxis]
    best[rows], harm[0, rows] = np.take_along_axis(two, pick, 1), np.take_along_axis(new[0], pick, 1)
    return Choice(best[:, 0], harm[0, :, 0])
