"""The forecast of contacts: when the pairs of a line first meet under commands held constant, and how hard.

The physics of ``advance``, on a table that somebody has filled; nothing of the motion is kept.
"""

from __future__ import annotations

import math

from ethbrake_marl.physics.compiled import compiled_apart
from ethbrake_marl.physics.impact import CLOSING, STRUCK
from ethbrake_marl.physics.segment import (
    COUNT,
    DONE,
    FIRST_HARM,
    IMPACT,
    MOST_EVENTS,
    STUCK,
    TOTAL_HARM,
    move_apart,
    record_impacts,
    start_events,
    to_next_impact,
)
from ethbrake_marl.physics.worlds import Floats

# rows of what is found, per pair
CONTACT_TIME = 0  # from now to the first impact from now on (s); infinite: none
CONTACT_CLOSING = 1  # its closing speed (m/s); 0: none
CONTACT_ROWS = 2


@compiled_apart
def forecast_contacts(table: Floats, restitution: float, duration: float, found: Floats) -> int:
    """Take one world ``duration`` (s) on; its status. Fills ``found`` [CONTACT_ROWS, N], and the harm of the table.

    A pair that has had an impact before may have another first one from now on; in first-impact harm it counts no more.
    """
    for p in range(table.shape[1] - 1):
        found[CONTACT_TIME, p], found[CONTACT_CLOSING, p] = math.inf, 0.0
        table[FIRST_HARM, p] = 0.0
        table[TOTAL_HARM, p] = 0.0
        table[COUNT, p] = 0.0
    if move_apart(table, duration):
        return DONE
    start_events(table)
    no_rows, now = table[:0], 0.0
    for _ in range(MOST_EVENTS):
        status, now = to_next_impact(table, restitution, now, duration)
        if status != IMPACT:
            return status
        for p in range(table.shape[1] - 1):
            if table[STRUCK, p] == 1.0 and found[CONTACT_TIME, p] == math.inf:
                found[CONTACT_TIME, p], found[CONTACT_CLOSING, p] = now, table[CLOSING, p]
        record_impacts(table, now, 0, no_rows, 0)
    return STUCK
