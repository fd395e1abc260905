"""The gates of the long programme: each measures one figure and has one threshold."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Figure(NamedTuple):
    """One measured figure, good when it does not exceed its threshold."""

    value: float
    threshold: float
    of: str  # what it was measured on

    @property
    def good(self) -> bool:
        """Whether the gate passes; NaN does not."""
        return self.value <= self.threshold


GATES: dict[str, Callable[[], Figure]] = {}


def gate(name: str) -> Callable[[Callable[[], Figure]], Callable[[], Figure]]:
    """Enter a function into the programme under a name."""

    def enter(measure: Callable[[], Figure]) -> Callable[[], Figure]:
        GATES[name] = measure
        return measure

    return enter
