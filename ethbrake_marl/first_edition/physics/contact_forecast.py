"""Forecast of contacts: time and closing speed of the next impact of each pair under constant commands.

The forecast simulates the same physics as ``advance``, but returns no motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ethbrake_marl.first_edition.physics.impact import record_impacts
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND
from ethbrake_marl.first_edition.physics.rows import FLAG, ROW, builds_up
from ethbrake_marl.first_edition.physics.segment import move_apart, start_events, to_next_impact
from ethbrake_marl.first_edition.physics.state import Floats


class _Contact(NamedTuple):
    """Row numbers of the forecast array ``contacts`` [WIDTH, N]; column p describes the next impact of pair p."""

    TIME: int = 0  # time from now to the pair's next impact (s); infinite: none
    CLOSING: int = 1  # closing speed of that impact (m/s); 0: none
    WIDTH: int = 2  # number of rows


CONTACT = _Contact()


@compiled(apart=True)
def forecast_contacts(table: Floats, restitution: float, duration: float, contacts: Floats) -> int:
    """Simulate one world for ``duration`` (s) and write each pair's next impact into ``contacts``; return a status.

    The status is ``FLAG.DONE``, or the code of the check that failed. The next impact of a pair is also reported if the
    pair had an impact before the forecast; this next impact adds no first-impact harm.

    Args:
        table: the world in the layout of ``physics.rows``; the rows of motion and harm are overwritten.
        restitution: coefficient of restitution of every impact, in [0, 1].
        duration: length of the forecast, s.
        contacts: result, [CONTACT.WIDTH, N], see ``CONTACT``; the last column is not used.

    """
    for p in range(table.shape[1] - 1):
        contacts[CONTACT.TIME, p], contacts[CONTACT.CLOSING, p] = math.inf, 0.0
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
            if table[ROW.STRUCK, p] == 1.0 and contacts[CONTACT.TIME, p] == math.inf:
                contacts[CONTACT.TIME, p], contacts[CONTACT.CLOSING, p] = now, table[ROW.CLOSING, p]
        record_impacts(table, now, 0, no_rows, 0)
    return FLAG.STUCK
