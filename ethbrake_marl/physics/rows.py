"""The table of one world that the compiled kernels work on: a row per quantity, a column per vehicle or pair."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import BOUND
from ethbrake_marl.physics.state import Floats, Ints


class _Rows(NamedTuple):
    """Rows of the table of one world: of its vehicles, its pairs, its pooled blocks."""

    # per vehicle
    SPEED: int = 0
    MASS: int = 1
    BEFORE: int = 2  # speed before an impact
    POOLED: int = 3
    # per pair
    GAP: int = 4
    CLOSING: int = 5  # closing speed before an impact, 0 where the pair does not touch
    CONTACT_SPEED: int = 6  # exact closing speed of a pair that has just met, else 0
    STRUCK: int = 7  # 1 where the last round was an impact (not a touch)
    # per pooled block
    BLOCK_MASS: int = 8
    BLOCK_LOW: int = 9
    BLOCK_HIGH: int = 10
    BLOCK_FIRST: int = 11
    # per vehicle: of motion
    COMMAND: int = 12
    ONSET: int = 13  # when the command takes effect, seconds from the start of the segment
    LIMIT: int = 14
    ACTIVE: int = 15  # 1 once the command is in effect
    ACCELERATION: int = 16
    FORCE_LOW: int = 17
    FORCE_HIGH: int = 18
    SPEED_TIME: int = 19  # time to the next speed event
    SPEED_VALUE: int = 20  # the speed there
    WAY: int = 21
    # per pair: of motion
    JOINED: int = 22  # 1 where the pair moves as one body
    CONTACT_TIME: int = 23
    HIT: int = 24  # 1 once the pair has had an impact
    FIRST_HARM: int = 25  # harm of this segment
    TOTAL_HARM: int = 26
    COUNT: int = 27  # impacts of this segment
    # of an episode: per vehicle
    LATENCY: int = 28  # when its command takes effect (s since Vehicle 1 began to brake)
    # of an episode: per pair
    SUM_FIRST_HARM: int = 29  # harm since the episode began (m2/s2)
    SUM_TOTAL_HARM: int = 30
    # of brakes that build up: per vehicle
    FORCE: int = 31  # acceleration that its brakes or its engine call for now; it moves towards the command (m/s2)
    BRAKE_RATE: int = 32  # how fast it falls, and rises (m/s3); infinite: at once
    RELEASE_RATE: int = 33
    BUILDS_UP: int = 34  # of the world, in column 0: 1 where some rate is finite
    FORCE_RATE: int = 35  # at which FORCE moves in this piece (m/s3)
    FORCE_TIME: int = 36  # until it reaches the command, or passes 0
    FORCE_VALUE: int = 37  # there
    JERK: int = 38
    LOW_JERK: int = 39  # at which FORCE_LOW and FORCE_HIGH move
    HIGH_JERK: int = 40
    # per pooled block
    BLOCK_LOW_JERK: int = 41
    BLOCK_HIGH_JERK: int = 42
    # how many of them
    OF_IMPACT: int = 12  # rows of the table that an impact needs, a segment, an episode
    OF_SEGMENT: int = 28
    OF_EPISODE: int = 31
    OF_BUILD_UP: int = 43  # of a segment or an episode in which brakes may build up
    # of brakes in pieces: per vehicle, in tables longer than OF_BUILD_UP
    NEXT_PIECE: int = 43  # when the next piece of its command begins, seconds from the start of the segment
    PIECES: int = 44  # when each of K pieces begins, seconds after the onset (infinite: none), then their K commands


ROW = _Rows()


class _Flags(NamedTuple):
    """What advancing one world told."""

    IMPACT: int = 0
    DONE: int = 1
    PENETRATED: int = 2
    STUCK: int = 3

    def failure(self, status: Ints, from_s: Floats, until_s: Floats) -> PhysicsError:
        """The error for all worlds that the kernel marked with a ``status`` [n] other than DONE."""
        reasons = {self.PENETRATED: "a contact was missed", self.STUCK: f"more than {BOUND.MOST_EVENTS} events"}
        return PhysicsError(
            {
                k: f"{reasons[int(status[k])]} between {from_s[k]:g} s and {until_s[k]:g} s"
                for k in np.flatnonzero(status != self.DONE).tolist()
            }
        )


FLAG = _Flags()


class _Listed(NamedTuple):
    """Columns of the list of impacts."""

    WORLD: int = 0
    PAIR: int = 1
    TIME: int = 2
    CLOSING: int = 3
    FIRST: int = 4
    FRONT_CHANGE: int = 5
    REAR_CHANGE: int = 6
    WIDTH: int = 7


LISTED = _Listed()


@compiled(bare=True)
def builds_up(table: Floats) -> bool:
    """Whether the brakes of this world build up."""
    return bool(table.shape[0] > ROW.OF_EPISODE and table[ROW.BUILDS_UP, 0] == 1.0)


@compiled
def rows_for(pieces: int) -> int:
    """Rows of a table for vehicles with so many ``pieces``, times and commands; 0: ROW.OF_BUILD_UP."""
    return ROW.PIECES + pieces if pieces > 0 else ROW.OF_BUILD_UP


@compiled(bare=True)
def place_rates(table: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats) -> None:
    """Write rates (m/s3), each [N], and pieces [N, 2 K] of the vehicles into a table [rows_for(2 K), N or N + 1].

    Where all rates are infinite and nobody brakes in pieces, the forces are not looked at.
    """
    at, least = table.shape[1] - brake_rate.shape[0], math.inf
    for row in range(pieces.shape[1]):
        for i in range(table.shape[1]):
            table[ROW.PIECES + row, i] = math.inf if i < at else pieces[i - at, row]
            least = min(least, table[ROW.PIECES + row, i])
    for i in range(brake_rate.shape[0]):
        least = min(least, brake_rate[i], release_rate[i])
    table[ROW.BUILDS_UP, 0] = 1.0 if least < math.inf else 0.0
    if least < math.inf:
        for i in range(brake_rate.shape[0]):
            table[ROW.BRAKE_RATE, at + i] = brake_rate[i]
            table[ROW.RELEASE_RATE, at + i] = release_rate[i]


@compiled(bare=True)
def place_forces(
    table: Floats, force: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats
) -> None:  # fmt: skip
    """``place_rates``, and the forces of the vehicles [N] (m/s2)."""
    place_rates(table, brake_rate, release_rate, pieces)
    if table[ROW.BUILDS_UP, 0] == 1.0:
        for i in range(force.shape[0]):
            table[ROW.FORCE, table.shape[1] - force.shape[0] + i] = force[i]


@compiled
def place_obstacle(table: Floats, gap: float, hit: float) -> None:
    """Write the obstacle into column 0 of a world's table; its speed and command are the zeros of a new table."""
    table[ROW.MASS, 0] = math.inf
    table[ROW.GAP, 0] = gap
    table[ROW.HIT, 0] = hit
