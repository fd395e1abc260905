"""Brakes in pieces: from its onset on such a vehicle has the command of the piece in force, whatever else it is told.
Its world moves as one in which brakes build up, at rates that may be infinite.
"""

from __future__ import annotations

import math

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import command_acts
from ethbrake_marl.physics.rows import ROW, builds_up
from ethbrake_marl.physics.state import Floats


@compiled(bare=True)
def begin_piece(table: Floats, i: int, now: float) -> None:
    """Give vehicle ``i`` the command of its piece at ``now`` (s from the segment's start), and plan the next one."""
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
    """Whether some vehicle's next piece is still to begin."""
    if table.shape[0] > ROW.OF_BUILD_UP:
        for i in range(table.shape[1]):
            if table[ROW.NEXT_PIECE, i] < math.inf:
                return True
    return False


@compiled(bare=True)
def force_at(table: Floats, i: int, command: float, latency_s: float, time_s: float) -> float:
    """The force of vehicle ``i`` at ``time_s``, the end of a segment; no command acts before its latency. [m/s2]"""
    acts = command_acts(latency_s, time_s)
    if not builds_up(table):
        return command if acts else 0.0
    wanted = table[ROW.COMMAND, i] if acts else 0.0  # of its piece, where it brakes in pieces
    return force_now(table[ROW.FORCE, i], wanted, table[ROW.BRAKE_RATE, i], table[ROW.RELEASE_RATE, i])


@compiled
def force_now(force: float, wanted: float, brake_rate: float, release_rate: float) -> float:
    """The force at the moment at which another command begins to act: it jumps only at an infinite rate. [m/s2]"""
    return wanted if math.isinf(brake_rate if wanted < force else release_rate) else force
