"""What asks more than a test may take. ``python -m tests.programmes`` lists the programmes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
KEPT = ROOT / ".venvs"  # environments of other libraries and other versions, kept for the next time


class Told(NamedTuple):
    """How a case ended: whether it was good (None: nothing is claimed), and one line about it."""

    good: bool | None
    text: str = ""


Cases = Iterator[tuple[str, Callable[[], Told]]]
