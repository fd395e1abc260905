"""The forecast of contacts: when the pairs of a line first meet under commands held constant, and how hard.

The physics of ``advance``, on a table that somebody has filled; nothing of the motion is kept.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ethbrake_marl.physics.impact import record_impacts
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import BOUND
from ethbrake_marl.physics.rows import FLAG, ROW, builds_up
from ethbrake_marl.physics.segment import move_apart, start_events, to_next_impact
from ethbrake_marl.physics.state import Floats


class _Contact(NamedTuple):
    """Rows of a forecast of the next impact of each pair."""

    TIME: int = 0  # from now to the first impact from now on (s); infinite: none
    CLOSING: int = 1  # its closing speed (m/s); 0: none
    WIDTH: int = 2


CONTACT = _Contact()


@compiled(apart=True)
def forecast_contacts(table: Floats, restitution: float, duration: float, found: Floats) -> int:
    """Take one world ``duration`` (s) on; its status. Fills ``found`` [CONTACT_ROWS, N], and the harm of the table.

    A pair that has had an impact before may have another first one from now on; in first-impact harm it counts no more.
    """
    for p in range(table.shape[1] - 1):
        found[CONTACT.TIME, p], found[CONTACT.CLOSING, p] = math.inf, 0.0
        table[ROW.FIRST_HARM, p] = 0.0
        table[ROW.TOTAL_HARM, p] = 0.0
        table[ROW.COUNT, p] = 0.0
    building = builds_up(table)
    if move_apart(table, duration, building):
        return FLAG.DONE
    start_events(table, building)
    no_rows, now = table[:0], 0.0
    for _ in range(BOUND.MOST_EVENTS):
        status, now = to_next_impact(table, restitution, now, duration, building)
        if status != FLAG.IMPACT:
            return status
        for p in range(table.shape[1] - 1):
            if table[ROW.STRUCK, p] == 1.0 and found[CONTACT.TIME, p] == math.inf:
                found[CONTACT.TIME, p], found[CONTACT.CLOSING, p] = now, table[ROW.CLOSING, p]
        record_impacts(table, now, 0, no_rows, 0)
    return FLAG.STUCK
