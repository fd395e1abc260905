"""What an agent is: it drives one vehicle in a whole batch of worlds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Ints
from ethbrake_marl.starts import Script


@runtime_checkable
class Agent(Script, Protocol):
    """A ``Script`` with a name: ``begin`` and ``act`` for one vehicle in every world of a batch of ``n``."""

    name: str


@runtime_checkable
class PredictingAgent(Protocol):
    """An agent that also states, when an episode begins, which harm it expects."""

    predicted_harm: Floats  # [n] m2/s2, filled by ``begin``


@runtime_checkable
class LookingAhead(Protocol):
    """An agent whose choice depends on what the other vehicles do; whoever knows their scripts sets them."""

    others: Mapping[int, Script]  # by vehicle index; vehicles without an entry brake fully


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
