"""How worlds depart from the plain game, and the check with which a feature refuses departures that it does not cover.

In the plain game no vehicle moves backward, brakes act at once, nothing stands ahead of Vehicle 1, and vehicles move
and collide as ``motion`` computes. Everything else is a departure with a name: one of the names below, the name of a
row of ``State.car`` that is not in ``PLAIN_ROWS``, or what a physics or a user has marked (``state.mark``). A feature
refuses a departure that it does not name, so nothing new is covered by silence.
"""

from __future__ import annotations

from collections.abc import Iterable, Set as AbstractSet
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    CAR_NAMES,
    DRIVING,
    FAR_M,
    GAP,
    LATENCY,
    LIMIT,
    MASS,
    OWN_LATENCY,
    RELEASE_RATE,
    RESTITUTION,
    SCRIPTED,
    SPEED,
    Bools,
    Floats,
)

MARKS = "departures"  # memory of a state: the departures that its arrays do not show, name -> None

BUILD_UP = "build-up"  # brakes or engines need time to build up their force
OBSTACLE = "obstacle"  # an obstacle stands ahead of Vehicle 1
BACKWARD = "backward"  # a vehicle moves backward
MAP = "map"  # impacts happen only at decisions
SHOWN = frozenset({BUILD_UP, OBSTACLE, BACKWARD})  # departures that the arrays of every state show
BRAKES_EXACTLY = SHOWN | {MAP}  # departures in which commands and speeds say how a vehicle moves without contact

# Rows of `car` that every feature takes into account, in the order in which digests hash them. Any other row departs
# where it is not 0; but SCRIPTED belongs to the game, not to its worlds.
PLAIN_ROWS = [MASS, LIMIT, LATENCY, BRAKING, DRIVING, BRAKE_RATE, RELEASE_RATE, RESTITUTION, OWN_LATENCY]


def departures_of(physics: Any) -> frozenset[str]:
    """Departures of the worlds of a game with this ``physics`` (``episode.game.Physics``; None: exact impacts).

    They are its attribute ``departures``: empty, if vehicles move and collide as ``motion`` computes. A physics without
    this attribute departs by the name of its class.
    """
    if physics is None:
        return frozenset()
    name = type(physics).__name__
    departures = getattr(physics, "departures", {name})
    if not isinstance(departures, AbstractSet):
        raise InvalidInput(f"physics {name}: departures = {departures!r:.60}: must be a set of names; empty: exact")
    return frozenset(departures)


def departing_worlds(
    line: Floats, car: Floats, marks: Iterable[str], ignored: AbstractSet[str] = frozenset()
) -> dict[str, Bools]:
    """Name of each departure, except the ``ignored`` ones -> worlds that depart so, a mask [n].

    ``line`` and ``car`` are arrays of a ``State``, and ``marks`` the departures with which it is marked.
    """
    worlds: dict[str, Any] = dict.fromkeys(marks, np.ones(len(line), np.bool_))
    if BUILD_UP not in ignored:
        worlds[BUILD_UP] = np.isfinite(car[:, [BRAKE_RATE, RELEASE_RATE], 1:]).any(axis=(1, 2))
    if OBSTACLE not in ignored:
        worlds[OBSTACLE] = line[:, GAP, 0] < FAR_M
    if BACKWARD not in ignored:
        worlds[BACKWARD] = ~(line[:, SPEED, 1:] >= 0.0).all(axis=1)
    for row, name in enumerate(CAR_NAMES):
        if row not in (*PLAIN_ROWS, SCRIPTED):
            worlds[name] = (car[:, row] != 0.0).any(axis=1)
    return {name: mask for name, mask in worlds.items() if name not in ignored and mask.any()}
