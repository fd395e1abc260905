"""Features that somebody registers: checked when they are, and whenever they are evaluated."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.physics import Floats, Worlds, make_worlds
from ethbrake_marl.physics.worlds import read_only
from ethbrake_marl.scenario.features import (
    FEATURES,
    MOST_NEIGHBOURS,
    Feature,
    Of,
    RegisteredFeature,
    built_in_names,
)

_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}")


def register_feature(
    name: str,
    function: Callable[..., Floats],
    *,
    unit: str,
    scale: float,
    low: float,
    high: float,
    of: Of = "own",
    unknown: float = 0.0,
) -> None:
    """Make ``name`` a feature that an ``observation:`` may list; its docstring says what it means.

    Args:
        name: lower case letters, digits and ``_``, listed as it is; one of a neighbour as ``front_1.name``.
        function: from worlds and the vehicle (0 = front) to its value [n], in ``unit``; of a neighbour: from worlds,
            the vehicle and the neighbour. It must work for lines of any length and see the world through nothing else.
        unit: of the value.
        scale: what is observed is ``clip(value / scale, low, high)``; above 0.
        low: see ``scale``.
        high: see ``scale``; above ``low``.
        of: whose it is, ``own`` or ``neighbour``. Of a neighbour it is told only where the vehicle has its news.
        unknown: what a feature of a neighbour is where the vehicle knows nothing of it, in ``unit``.

    What an own feature tells of other vehicles is up to its author: a channel hides nothing of it. Registering the same
    again changes nothing. Raises ``AlreadyExists`` for a name that is taken, ``InvalidInput`` for what cannot be used,
    a function among that which fails, or gives another shape or a number that is not finite, in a few worlds.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"feature {name!r:.80}: must be 1 to 64 of a-z, 0-9 and _, beginning with a letter")
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"feature {name!r}: needs a function with a docstring that says what it means")
    _check_numbers(name, scale=scale, low=low, high=high, unknown=unknown)
    if of not in get_args(Of) or (of == "own" and unknown != 0.0):
        raise InvalidInput(
            f"feature {name!r}: of = {of!r}, unknown = {unknown:g}: must be own, or neighbour (with any unknown)"
        )

    feature = Feature(name, str(unit), float(scale), float(low), float(high), " ".join(str(function.__doc__).split()))
    entry = RegisteredFeature(feature, function, of, float(unknown), ())
    entry = replace(entry, tried=_tried(entry))
    if name in _taken() or FEATURES.setdefault(name, entry) != entry:
        raise AlreadyExists(f"feature {name!r} is registered already; give another name")


def checked_values(
    entry: RegisteredFeature, worlds: Worlds, vehicle: int, neighbour: int | None, counts: Any, steps: Floats | None
) -> Floats:
    """What a registered feature gives, scaled, [n]; ``unknown`` where it does not count.

    ``steps`` [n], if known, is told in the message. Raises ``InvalidInput`` that names feature, vehicle and world.
    """
    name = entry.feature.name
    given = (worlds, vehicle) if neighbour is None else (worlds, vehicle, neighbour)
    value = np.asarray(entry.function(*given))
    if value.shape != (worlds.n,) or value.dtype.kind not in "fiub":
        raise InvalidInput(
            f"feature {name!r}: gave {value.dtype} of shape {value.shape}; must be numbers of shape ({worlds.n},), one"
            " per world"
        )
    told = np.where(counts, value, entry.unknown)
    if not np.isfinite(told).all():
        world = int(np.argmin(np.isfinite(told)))
        step = "" if steps is None else f" after step {int(steps[world])}"
        raise InvalidInput(
            f"feature {name!r}: is {told[world]} for vehicle_{vehicle + 1} in world {world} at"
            f" {worlds.time_s[world]:g} s{step}; must be finite"
        )
    return entry.scaled(told)


def _taken() -> set[str]:
    return {*built_in_names(), *(f"{side}_{k}" for side in ("front", "rear") for k in range(MOST_NEIGHBOURS + 1))}


def _check_numbers(name: str, **numbers: float) -> None:
    for key, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InvalidInput(f"feature {name!r}: {key} = {value!r}: must be a finite number")
    if not numbers["scale"] > 0.0:
        raise InvalidInput(f"feature {name!r}: scale = {numbers['scale']:g}: must be above 0")
    if not numbers["low"] < numbers["high"]:
        raise InvalidInput(f"feature {name!r}: low = {numbers['low']:g}: must be below high ({numbers['high']:g})")


def _tried(entry: RegisteredFeature) -> tuple[float, ...]:
    worlds = read_only(
        make_worlds(
            [[8.0, 6.0], [3.0, 21.0], [0.5, 40.0]],
            [[20.0, 18.0, 22.0], [9.0, 13.0, 11.0], [31.0, 30.0, 33.0]],
            braking_capacity_mps2=[6.0, 7.0, 5.0],
            driving_capacity_mps2=[1.0, 2.0, 3.0],
            latency_s=[0.0, 0.5, 0.25],
            mass_t=[4.5, 15.5, 5.9],
            restitution=[0.0, 0.1, 0.3],
        )
    )
    seen = [(0, None), (1, None), (2, None)] if entry.of == "own" else [(1, 0), (1, 2), (2, 0)]
    try:
        values = [checked_values(entry, worlds, vehicle, neighbour, True, None) for vehicle, neighbour in seen]
    except InvalidInput:
        raise
    except Exception as error:
        raise InvalidInput(
            f"feature {entry.feature.name!r}: its function fails for a line of three vehicles: {type(error).__name__}:"
            f" {error}"
        ) from error
    return tuple(float(value) for each in values for value in each)
