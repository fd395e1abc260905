"""Worlds that cannot be advanced: left out, named, and never at the expense of the others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from ethbrake_marl.errors import PhysicsError, renumbered
from ethbrake_marl.physics.state import Bools, Floats, Ints

Result = TypeVar("Result")

LeftOutRows = tuple[tuple[int, str], ...]  # row of the batch that was given, why its world counts nowhere


def measured_without_failed(measure: Callable[[Ints], Result], n: int) -> tuple[Result, Ints, LeftOutRows]:
    """What ``measure`` finds in those of ``n`` worlds in which it does not fail, their rows, and which were left out.

    As ``leaving_out_failed``, but raises ``PhysicsError`` where no world is left.
    """
    found, rows, failed = leaving_out_failed(measure, np.arange(n))
    if found is None:
        raise PhysicsError(failed)
    return found, rows, tuple(sorted(failed.items()))


def leaving_out_failed(work: Callable[[Ints], Result], rows: Ints) -> tuple[Result | None, Ints, dict[int, str]]:
    """Result of ``work`` on those of ``rows`` in which it does not fail, these rows, and what went wrong in the others.

    ``work`` takes rows of a batch and raises ``PhysicsError`` by the place in what it was given. As the result of a
    world does not depend on its batch, it is simply done again without those that failed; each time there are fewer.
    The result is None where no row is left.
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
    """Every impact of a segment, by world and then by time; arrays [k]."""

    world: Ints
    pair: Ints  # -1: Vehicle 1 and the obstacle ahead
    time_s: Floats  # since Vehicle 1 began to brake
    closing_speed_mps: Floats  # immediately before, > 0
    first: Bools  # the pair had no impact before
    front_speed_change_mps: Floats  # of the pair's front vehicle in this cluster of impacts, >= 0
    rear_speed_change_mps: Floats  # of its rear vehicle, usually negative


@dataclass(frozen=True, slots=True)
class Impacts:
    """What happened in a segment. Harm of a pair's impact is its squared closing speed (m2/s2)."""

    first_impact_harm: Floats  # [n, P] only impacts of pairs that had none before
    total_harm: Floats  # [n, P] every impact
    count: Ints  # [n, P]
    obstacle_first_harm: Floats  # [n] the same of Vehicle 1's impacts with the obstacle ahead
    obstacle_total_harm: Floats  # [n]
    obstacle_count: Ints  # [n]
    rows: ImpactRows | None = None  # only when recorded

    @staticmethod
    def no_obstacle(n: int) -> tuple[Floats, Floats, Ints]:
        """Harm, by both counts, and impacts of ``n`` worlds without an obstacle."""
        return np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
