"""One world as arrays of rows: what changes, what stays, and the scratch memory of the physics.

Column 0 is the *obstacle* ahead of the line, columns 1 to N are the vehicles, front to rear; all are called *bodies*.
In a row of pairs, column p is the pair (body p, body p + 1). Column 0 exists in every world: without an obstacle its
gap is ``FAR_M``, and the physics leaves it out.

Arrays that most functions share: ``line`` [16, N + 1] changes, ``car`` [10, N + 1] stays the same, ``scratch`` [38, N +
1] is the working memory of one call. A batch of n worlds has one more axis in front: ``line`` [n, 16, N + 1], ``car``
[n, 10, N + 1].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

# rows of `line`
SPEED = 0  # m/s, positive forward
FORCE = 1  # acceleration that brakes or engine alone would cause now (m/s2), negative brakes
GAP = 2  # of the pair, bumper to bumper (m)
HIT = 3  # 1 once the pair has had an impact
FIRST = 4  # harm of the pair's first impact (m2/s2)
TOTAL = 5  # harm of all its impacts (m2/s2)
IMPACTS = 6  # number of its impacts
PUSHED = 7  # push: closing speed that forces have built up and the pair's contact has taken up (m/s)
DROVE = 8  # of the pair's rear vehicle: speed that its engine alone would have given it (m/s)
MOVING = 9  # of the pair's rear vehicle: price of its motion at the horizon (m2/s2)
THROWN = 10  # change of the closing speed by impacts since the pair last touched (m/s)
PASSED = 11  # harm that the contact passes on in impacts, beyond the harm of its own closing speed (m2/s2)
ANSWERED = 12  # of the pair's rear vehicle: its part of the pushes for which somebody answers (m/s)
SHARED = 13  # of the pair's rear vehicle: its part of the pushes for which nobody answers (m/s)
EASED = 14  # of the body: 1 if, after its latency and its last impact in front, its brakes have lacked full force
FOREIGN = 15  # of the body: part of its speed that it has from contacts, not by its own force (m/s)
LINE_ROWS = 16

# rows of `car`
MASS = 0  # t; infinite: the obstacle
LIMIT = 1  # speed up to which the vehicle drives (m/s)
LATENCY = 2  # time after the alert at which its commands begin to take effect (s)
BRAKING = 3  # largest deceleration on this road (m/s2)
DRIVING = 4  # largest acceleration forward on this road (m/s2)
BRAKE_RATE = 5  # rate at which the force falls towards the command (m/s3); infinite: at once
RELEASE_RATE = 6  # rate at which the force rises towards the command (m/s3); infinite: at once
RESTITUTION = 7  # of every impact of the world, in all columns (1)
OWN_LATENCY = 8  # latency without the wait for news of the alert (s)
SCRIPTED = 9  # 1: a script drives the vehicle in this game (`Game.marked`)
CAR_NAMES = (
    *("mass", "speed limit", "latency", "braking capacity", "driving capacity"),
    *("brake rate", "release rate", "restitution", "own latency", "scripted"),
)  # of these rows, in their order
CAR_ROWS = len(CAR_NAMES)

# rows of `scratch`
COMMAND = 0  # acceleration that the body wants in this interval (m/s2)
ONSET = 1  # when the command takes effect (s from the start of the interval)
ACTIVE = 2  # 1 once it is in effect
ACCELERATION = 3  # until the next event (m/s2)
JERK = 4  # until the next event (m/s3)
LOW = 5  # acceleration by the body's own force if it is about to move forward (m/s2)
HIGH = 6  # the same if it is about to move backward (m/s2)
LOW_JERK = 7  # rate of LOW (m/s3)
HIGH_JERK = 8  # rate of HIGH (m/s3)
FORCE_RATE = 9  # rate of FORCE (m/s3)
FORCE_TIME = 10  # time until FORCE is FORCE_GOAL (s)
FORCE_GOAL = 11  # the command, or 0 on the way to it (m/s2)
SPEED_TIME = 12  # time until the speed is SPEED_GOAL (s)
SPEED_GOAL = 13  # 0 or the speed limit (m/s)
WAY = 14  # distance travelled in the interval (m)
CONTACT_TIME = 15  # of the pair: time until its gap is 0 (s); infinite: it stays open
CONTACT_SPEED = 16  # of the pair: exact closing speed of a contact that has just happened (m/s), otherwise 0
JOINED = 17  # of the pair: 1 while it moves as one body
CLOSING = 18  # of the pair: closing speed before an impact (m/s)
POOLED = 19  # speed that the body would have after a plastic impact (m/s)
ZERO = 20  # zeros
BLOCK_MASS = 21  # of a block of bodies that move alike: mass (t)
BLOCK_LOW = 22  # sum of mass times LOW, or times speed
BLOCK_HIGH = 23  # sum of mass times HIGH, or times speed
BLOCK_LOW_JERK = 24  # sum of mass times LOW_JERK
BLOCK_HIGH_JERK = 25  # sum of mass times HIGH_JERK
BLOCK_HEAD = 26  # its front body
NEW_FIRST = 27  # of the pair: first-impact harm of this interval (m2/s2)
NEW_TOTAL = 28  # of the pair: harm of all its impacts in this interval (m2/s2)
NEW_IMPACTS = 29  # of the pair: number of its impacts in this interval
NEXT_TIME = 30  # of the pair: time of its first impact in this interval (s from its start); infinite: none
NEXT_CLOSING = 31  # of the pair: closing speed of that impact (m/s)
BEFORE = 32  # speed before an impact (m/s)
FRONT_CHANGE = 33  # largest change of speed by one impact at the body's front in this interval (m/s)
REAR_CHANGE = 34  # the same at its rear (m/s)
LAST_TIME = 35  # of the pair: time of its last impact in this interval (s from its start); infinite: none
PART = 36  # of a part of a line: acceleration by own forces (m/s2)
PART_RATE = 37  # its rate (m/s3)
SCRATCH_ROWS = 38

FAR_M = 1e300  # gap ahead of a line without an obstacle


def scratch_for(bodies: int) -> Floats:
    """Scratch memory for worlds with this number of ``bodies``, [SCRATCH_ROWS, bodies]."""
    return np.zeros((SCRATCH_ROWS, bodies))
