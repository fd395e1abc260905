"""The table on which the compiled kernels work, one per world: a row per quantity, a column per vehicle or pair."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.motion import BOUND
from ethbrake_marl.physics.state import Floats, Ints


class _Rows(NamedTuple):
    """Rows of the table of one world: quantities of its vehicles, its pairs and its pooled blocks."""

    # per vehicle
    SPEED: int = 0
    MASS: int = 1
    BEFORE: int = 2  # speed before an impact
    POOLED: int = 3
    # per pair
    GAP: int = 4
    CLOSING: int = 5  # closing speed before an impact; 0 if the pair does not touch
    CONTACT_SPEED: int = 6  # exact closing speed of a pair that has just come into contact, otherwise 0
    STRUCK: int = 7  # 1 if the pair had an impact (not a touch) in the last round
    # per pooled block
    BLOCK_MASS: int = 8
    BLOCK_LOW: int = 9
    BLOCK_HIGH: int = 10
    BLOCK_FIRST: int = 11
    # motion, per vehicle
    COMMAND: int = 12
    ONSET: int = 13  # when the command takes effect, in seconds from the start of the segment
    LIMIT: int = 14
    ACTIVE: int = 15  # 1 once the command is in effect
    ACCELERATION: int = 16
    FORCE_LOW: int = 17
    FORCE_HIGH: int = 18
    SPEED_TIME: int = 19  # time to the next speed event
    SPEED_VALUE: int = 20  # the speed there
    WAY: int = 21
    # motion, per pair
    JOINED: int = 22  # 1 if the pair moves as one body
    CONTACT_TIME: int = 23
    HIT: int = 24  # 1 once the pair has had an impact
    FIRST_HARM: int = 25  # harm in this segment
    TOTAL_HARM: int = 26
    COUNT: int = 27  # number of impacts in this segment
    # episode, per vehicle
    LATENCY: int = 28  # when the command takes effect (s since Vehicle 1 began to brake)
    # episode, per pair
    SUM_FIRST_HARM: int = 29  # harm since the episode began (m2/s2)
    SUM_TOTAL_HARM: int = 30
    # brake build-up, per vehicle
    FORCE: int = 31  # present acceleration by brakes or engine; it moves towards the command (m/s2)
    BRAKE_RATE: int = 32  # rate at which FORCE falls (m/s3); infinite: at once
    RELEASE_RATE: int = 33  # rate at which FORCE rises (m/s3)
    BUILDS_UP: int = 34  # of the world, in column 0: 1 if some rate is finite or some vehicle brakes in pieces
    FORCE_RATE: int = 35  # rate of FORCE until the next event (m/s3)
    FORCE_TIME: int = 36  # time until FORCE reaches the command or passes 0
    FORCE_VALUE: int = 37  # FORCE at that time
    JERK: int = 38
    LOW_JERK: int = 39  # rate of FORCE_LOW; HIGH_JERK: of FORCE_HIGH
    HIGH_JERK: int = 40
    # per pooled block
    BLOCK_LOW_JERK: int = 41
    BLOCK_HIGH_JERK: int = 42
    # number of rows that a table needs
    OF_IMPACT: int = 12  # for impacts only
    OF_SEGMENT: int = 28  # for a segment
    OF_EPISODE: int = 31  # for an episode
    OF_BUILD_UP: int = 43  # for a segment or an episode with brake build-up
    # braking in pieces, per vehicle, in tables longer than OF_BUILD_UP
    NEXT_PIECE: int = 43  # when the next piece begins, in seconds from the start of the segment
    PIECES: int = 44  # K rows: start of each piece (s after the onset; infinite: none); K rows: its command


ROW = _Rows()


class _Flags(NamedTuple):
    """Status of a world after the kernel has advanced it."""

    IMPACT: int = 0
    DONE: int = 1
    PENETRATED: int = 2
    STUCK: int = 3

    def failure(self, status: Ints, from_s: Floats, until_s: Floats) -> PhysicsError:
        """Return the error for all worlds with a ``status`` [n] other than DONE."""
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
    """Return whether the brakes of this world build up or come in pieces."""
    return bool(table.shape[0] > ROW.OF_EPISODE and table[ROW.BUILDS_UP, 0] == 1.0)


@compiled
def rows_for(pieces: int) -> int:
    """Return the number of table rows for ``pieces`` = 2 K columns of braking in pieces; 0: ROW.OF_BUILD_UP rows."""
    return ROW.PIECES + pieces if pieces > 0 else ROW.OF_BUILD_UP


@compiled(bare=True)
def place_rates(table: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats) -> None:
    """Write brake and release rates [N] (m/s3) and pieces [N, 2 K] into a table [rows_for(2 K), N or N + 1].

    If all rates are infinite and no vehicle brakes in pieces, BUILDS_UP is 0 and forces are not used.
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
    """``place_rates``, and write the forces of the vehicles [N] (m/s2)."""
    place_rates(table, brake_rate, release_rate, pieces)
    if table[ROW.BUILDS_UP, 0] == 1.0:
        for i in range(force.shape[0]):
            table[ROW.FORCE, table.shape[1] - force.shape[0] + i] = force[i]


@compiled
def place_obstacle(table: Floats, gap: float, hit: float) -> None:
    """Write the obstacle into column 0 of a table; its speed and command stay at the zeros of a new table."""
    table[ROW.MASS, 0] = math.inf
    table[ROW.GAP, 0] = gap
    table[ROW.HIT, 0] = hit
