"""Worlds that cannot be advanced: left out, named, and never at the expense of the others."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ethbrake_marl.errors import PhysicsError, renumbered
from ethbrake_marl.physics.segment import DONE, MOST_EVENTS, PENETRATED, STUCK
from ethbrake_marl.physics.worlds import Floats, Ints

Result = TypeVar("Result")


LeftOutRows = tuple[tuple[int, str], ...]  # row of the batch that was given, why its world counts nowhere
_REASONS = {PENETRATED: "a contact was missed", STUCK: f"more than {MOST_EVENTS} events"}


def failure(status: Ints, from_s: Floats, until_s: Floats) -> PhysicsError:
    """The error for all worlds that the kernel marked with a ``status`` [n] other than DONE."""
    return PhysicsError(
        {
            k: f"{_REASONS[int(status[k])]} between {from_s[k]:g} s and {until_s[k]:g} s"
            for k in np.flatnonzero(status != DONE).tolist()
        }
    )


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
