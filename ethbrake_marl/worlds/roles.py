"""Roles of vehicles: ``learner``, the scripts ``full_brake``, ``coast`` and ``constant:a``, or the name of an agent."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import require, suggestion
from ethbrake_marl.files.yaml import YamlPath, parse_numeral
from ethbrake_marl.motion.layout import Floats

LEARNER = "learner"
HOLDING_SCRIPTS = ("full_brake", "coast", "constant")  # scripts that hold one command

_FORM = re.compile(r"(?P<name>[a-z][a-z0-9_@.-]*)(:(?P<argument>\S+))?")


def names_of(vehicles: int) -> tuple[str, ...]:
    return tuple(f"vehicle_{i + 1}" for i in range(vehicles))


def check_vehicle(name: str, vehicles: int, at: YamlPath, value: Any) -> None:
    close = "" if name.startswith("vehicle_") else suggestion(name, names_of(vehicles))
    hint = close or f"this scenario has vehicle_1 ... vehicle_{vehicles}"
    require(name in names_of(vehicles), at, value, f"unknown vehicle; {hint}")


def check_role(role: str) -> str:
    """Raises ``InvalidInput``. A Python file is no valid name: scenarios must not run code."""
    match = _FORM.fullmatch(role)
    if match is None:
        raise InvalidInput(
            f"agent {role!r}: must be name or name:argument, for instance full_brake or constant:3.5; a name begins"
            " with a letter a-z and continues with a-z, 0-9, _, @, . and -"
        )
    name, argument = match["name"], match["argument"]
    if name.endswith(".py") or ".py:" in role:
        raise InvalidInput(
            f"agent {role!r}: is a function in a Python file, which a scenario cannot use (the option --agents can)"
            "; to use the function in a scenario, register it as an agent in a file that --load names, or in a package"
        )
    if name in (LEARNER, "full_brake", "coast") and argument is not None:
        raise InvalidInput(f"agent {role!r}: {name} takes no argument")
    number = parse_numeral(argument or "")
    if name == "constant" and (number is None or not math.isfinite(number)):
        raise InvalidInput(
            f"agent {role!r}: constant needs a finite deceleration in m/s2 after the colon, for instance constant:3.5"
        )
    return role


def deceleration_of(role: str) -> float | None:
    """m/s2; negative: drives. None for a role other than ``constant:a``."""
    name, _, argument = role.partition(":")
    return parse_numeral(argument) if name == "constant" else None


def first_command(role: str, braking_capacity: Floats) -> Floats:
    """Command that a role holds, or that applies until its agent decides, [n] m/s2, for braking capacities [n]."""
    deceleration = deceleration_of(role)
    if deceleration is not None:
        return np.full(braking_capacity.shape, 0.0 - deceleration)
    return -braking_capacity if role == "full_brake" else np.zeros(braking_capacity.shape)


class Roles(dict[str, str]):
    def _refuse(self, *args: object, **kwargs: object) -> NoReturn:
        raise InvalidInput(
            "roles of a scenario cannot be changed; make a new scenario with scenario.replace(roles=...) or"
            " scenario.with_learners"
        )

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[type[Roles], tuple[dict[str, str]]]:
        return Roles, (dict(self),)

    @classmethod
    def complete(cls, roles: Mapping[str, str], vehicles: int) -> Roles:
        """A vehicle that is not in ``roles`` brakes fully."""
        return cls({name: roles.get(name, "full_brake") for name in names_of(vehicles)})
