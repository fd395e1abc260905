"""Braking in pieces: from its onset on, a vehicle follows a fixed sequence of commands instead of the given command.

Its world is advanced like one with brake build-up, whose rates may be infinite.
"""

from __future__ import annotations

import math

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import command_acts
from ethbrake_marl.physics.rows import ROW, builds_up
from ethbrake_marl.physics.state import Floats


@compiled(bare=True)
def begin_piece(table: Floats, i: int, now: float) -> None:
    """Give vehicle ``i`` the command of its piece at ``now`` and write down when its next piece begins.

    Times are in seconds from the start of the segment.
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
    """Return whether some vehicle has a piece that has not begun yet."""
    if table.shape[0] > ROW.OF_BUILD_UP:
        for i in range(table.shape[1]):
            if table[ROW.NEXT_PIECE, i] < math.inf:
                return True
    return False


@compiled(bare=True)
def force_at(table: Floats, i: int, command: float, latency_s: float, time_s: float) -> float:
    """Return the force of vehicle ``i`` at the end of a segment, ``time_s``; 0 command before the latency. [m/s2]"""
    acts = command_acts(latency_s, time_s)
    if not builds_up(table):
        return command if acts else 0.0
    wanted = table[ROW.COMMAND, i] if acts else 0.0  # the command of its piece, if it brakes in pieces
    return force_now(table[ROW.FORCE, i], wanted, table[ROW.BRAKE_RATE, i], table[ROW.RELEASE_RATE, i])


@compiled
def force_now(force: float, wanted: float, brake_rate: float, release_rate: float) -> float:
    """Return the force just after the command ``wanted`` takes effect: it jumps only if its rate is infinite. [m/s2]"""
    return wanted if math.isinf(brake_rate if wanted < force else release_rate) else force
