"""Observations: named features with fixed analytic scalings, the same for every vehicle.

An observation is the vehicle's own features followed by those of its nearest neighbours, front ones first. Each
feature is ``clip(value / scale, low, high)``. What this vehicle does not know, or a neighbour that is absent, reads 0
with its ``known`` flag 0. There are no running statistics: an observation means the same in every run. Over a channel
(``v2x``), ``latency_left`` and what follows from it count the own part of a latency only: nobody knows beforehand when
news that has not arrived will.

Where an obstacle stands ahead of Vehicle 1, the vehicle's place in the line and what it knows of
the obstacle follow. Vehicle 1 sees it; any other vehicle knows of it as soon as it has Vehicle 1's news.

Where an observation lists the group ``contact``, it is followed by what three forecasts say (``observations.contact``).
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from functools import cache
from itertools import product
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import AlreadyExists, InvalidInput, PhysicsError, unknown_name
from ethbrake_marl.physics import (
    BOUND,
    CONTACT,
    FLAG,
    ROW,
    Bools,
    Floats,
    Ints,
    Messages,
    Packed,
    Worlds,
    columns,
    compiled,
    estimate_rows,
    forecast_contacts,
    make_worlds,
    place_obstacle,
    place_rates,
    stopping_distance,
)
from ethbrake_marl.registry import Registry

# The named features, built in or registered.

MOST_NEIGHBOURS = 64  # on each side

Of = Literal["own", "neighbour"]


@dataclass(frozen=True, slots=True)
class Feature:
    """One number of an observation: ``clip(value / scale, low, high)``."""

    name: str
    unit: str
    scale: float
    low: float
    high: float
    meaning: str


CONTACT_COMMANDS = ("brake", "coast", "drive")  # own commands that are forecast: full braking, none, full driving
CONTACT_SIDES = ("front", "rear")  # own pairs; in front of Vehicle 1 an obstacle


class Groups(NamedTuple):
    """The built-in features by group; those of contacts are told of each of ``CONTACT_COMMANDS`` in turn."""

    own: tuple[Feature, ...]
    role: tuple[Feature, ...]
    obstacle: tuple[Feature, ...]
    contact: tuple[Feature, ...]
    contact_far: tuple[Feature, ...]
    neighbour: tuple[Feature, ...]  # of each that is listed, ``front_1`` and so on


_contact: list[Feature] = []
_far: list[Feature] = []
for _command, _held in zip(CONTACT_COMMANDS, ("braking fully", "coasting", "driving fully"), strict=True):
    for _side, _where in zip(CONTACT_SIDES, ("in front", "behind"), strict=True):  # four numbers of each own pair
        _pair, _told = f"{_command}_{_side}", f"{_held}: time to the first impact {_where}"
        _contact += [
            Feature(f"{_pair}_time", "s", 2.0, 0.0, 2.0, _told),
            Feature(f"{_pair}_closing_speed", "m/s", 10.0, 0.0, 4.0, "its closing speed; 0 without one"),
            Feature(f"{_pair}_fraction", "1", 1.0, 0.0, 1.0, "where in its decision step it falls"),
            Feature(f"{_pair}_steps", "1", 10.0, 0.0, 2.0, "whole decision steps before that one"),
        ]
        _far += [Feature(f"{_pair}_time", "s", 5.0, 0.0, 2.0, _told)]
    _contact += [  # then the harm of the line
        Feature(f"{_command}_first_impact_harm", "m2/s2", 50.0, 0.0, 4.0, f"{_held}: first-impact harm of the line"),
        Feature(f"{_command}_total_harm", "m2/s2", 50.0, 0.0, 4.0, f"{_held}: total harm of the line"),
    ]
    _far += [  # what is late or hard: beyond the bounds of those above
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
    """A feature that somebody registered, or one of ours that belongs to no group."""

    feature: Feature
    function: Callable[..., Floats]
    of: Of
    unknown: float  # in the feature's unit
    tried: tuple[float, ...]  # what it gave in a few worlds: a changed function shows there

    def scaled(self, value: Floats) -> Floats:
        """``clip(value / scale, low, high)``."""
        feature = self.feature
        return np.clip(value * (1.0 / feature.scale), feature.low, feature.high)

    def checked(self, worlds: Worlds, vehicle: int, neighbour: int | None, counts: Any, steps: Floats | None) -> Floats:
        """What it gives, scaled, [n]; ``unknown`` where it does not count.

        ``steps`` [n], if known, is told in the message. Raises ``InvalidInput`` that names feature, vehicle and world.
        """
        name = self.feature.name
        given = (worlds, vehicle) if neighbour is None else (worlds, vehicle, neighbour)
        value = np.asarray(self.function(*given))
        if value.shape != (worlds.n,) or value.dtype.kind not in "fiub":
            raise InvalidInput(
                f"feature {name!r}: gave {value.dtype} of shape {value.shape}; must be numbers of shape ({worlds.n},),"
                " one per world"
            )
        told = np.where(counts, value, self.unknown)
        if not np.isfinite(told).all():
            world = int(np.argmin(np.isfinite(told)))
            step = "" if steps is None else f" after step {int(steps[world])}"
            raise InvalidInput(
                f"feature {name!r}: is {told[world]} for vehicle_{vehicle + 1} in world {world} at"
                f" {worlds.time_s[world]:g} s{step}; must be finite"
            )
        return self.scaled(told)


def age(worlds: Worlds, vehicle: int, neighbour: int) -> Floats:
    """Time since the sample that was last told of it, [n] s; 0 where the present is known."""
    told = Messages.of(worlds).age_s(worlds.time_s)[:, vehicle, neighbour]
    return np.where(np.isfinite(told), told, 0.0)


def build_up_time(worlds: Worlds, vehicle: int, neighbour: int | None = None) -> Floats:
    """Time in which the brakes of the neighbour, or the own ones, build up from 0 to full, [n] s; 0: at once."""
    i, v = vehicle if neighbour is None else neighbour, worlds.vehicles
    return v.braking_capacity_mps2[:, i] / v.brake_rate_mps3[:, i]


def release_time(worlds: Worlds, vehicle: int, neighbour: int | None = None) -> Floats:
    """Time in which they are released again, [n] s; 0: at once."""
    i, v = vehicle if neighbour is None else neighbour, worlds.vehicles
    return v.braking_capacity_mps2[:, i] / v.release_rate_mps3[:, i]


def place(worlds: Worlds, vehicle: int) -> Floats:
    """Vehicles ahead in the line, [n]: which one this is, for a policy that several share."""
    return np.full(worlds.n, float(vehicle))


def _single(name: str, high: float, function: Callable[..., Floats], of: Of, meaning: str) -> RegisteredFeature:
    return RegisteredFeature(Feature(name, "s", 1.0, 0.0, high, meaning), function, of, 0.0, (0.0, 0.0, 0.0))


_BUILT_IN: dict[str, RegisteredFeature] = {
    "age": _single(
        "age", 8.0, age, "neighbour", "time since the sample that was last told of it; 0 where the present is known"
    ),
    "build_up_time": _single(
        "build_up_time", 4.0, build_up_time, "neighbour", "time in which its brakes build up from 0 to full; 0: at once"
    ),
    "release_time": _single(
        "release_time", 4.0, release_time, "neighbour", "time in which its full brakes are released; 0: at once"
    ),
    "own_build_up_time": _single(
        "own_build_up_time", 4.0, build_up_time, "own", "time in which own brakes build up from 0 to full; 0: at once"
    ),
    "own_release_time": _single(
        "own_release_time", 4.0, release_time, "own", "time in which own full brakes are released; 0: at once"
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
    """The full names of the features that a list of groups (``own``, ``front_1``) and single features stands for.

    Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for what is no list, is empty, or names one twice.
    """
    if isinstance(listed, str) or not isinstance(listed, Sequence) or not listed:
        raise InvalidInput("observation: must be a list of groups and features, for instance [own, front_1, rear_1]")
    names = [name for each in listed for name in _expanded(each)]
    for name, times in Counter(names).items():
        if times > 1:
            raise InvalidInput(f"observation: {name} is listed twice")
    return tuple(names)


class _ListSchema:
    """The JSON schema of an observation: a list of what is known when it is asked for."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        further = {"type": "string", "pattern": r"^(front|rear)_[1-9][0-9]?(\.[a-z0-9_]+)?$"}
        items = {"anyOf": [{"type": "string", "enum": choices()}, further]}
        return {"type": "array", "items": items, "minItems": 1, "uniqueItems": True}


ListedFeatures = Annotated[tuple[str, ...], Field(strict=False), _ListSchema]


def feature_named(name: str) -> Feature:
    """One feature by its full name; raises ``UnknownName``."""
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
    """Of which neighbour a feature with this full name is: ``("front", 1)``; None: of none."""
    match = _SIDE.fullmatch(name.partition(".")[0])
    return (match[1], int(match[2])) if match and int(match[2]) <= MOST_NEIGHBOURS else None


def registered_in(names: Iterable[str]) -> dict[str, RegisteredFeature]:
    """The registered features among those of full names, by their own names."""
    own = [name.partition(".")[2] or name for name in names]
    return {name: FEATURES[name] for name in own if name in FEATURES}


def choices(sides: Iterable[str] = ("front_1", "rear_1")) -> list[str]:
    """What an ``observation:`` may list: groups, then single features, of these neighbours."""
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
        known = [each for each in known if "." not in each]  # a hundred single ones would hide the groups
    return unknown_name("feature", name, known, may_be_own=True)


# The features that an observation holds, in order.


@dataclass(frozen=True, slots=True)
class ObservationSpec:
    """How many neighbours an observation holds on each side, and whether place, obstacle and contacts follow.

    With ``chosen`` it holds these features alone, in this order; ``choose_observation`` makes such a one.

    >>> import ethbrake_marl as eb
    >>> spec = eb.ObservationSpec(front=2, rear=0)
    >>> spec.size, spec.features[7].name
    (27, 'front_1.known')
    >>> eb.choose_observation(["own", "front_1.gap"]).size
    8

    """

    front: int = 1  # neighbours ahead, 0 to 64
    rear: int = 1  # neighbours behind
    role: bool = False  # ROLE_FEATURES
    obstacle: bool = False  # OBSTACLE_FEATURES
    chosen: tuple[str, ...] = ()  # full names; the other fields say how far these look
    contact: bool = False  # CONTACT_FEATURES; those of contact_far must be chosen
    time_step_s: float | None = None  # between two decisions; contact features need it, others do not look at it

    def __post_init__(self) -> None:
        """Refuse what is not a number of neighbours, and features that the rest does not fit."""
        for side, count in (("front", self.front), ("rear", self.rear)):
            whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
            if not whole or not 0 <= count <= MOST_NEIGHBOURS:
                raise InvalidInput(f"observation: {side} = {count!r}; must be a whole number in 0..{MOST_NEIGHBOURS}")
        for name, shown in (("role", self.role), ("obstacle", self.obstacle), ("contact", self.contact)):
            if not isinstance(shown, bool):
                raise InvalidInput(f"observation: {name} = {shown!r}; must be True or False")
        if self.time_step_s is not None and not 0.0 < self.time_step_s < math.inf:
            raise InvalidInput(f"observation: time_step_s = {self.time_step_s!r}; must be a positive number of seconds")
        if self.chosen and _reach(self.chosen) != (self.front, self.rear, self.role, self.obstacle, self.contact):
            raise InvalidInput("observation: chosen: the other fields do not fit; use eb.choose_observation([...])")

    @property
    def sides(self) -> tuple[tuple[str, int], ...]:
        """Neighbours as (prefix, offset in the line), front ones first, nearest first."""
        fronts = tuple((f"front_{k}", -k) for k in range(1, self.front + 1))
        return fronts + tuple((f"rear_{k}", k) for k in range(1, self.rear + 1))

    @property
    def features(self) -> tuple[Feature, ...]:
        """Every number of an observation in order; names are unique (``own.speed``, ``front_1.gap``)."""
        return tuple(feature_named(name) for name in self.chosen) or self.whole

    @property
    def whole(self) -> tuple[Feature, ...]:
        """The same with all built-in features of every group that it looks at."""
        groups = [("own", GROUPS.own), *((prefix, GROUPS.neighbour) for prefix, _ in self.sides)]
        groups += [("role", GROUPS.role)] if self.role else []
        groups += [("obstacle", GROUPS.obstacle)] if self.obstacle else []
        groups += [("contact", GROUPS.contact)] if self.contact else []
        groups += [("contact_far", GROUPS.contact_far)] if self.far else []
        return tuple(replace(f, name=f"{prefix}.{f.name}") for prefix, group in groups for f in group)

    @property
    def far(self) -> bool:
        """Whether any of GROUPS.contact_far is chosen."""
        return any(name.startswith("contact_far.") for name in self.chosen)

    @property
    def size(self) -> int:
        """Length F of an observation."""
        return len(self.features)

    @property
    def plan(self) -> Plan:
        """Offsets of the neighbours and scaling of every feature, in order; what is picked, and what is added.

        Made once for each specification, not to be changed. Raises ``InvalidInput`` for contact features without a
        time step.
        """
        return _plan(self, tuple(registered_in(self.chosen).items()) if self.chosen else ())

    def at_steps_of(self, time_step_s: float) -> ObservationSpec:
        """The same for decisions every ``time_step_s`` (s), where it needs to know and does not say so itself."""
        return replace(self, time_step_s=time_step_s) if self.contact and self.time_step_s is None else self


Observation = ObservationSpec | Sequence[str] | Mapping[str, Any]  # or a list of groups and features, or the fields


def choose_observation(listed: Observation, time_step_s: float | None = None) -> ObservationSpec:
    """The observation of a list of groups and single features: ``[own, front_1, rear_1.gap, my_feature]``.

    A mapping names the fields of an ``ObservationSpec``, which is what JSON makes of one. ``time_step_s`` (s) is the
    time between two decisions; an environment knows its own, so only who observes without one gives it, for contact
    features. Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for what is no such list.
    """
    if isinstance(listed, ObservationSpec):
        spec = listed
    elif isinstance(listed, Mapping):
        known = [field.name for field in fields(ObservationSpec)]
        for name in listed:
            if name not in known:
                raise unknown_name("observation", name, known)
        chosen = listed.get("chosen", ())
        if not isinstance(chosen, list | tuple):
            raise InvalidInput(f"observation: chosen = {chosen!r}; must be a list of features")
        spec = ObservationSpec(**{**listed, "chosen": listed_features(chosen) if chosen else ()})
    else:
        names = listed_features(listed)
        front, rear, role, obstacle, contact = _reach(names)
        spec = ObservationSpec(front, rear, role, obstacle, contact=contact)
        if tuple(feature.name for feature in spec.features) != names:
            spec = replace(spec, chosen=names)
    return spec if time_step_s is None else spec.at_steps_of(time_step_s)


def _reach(names: Sequence[str]) -> tuple[int, int, bool, bool, bool]:
    """How far features look: neighbours in front and behind, the own place, the obstacle, contacts."""
    sides = [side for name in names if (side := side_of(name)) is not None]
    front, rear = (max((k for at, k in sides if at == wanted), default=0) for wanted in ("front", "rear"))
    groups = {name.partition(".")[0] for name in names}
    return front, rear, "role" in groups, "obstacle" in groups, bool(groups & {"contact", "contact_far"})


# The contact features: what three forecasts of the vehicle's own command say of its next impacts.
#
# The vehicle looks at the part of the line around it whose news it has, as its other features tell it. It goes on, once
# its own latency has elapsed, with full braking, coasting or full driving. Every other vehicle of that part goes on
# with the command that is observed of it; one of which none is in force brakes fully as soon as its latency has
# elapsed, and so does one that brakes where brakes build up: its command is not seen in the force of the moment.

FORECAST_S = 10.0  # how far the forecasts look; also the time to an impact that never comes
_OF_PAIR, _HARMS = 4, 2  # numbers of each pair; of the line
_OF_COMMAND = len(CONTACT_SIDES) * _OF_PAIR + _HARMS
_NEAR = len(CONTACT_COMMANDS) * _OF_COMMAND  # columns of contact; behind them are those of contact_far
_FAR = len(CONTACT_SIDES) + _HARMS  # numbers of contact_far for each command


class Contacts(NamedTuple):
    """Which contact features are wanted, and how they are scaled."""

    time_step_s: float  # between two decisions
    commands: Ints  # those to forecast, as places in CONTACT_COMMANDS
    features: Floats  # [3, 30], with far [3, 42]: 1 / scale, low, high of every contact feature


@compiled
def _observe_contacts(
    state: Floats, params: Floats, observers: Ints, time_step: float, commands: Ints, features: Floats,
    out: NDArray[np.float32], failed: Bools,
) -> None:  # fmt: skip
    """Fill ``out``, and ``failed`` [n] where a check of the kernel failed."""
    of = columns(state)
    N, at = (
        of.vehicles,
        1 if state.shape[1] > of.obstacle else 0,
    )  # vehicle i stands in column at + i, behind an obstacle
    line, table = np.zeros((ROW.OF_BUILD_UP, N + at)), np.zeros((ROW.OF_BUILD_UP, N + at))
    found, value = np.zeros((CONTACT.WIDTH, N + at)), np.zeros(_OF_COMMAND + _FAR)
    no_pieces = np.zeros((N, 0))  # nobody is told how another one will brake
    for k in range(out.shape[0]):
        for o in range(observers.shape[0]):
            i = observers[o]
            first, last = _place_known(line, state, params, k, i, at)
            brake_rate, release_rate = of.brake_rate, of.release_rate
            place_rates(
                table, params[k, brake_rate : brake_rate + N], params[k, release_rate : release_rate + N], no_pieces
            )
            for c in commands:
                for j in range(N + at):
                    for row in (ROW.SPEED, ROW.COMMAND, ROW.MASS, ROW.LIMIT, ROW.ONSET, ROW.GAP, ROW.HIT):
                        table[row, j] = line[row, j]
                    table[ROW.FORCE, j] = line[ROW.FORCE, j]
                table[ROW.COMMAND, at + i] = 0.0
                if c == 0:
                    table[ROW.COMMAND, at + i] = -params[k, of.braking + i]
                elif c == 2:
                    table[ROW.COMMAND, at + i] = params[k, of.driving + i]
                if forecast_contacts(table, params[k, of.restitution], FORECAST_S, found) != FLAG.DONE:
                    failed[k] = True
                    break
                _tell(table, found, at + i, first, last, time_step, value)
                for f in range(_OF_COMMAND + _FAR if out.shape[2] > _NEAR else _OF_COMMAND):
                    column = c * _OF_COMMAND + f if f < _OF_COMMAND else _NEAR + c * _FAR + f - _OF_COMMAND
                    scaled = value[f] * features[0, column]
                    out[k, o, column] = min(max(scaled, features[1, column]), features[2, column])


@compiled
def _place_known(table: Floats, state: Floats, params: Floats, k: int, i: int, at: int) -> tuple[int, int]:
    """Write world k, as vehicle i knows it, into a table; its first and last columns that are known.

    Whoever is not known stands far away. Where an obstacle is known, it is the first column.
    """
    of = columns(state)
    N, speed, command, gap, obstacle = of.vehicles, of.speed, of.command, of.gap, of.obstacle
    braking, latency, mass, limit, news = of.braking, of.latency, of.mass, of.limit, of.news
    by_link, time = params.shape[1] > of.own_latency, state[k, of.time]
    own_part = of.own_latency if by_link else latency
    first, last = i, i
    while first > 0 and time >= params[k, news + i * N + first - 1 if by_link else latency + i]:
        first -= 1
    while last < N - 1 and time >= params[k, news + i * N + last + 1 if by_link else latency + i]:
        last += 1
    for j in range(N):
        known = first <= j <= last
        in_force = state[k, command + j]
        table[ROW.SPEED, at + j] = state[k, speed + j] if known else 0.0
        table[ROW.MASS, at + j] = params[k, mass + j]
        table[ROW.LIMIT, at + j] = params[k, limit + j]
        table[ROW.ONSET, at + j] = 0.0
        table[ROW.COMMAND, at + j] = in_force if known else 0.0
        if j == i or in_force == 0.0:
            table[ROW.ONSET, at + j] = max(params[k, own_part + j] - time, 0.0)
            table[ROW.COMMAND, at + j] = -params[k, braking + j] if known else 0.0
        elif known and in_force < 0.0 and params[k, of.brake_rate + j] < math.inf:  # it may build up still
            table[ROW.COMMAND, at + j] = -params[k, braking + j]
        table[ROW.FORCE, at + j] = in_force if known else 0.0
        if j < N - 1:
            table[ROW.GAP, at + j] = state[k, gap + j] if first <= j < last else BOUND.FAR_AWAY_M
            table[ROW.HIT, at + j] = state[k, gap + N - 1 + j]
    if at == 1:
        seen = first == 0 and state[k, obstacle] < math.inf
        place_obstacle(table, state[k, obstacle] if seen else BOUND.FAR_AWAY_M, state[k, obstacle + 1])
        return (0 if seen else 1 + first), 1 + last
    return first, last


@compiled
def _tell(table: Floats, found: Floats, own: int, first: int, last: int, time_step: float, value: Floats) -> None:
    """The numbers of one forecast before scaling; 0 for a pair whose other vehicle is not known, or not there.

    An impact at the very end of a decision step belongs to that step, as in the engine.
    """
    for side in range(2):
        p, at = own - 1 + side, side * _OF_PAIR
        if not first <= p < last:
            for f in range(_OF_PAIR):
                value[at + f] = 0.0
            continue
        time = found[CONTACT.TIME, p]
        met = time < math.inf
        steps = (time if met else FORECAST_S) / time_step
        whole = max(math.ceil(steps) - 1.0, 0.0)
        value[at] = time if met else FORECAST_S
        value[at + 1] = found[CONTACT.CLOSING, p]
        value[at + 2] = steps - whole if met else 0.0
        value[at + 3] = whole
    first_harm, total_harm = 0.0, 0.0
    for p in range(first, last):
        first_harm += table[ROW.FIRST_HARM, p]
        total_harm += table[ROW.TOTAL_HARM, p]
    value[2 * _OF_PAIR] = first_harm
    value[2 * _OF_PAIR + 1] = total_harm
    value[_OF_COMMAND], value[_OF_COMMAND + 1] = value[0], value[_OF_PAIR]
    value[_OF_COMMAND + 2], value[_OF_COMMAND + 3] = math.sqrt(first_harm), math.sqrt(total_harm)


# From worlds to observations: compiled loops over the built-in features, then the functions of registered ones.

Observations = NDArray[np.float32]

_OWN, _NEIGHBOUR = len(GROUPS.own), len(GROUPS.neighbour)
_ROLE, _OBSTACLE = len(GROUPS.role), len(GROUPS.obstacle)


def observe(worlds: Worlds, vehicle: int, spec: ObservationSpec) -> Observations:
    """Observation of ``vehicle`` (0 = front) in every world, [n, F] float32 in its own memory."""
    if not 0 <= vehicle < worlds.N:
        raise InvalidInput(f"observe: vehicle index {vehicle}; must be in 0..{worlds.N - 1}")
    packed = Packed.of(worlds)
    return spec.plan.observe(packed.state, packed.params, np.array([vehicle]))[:, 0].copy()


class Scaling(NamedTuple):
    """The groups of a specification as the kernel wants them."""

    offsets: Ints  # of the neighbours in the line
    role: bool
    obstacle: bool
    features: Floats  # [3, F] 1 / scale, low, high


class Extra(NamedTuple):
    """A registered feature in an observation."""

    column: int
    entry: RegisteredFeature
    offset: int  # of the neighbour in the line; 0: its own
    known: int  # column of the neighbour's ``known`` in the whole groups


class Plan(NamedTuple):
    """How an observation is made: by kernels, which fill whole groups, and by functions of registered features."""

    scaling: Scaling
    contacts: Contacts | None  # their group is the last one; None: it holds none
    picked: Ints | None  # [F] columns of the whole groups; None: all of them
    extras: tuple[Extra, ...]

    def observe(self, state: Floats, params: Floats, vehicles: Ints, steps: Floats | None = None) -> Observations:
        """Observations of several vehicles in worlds given as rows of ``physics.batch``, [n, len(vehicles), F].

        ``steps`` [n] is how many steps each world has made, for error texts. Over a channel of periodic messages a
        vehicle sees the worlds as it takes them to be (``physics.messages``). Contact features of commands that are
        not wanted are 0. Raises ``PhysicsError`` naming the worlds in which a forecast of contacts failed.
        """
        if not Packed(state, params).has_messages:
            return self._observe_present(state, params, vehicles, steps)
        estimate, seen = np.empty(state.shape), []
        for vehicle in vehicles.tolist():
            estimate_rows(state, params, vehicle, estimate)
            seen.append(self._observe_present(estimate, params, np.array([vehicle]), steps))
        return np.concatenate(seen, axis=1)

    def _observe_present(self, state: Floats, params: Floats, vehicles: Ints, steps: Floats | None) -> Observations:
        """The same where everything known is known as it is."""
        shape = len(state), len(vehicles)
        whole = np.empty((*shape, self.scaling.features.shape[1]), np.float32)
        _observe_rows(state, params, vehicles, *self.scaling, whole)
        if self.contacts is not None:
            found = np.zeros((*shape, self.contacts.features.shape[1]), np.float32)
            failed = np.zeros(len(state), np.bool_)
            _observe_contacts(state, params, vehicles, *self.contacts, found, failed)
            if failed.any():
                reason = f"a forecast of contacts could not look {FORECAST_S:g} s ahead"
                raise PhysicsError({k: reason for k in np.flatnonzero(failed).tolist()})
            whole = np.concatenate([whole, found], axis=2)
        if self.picked is None:
            return whole
        out: Observations = whole.take(self.picked, axis=2)
        if not self.extras:
            return out
        worlds = Packed(state, params).worlds().read_only()
        for extra, (o, vehicle) in product(self.extras, enumerate(vehicles.tolist())):
            neighbour = vehicle + extra.offset if extra.offset else None
            counts = np.ones(worlds.n, np.bool_) if neighbour is None else whole[:, o, extra.known] == 1.0
            if counts.any():  # one of a neighbour tells where the kernel says that it is known
                values = extra.entry.checked(worlds, vehicle, neighbour, counts, steps)
            else:  # nobody is there, or nobody is heard
                values = extra.entry.scaled(np.full(worlds.n, extra.entry.unknown))
            out[:, o, extra.column] = values
        return out


@cache
def _plan(spec: ObservationSpec, registered: tuple[tuple[str, RegisteredFeature], ...]) -> Plan:
    whole, entries = spec.whole, dict(registered)
    usual = whole[: len(whole) - spec.contact * len(GROUPS.contact) - spec.far * len(GROUPS.contact_far)]
    offsets = np.array([offset for _, offset in spec.sides], np.int64)
    scaling, contacts = Scaling(offsets, spec.role, spec.obstacle, _scales(usual)), None
    if spec.contact:
        if spec.time_step_s is None:
            raise InvalidInput(
                "observation: contact features need the time between two decisions; give it as time_step_s, for"
                " instance eb.choose_observation([...], time_step_s=scenario.time_step_s)"
            )
        inside = [name.partition(".") for name in spec.chosen or (feature.name for feature in spec.whole)]
        names = [own for group, _, own in inside if group in ("contact", "contact_far")]
        wanted = [c for c, each in enumerate(CONTACT_COMMANDS) if any(n.startswith(f"{each}_") for n in names)]
        features = GROUPS.contact + GROUPS.contact_far if spec.far else GROUPS.contact
        contacts = Contacts(spec.time_step_s, np.array(wanted, np.int64), _scales(features))
    if not spec.chosen:
        return Plan(scaling, contacts, None, ())
    place, sides = {feature.name: c for c, feature in enumerate(whole)}, dict(spec.sides)
    extras = []
    for column, name in enumerate(spec.chosen):
        if name not in place:
            side, _, own = name.rpartition(".")
            extras.append(Extra(column, entries[own], sides.get(side, 0), place.get(f"{side}.known", 0)))
    picked = np.array([place.get(name, 0) for name in spec.chosen], np.int64)
    return Plan(scaling, contacts, picked, tuple(extras))


def _scales(features: Sequence[Feature]) -> Floats:
    """1 / scale, low, high of every feature, [3, F]."""
    return np.array([[1.0 / f.scale for f in features], [f.low for f in features], [f.high for f in features]])


@compiled
def _observe_rows(
    state: Floats, params: Floats, observers: Ints, offsets: Ints, role: bool, with_obstacle: bool, features: Floats,
    out: Observations,
) -> None:  # fmt: skip
    """Fill ``out`` with the clipped features of each observer, in the order of the lists of features above.

    One long loop on purpose: handing these arrays on to functions made it four times as slow.
    """
    of = columns(state)
    N, speed, command, gap_column, hit, obstacle = of.vehicles, of.speed, of.command, of.gap, of.hit, of.obstacle
    braking, driving, latency, mass, news = of.braking, of.driving, of.latency, of.mass, of.news
    by_link, some_obstacle = params.shape[1] > of.own_latency, state.shape[1] > obstacle
    own_part = of.own_latency if by_link else latency  # of vehicle j's latency: own_part + j
    value = np.zeros(out.shape[2])
    for k in range(out.shape[0]):
        time = state[k, of.time]
        for o in range(observers.shape[0]):
            i = observers[o]
            own_speed, own_latency = state[k, speed + i], max(params[k, own_part + i] - time, 0.0)
            own_stop = stopping_distance(own_speed, own_latency, params[k, braking + i])
            value[0] = own_speed
            value[1] = state[k, command + i]
            value[2] = params[k, braking + i]
            value[3] = params[k, driving + i]
            value[4] = params[k, mass + i]
            value[5] = own_latency
            value[6] = params[k, of.restitution]
            c = _OWN
            for offset in offsets:
                j = i + offset
                if not (0 <= j < N and time >= params[k, news + i * N + j if by_link else latency + i]):
                    for absent in range(c, c + _NEIGHBOUR):
                        value[absent] = 0.0
                    c += _NEIGHBOUR
                    continue
                gap = 0.0
                for p in range(min(i, j), max(i, j)):
                    gap += state[k, gap_column + p]
                in_front = j < i
                other_speed = state[k, speed + j]
                other_latency = max(params[k, own_part + j] - time, 0.0)
                other_stop = stopping_distance(other_speed, other_latency, params[k, braking + j])
                room = gap + other_stop if in_front else other_stop - gap
                value[c] = 1.0
                value[c + 1] = gap
                value[c + 2] = own_speed - other_speed if in_front else other_speed - own_speed
                value[c + 3] = state[k, command + j]
                value[c + 4] = params[k, braking + j]
                value[c + 5] = params[k, mass + j]
                value[c + 6] = other_latency
                value[c + 7] = state[k, hit + (i - 1 if in_front else i)]
                value[c + 8] = gap + other_stop - own_stop if in_front else gap + own_stop - other_stop
                value[c + 9] = _fitting_deceleration(own_speed, own_latency, room)
                c += _NEIGHBOUR
            if role:
                value[c] = i
                value[c + 1] = N - 1 - i
                c += _ROLE
            if with_obstacle:
                told = i == 0 or time >= params[k, news + i * N if by_link else latency + i]
                for absent in range(c, c + _OBSTACLE):
                    value[absent] = 0.0
                if told and some_obstacle and state[k, obstacle] < math.inf:
                    gap = state[k, obstacle]
                    for p in range(i):
                        gap += state[k, gap_column + p]
                    value[c] = 1.0
                    value[c + 1] = gap
                    value[c + 2] = state[k, obstacle + 1]
                    value[c + 3] = gap - own_stop
                    value[c + 4] = _fitting_deceleration(own_speed, own_latency, gap)
            for c in range(out.shape[2]):
                out[k, o, c] = min(max(value[c] * features[0, c], features[1, c]), features[2, c])


@compiled
def _fitting_deceleration(speed: float, latency_left: float, room: float) -> float:
    """Constant deceleration that uses up exactly ``room`` after the own latency: ``v^2 / (2 (room - v tau))``.

    Room below 1 mm counts as 1 mm. Without room it therefore reads as the upper clipping bound (20 m/s2) from 0.2 m/s
    on, and lower for a slower vehicle; at rest it is 0.
    """
    speed = max(speed, 0.0)
    left = max(room - speed * latency_left, 1e-3)
    return speed * speed / (2.0 * left)


# Features that somebody registers: checked when they are, and whenever they are evaluated.

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

    An installed package does the same with an entry point of the group ``ethbrake_marl.features``: a ``Part`` of the
    function and what stands behind it here.

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
