"""Reset, as every face means it: seed, options, and the user's own initial state."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ethbrake_marl.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import initial_state_worlds

INITIAL_STATE = "initial_state"


class UnknownResetOption(UserWarning):
    """A key of ``reset``'s options is not known to this environment; it is ignored."""


def fresh_seed() -> int:
    """A seed from the operating system's entropy, for an environment that was never given one."""
    entropy = np.random.SeedSequence().entropy
    assert isinstance(entropy, int)  # always, when SeedSequence chooses it itself
    return entropy


def restart(engine: Engine, seed: int | None, options: Mapping[str, Any] | None) -> None:
    """Start new episodes in all worlds: the stream of ``seed`` from its start, or where the stream stands.

    ``options["initial_state"]`` (see ``scenario.initial_state_worlds``) is the start of every world instead; with
    autoreset, later episodes come from the stream. Other options warn with ``UnknownResetOption`` and are ignored.
    Raises ``InvalidInput``, with nothing changed, for a seed that is not a whole number >= 0, or a bad initial state.
    """
    check_seed(seed)
    if not (options is None or isinstance(options, Mapping)):
        raise InvalidInput(
            f"reset: options = {options!r}: must be None or a mapping, for instance {{'{INITIAL_STATE}': ...}}"
        )
    warn_of_unknown(options or ())
    worlds = None
    if options and INITIAL_STATE in options:
        worlds = initial_state_worlds(options[INITIAL_STATE], engine.scenario).take(np.zeros(engine.n, np.int64))
    restart_from(engine, seed, worlds)


def restart_from(engine: Engine, seed: int | None, worlds: Worlds | None) -> None:
    """Start new episodes from ``worlds`` (None: from the stream)."""
    engine.reset(seed=None if seed is None else int(seed), worlds=worlds)


def check_seed(seed: int | None) -> None:
    """Refuse a seed that is neither None nor a whole number >= 0."""
    if seed is None:
        return
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not seed >= 0:
        raise InvalidInput(f"reset: seed = {seed!r}: must be None or a whole number, at least 0")


def warn_of_unknown(options: Iterable[str]) -> None:
    """One warning for all option names that are not known."""
    unknown = sorted({str(name) for name in options} - {INITIAL_STATE})
    if unknown:
        names = ", ".join(unknown)
        warnings.warn(
            f"reset: unknown option {names}, ignored; known: {INITIAL_STATE}", UnknownResetOption, stacklevel=4
        )
