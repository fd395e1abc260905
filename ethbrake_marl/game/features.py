"""The named features of an observation, built in or registered."""

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
from ethbrake_marl.physics.messages import INTENT, PIECES, Messages, Piece
from ethbrake_marl.physics.state import Floats, Worlds, make_worlds
from ethbrake_marl.registry import Registry

MOST_NEIGHBOURS = 64  # largest number of neighbours on each side

Of = Literal["own", "neighbour"]


@dataclass(frozen=True, slots=True)
class Feature:
    """One number of an observation: ``clip(value / scale, low, high)``."""

    name: str  # full name, such as ``own.speed``, or the name inside a group
    unit: str  # unit of the value
    scale: float  # the value is divided by this, in ``unit``
    low: float  # least number that is observed
    high: float  # largest number that is observed
    meaning: str  # what it is, in words


CONTACT_COMMANDS = ("brake", "coast", "drive")  # own commands of the forecasts: full braking, coasting, full driving

CONTACT_SIDES = ("front", "rear")  # the vehicle's pairs; in front of Vehicle 1 an obstacle


class Groups(NamedTuple):
    """The built-in features by group; contact features exist for each of ``CONTACT_COMMANDS``."""

    own: tuple[Feature, ...]  # the vehicle itself
    role: tuple[Feature, ...]  # its place in the line
    obstacle: tuple[Feature, ...]  # the obstacle ahead of the line
    contact: tuple[Feature, ...]  # next impacts that it forecasts under own commands
    contact_far: tuple[Feature, ...]  # late or hard impacts, beyond the bounds of ``contact``
    neighbour: tuple[Feature, ...]  # features of each neighbour (``front_1``, ...)


_contact: list[Feature] = []

_far: list[Feature] = []

for _command, _held in zip(CONTACT_COMMANDS, ("braking fully", "coasting", "driving fully"), strict=True):
    for _side, _where in zip(CONTACT_SIDES, ("in front", "behind"), strict=True):  # four features per pair
        _pair, _told = f"{_command}_{_side}", f"{_held}: time to the first impact {_where}"
        _contact += [
            Feature(f"{_pair}_time", "s", 2.0, 0.0, 2.0, _told),
            Feature(f"{_pair}_closing_speed", "m/s", 10.0, 0.0, 4.0, "its closing speed; 0 without one"),
            Feature(f"{_pair}_fraction", "1", 1.0, 0.0, 1.0, "where in its decision step it falls"),
            Feature(f"{_pair}_steps", "1", 10.0, 0.0, 2.0, "whole decision steps before that one"),
        ]
        _far += [Feature(f"{_pair}_time", "s", 5.0, 0.0, 2.0, _told)]
    _contact += [  # features of the whole line
        Feature(f"{_command}_first_impact_harm", "m2/s2", 50.0, 0.0, 4.0, f"{_held}: first-impact harm of the line"),
        Feature(f"{_command}_total_harm", "m2/s2", 50.0, 0.0, 4.0, f"{_held}: total harm of the line"),
    ]
    _far += [  # late or hard impacts, beyond the bounds of the features above
        Feature(f"{_command}_first_impact_speed", "m/s", 10.0, 0.0, 6.0, "square root of the first-impact harm"),
        Feature(f"{_command}_total_speed", "m/s", 10.0, 0.0, 6.0, "square root of the total harm"),
    ]

GROUPS = Groups(
    own=(
        Feature("speed", "m/s", 20.0, -2.0, 4.0, "own speed"),
        Feature("acceleration", "m/s2", 10.0, -2.0, 2.0, "own command in force"),
        Feature("braking_capacity", "m/s2", 10.0, 0.0, 2.0, "own largest deceleration"),
        Feature("driving_capacity", "m/s2", 10.0, 0.0, 2.0, "own largest forward acceleration"),
        Feature("mass", "t", 10.0, 0.0, 8.0, "own mass"),
        Feature("latency_left", "s", 1.0, 0.0, 4.0, "time until own commands take effect"),
        Feature("restitution", "1", 1.0, 0.0, 1.0, "coefficient of restitution"),
    ),
    role=(
        Feature(
            "vehicles_ahead", "1", 1.0, 0.0, 2.0, "how many vehicles are ahead in the line; 2 stands for 2 or more"
        ),
        Feature("vehicles_behind", "1", 1.0, 0.0, 2.0, "how many are behind"),
    ),
    obstacle=(
        Feature(
            "known", "1", 1.0, 0.0, 1.0, "1 if there is an obstacle ahead of the line and this vehicle knows of it"
        ),
        Feature("gap", "m", 10.0, 0.0, 10.0, "free distance to it, vehicles between not counted as length"),
        Feature("hit", "1", 1.0, 0.0, 1.0, "1 if Vehicle 1 has had an impact with it"),
        Feature(
            "stopping_margin", "m", 10.0, -15.0, 20.0, "distance left at rest after braking fully as soon as possible"
        ),
        Feature(
            "fitting_deceleration", "m/s2", 10.0, 0.0, 2.0, "own constant deceleration that ends at rest, touching it"
        ),
    ),
    contact=tuple(_contact),
    contact_far=tuple(_far),
    neighbour=(
        Feature("known", "1", 1.0, 0.0, 1.0, "1 if this neighbour exists and its message has arrived"),
        Feature("gap", "m", 10.0, 0.0, 10.0, "free distance to it, other vehicles between not counted as length"),
        Feature("closing_speed", "m/s", 10.0, -4.0, 4.0, "positive when the two approach"),
        Feature("acceleration", "m/s2", 10.0, -2.0, 2.0, "its command in force"),
        Feature("braking_capacity", "m/s2", 10.0, 0.0, 2.0, "its largest deceleration"),
        Feature("mass", "t", 10.0, 0.0, 8.0, "its mass"),
        Feature("latency_left", "s", 1.0, 0.0, 4.0, "time until its commands take effect"),
        Feature("hit", "1", 1.0, 0.0, 1.0, "1 if the pair on its side has had an impact"),
        Feature("stopping_margin", "m", 10.0, -15.0, 20.0, "gap left at rest if both brake fully as soon as they can"),
        Feature(
            "fitting_deceleration",
            "m/s2",
            10.0,
            0.0,
            2.0,
            "own constant deceleration with which the two would come to rest touching, the neighbour braking fully",
        ),
    ),
)

_SIDE = re.compile(r"(front|rear)_([1-9][0-9]?)")


@dataclass(frozen=True, slots=True)
class RegisteredFeature:
    """A registered feature, or a built-in one that belongs to no group."""

    feature: Feature  # name, unit, scale, bounds and meaning
    function: Callable[..., Floats]  # (worlds, vehicle) or (worlds, vehicle, neighbour) -> value, [n]
    of: Of  # ``own``: of the vehicle itself; ``neighbour``: of a neighbour
    unknown: float  # value for an unknown neighbour, in the feature's unit
    tried: tuple[float, ...]  # values in a few test worlds, which reveal a changed function
    reads: tuple[Piece, ...] | None = None  # pieces of a neighbour's message that the function reads; None: not said

    def scaled(self, value: Floats) -> Floats:
        """Return the observed number ``clip(value / scale, low, high)`` for a ``value`` in the feature's unit."""
        feature = self.feature
        return np.clip(value * (1.0 / feature.scale), feature.low, feature.high)

    def checked(self, worlds: Worlds, vehicle: int, neighbour: int | None, counts: Any, steps: Floats | None) -> Floats:
        """Compute the feature in n worlds and return it scaled, [n].

        Raises ``InvalidInput`` naming feature, vehicle and world for a result of wrong shape or a value that is not
        finite.

        Args:
            worlds: the n worlds.
            vehicle: index of the observing vehicle, from 0.
            neighbour: index of the neighbour; None for a feature of the vehicle itself.
            counts: whether to use the value, a mask [n] or one truth value; other worlds get ``unknown``.
            steps: number of steps so far, [n], for messages, if known.

        """
        name = self.feature.name
        arguments = (worlds, vehicle) if neighbour is None else (worlds, vehicle, neighbour)
        value = np.asarray(self.function(*arguments))
        if value.shape != (worlds.n,) or value.dtype.kind not in "fiub":
            raise InvalidInput(
                f"feature {name!r}: gave {value.dtype} of shape {value.shape}; must be numbers of shape ({worlds.n},),"
                " one per world"
            )
        values = np.where(counts, value, self.unknown)
        if not np.isfinite(values).all():
            world = int(np.argmin(np.isfinite(values)))
            step = "" if steps is None else f" after step {int(steps[world])}"
            raise InvalidInput(
                f"feature {name!r}: is {values[world]} for vehicle_{vehicle + 1} in world {world} at"
                f" {worlds.time_s[world]:g} s{step}; must be finite"
            )
        return self.scaled(values)


def age(worlds: Worlds, vehicle: int, neighbour: int) -> Floats:
    """Return the age of the newest state that ``vehicle`` has received from ``neighbour``, [n] s.

    It is 0 if the present state is known. Both are indices from 0.
    """
    ages = Messages.of(worlds).age_s(worlds.time_s)[:, vehicle, neighbour]
    return np.where(np.isfinite(ages), ages, 0.0)


def intent(worlds: Worlds, vehicle: int, neighbour: int) -> Floats:
    """Return the command that the neighbour chose at its last decision, as its newest message told it, [n] m/s2."""
    return Messages.of(worlds).intents(vehicle)[:, neighbour]


def build_up_time(worlds: Worlds, vehicle: int, neighbour: int | None = None) -> Floats:
    """Return the time in which the brakes of the neighbour build up from 0 to full, [n] s; 0: at once.

    Both vehicles are indices from 0; ``neighbour`` None: the brakes of ``vehicle`` itself.
    """
    i, v = vehicle if neighbour is None else neighbour, worlds.vehicles
    return v.braking_capacity_mps2[:, i] / v.brake_rate_mps3[:, i]


def release_time(worlds: Worlds, vehicle: int, neighbour: int | None = None) -> Floats:
    """Return the time in which the fully applied brakes of the neighbour are released, [n] s; 0: at once.

    Both vehicles are indices from 0; ``neighbour`` None: the brakes of ``vehicle`` itself.
    """
    i, v = vehicle if neighbour is None else neighbour, worlds.vehicles
    return v.braking_capacity_mps2[:, i] / v.release_rate_mps3[:, i]


def harm_weight(worlds: Worlds, vehicle: int, neighbour: int | None = None) -> Floats:
    """Return the weight of the neighbour's harm in the objective ``preference``, as a share of the line's, [n].

    Both vehicles are indices from 0; ``neighbour`` None: the weight of ``vehicle`` itself.
    """
    weight = worlds.vehicles.harm_weight
    share: Floats = weight[:, vehicle if neighbour is None else neighbour] / weight.sum(axis=1)
    return share


def place(worlds: Worlds, vehicle: int) -> Floats:
    """Return the number of vehicles ahead of ``vehicle`` (index from 0) in the line, [n].

    It distinguishes the vehicles of a shared policy.
    """
    return np.full(worlds.n, float(vehicle))


def _single(
    name: str, high: float, function: Callable[..., Floats], of: Of, meaning: str, *reads: Piece
) -> RegisteredFeature:
    return RegisteredFeature(Feature(name, "s", 1.0, 0.0, high, meaning), function, of, 0.0, (0.0, 0.0, 0.0), reads)


def _knows(piece: Piece) -> RegisteredFeature:
    """Return the feature that is 1 where the vehicle knows this piece of the neighbour."""
    meaning = f"1 if its {piece.replace('_', ' ')} is known: a message told it, or, where sensors can, it is measured"
    feature = Feature(f"{piece}_known", "1", 1.0, 0.0, 1.0, meaning)
    return RegisteredFeature(feature, _certain, "neighbour", 0.0, (1.0, 1.0, 1.0), (piece,))


def _certain(worlds: Worlds, vehicle: int, neighbour: int) -> Floats:
    return np.ones(worlds.n)


_BUILT_IN: dict[str, RegisteredFeature] = {
    "age": _single(
        "age", 8.0, age, "neighbour", "time since the sample that was last told of it; 0 where the present is known"
    ),
    "build_up_time": _single(
        "build_up_time",
        4.0,
        build_up_time,
        "neighbour",
        "time in which its brakes build up from 0 to full; 0: at once",
        "braking_capacity",
    ),
    "intent": RegisteredFeature(
        Feature(
            "intent", "m/s2", 10.0, -2.0, 2.0, "command that it chose at its last decision; where messages tell it"
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
        "time in which its full brakes are released; 0: at once",
        "braking_capacity",
    ),
    "own_build_up_time": _single(
        "own_build_up_time", 4.0, build_up_time, "own", "time in which own brakes build up from 0 to full; 0: at once"
    ),
    "own_release_time": _single(
        "own_release_time", 4.0, release_time, "own", "time in which own full brakes are released; 0: at once"
    ),
    "harm_weight": RegisteredFeature(
        Feature("harm_weight", "1", 1.0, 0.0, 1.0, "weight of its harm in objective: preference, share of all weights"),
        harm_weight,
        "neighbour",
        0.0,
        (1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0),
        (),
    ),
    "own_harm_weight": RegisteredFeature(
        Feature("own_harm_weight", "1", 1.0, 0.0, 1.0, "weight of own harm there, share of all weights"),
        harm_weight,
        "own",
        0.0,
        (1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0),
    ),
    "place": RegisteredFeature(
        Feature("place", "1", 1.0, 0.0, 63.0, "how many vehicles are ahead in the line"),
        place,
        "own",
        0.0,
        (0.0, 1.0, 2.0),
    ),
}


def listed_features(listed: object) -> tuple[str, ...]:
    """Return the full names of the features in a list of groups and single features, in order.

    For example ``("own.speed", ..., "front_1.gap")`` for ``["own", "front_1.gap"]``. Raises ``UnknownName`` with a
    suggestion; ``InvalidInput`` if it is not a list, is empty, or has a feature twice.
    """
    if isinstance(listed, str) or not isinstance(listed, Sequence) or not listed:
        raise InvalidInput("observation: must be a list of groups and features, for instance [own, front_1, rear_1]")
    names = [name for each in listed for name in _expanded(each)]
    for name, times in Counter(names).items():
        if times > 1:
            raise InvalidInput(f"observation: {name} is listed twice")
    return tuple(names)


class _ListSchema:
    """Annotation of a field that lists the features of an observation: its JSON schema names all features.

    Features that are registered before the schema is made are included.
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
    """Return the neighbour in a full feature name, for example ``("front", 1)``; None if the name has none."""
    match = _SIDE.fullmatch(name.partition(".")[0])
    return (match[1], int(match[2])) if match and int(match[2]) <= MOST_NEIGHBOURS else None


def registered_in(names: Iterable[str]) -> dict[str, RegisteredFeature]:
    """Return name -> feature of the registered features among these full names.

    The key is the feature's own name: ``age`` for ``front_1.age``.
    """
    own = [name.partition(".")[2] or name for name in names]
    return {name: FEATURES[name] for name in own if name in FEATURES}


def choices(sides: Iterable[str] = ("front_1", "rear_1")) -> list[str]:
    """Return what an ``observation:`` list may contain: names of groups, then of single features.

    ``sides``: neighbours whose features are included, such as ``front_1``.
    """
    groups = ["own", *sides, "role", "obstacle", "contact", "contact_far"]
    single = [f"{group}.{feature.name}" for group in groups for feature in _group(group)]
    entries = FEATURES.usable()
    own = [name for name, entry in entries.items() if entry.of == "own"]
    each = [f"{side}.{name}" for side in sides for name, entry in entries.items() if entry.of == "neighbour"]
    return [*groups, *single, *own, *each]


def _expanded(each: object) -> tuple[str, ...]:
    if not isinstance(each, str):
        raise InvalidInput(f"observation: {each!r:.60}: must be the name of a group or a feature")
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
        return InvalidInput(f"feature {name!r} is of a neighbour: write front_1.{name} or rear_1.{name}")
    side = name.partition(".")[0]
    sides = ["front_1", "rear_1"] + ([side] if _is_side(side) else [])
    known = choices(dict.fromkeys(sides))
    if not get_close_matches(name, known, n=1):
        known = [each for each in known if "." not in each]  # a hundred single features would hide the groups
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
    """Register ``name`` as a feature that an ``observation:`` may list; its meaning is the function's docstring.

    An installed package registers a feature with an entry point of the group ``ethbrake_marl.features``: a ``Part``
    with the arguments after ``name``.

    Args:
        name: lower case letters, digits and ``_``. A feature of the vehicle itself is listed under this name, a feature
            of a neighbour as ``front_1.name``.
        function: ``function(worlds, vehicle)`` returns the value [n] in ``unit``; vehicle 0 is in front. For a
            neighbour: ``function(worlds, vehicle, neighbour)``. It must work for lines of any length, and depend on
            nothing but its arguments.
        unit: unit of the value.
        scale: the observed number is ``clip(value / scale, low, high)``; above 0.
        low: see ``scale``.
        high: see ``scale``; above ``low``.
        of: ``own`` or ``neighbour``. A neighbour's feature is observed only if the vehicle has its news.
        unknown: value of a neighbour's feature if the vehicle knows nothing of the neighbour, in ``unit``.
        reads: pieces of the neighbour's message that the function needs (``v2x: tells``); where one is not known, the
            value is ``unknown``. None: not said, so scenarios whose messages lack a piece refuse the feature.

    A channel hides nothing from a feature of kind ``own``: its author decides what it reveals of other vehicles.
    Registering the same feature again changes nothing. Raises ``AlreadyExists`` if the name is taken; ``InvalidInput``
    for invalid arguments, or if in a few test worlds the function fails, or returns a wrong shape or a number that is
    not finite.

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

    if reads is not None and not (of == "neighbour" and not isinstance(reads, str) and set(reads) <= set(PIECES)):
        raise InvalidInput(
            f"feature {name!r}: reads = {reads!r}: a neighbour's feature names some of {', '.join(PIECES)}"
        )

    feature = Feature(name, str(unit), float(scale), float(low), float(high), " ".join(str(function.__doc__).split()))
    entry = RegisteredFeature(feature, function, of, float(unknown), (), None if reads is None else tuple(reads))
    entry = replace(entry, tried=_tried(entry))
    sides = (f"{side}_{k}" for side in ("front", "rear") for k in range(MOST_NEIGHBOURS + 1))
    taken = {*GROUPS._fields[:-1], *sides, *(feature.name for group in GROUPS for feature in group)}
    if name in taken:
        raise AlreadyExists(f"feature {name!r} is registered already; give another name")
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


FEATURES: Registry[RegisteredFeature] = Registry("feature", "features", register_feature, _BUILT_IN)
