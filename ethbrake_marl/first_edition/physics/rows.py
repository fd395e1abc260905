"""The table of one world on which the compiled functions work: a row per quantity, a column per vehicle or pair.

The constants of ``ROW`` name the rows: ``table[ROW.SPEED, i]`` is the speed of vehicle i. In a row for pairs, column p
belongs to the pair (vehicle p, vehicle p + 1). If there is an obstacle ahead, the obstacle is in column 0 and vehicle i
is in column i + 1.

A vehicle *brakes in pieces* if it follows a fixed sequence of commands (``Vehicles.pieces``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.motion import BOUND
from ethbrake_marl.first_edition.physics.state import Floats, Ints


class _Rows(NamedTuple):
    """Row numbers of the table of one world: quantities of its vehicles, its pairs and its *blocks*.

    A *block* consists of touching vehicles that get one common speed or acceleration. The *force* of a vehicle is the
    acceleration that its brakes or engine alone would cause.
    """

    # per vehicle
    SPEED: int = 0  # m/s
    MASS: int = 1  # t; infinite: an obstacle
    BEFORE: int = 2  # speed before the last round of impacts (m/s)
    POOLED: int = 3  # common speed of the vehicle's block (m/s)
    # per pair
    GAP: int = 4  # bumper to bumper (m)
    CLOSING: int = 5  # closing speed before an impact (m/s); 0 if the pair does not touch
    CONTACT_SPEED: int = 6  # exact closing speed of a pair that has just come into contact (m/s), otherwise 0
    STRUCK: int = 7  # 1 if the pair had an impact (not a touch) in the last round
    # per pooled block
    BLOCK_MASS: int = 8  # total mass (t)
    BLOCK_LOW: int = 9  # sum of mass times the lower bound of each vehicle's speed or acceleration
    BLOCK_HIGH: int = 10  # sum of mass times the upper bound
    BLOCK_FIRST: int = 11  # column of the front vehicle
    # motion, per vehicle
    COMMAND: int = 12  # commanded acceleration; negative brakes (m/s2)
    ONSET: int = 13  # when the command takes effect, in seconds from the start of the segment
    LIMIT: int = 14  # speed up to which the vehicle drives (m/s)
    ACTIVE: int = 15  # 1 once the command is in effect
    ACCELERATION: int = 16  # until the next event (m/s2)
    FORCE_LOW: int = 17  # acceleration by own forces if the vehicle is about to move forward (m/s2)
    FORCE_HIGH: int = 18  # the same if it is about to move backward (m/s2)
    SPEED_TIME: int = 19  # time until the vehicle stands or reaches its speed limit (s); infinite: never
    SPEED_VALUE: int = 20  # speed at that time (m/s)
    WAY: int = 21  # distance travelled in the segment (m)
    # motion, per pair
    JOINED: int = 22  # 1 if the pair moves as one body
    CONTACT_TIME: int = 23  # time to the next contact (s); infinite: none
    HIT: int = 24  # 1 once the pair has had an impact
    FIRST_HARM: int = 25  # harm of the pair's first impact of the episode, if in this segment (m2/s2)
    TOTAL_HARM: int = 26  # harm of all impacts in this segment (m2/s2)
    COUNT: int = 27  # number of impacts in this segment
    # episode, per vehicle
    LATENCY: int = 28  # when the command takes effect (s since Vehicle 1 began to brake)
    # episode, per pair
    SUM_FIRST_HARM: int = 29  # first-impact harm since the episode began (m2/s2)
    SUM_TOTAL_HARM: int = 30  # harm of all impacts since the episode began (m2/s2)
    FRONT_WEIGHT: int = 31  # share of the pair's harm that the front vehicle bears, times the weight of its harm
    REAR_WEIGHT: int = 32  # the same of the rear vehicle
    # brake build-up, per vehicle
    FORCE: int = 33  # present force; it moves towards the command (m/s2)
    BRAKE_RATE: int = 34  # rate at which FORCE falls (m/s3); infinite: at once
    RELEASE_RATE: int = 35  # rate at which FORCE rises (m/s3)
    BUILDS_UP: int = 36  # of the world, in column 0: 1 if some rate is finite or some vehicle brakes in pieces
    FORCE_RATE: int = 37  # rate of FORCE until the next event (m/s3)
    FORCE_TIME: int = 38  # time until FORCE reaches the command or passes 0 (s)
    FORCE_VALUE: int = 39  # FORCE at that time (m/s2)
    JERK: int = 40  # rate of ACCELERATION until the next event (m/s3)
    LOW_JERK: int = 41  # rate of FORCE_LOW (m/s3)
    HIGH_JERK: int = 42  # rate of FORCE_HIGH (m/s3)
    # per pooled block
    BLOCK_LOW_JERK: int = 43  # sum of mass times LOW_JERK
    BLOCK_HIGH_JERK: int = 44  # sum of mass times HIGH_JERK
    # number of rows that a table needs
    OF_IMPACT: int = 12  # for impacts only
    OF_SEGMENT: int = 28  # for a segment
    OF_EPISODE: int = 33  # for an episode
    OF_BUILD_UP: int = 45  # for a segment or an episode with brake build-up
    # braking in pieces, per vehicle, in tables longer than OF_BUILD_UP
    NEXT_PIECE: int = 45  # when the next piece begins, in seconds from the start of the segment
    PIECES: int = 46  # K rows: start of each piece (s after the onset; infinite: none); K rows: its command


ROW = _Rows()


class _Flags(NamedTuple):
    """Status codes of one world after its motion: an impact, the end of the segment, or a failure."""

    IMPACT: int = 0  # a round of impacts was resolved; the segment goes on
    DONE: int = 1  # the end of the segment is reached
    PENETRATED: int = 2  # failure: a gap became negative, so a contact was missed
    STUCK: int = 3  # failure: more than BOUND.MOST_EVENTS events

    def failure(self, status: Ints, from_s: Floats, until_s: Floats) -> PhysicsError:
        """Return the error that lists every world whose ``status`` [n] is not DONE.

        ``from_s`` and ``until_s`` [n] are start and end (s) of each world's segment, for the error message.
        """
        reasons = {
            self.PENETRATED: "a contact was missed",
            self.STUCK: f"there were more than {BOUND.MOST_EVENTS:,} events",
        }
        return PhysicsError(
            {
                k: f"{reasons[int(status[k])]} between {from_s[k]:g} s and {until_s[k]:g} s"
                for k in np.flatnonzero(status != self.DONE).tolist()
            }
        )


FLAG = _Flags()


class _Listed(NamedTuple):
    """Column numbers of the array of impacts, which has one row per impact."""

    WORLD: int = 0  # number of the world
    PAIR: int = 1  # column of the pair in the table
    TIME: int = 2  # time of the impact (s)
    CLOSING: int = 3  # closing speed just before it (m/s)
    FIRST: int = 4  # 1 if it is the pair's first impact, else 0
    FRONT_CHANGE: int = 5  # change of the front vehicle's speed (m/s)
    REAR_CHANGE: int = 6  # change of the rear vehicle's speed (m/s)
    WIDTH: int = 7  # number of columns


LISTED = _Listed()


@compiled(bare=True)
def builds_up(table: Floats) -> bool:
    """Return whether brakes build up at a finite rate, or a vehicle brakes in pieces."""
    return bool(table.shape[0] > ROW.OF_EPISODE and table[ROW.BUILDS_UP, 0] == 1.0)


@compiled
def rows_for(pieces: int) -> int:
    """Return the number of rows of a table for vehicles that brake in K pieces; ``pieces`` is 2 K.

    If ``pieces`` is 0, the result is ROW.OF_BUILD_UP.
    """
    return ROW.PIECES + pieces if pieces > 0 else ROW.OF_BUILD_UP


@compiled(bare=True)
def place_rates(table: Floats, brake_rate: Floats, release_rate: Floats, pieces: Floats) -> None:
    """Write brake rates, release rates and pieces of one world's vehicles into its table.

    The function sets the entry BUILDS_UP to 1 if a rate is finite or a vehicle brakes in pieces. Otherwise it sets
    BUILDS_UP to 0, and the rows of forces are not used.

    Args:
        table: table to fill, [rows_for(2 K), N or N + 1]; with N + 1 columns, column 0 is an obstacle.
        brake_rate: rate at which each vehicle's force falls, [N] m/s3; infinite: at once.
        release_rate: rate at which each vehicle's force rises, [N] m/s3; infinite: at once.
        pieces: starts (s) and commands (m/s2), [N, 2 K], as in ``Vehicles.pieces``.

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
    """Write brake and release rates, pieces and forces of one world's vehicles into its table.

    ``force`` are the present forces, [N] m/s2. The other arguments are as in ``place_rates``. If ``place_rates`` sets
    the entry BUILDS_UP to 0, the function writes no forces.
    """
    place_rates(table, brake_rate, release_rate, pieces)
    if table[ROW.BUILDS_UP, 0] == 1.0:
        for i in range(force.shape[0]):
            table[ROW.FORCE, table.shape[1] - force.shape[0] + i] = force[i]


@compiled
def place_obstacle(table: Floats, gap: float, hit: float) -> None:
    """Write an obstacle into column 0 of a new table; speed and command of the obstacle stay 0.

    ``gap`` is the gap to Vehicle 1, m. ``hit`` is 1 if Vehicle 1 has already had an impact with the obstacle, else 0.
    """
    table[ROW.MASS, 0] = math.inf
    table[ROW.GAP, 0] = gap
    table[ROW.HIT, 0] = hit
