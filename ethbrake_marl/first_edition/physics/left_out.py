"""Leave out worlds that the physics cannot advance, and report them; the results of the other worlds do not change.

Worlds are identified by indices. The arguments ``measure`` and ``work`` are functions of an array of world indices. If
the physics fails, they must raise a ``PhysicsError`` that lists the failed worlds by their positions in this array.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ethbrake_marl.errors import PhysicsError, renumbered
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints

Result = TypeVar("Result")

LeftOutRows = tuple[tuple[int, str], ...]  # row of each world that was left out, and why


def measured_without_failed(measure: Callable[[Ints], Result], n: int) -> tuple[Result, Ints, LeftOutRows]:
    """Call ``measure`` for the worlds that do not fail; return the result, these worlds, and the failed worlds.

    The worlds are 0 to n - 1. The failed worlds are pairs (index of the world, reason), in ascending order. The
    function works like ``leaving_out_failed``, but raises ``PhysicsError`` if every world fails.
    """
    result, rows, failed = leaving_out_failed(measure, np.arange(n))
    if result is None:
        raise PhysicsError(failed)
    return result, rows, tuple(sorted(failed.items()))


def leaving_out_failed(work: Callable[[Ints], Result], rows: Ints) -> tuple[Result | None, Ints, dict[int, str]]:
    """Call ``work`` for the worlds that do not fail; return the result, these worlds, and {failed world: reason}.

    ``work`` is called first with ``rows`` [k], and repeated without the failed worlds until no world fails. The results
    of the other worlds stay the same, because the result of a world does not depend on the other worlds. If every world
    fails, the returned result is None.
    """
    failed: dict[int, str] = {}
    while len(rows):
        try:
            with renumbered(rows):
                return work(rows), rows, failed
        except PhysicsError as error:
            failed |= error.worlds
            rows = rows[~np.isin(rows, list(error.worlds))]
    return None, rows, failed


@dataclass(frozen=True, slots=True)
class ImpactRows:
    """The k impacts of a segment (an interval of constant commands), ordered by world and then by time; arrays [k]."""

    world: Ints  # row of the world in the batch
    pair: Ints  # index of the pair; -1: Vehicle 1 and the obstacle ahead
    time_s: Floats  # time since Vehicle 1 began to brake
    closing_speed_mps: Floats  # just before the impact, > 0
    first: Bools  # whether this is the pair's first impact
    front_speed_change_mps: Floats  # change of the front vehicle's speed in this round of impacts, >= 0
    rear_speed_change_mps: Floats  # change of the rear vehicle's speed, usually negative


@dataclass(frozen=True, slots=True)
class Impacts:
    """Harm (m2/s2) and number of impacts in a segment."""

    first_impact_harm: Floats  # [n, P] harm of each pair's first impact of the episode, if it is in this segment
    total_harm: Floats  # [n, P] harm of every impact
    count: Ints  # [n, P] number of impacts
    obstacle_first_harm: Floats  # [n] first-impact harm of Vehicle 1 with the obstacle ahead
    obstacle_total_harm: Floats  # [n] total harm of Vehicle 1 with the obstacle
    obstacle_count: Ints  # [n] number of impacts of Vehicle 1 with the obstacle
    rows: ImpactRows | None = None  # every single impact; None if not recorded

    @staticmethod
    def no_obstacle(n: int) -> tuple[Floats, Floats, Ints]:
        """Return zeros for the three obstacle fields of n worlds without obstacle, [n] each."""
        return np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
