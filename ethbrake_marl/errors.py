"""One family of exceptions. Every message says what is wrong, where, and what would be right."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


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
    """The advance could not finish a segment: a defect of the kernel, never of the input."""


class UncertifiedStep(EthBrakeError):
    """An engine that a shield follows was made to do something else than was certified; the step was not made."""


def unknown_name(kind: str, name: object, known: Iterable[str]) -> UnknownName:
    """Build the error for an unknown ``name``, with a suggestion when one is close."""
    names = sorted(known)
    close = get_close_matches(name, names, n=1) if isinstance(name, str) else []
    hint = f"did you mean {close[0]!r}?" if close else f"known: {', '.join(names)}"
    return UnknownName(f"unknown {kind} {name!r}; {hint}")
