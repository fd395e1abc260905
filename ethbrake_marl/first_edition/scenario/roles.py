"""Roles: which vehicles learn, which scripts the others follow, and commands of scripts that do not need the state."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Annotated, Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import refuse
from ethbrake_marl.files.yaml import parse_numeral
from ethbrake_marl.first_edition.physics.state import Floats

LEARNER = "learner"

_PROFILE = "profile"  # script with a piecewise constant command

MOST_PIECES = 64

_SPEC = re.compile(r"(?P<name>[a-z][a-z0-9_@.-]*)(:(?P<argument>\S+))?")


class ScriptSpec(NamedTuple):
    """Name of an agent with an optional argument, in a scenario or on the command line, such as ``constant:3.5``."""

    name: str  # name of the agent, such as ``constant``
    argument: str | None  # text after the colon, such as ``3.5``; None: no colon

    def __str__(self) -> str:
        return self.name if self.argument is None else f"{self.name}:{self.argument}"

    @staticmethod
    @lru_cache(maxsize=256)
    def parse(spec: str) -> ScriptSpec:
        """Parse ``spec``, a text ``name[:argument]``.

        Raises ``InvalidInput`` if the name does not match ``[a-z][a-z0-9_@.-]*``, if the argument has spaces, or if
        ``spec`` names a Python file, because loading somebody else's scenario must not run code.
        """
        match = _SPEC.fullmatch(spec) if isinstance(spec, str) else None
        if match is None:
            raise InvalidInput(
                f"agent {spec!r}: must be name or name:argument, for instance full_brake or constant:3.5; a name begins"
                " with a letter a-z and continues with a-z, 0-9, _, @, . and -"
            )
        if match["name"].endswith(".py") or ".py:" in spec:
            raise InvalidInput(
                f"agent {spec!r}: is a function in a Python file, which a scenario cannot use (the option --agents can)"
                "; to use the function in a scenario, register it as an agent in a package that you install"
            )
        return ScriptSpec(match["name"], match["argument"])

    @property
    def deceleration_mps2(self) -> float | None:
        """Deceleration a of a script ``constant:a`` (m/s2, negative for driving); None for any other script.

        Raises ``InvalidInput`` if the deceleration is missing or not a finite number.
        """
        if self.name != "constant":
            return None
        deceleration = parse_numeral(self.argument or "")
        if deceleration is None or not math.isfinite(deceleration):
            raise InvalidInput(
                f"agent {str(self)!r}: constant needs a finite deceleration in m/s2 after the colon, for instance"
                " constant:3.5"
            )
        return deceleration

    @property
    def pieces(self) -> tuple[tuple[float, float], ...]:
        """Intervals of constant braking of a script ``profile``; an empty tuple for any other script.

        Each interval is (start in s after the latency, deceleration in m/s2). Raises ``InvalidInput`` unless the starts
        begin with 0 and increase, and no deceleration is negative.
        """
        if self.name != _PROFILE:
            return ()
        fields = [part.split("=") for part in (self.argument or "").split(",")]
        return checked_pieces([[parse_numeral(number) for number in piece] for piece in fields])

    @property
    def hardest_mps2(self) -> float | None:
        """Largest deceleration (m/s2) of a script ``constant:a`` or ``profile``; None for any other script."""
        return max(braking for _, braking in self.pieces) if self.name == _PROFILE else self.deceleration_mps2

    def is_state_free(self) -> bool:
        """Return whether the script ignores the state; True for ``full_brake``, ``coast``, ``constant:a`` and profiles.

        Raises ``InvalidInput`` if one of these four scripts has a missing, invalid or forbidden argument.
        """
        if self.name == _PROFILE:
            return len(self.pieces) > 0
        if self.name in ("full_brake", "coast"):
            if self.argument is not None:
                raise InvalidInput(f"agent {str(self)!r}: {self.name} takes no argument")
            return True
        return self.deceleration_mps2 is not None

    def command(
        self, braking_capacity_mps2: ArrayLike, driving_capacity_mps2: ArrayLike | None = None
    ) -> Floats | None:
        """Return the command (m/s2, negative for braking) of a script that does not need the state.

        The command has the shape of ``braking_capacity_mps2``. It is minus the braking capacity for ``full_brake``, 0
        for ``coast``, -a for ``constant:a``, the first command for a ``profile``, and None for any other script. Raises
        ``InvalidInput`` if a deceleration exceeds the braking capacity of a vehicle, or a forward acceleration its
        driving capacity (checked only if ``driving_capacity_mps2`` is given).
        """
        capacity = np.asarray(braking_capacity_mps2, dtype=np.float64)
        if not self.is_state_free():
            return None
        deceleration = self.hardest_mps2
        if deceleration is None:
            return -capacity if self.name == "full_brake" else np.zeros(capacity.shape)
        if not np.all(deceleration <= capacity):
            raise InvalidInput(
                f"agent {str(self)!r}: brakes harder than the braking capacity of {np.min(capacity):g} m/s2 allows"
            )
        if driving_capacity_mps2 is not None and not np.all(-deceleration <= np.asarray(driving_capacity_mps2)):
            raise InvalidInput(
                f"agent {str(self)!r}: drives harder than the driving capacity of {np.min(driving_capacity_mps2):g}"
                " m/s2 allows"
            )
        return np.full(capacity.shape, 0.0 - (self.pieces[0][1] if self.pieces else deceleration))


def checked_pieces(given: object) -> tuple[tuple[float, float], ...]:
    """Return the intervals of a ``profile``, ((start in s, deceleration in m/s2), ...), or raise ``InvalidInput``.

    The unchecked value ``given`` comes from a file; it should be a list ``[[start, deceleration], ...]``.
    """
    right = (
        f"a profile must be a list of 1 to {MOST_PIECES} pairs [start in s after the latency, deceleration in m/s2],"
        " such as [[0, 3], [1, 7]]"
    )
    if not isinstance(given, list | tuple) or not 1 <= len(given) <= MOST_PIECES:
        raise InvalidInput(right)
    for piece in given:
        numbers = isinstance(piece, list | tuple) and len(piece) == 2
        if not numbers or not all(type(each) in (int, float) and 0.0 <= each <= 3600.0 for each in piece):
            raise InvalidInput(f"{right}; {piece!r:.60} is not a list of two numbers in [0, 3600]")
    if given[0][0] != 0.0 or not all(one[0] < other[0] for one, other in pairwise(given)):
        raise InvalidInput(f"{right}; the first start must be 0, and each later start must be larger")
    return tuple((float(begins), float(braking)) for begins, braking in given)


def _role_text(role: object) -> object:
    """Convert a role from a file to text: ``{profile: [[0, 3], [1, 7]]}`` becomes ``profile:0=3,1=7``.

    A role that is not a mapping is returned unchanged.
    """
    if not isinstance(role, dict):
        return role
    try:
        if set(role) != {_PROFILE}:
            raise InvalidInput("must be learner, the name of a script, or a mapping like {profile: [[0, 3], [1, 7]]}")
        pieces = checked_pieces(role[_PROFILE])
    except InvalidInput as error:
        refuse((), role, str(error))
    numbers = (tuple(repr(number).removesuffix(".0") for number in piece) for piece in pieces)
    return f"{_PROFILE}:" + ",".join(f"{begins}={braking}" for begins, braking in numbers)


def _role_content(role: str) -> str | dict[str, list[list[float]]]:
    """Convert a role to its form in a scenario file: ``profile:0=3`` to ``{"profile": [[0.0, 3.0]]}``.

    A role that is not a ``profile`` is returned unchanged.
    """
    pieces = ScriptSpec.parse(role).pieces
    return {_PROFILE: [list(piece) for piece in pieces]} if pieces else role


_ROLE_SCHEMA = {
    "anyOf": [
        {"type": "string"},
        {
            "type": "object",
            "required": [_PROFILE],
            "additionalProperties": False,
            "properties": {
                _PROFILE: {
                    "type": "array",
                    "minItems": 1,
                    "maxItems": MOST_PIECES,
                    "items": {"type": "array", "minItems": 2, "maxItems": 2, "items": {"type": "number", "minimum": 0}},
                }
            },
        },
    ]
}

Role = Annotated[
    str, BeforeValidator(_role_text), PlainSerializer(_role_content, return_type=Any), WithJsonSchema(_ROLE_SCHEMA)
]


class Roles(dict[str, str]):
    """Immutable mapping from vehicle names to roles: ``learner`` or the name of a script."""

    def _refuse(self, *args: object, **kwargs: object) -> NoReturn:
        raise InvalidInput(
            "roles of a scenario cannot be changed; make a new scenario with scenario.replace(roles=...) or"
            " scenario.with_learners"
        )

    __setitem__ = __delitem__ = __ior__ = _refuse
    update = setdefault = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[type[Roles], tuple[dict[str, str]]]:
        return Roles, (dict(self),)

    @staticmethod
    def complete(given: Mapping[str, str] | None, vehicles: int) -> Roles:
        """Return the role of each of ``vehicles`` vehicles.

        ``given`` maps names such as ``vehicle_2`` to roles; a vehicle without a role brakes fully. If ``given`` is
        None, vehicle_2 learns and all other vehicles brake fully.
        """
        roles = {"vehicle_2": LEARNER} if given is None else given
        names = [f"vehicle_{i + 1}" for i in range(vehicles)]
        return Roles({name: roles.get(name, "full_brake") for name in names})
