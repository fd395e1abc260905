"""Braking profiles: after its latency, a vehicle follows a fixed sequence of commands (it *brakes in pieces*).

A world in which a vehicle follows a braking profile is advanced by the functions for brakes that build up
(``physics.build_up``), even if all brakes act at once. The argument ``table`` is one world in the layout of
``physics.rows``. A *piece* is the time interval of one command. The *force* of a vehicle is the acceleration that its
brakes or engine alone would cause.
"""

from __future__ import annotations

import math

from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import command_acts
from ethbrake_marl.first_edition.physics.rows import ROW, builds_up
from ethbrake_marl.first_edition.physics.state import Floats


@compiled(bare=True)
def begin_piece(table: Floats, i: int, now: float) -> None:
    """Set the command of vehicle ``i`` to the command of its piece at the time ``now``.

    The function also writes the time at which the vehicle's next piece begins into row NEXT_PIECE. Both times are in
    seconds from the start of the segment.
    """
    count = (table.shape[0] - ROW.PIECES) // 2
    table[ROW.NEXT_PIECE, i] = math.inf
    for piece in range(count):
        begins = table[ROW.ONSET, i] + table[ROW.PIECES + piece, i]
        if begins == math.inf or (piece > 0 and begins > now):
            table[ROW.NEXT_PIECE, i] = begins
            return
        table[ROW.COMMAND, i] = table[ROW.PIECES + count + piece, i]


@compiled(bare=True)
def pieces_to_come(table: Floats) -> bool:
    """Return whether at least one vehicle has a piece that has not begun yet."""
    if table.shape[0] > ROW.OF_BUILD_UP:
        for i in range(table.shape[1]):
            if table[ROW.NEXT_PIECE, i] < math.inf:
                return True
    return False


@compiled(bare=True)
def force_at(table: Floats, i: int, command: float, latency_s: float, time_s: float) -> float:
    """Return the force (m/s2) of vehicle ``i`` at the end ``time_s`` of a segment; ``table`` is the world at this time.

    Until the latency has elapsed, the function uses 0 instead of ``command`` (m/s2), the command in the segment.
    ``latency_s`` and ``time_s`` are counted from the same moment.
    """
    acts = command_acts(latency_s, time_s)
    if not builds_up(table):
        return command if acts else 0.0
    wanted = table[ROW.COMMAND, i] if acts else 0.0  # the command of its piece, if it brakes in pieces
    return force_now(table[ROW.FORCE, i], wanted, table[ROW.BRAKE_RATE, i], table[ROW.RELEASE_RATE, i])


@compiled
def force_now(force: float, wanted: float, brake_rate: float, release_rate: float) -> float:
    """Return a vehicle's force (m/s2) just after the command ``wanted`` (m/s2) takes effect.

    The force falls to the command at the rate ``brake_rate`` or rises to it at the rate ``release_rate`` (m/s3). If
    this rate is infinite, the result is the command; otherwise it is ``force``, the force just before.
    """
    return wanted if math.isinf(brake_rate if wanted < force else release_rate) else force
