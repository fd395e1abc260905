"""One family of exceptions. Every message says what is wrong, where, and what would be right."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

_NAMED = 5  # failed worlds that a message names one by one


class EthBrakeError(Exception):
    """Base of every error that this package raises on purpose."""


class InvalidInput(EthBrakeError, ValueError):
    """A value given by the user cannot be used: the message names it, its value and what would be right."""


class UnknownName(InvalidInput):
    """A name (scenario, agent, key, run) is not known; the message lists or suggests those that are."""


class AlreadyExists(EthBrakeError, FileExistsError):
    """Something would be overwritten; pass ``force`` (``--force``) to allow it."""


class CorruptBundle(EthBrakeError, ValueError):
    """A policy bundle is damaged, or is not one; nothing of it was used."""


class PhysicsError(EthBrakeError, ArithmeticError):
    """Some worlds of a batch could not be advanced: a defect of the kernel, never of the input.

    ``worlds``: what is wrong, by the world's row in the batch that was given. All others are well, and a world's result
    does not depend on its batch: who has a list may leave these out and go on (``physics.leaving_out_failed``).
    """

    def __init__(self, worlds: Mapping[int, str]) -> None:
        super().__init__(worlds)
        self.worlds = dict(worlds)

    def __str__(self) -> str:
        named = [f"world {row}: {reason}" for row, reason in list(self.worlds.items())[:_NAMED]]
        more = len(self.worlds) - len(named)
        return "; ".join([*named, f"and {more:,} more worlds"] if more else named)

    def renumbered(self, rows: Sequence[int] | NDArray[np.int64]) -> PhysicsError:
        """The same of the batch from which the worlds of this one were taken: world k was its world ``rows[k]``."""
        return PhysicsError({int(rows[row]): reason for row, reason in self.worlds.items()})


class FailedWorld(UserWarning):
    """A running episode was cut off: its world could not be advanced. (The rest of the batch goes on.)"""


@contextmanager
def renumbered(rows: Sequence[int] | NDArray[np.int64]) -> Iterator[None]:
    """Worlds that fail inside are told by the rows of the batch from which they were taken."""
    try:
        yield
    except PhysicsError as error:
        raise error.renumbered(rows) from error


def unknown_name(kind: str, name: object, known: Iterable[str]) -> UnknownName:
    """Build the error for an unknown ``name``, with a suggestion when one is close."""
    names = sorted(known)
    close = get_close_matches(name, names, n=1) if isinstance(name, str) else []
    hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(names)}"
    return UnknownName(f"unknown {kind} {name!r}; {hint}")
