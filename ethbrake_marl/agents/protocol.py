"""What an agent is: it drives one vehicle in a whole batch of worlds."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Ints, Worlds


@runtime_checkable
class Agent(Protocol):
    """Drives one vehicle in every world of a batch of ``n``; one object per vehicle."""

    name: str

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """New episodes start in these rows of the batch.

        ``worlds`` holds those rows only (``len(rows)`` worlds), in their state at the alert. The first call of a
        batch has ``rows = 0..n-1``; later ones, after an automatic reset, any subset.
        """

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration of ``vehicle`` (index from 0) in every world of the batch, [n] m/s2."""


@runtime_checkable
class PredictingAgent(Protocol):
    """An agent that also states, when an episode begins, which harm it expects."""

    predicted_harm: Floats  # [n] m2/s2, filled by ``begin``


def place(stored: Floats, rows: Ints, values: Floats) -> Floats:
    """Per-world values after new episodes in ``rows``; grows to the largest row seen, NaN where none began yet."""
    size = max(stored.size, int(rows.max(initial=-1)) + 1)
    placed = np.full(size, np.nan)
    placed[: stored.size] = stored
    placed[rows] = values
    return placed


def recall(stored: Floats, n: int, name: str) -> Floats:
    """The values of a batch of ``n`` (own memory). Raises ``InvalidInput`` if an episode in it never began."""
    values = stored[:n].copy()
    if values.size < n or not np.all(np.isfinite(values)):
        raise InvalidInput(f"agent {name!r}: act on {n} worlds, but begin was not called for each of them")
    return values
