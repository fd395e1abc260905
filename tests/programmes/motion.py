"""The motion of this package on many worlds: rational numbers, small steps, and every bit of a batch.

With ``--worlds 10000`` (the default) each of twenty kinds of worlds has 500: 2 to 6 vehicles, with an obstacle or not,
with brakes that act at once or build up.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np

from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.layout import Floats
from tests.motion.random_lines import (
    Runs,
    differences,
    exactly,
    played,
    push_differences,
    pushes_off,
    random_runs,
    stepped,
)
from tests.programmes import Cases, Given, Told

OPTIONS = {
    "--worlds": {"type": int, "default": 10_000, "help": "number of worlds"},
    "--seed": {"type": int, "default": 1, "help": "seed of the worlds"},
}
CLOSE, CLOSE_STEPS = 1e-7, 1e-3  # relative; a contact with a closing speed near 0 loses half of the digits
CLOSE_PUSHES, PUSHES = 1e-6, 200  # relative; worlds of a kind whose pushes are compared, by finer steps
FEW = 30  # impacts, after which rounding may change their order
UNRESOLVED = 0.04  # largest share of worlds in which two plastic impacts take turns faster than small steps


def cases(given: Given) -> Cases:
    each = max(1, given.worlds // 20)
    for N, obstacle, builds_up in product((2, 3, 4, 5, 6), (False, True), (False, True)):
        rng = np.random.default_rng([given.seed, N, obstacle, builds_up])
        make = partial(random_runs, rng, each, N, builds_up=builds_up, obstacle=obstacle)
        name = f"{N} vehicles{', obstacle' * obstacle}{', brakes build up' * builds_up}"
        yield name, partial(by_steps if builds_up else by_rational_numbers, make)


def by_rational_numbers(make: Callable[[], Runs]) -> Told:
    """Compare with rational arithmetic; worlds with more than 60 impacts are left out."""
    runs = make()
    end, bits = played(runs), batch(runs)
    rows = np.flatnonzero(end[:, at.COUNT, :-1].sum(axis=1) <= 2 * FEW)
    exact = np.stack([exactly(runs, k) for k in rows])
    off, counts = differences(end[rows], exact), (end[rows, at.COUNT] != exact[:, at.COUNT]).any(axis=1).sum()
    pushes = push_differences(end[rows], exact).max()
    good = bool(off.max() <= CLOSE and pushes <= CLOSE and not counts and bits)
    text = (
        f"{len(rows)} of {len(end)} worlds, {int(end[:, at.COUNT, :-1].sum())} impacts: off by {off.max():.1e} at most,"
        f" pushes by {pushes:.1e}"
    )
    return Told(good, f"{text}, other impacts in {counts}; same bits in every batch: {bits}")


def by_steps(make: Callable[[], Runs]) -> Told:
    """Compare with steps of 1e-3 s, and with finer ones where they differ."""
    runs = make()
    end, bits = played(runs), batch(runs)
    few = end[:, at.COUNT, :-1].sum(axis=1) <= FEW
    runs, end = runs.take(few), end[few]
    off, steps, step_s = differences(end, stepped(runs, 1e-3)), list[str](), 1e-3
    while (far := ~(off <= CLOSE_STEPS)).any() and step_s > 2e-5:
        step_s /= 10.0
        steps.append(f"{far.sum()} by {step_s:.0e} s")
        off[far] = differences(end[far], stepped(runs.take(far), step_s))
    far = ~(off <= CLOSE_STEPS)
    ends = stepped(runs.take(far), step_s)
    fewer = ends[:, at.COUNT, :-1].sum(axis=1) < end[far, at.COUNT, :-1].sum(axis=1)
    ends[:, at.TOTAL] = end[far, at.TOTAL]  # small steps miss the last impacts of a series, and nothing else
    unlike = ~fewer | (differences(end[far], ends) > CLOSE_STEPS)
    pushes, compared = pushes_by_steps(runs.take(np.arange(min(PUSHES, len(end)))))
    good = bool(far.mean() <= UNRESOLVED and not unlike.any() and bits and pushes <= CLOSE_PUSHES)
    text = f"{len(end)} of {len(few)} worlds, {', '.join(steps) or 'none by finer steps'}: off by {off[~far].max():.1e}"
    text += f" at most, median {np.median(off):.1e}; {far.sum()} plastic series, {unlike.sum()} unlike them"
    text += f"; pushes of {compared} worlds off by {pushes:.1e} at most"
    return Told(good, f"{text}; same bits: {bits}")


def pushes_by_steps(runs: Runs) -> tuple[float, int]:
    """Return the largest relative difference of pushes, and the number of worlds with the same impacts."""
    off, same = pushes_off(runs, CLOSE_PUSHES)
    return float(off[same].max()), int(same.sum())


def batch(runs: Runs) -> bool:
    """Return whether worlds in another order, and the first ones alone, end with the same bits."""
    end = played(runs)
    order = np.random.default_rng(0).permutation(len(end))
    return equal(played(runs.take(order)), end[order]) and all(
        equal(played(runs.take(order[k : k + 1])), end[order[k : k + 1]]) for k in range(min(20, len(end)))
    )


def equal(one: Floats, other: Floats) -> bool:
    """Return whether two arrays have the same bits."""
    return one.tobytes() == other.tobytes()
