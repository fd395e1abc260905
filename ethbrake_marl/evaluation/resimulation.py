"""Simulates parts of an episode again, for quantities that its states do not hold."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ethbrake_marl.episode.state import State, require
from ethbrake_marl.motion.interval import move_line, move_lines
from ethbrake_marl.motion.layout import Bools, Floats, scratch_for


def advance_worlds(line: Floats, car: Floats, time: Floats, until: Floats, wanted: Floats, scratch: Floats) -> int:
    """Advance every world from ``time`` to ``until`` (s, [n] each); change ``line`` in place.

    Returns the index of a world in which the simulation failed, or -1. All vehicles hold the commands ``wanted`` [n, N
    + 1] (m/s2); the other arrays are described in ``motion.layout``.
    """
    moved = line.copy()  # arrays of any layout become alike, because a kernel is compiled for each layout
    failed: int = move_lines(moved, car.copy(), time.copy(), until.copy(), wanted.copy(), scratch)
    line[:] = moved
    return failed


def simulate_again(before: State, after: State, rows: Bools) -> Iterator[tuple[int, Floats]]:
    """Simulate the worlds in the mask ``rows`` [n] again, from ``before`` to ``after``, one after the other.

    Yields the index of each world, and the scratch memory that the physics has filled (``motion.layout``). There must
    be no decision between the two states.
    """
    require(before, "a quantity of single impacts", simulates=True)
    scratch = scratch_for(after.vehicles + 1)
    for k in np.flatnonzero(rows).tolist():
        line, car, wanted = (array[k].copy() for array in (before.line, before.car, after.wanted))
        move_line(line, car, wanted, scratch, before.time_s[k], after.time_s[k])
        yield k, scratch
