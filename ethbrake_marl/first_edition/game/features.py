"""The features that an observation can have: built-in features in groups, and registered features.

In all functions, ``vehicle`` (the observer) and ``neighbour`` are indices of vehicles (0 = front). If ``neighbour`` may
be None, None means the feature of ``vehicle`` itself.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from pydantic import Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import AlreadyExists, InvalidInput, unknown_name
from ethbrake_marl.first_edition.physics.messages import INTENT, PIECES, Messages, Piece
from ethbrake_marl.first_edition.physics.state import Floats, Worlds, make_worlds
from ethbrake_marl.registry import Registry

MOST_NEIGHBOURS = 64  # largest number of neighbours on each side

Of = Literal["own", "neighbour"]


@dataclass(frozen=True, slots=True)
class Feature:
    """One number of an observation. A vehicle observes the number ``clip(value / scale, low, high)``."""

    name: str  # full name, such as ``own.speed``, or name inside a group, such as ``speed``
    unit: str  # unit of the value
    scale: float  # number by which the value is divided, in ``unit``
    low: float  # smallest number that is observed
    high: float  # largest number that is observed
    meaning: str  # meaning of the value, in words


CONTACT_COMMANDS = ("brake", "coast", "drive")  # own commands of the forecasts: full braking, coasting, full driving

CONTACT_SIDES = ("front", "rear")  # the vehicle's two pairs; the front pair of Vehicle 1 is with the obstacle


class Groups(NamedTuple):
    """The built-in features by group. Each contact feature exists once for each command in ``CONTACT_COMMANDS``."""

    own: tuple[Feature, ...]  # features of the vehicle itself
    role: tuple[Feature, ...]  # place of the vehicle in the line
    obstacle: tuple[Feature, ...]  # features of the obstacle ahead of the line
    contact: tuple[Feature, ...]  # next impacts that the vehicle forecasts for each own command
    contact_far: tuple[Feature, ...]  # the same for impacts so late or hard that features of ``contact`` are clipped
    neighbour: tuple[Feature, ...]  # features of each neighbour (``front_1``, ...)


_contact: list[Feature] = []

_far: list[Feature] = []

for _command, _held in zip(CONTACT_COMMANDS, ("full braking", "coasting", "full driving"), strict=True):
    for _side, _where in zip(CONTACT_SIDES, ("the vehicle ahead", "the vehicle behind"), strict=True):
        _pair, _impact = f"{_command}_{_side}", f"forecast for {_held}, first impact with {_where}"
        _contact += [  # four features per pair
            Feature(f"{_pair}_time", "s", 2.0, 0.0, 2.0, f"{_impact}: time until this impact"),
            Feature(f"{_pair}_closing_speed", "m/s", 10.0, 0.0, 4.0, f"{_impact}: closing speed; 0 without impact"),
            Feature(f"{_pair}_fraction", "1", 1.0, 0.0, 1.0, f"{_impact}: time within its decision step, 0 to 1"),
            Feature(f"{_pair}_steps", "1", 10.0, 0.0, 2.0, f"{_impact}: number of full decision steps before it"),
        ]
        _far += [Feature(f"{_pair}_time", "s", 5.0, 0.0, 2.0, f"{_impact}: time until this impact")]
    _line = f"forecast for {_held}:"
    _contact += [  # features of all pairs that the vehicle knows
        Feature(f"{_command}_first_impact_harm", "m2/s2", 50.0, 0.0, 4.0, f"{_line} first-impact harm of known pairs"),
        Feature(f"{_command}_total_harm", "m2/s2", 50.0, 0.0, 4.0, f"{_line} total harm of known pairs"),
    ]
    _far += [
        Feature(f"{_command}_first_impact_speed", "m/s", 10.0, 0.0, 6.0, f"{_line} square root of first-impact harm"),
        Feature(f"{_command}_total_speed", "m/s", 10.0, 0.0, 6.0, f"{_line} square root of total harm"),
    ]

GROUPS = Groups(
    own=(
        Feature("speed", "m/s", 20.0, -2.0, 4.0, "own speed"),
        Feature("acceleration", "m/s2", 10.0, -2.0, 2.0, "own acceleration in force"),
        Feature("braking_capacity", "m/s2", 10.0, 0.0, 2.0, "own largest deceleration"),
        Feature("driving_capacity", "m/s2", 10.0, 0.0, 2.0, "own largest forward acceleration"),
        Feature("mass", "t", 10.0, 0.0, 8.0, "own mass"),
        Feature("latency_left", "s", 1.0, 0.0, 4.0, "time until own commands take effect"),
        Feature("restitution", "1", 1.0, 0.0, 1.0, "coefficient of restitution of all impacts"),
    ),
    role=(
        Feature("vehicles_ahead", "1", 1.0, 0.0, 2.0, "number of vehicles ahead in the line; 2 means 2 or more"),
        Feature("vehicles_behind", "1", 1.0, 0.0, 2.0, "number of vehicles behind in the line; 2 means 2 or more"),
    ),
    obstacle=(
        Feature(
            "known", "1", 1.0, 0.0, 1.0, "1 if there is an obstacle ahead of the line and this vehicle knows of it"
        ),
        Feature("gap", "m", 10.0, 0.0, 10.0, "sum of the gaps from this vehicle to the obstacle"),
        Feature("hit", "1", 1.0, 0.0, 1.0, "1 if Vehicle 1 has had an impact with the obstacle"),
        Feature(
            "stopping_margin",
            "m",
            10.0,
            -15.0,
            20.0,
            "distance to the obstacle at rest if this vehicle brakes fully as soon as possible",
        ),
        Feature(
            "fitting_deceleration",
            "m/s2",
            10.0,
            0.0,
            2.0,
            "own constant deceleration with which this vehicle stops exactly at the obstacle",
        ),
    ),
    contact=tuple(_contact),
    contact_far=tuple(_far),
    neighbour=(
        Feature("known", "1", 1.0, 0.0, 1.0, "1 if this neighbour exists and its state is known"),
        Feature("gap", "m", 10.0, 0.0, 10.0, "sum of the gaps between this vehicle and the neighbour"),
        Feature("closing_speed", "m/s", 10.0, -4.0, 4.0, "closing speed of the two vehicles, above 0 if they approach"),
        Feature("acceleration", "m/s2", 10.0, -2.0, 2.0, "acceleration in force of the neighbour"),
        Feature("braking_capacity", "m/s2", 10.0, 0.0, 2.0, "largest deceleration of the neighbour"),
        Feature("mass", "t", 10.0, 0.0, 8.0, "mass of the neighbour"),
        Feature("latency_left", "s", 1.0, 0.0, 4.0, "time until the neighbour's commands take effect"),
        Feature(
            "hit",
            "1",
            1.0,
            0.0,
            1.0,
            "1 if this vehicle has had an impact with the next vehicle on the neighbour's side",
        ),
        Feature(
            "stopping_margin",
            "m",
            10.0,
            -15.0,
            20.0,
            "gap to the neighbour at rest if both vehicles brake fully as soon as possible",
        ),
        Feature(
            "fitting_deceleration",
            "m/s2",
            10.0,
            0.0,
            2.0,
            "own constant deceleration with which both vehicles stop with gap 0 if the neighbour brakes fully",
        ),
    ),
)

_SIDE = re.compile(r"(front|rear)_([1-9][0-9]?)")


@dataclass(frozen=True, slots=True)
class RegisteredFeature:
    """A feature with its own function: a registered feature, or a built-in feature that belongs to no group."""

    feature: Feature  # name, unit, scale, bounds and meaning of the feature
    function: Callable[..., Floats]  # (worlds, vehicle) or (worlds, vehicle, neighbour) -> value, [n]
    of: Of  # vehicle that the feature describes: ``own``, the observer itself; ``neighbour``, a neighbour
    unknown: float  # value for an unknown neighbour, in the feature's unit
    tried: tuple[float, ...]  # values in a few test worlds; a changed function gives other values
    reads: tuple[Piece, ...] | None = None  # data of the neighbour that the function reads; None: not specified

    def scaled(self, value: Floats) -> Floats:
        """Return the observed number for a ``value`` in the feature's unit."""
        feature = self.feature
        return np.clip(value * (1.0 / feature.scale), feature.low, feature.high)

    def checked(self, worlds: Worlds, vehicle: int, neighbour: int | None, counts: Any, steps: Floats | None) -> Floats:
        """Compute the feature in n worlds and return the scaled and clipped values, [n].

        Raises ``InvalidInput``, which names the feature, if the function returns an array of a wrong shape or a value
        that is not finite. ``counts`` is a mask [n] (or one truth value for all worlds): where it is False, the feature
        has the value ``unknown``. ``steps``, the number of steps that each episode has taken, [n], appears in error
        messages; None: not known.
        """
        name = self.feature.name
        arguments = (worlds, vehicle) if neighbour is None else (worlds, vehicle, neighbour)
        value = np.asarray(self.function(*arguments))
        if value.shape != (worlds.n,) or value.dtype.kind not in "fiub":
            raise InvalidInput(
                f"feature {name!r}: its function returned {value.dtype} values of shape {value.shape}; must return"
                f" numbers of shape ({worlds.n},), one per world"
            )
        values = np.where(counts, value, self.unknown)
        if not np.isfinite(values).all():
            world = int(np.argmin(np.isfinite(values)))
            step = "" if steps is None else f" after step {int(steps[world])}"
            raise InvalidInput(
                f"feature {name!r}: its value is {values[world]} for vehicle_{vehicle + 1} in world {world} at"
                f" {worlds.time_s[world]:g} s{step}; must be finite"
            )
        return self.scaled(values)


def age(worlds: Worlds, vehicle: int, neighbour: int) -> Floats:
    """Return the age of the newest state that ``vehicle`` has received from ``neighbour``, [n] s.

    The age is 0 if ``vehicle`` knows the present state of ``neighbour``.
    """
    ages = Messages.of(worlds).age_s(worlds.time_s)[:, vehicle, neighbour]
    return np.where(np.isfinite(ages), ages, 0.0)


def intent(worlds: Worlds, vehicle: int, neighbour: int) -> Floats:
    """Return the intent in the neighbour's newest message, [n] m/s2: the command of the neighbour's last decision."""
    return Messages.of(worlds).intents(vehicle)[:, neighbour]


def build_up_time(worlds: Worlds, vehicle: int, neighbour: int | None = None) -> Floats:
    """Return the time in which the brakes of a vehicle build up from 0 to full, [n] s; 0 if brakes act at once."""
    i, v = vehicle if neighbour is None else neighbour, worlds.vehicles
    return v.braking_capacity_mps2[:, i] / v.brake_rate_mps3[:, i]


def release_time(worlds: Worlds, vehicle: int, neighbour: int | None = None) -> Floats:
    """Return the time that a vehicle needs to release fully applied brakes, [n] s; 0 if brakes are released at once."""
    i, v = vehicle if neighbour is None else neighbour, worlds.vehicles
    return v.braking_capacity_mps2[:, i] / v.release_rate_mps3[:, i]


def harm_weight(worlds: Worlds, vehicle: int, neighbour: int | None = None) -> Floats:
    """Return the weight of a vehicle's harm in the objective ``preference``, divided by the sum of all weights, [n]."""
    weight = worlds.vehicles.harm_weight
    share: Floats = weight[:, vehicle if neighbour is None else neighbour] / weight.sum(axis=1)
    return share


def place(worlds: Worlds, vehicle: int) -> Floats:
    """Return the number of vehicles ahead of ``vehicle`` in the line, [n].

    If several vehicles share a policy, this feature shows the policy which vehicle it drives.
    """
    return np.full(worlds.n, float(vehicle))


def _single(
    name: str, high: float, function: Callable[..., Floats], of: Of, meaning: str, *reads: Piece
) -> RegisteredFeature:
    return RegisteredFeature(Feature(name, "s", 1.0, 0.0, high, meaning), function, of, 0.0, (0.0, 0.0, 0.0), reads)


def _knows(piece: Piece) -> RegisteredFeature:
    """Return the feature that is 1 if the observer knows the property ``piece`` of a neighbour, such as ``"mass"``."""
    meaning = f"1 if the neighbour's {piece.replace('_', ' ')} is known, from a message or from sensors"
    feature = Feature(f"{piece}_known", "1", 1.0, 0.0, 1.0, meaning)
    return RegisteredFeature(feature, _certain, "neighbour", 0.0, (1.0, 1.0, 1.0), (piece,))


def _certain(worlds: Worlds, vehicle: int, neighbour: int) -> Floats:
    return np.ones(worlds.n)


_BUILT_IN: dict[str, RegisteredFeature] = {
    "age": _single(
        "age",
        8.0,
        age,
        "neighbour",
        "age of the newest state received from the neighbour; 0 if its present state is known",
    ),
    "build_up_time": _single(
        "build_up_time",
        4.0,
        build_up_time,
        "neighbour",
        "time in which the neighbour's brakes build up from 0 to full; 0 if they act at once",
        "braking_capacity",
    ),
    "intent": RegisteredFeature(
        Feature(
            "intent",
            "m/s2",
            10.0,
            -2.0,
            2.0,
            "command that the neighbour chose at its last decision, if its messages contain it",
        ),
        intent,
        "neighbour",
        0.0,
        (0.0, 0.0, 0.0),
        (PIECES[INTENT],),
    ),
    **{f"{piece}_known": _knows(piece) for piece in PIECES},
    "release_time": _single(
        "release_time",
        4.0,
        release_time,
        "neighbour",
        "time in which the neighbour's fully applied brakes are released; 0 if at once",
        "braking_capacity",
    ),
    "own_build_up_time": _single(
        "own_build_up_time",
        4.0,
        build_up_time,
        "own",
        "time in which own brakes build up from 0 to full; 0 if they act at once",
    ),
    "own_release_time": _single(
        "own_release_time",
        4.0,
        release_time,
        "own",
        "time in which fully applied own brakes are released; 0 if at once",
    ),
    "harm_weight": RegisteredFeature(
        Feature(
            "harm_weight",
            "1",
            1.0,
            0.0,
            1.0,
            "weight of the neighbour's harm in objective: preference, divided by the sum of all weights",
        ),
        harm_weight,
        "neighbour",
        0.0,
        (1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0),
        (),
    ),
    "own_harm_weight": RegisteredFeature(
        Feature(
            "own_harm_weight",
            "1",
            1.0,
            0.0,
            1.0,
            "weight of own harm in objective: preference, divided by the sum of all weights",
        ),
        harm_weight,
        "own",
        0.0,
        (1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0),
    ),
    "place": RegisteredFeature(
        Feature("place", "1", 1.0, 0.0, 63.0, "number of vehicles ahead in the line"),
        place,
        "own",
        0.0,
        (0.0, 1.0, 2.0),
    ),
}


def listed_features(listed: object) -> tuple[str, ...]:
    """Replace each group in a list of groups and features by its features; return all full names.

    For ``["own", "front_1.gap"]`` the result is ``("own.speed", ..., "front_1.gap")``. Raises ``UnknownName`` with a
    suggestion for an unknown name, and ``InvalidInput`` if ``listed`` is not a list, is empty, or contains a feature
    twice.
    """
    if isinstance(listed, str) or not isinstance(listed, Sequence) or not listed:
        raise InvalidInput("observation: must be a list of groups and features, for instance [own, front_1, rear_1]")
    names = [name for each in listed for name in _expanded(each)]
    for name, times in Counter(names).items():
        if times > 1:
            raise InvalidInput(f"observation: {name} is listed twice; list it once")
    return tuple(names)


class _ListSchema:
    """Pydantic annotation of a field with a list of features: the field's JSON schema lists the names of all features.

    Features that are registered before the schema is generated are included.
    """

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        further = {"type": "string", "pattern": r"^(front|rear)_[1-9][0-9]?(\.[a-z0-9_]+)?$"}
        items = {"anyOf": [{"type": "string", "enum": choices()}, further]}
        return {"type": "array", "items": items, "minItems": 1, "uniqueItems": True}


ListedFeatures = Annotated[tuple[str, ...], Field(strict=False), _ListSchema]


def feature_named(name: str) -> Feature:
    """Return the feature with the full name ``name``, such as ``front_1.gap``; raise ``UnknownName`` if none has it."""
    group, dot, own = name.partition(".")
    if name in FEATURES and FEATURES[name].of == "own":
        return FEATURES[name].feature
    if _is_side(group) and own in FEATURES and FEATURES[own].of == "neighbour":
        return replace(FEATURES[own].feature, name=name)
    for feature in _group(group) if dot else ():
        if feature.name == own:
            return replace(feature, name=name)
    raise _unknown(name)


def side_of(name: str) -> tuple[str, int] | None:
    """Return the neighbour that a feature's full name contains: ``front_1.gap``: ("front", 1); ``own.speed``: None."""
    match = _SIDE.fullmatch(name.partition(".")[0])
    return (match[1], int(match[2])) if match and int(match[2]) <= MOST_NEIGHBOURS else None


def registered_in(names: Iterable[str]) -> dict[str, RegisteredFeature]:
    """Return those features in ``names`` (full names) that have a function of their own, as a dictionary.

    The keys do not contain the neighbour: for ``front_1.age`` the key is ``age``.
    """
    own = [name.partition(".")[2] or name for name in names]
    return {name: FEATURES[name] for name in own if name in FEATURES}


def choices(sides: Iterable[str] = ("front_1", "rear_1")) -> list[str]:
    """Return the names that an ``observation:`` list may contain: groups first, then single features.

    ``sides`` are the neighbours whose features the result contains.
    """
    groups = ["own", *sides, "role", "obstacle", "contact", "contact_far"]
    single = [f"{group}.{feature.name}" for group in groups for feature in _group(group)]
    entries = FEATURES.usable()
    own = [name for name, entry in entries.items() if entry.of == "own"]
    each = [f"{side}.{name}" for side in sides for name, entry in entries.items() if entry.of == "neighbour"]
    return [*groups, *single, *own, *each]


def _expanded(each: object) -> tuple[str, ...]:
    if not isinstance(each, str):
        raise InvalidInput(f"observation: {each!r:.60}: must be the name of a group or of a feature")
    if group := _group(each):
        return tuple(f"{each}.{feature.name}" for feature in group)
    return (feature_named(each).name,)


def _group(name: str) -> tuple[Feature, ...]:
    if _is_side(name):
        return GROUPS.neighbour
    return getattr(GROUPS, name) if name in GROUPS._fields[:-1] else ()


def _is_side(name: str) -> bool:
    return side_of(name) is not None and "." not in name


def _unknown(name: str) -> InvalidInput:
    if name in FEATURES:
        return InvalidInput(f"feature {name!r} describes a neighbour; write front_1.{name} or rear_1.{name}")
    side = name.partition(".")[0]
    sides = ["front_1", "rear_1"] + ([side] if _is_side(side) else [])
    known = choices(dict.fromkeys(sides))
    if not get_close_matches(name, known, n=1):
        known = [each for each in known if "." not in each]  # about a hundred features of groups are too many to list
    return unknown_name("feature", name, known, may_be_own=True)


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
    reads: Sequence[Piece] | None = None,
) -> None:
    """Register a feature, so that an ``observation:`` list can contain it.

    The docstring of ``function`` is shown as the meaning of the feature.

    An installed package registers a feature with an entry point of the group ``ethbrake_marl.first_edition.features``. The entry
    point names a ``Part``, which contains all arguments of this function except ``name``.

    A feature with ``of="own"`` can read data that no message contained. Registering the same feature again changes
    nothing. Raises ``AlreadyExists`` if the name is in use, and ``InvalidInput`` for invalid arguments, or if the
    function, called for test worlds, fails or returns a wrong shape or number.

    Args:
        name: 1 to 64 characters ``a-z``, ``0-9`` and ``_``, beginning with a letter. An observation lists a feature of
            the vehicle itself as ``name``, a feature of a neighbour as ``front_1.name``.
        function: ``function(worlds, vehicle)``, or ``function(worlds, vehicle, neighbour)`` for a feature of a
            neighbour, where ``vehicle`` and ``neighbour`` are indices (0 = front). The function returns the value of
            the feature in each world, [n], in ``unit``. It must work for any number of vehicles, and its result must
            depend only on its arguments.
        unit: unit of the value that the function returns.
        scale: number above 0; the observed number is ``clip(value / scale, low, high)``.
        low: smallest number that a vehicle can observe.
        high: largest number that a vehicle can observe, above ``low``.
        of: vehicle that the feature describes: ``own``, the observing vehicle, or ``neighbour``. The value for a
            neighbour is observed only if the observing vehicle knows this neighbour.
        unknown: value for an unknown neighbour, in ``unit``; must be 0 if ``of`` is ``own``.
        reads: data in the neighbour's messages that the function needs (the names in ``v2x: tells``). If the observer
            does not know all these data, the feature has the value ``unknown``. If ``reads`` is None, the feature
            cannot be used in a scenario whose messages leave out some data.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"feature {name!r:.80}: the name must be 1 to 64 characters a-z, 0-9 and _, beginning with a letter"
        )
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"feature {name!r}: must be a function with a docstring that describes the feature")
    _check_numbers(name, scale=scale, low=low, high=high, unknown=unknown)
    if of not in get_args(Of) or (of == "own" and unknown != 0.0):
        raise InvalidInput(
            f"feature {name!r}: of = {of!r}, unknown = {unknown:g}: of must be 'own' or 'neighbour'; with of = 'own',"
            " unknown must be 0"
        )

    if reads is not None and not (of == "neighbour" and not isinstance(reads, str) and set(reads) <= set(PIECES)):
        raise InvalidInput(
            f"feature {name!r}: reads = {reads!r}: must be a list with some of the names {', '.join(PIECES)}, and is"
            " possible only with of='neighbour'"
        )

    feature = Feature(name, str(unit), float(scale), float(low), float(high), " ".join(str(function.__doc__).split()))
    entry = RegisteredFeature(feature, function, of, float(unknown), (), None if reads is None else tuple(reads))
    entry = replace(entry, tried=_tried(entry))
    sides = (f"{side}_{k}" for side in ("front", "rear") for k in range(MOST_NEIGHBOURS + 1))
    taken = {*GROUPS._fields[:-1], *sides, *(feature.name for group in GROUPS for feature in group)}
    if name in taken:
        raise AlreadyExists(f"feature {name!r}: this name is already in use; give another name")
    FEATURES.add(name, entry, lambda other: other == entry)


def _check_numbers(name: str, **numbers: float) -> None:
    for key, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InvalidInput(f"feature {name!r}: {key} = {value!r}: must be a finite number")
    if not numbers["scale"] > 0.0:
        raise InvalidInput(f"feature {name!r}: scale = {numbers['scale']:g}: must be above 0")
    if not numbers["low"] < numbers["high"]:
        raise InvalidInput(f"feature {name!r}: low = {numbers['low']:g}: must be below high ({numbers['high']:g})")


def _tried(entry: RegisteredFeature) -> tuple[float, ...]:
    worlds = make_worlds(
        [[8.0, 6.0], [3.0, 21.0], [0.5, 40.0]],
        [[20.0, 18.0, 22.0], [9.0, 13.0, 11.0], [31.0, 30.0, 33.0]],
        braking_capacity_mps2=[6.0, 7.0, 5.0],
        driving_capacity_mps2=[1.0, 2.0, 3.0],
        latency_s=[0.0, 0.5, 0.25],
        mass_t=[4.5, 15.5, 5.9],
        restitution=[0.0, 0.1, 0.3],
    ).read_only()
    seen = [(0, None), (1, None), (2, None)] if entry.of == "own" else [(1, 0), (1, 2), (2, 0)]
    try:
        values = [entry.checked(worlds, vehicle, neighbour, True, None) for vehicle, neighbour in seen]
    except InvalidInput:
        raise
    except Exception as error:
        raise InvalidInput(
            f"feature {entry.feature.name!r}: its function fails for a line of three vehicles: {type(error).__name__}:"
            f" {error}"
        ) from error
    return tuple(float(value) for each in values for value in each)


FEATURES: Registry[RegisteredFeature] = Registry("feature", "first_edition.features", register_feature, _BUILT_IN)
