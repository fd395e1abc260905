"""Braking profiles: after its latency, a vehicle follows a fixed sequence of commands (it *brakes in pieces*).

A *piece* is a time interval in which the command of a vehicle with a braking profile is constant. A world in which a
vehicle follows a braking profile is advanced by the functions for brakes that build up (``physics.build_up``), even if
all brakes act at once.
"""

from __future__ import annotations

import math

from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import command_acts
from ethbrake_marl.physics.rows import ROW, builds_up
from ethbrake_marl.physics.state import Floats


@compiled(bare=True)
def begin_piece(table: Floats, i: int, now: float) -> None:
    """Set the command of vehicle ``i`` to the command of its piece (interval of constant command) at the time ``now``.

    The function also writes the time at which the vehicle's next piece begins into the table (row NEXT_PIECE). ``now``
    and the time that the function writes are in seconds from the start of the segment. ``table``: one world in the
    layout of ``physics.rows``.
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
    """Return whether at least one vehicle has a piece (interval of constant command) that has not begun yet.

    ``table``: one world in the layout of ``physics.rows``.
    """
    if table.shape[0] > ROW.OF_BUILD_UP:
        for i in range(table.shape[1]):
            if table[ROW.NEXT_PIECE, i] < math.inf:
                return True
    return False


@compiled(bare=True)
def force_at(table: Floats, i: int, command: float, latency_s: float, time_s: float) -> float:
    """Return the force (m/s2) of a vehicle at the end of a segment.

    The force is the acceleration by brakes or engine. Until the latency has elapsed, the function uses 0 instead of
    ``command``.

    Args:
        table: the world at the end of the segment, in the layout of ``physics.rows``.
        i: column of the vehicle.
        command: command of the vehicle in the segment, m/s2.
        latency_s: time before which the vehicle's commands have no effect, s.
        time_s: end of the segment, s, counted from the same moment as ``latency_s``.

    """
    acts = command_acts(latency_s, time_s)
    if not builds_up(table):
        return command if acts else 0.0
    wanted = table[ROW.COMMAND, i] if acts else 0.0  # the command of its piece, if it brakes in pieces
    return force_now(table[ROW.FORCE, i], wanted, table[ROW.BRAKE_RATE, i], table[ROW.RELEASE_RATE, i])


@compiled
def force_now(force: float, wanted: float, brake_rate: float, release_rate: float) -> float:
    """Return a vehicle's force (m/s2) just after a command takes effect.

    The force is the acceleration by brakes or engine. If the rate at which the force moves towards the command is
    infinite, the result is the command. If this rate is finite, the result is ``force``.

    Args:
        force: force just before the command takes effect, m/s2.
        wanted: command, m/s2; negative brakes.
        brake_rate: rate at which the force falls to a lower command, m/s3; may be infinite.
        release_rate: rate at which the force rises to a higher command, m/s3; may be infinite.

    """
    return wanted if math.isinf(brake_rate if wanted < force else release_rate) else force
