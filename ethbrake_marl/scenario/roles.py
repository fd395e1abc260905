"""Roles: who learns, names of scripts (``name[:argument]``), and the commands of the scripts that need no state."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.physics.worlds import Floats

LEARNER = "learner"
STATE_FREE = ("full_brake", "coast", "constant")  # names of the scripts whose command never depends on the state

_SPEC = re.compile(r"(?P<name>[a-z][a-z0-9_@.-]*)(:(?P<argument>\S+))?")


@lru_cache(maxsize=256)
def parse_agent_spec(spec: str) -> tuple[str, str | None]:
    """Split ``name[:argument]``, for instance ``constant:3.5``, into its name and its argument or None.

    Raises ``InvalidInput`` unless the name matches ``[a-z][a-z0-9_@.-]*`` and the argument has no blanks, and for a
    Python file: a scenario that somebody else wrote must not run code.
    """
    match = _SPEC.fullmatch(spec) if isinstance(spec, str) else None
    if match is None:
        raise InvalidInput(
            f"agent {spec!r}: must be name or name:argument, the name in lower case letters, digits and _ @ . -,"
            " for instance full_brake or constant:3.5"
        )
    if match["name"].endswith(".py"):
        raise InvalidInput(
            f"agent {spec!r}: is a function of a Python file, and those are loaded only where a person names them"
            " (--agents, --plugin); no scenario does. A plug-in can register it under a name"
        )
    return match["name"], match["argument"]


@lru_cache(maxsize=256)
def constant_deceleration(spec: str) -> float | None:
    """The deceleration a (m/s2, negative = drive) of ``constant:a``; None for any other script.

    Raises ``InvalidInput`` when a is missing or not a finite number.
    """
    name, argument = parse_agent_spec(spec)
    if name != "constant":
        return None
    deceleration = parse_numeral(argument or "")
    if deceleration is None or not math.isfinite(deceleration):
        raise InvalidInput(
            f"agent {spec!r}: constant needs a finite deceleration in m/s2 after the colon, for instance constant:3.5"
        )
    return deceleration


@lru_cache(maxsize=256)
def is_state_free(spec: str) -> bool:
    """Whether the script's command never depends on the state: ``full_brake``, ``coast`` or ``constant:a``.

    Raises ``InvalidInput`` when such a script has an argument it does not take, or lacks the one it needs.
    """
    name, argument = parse_agent_spec(spec)
    if name in ("full_brake", "coast"):
        if argument is not None:
            raise InvalidInput(f"agent {spec!r}: {name} takes no argument")
        return True
    return constant_deceleration(spec) is not None


def constant_command(
    spec: str, braking_capacity_mps2: ArrayLike, driving_capacity_mps2: ArrayLike | None = None
) -> Floats | None:
    """Signed command (m/s2) of a state-free script, in the shape of the capacity; None for any other script.

    ``full_brake`` -> -capacity, ``coast`` -> 0, ``constant:a`` -> -a. Raises ``InvalidInput`` when a is above the
    braking capacity of any vehicle, or -a above its driving capacity where that is given.
    """
    capacity = np.asarray(braking_capacity_mps2, dtype=np.float64)
    if not is_state_free(spec):
        return None
    deceleration = constant_deceleration(spec)
    if deceleration is None:
        return -capacity if spec == "full_brake" else np.zeros(capacity.shape)
    if not np.all(deceleration <= capacity):
        raise InvalidInput(f"agent {spec!r}: above the braking capacity {np.min(capacity):g} m/s2")
    if driving_capacity_mps2 is not None and not np.all(-deceleration <= np.asarray(driving_capacity_mps2)):
        raise InvalidInput(f"agent {spec!r}: above the driving capacity {np.min(driving_capacity_mps2):g} m/s2")
    return np.full(capacity.shape, 0.0 - deceleration)


class Roles(dict[str, str]):
    """Vehicle -> ``learner`` or a script; like the rest of a scenario it cannot be changed."""

    def _refuse(self, *args: object, **kwargs: object) -> NoReturn:
        raise InvalidInput("roles of a scenario are frozen; use scenario.replace(roles=...) or scenario.with_learners")

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[type[Roles], tuple[dict[str, str]]]:
        """Copy and pickle through the constructor."""
        return Roles, (dict(self),)


def complete_roles(given: Mapping[str, str] | None, vehicles: int) -> Roles:
    """A role for every vehicle in order: full braking where none is given; by default vehicle_2 learns."""
    roles = {"vehicle_2": LEARNER} if given is None else given
    names = [f"vehicle_{i + 1}" for i in range(vehicles)]
    return Roles({name: roles.get(name, "full_brake") for name in names})
