"""Parts of an episode, simulated again for what its states do not say."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ethbrake_marl.episode.state import State, check_exact
from ethbrake_marl.motion.interval import move_line, move_lines
from ethbrake_marl.motion.layout import Bools, Floats, scratch_for


def advance_worlds(line: Floats, car: Floats, time: Floats, until: Floats, wanted: Floats, scratch: Floats) -> int:
    """Advance every world from ``time`` to ``until`` [n] (s), ``line`` in place; return a failed row, or -1.

    The other arrays are described in ``motion.layout``; all vehicles hold the commands ``wanted`` [n, N + 1] (m/s2).
    """
    moved = line.copy()  # arrays of any layout become alike, because a kernel is compiled for each layout
    failed: int = move_lines(moved, car.copy(), time.copy(), until.copy(), wanted.copy(), scratch)
    line[:] = moved
    return failed


def simulate_again(before: State, after: State, rows: Bools) -> Iterator[tuple[int, Floats]]:
    """Simulate ``rows`` worlds [n] again from ``before`` to ``after``; yield each row and the physics' scratch memory.

    There must be no decision between the states.
    """
    check_exact(before, "a quantity of single impacts")
    scratch = scratch_for(after.vehicles + 1)
    for k in np.flatnonzero(rows).tolist():
        line, car, wanted = (array[k].copy() for array in (before.line, before.car, after.wanted))
        move_line(line, car, wanted, scratch, before.time_s[k], after.time_s[k])
        yield k, scratch
