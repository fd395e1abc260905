"""The one table of reward terms: what each is, its unit, its usual weight, and the function that computes it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.errors import AlreadyExists, InvalidInput, describe_error, unknown_name
from ethbrake_marl.physics import Bools, Floats, Ints

_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """What the terms of one step are computed from, for n worlds of N vehicles (P pairs); read it, do not change it.

    Vehicles are counted from 0, the front one.
    """

    first_impact_harm: Floats  # [n] of the whole line in this step, m2/s2
    total_harm: Floats  # [n] likewise, every impact counted
    safe_end: Bools  # [n] the episode ended with this step without any collision
    gaps_m: Floats  # [n, P] after the step
    speeds_mps: Floats  # [n, N] after the step
    command_mps2: Floats  # [n, N] in force after the step
    previous_mps2: Floats  # [n, N] in force before it
    time_step_s: float
    time_s: Floats  # [n] since the alert, after the step
    braking_capacity_mps2: Floats  # [n, N] largest deceleration
    driving_capacity_mps2: Floats  # [n, N] largest forward acceleration
    latency_s: Floats  # [n, N] from when on commands take effect
    mass_t: Floats  # [n, N]
    learners: Ints  # [L] the vehicles that learn


TermFunction = Callable[[StepOutcome], Floats]


@dataclass(frozen=True, slots=True)
class Term:
    """One line of the table."""

    name: str
    meaning: str
    unit: str
    weight: float  # where a reward does not say
    function: Callable[..., Floats] | None  # of the reward's settings and the step; None: the engine adds it itself
    registered: bool = False  # by somebody else; its function takes the step alone


TERMS: dict[str, Term] = {}
SETTINGS: set[str] = set()  # names of a reward's other settings


def register_term(name: str, function: TermFunction, *, weight: float = 0.0, unit: str = "1") -> None:
    """Make ``name`` a term of every reward: a weight in a recipe, in ``RewardParams(terms=...)``, a column of infos.

    Args:
        name: lower case letters, digits and ``_``; the key of its weight beside ``harm`` and ``jerk``.
        function: from a ``StepOutcome`` to the term before its weight, of worlds [n] (shared by all vehicles), of the
            learners [n, L], or of all vehicles [n, N]; its docstring says what it means.
        weight: of a reward made from now on that does not name it (those by name, ``harm`` or ``paper``, stay as
            they are); at least 0.
        unit: of the term.

    Registering the same again changes nothing. Raises ``AlreadyExists`` for another term of that name, and
    ``InvalidInput`` for a name that is none, a function without a docstring, or a weight below 0.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"reward term {name!r:.80}: must be 1 to 64 of a-z, 0-9 and _, beginning with a letter")
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"reward term {name!r}: needs a function with a docstring that says what it means")
    if isinstance(weight, bool) or not isinstance(weight, int | float) or not 0.0 <= weight < float("inf"):
        raise InvalidInput(f"reward term {name!r}: weight = {weight!r}: must be a number, at least 0")
    term = Term(name, " ".join((function.__doc__ or "").split()), str(unit), float(weight), function, registered=True)
    if name in SETTINGS or TERMS.setdefault(name, term) != term:
        raise AlreadyExists(f"reward term {name!r} is registered already; give another name")


def registered_terms() -> dict[str, Term]:
    """Those that are not built in, in the order in which they were registered."""
    return {name: term for name, term in TERMS.items() if term.registered}


def settled_weights(given: dict[str, float]) -> dict[str, float]:
    """The weights of registered terms, each said to be its usual one left out where that is 0.

    Raises ``UnknownName`` for a term that is not registered.
    """
    known = registered_terms()
    for name in given:
        if name not in known:
            raise unknown_name("reward term", name, known, may_be_own=True)
    every = {name: given.get(name, term.weight) for name, term in known.items()}
    return {name: weight for name, weight in every.items() if weight > 0.0 or known[name].weight > 0.0}


def checked_term(term: Term, step: StepOutcome, counts: Bools, steps: Ints) -> Floats:
    """A registered term as [n, N]; 0 in rows that do not count.

    ``steps`` [n] is how many steps each world has made, for the message: ``InvalidInput`` names the term, and the
    world, vehicle and step of a number that is not finite, or the shape that does not fit.
    """
    assert term.function is not None
    try:
        value = np.asarray(term.function(step))
    except (Exception, SystemExit) as error:
        raise InvalidInput(f"reward term {term.name!r}, at step {int(steps.max())}: {describe_error(error)}") from error
    n, vehicles = step.speeds_mps.shape
    own = (n, len(step.learners))
    if value.dtype.kind not in "fiub" or value.shape not in ((n,), own, (n, vehicles)):
        raise InvalidInput(
            f"reward term {term.name!r}: gave {value.dtype} of shape {value.shape}; must be numbers of shape ({n},),"
            f" {own} (one per learner) or {(n, vehicles)} (one per vehicle)"
        )
    spread = np.zeros((n, vehicles))
    if value.ndim == 1:
        spread[:] = value[:, np.newaxis]
    elif value.shape == (n, vehicles):
        spread[:] = value
    else:
        spread[:, step.learners] = value
    spread[~counts] = 0.0
    if not np.isfinite(spread).all():
        world, vehicle = np.argwhere(~np.isfinite(spread))[0]
        raise InvalidInput(
            f"reward term {term.name!r}: is {spread[world, vehicle]} for vehicle_{vehicle + 1} in world {world} at step"
            f" {steps[world]}; must be finite"
        )
    return spread
