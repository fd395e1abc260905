"""Features: the numbers of an observation, in groups and with fixed scales.

A vehicle observes ``clip(value / scale, low, high)``. An unknown value of a group is observed as 0, and the group's
feature ``known`` is then 0.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np

from ethbrake_marl.episode.functions import description_of
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.motion.layout import BRAKE_RATE, RELEASE_RATE, Floats, Ints
from ethbrake_marl.registry import Registry

MOST_NEIGHBOURS = 64  # on each side

Of = Literal["own", "neighbour"]


class Feature(NamedTuple):
    name: str  # in its group (``speed``), or in full (``own.speed``)
    unit: str
    scale: float  # in `unit`
    low: float
    high: float
    meaning: str = ""


OWN = (
    Feature("speed", "m/s", 20.0, -2.0, 4.0, "own speed"),
    Feature("acceleration", "m/s2", 10.0, -2.0, 2.0, "own acceleration in force"),
    Feature("braking_capacity", "m/s2", 10.0, 0.0, 2.0, "own largest deceleration"),
    Feature("driving_capacity", "m/s2", 10.0, 0.0, 2.0, "own largest forward acceleration"),
    Feature("mass", "t", 10.0, 0.0, 8.0, "own mass"),
    Feature("latency_left", "s", 1.0, 0.0, 4.0, "time until own commands take effect"),
    Feature("restitution", "1", 1.0, 0.0, 1.0, "coefficient of restitution of all impacts"),
)
NEIGHBOUR = (
    Feature("known", "1", 1.0, 0.0, 1.0, "1 if this neighbour exists, can matter, and its state is known"),
    Feature("gap", "m", 10.0, 0.0, 10.0, "sum of the gaps between this vehicle and the neighbour"),
    Feature("closing_speed", "m/s", 10.0, -4.0, 4.0, "closing speed of the two, above 0 if they approach"),
    Feature("acceleration", "m/s2", 10.0, -2.0, 2.0, "acceleration in force of the neighbour"),
    Feature("braking_capacity", "m/s2", 10.0, 0.0, 2.0, "largest deceleration of the neighbour"),
    Feature("mass", "t", 10.0, 0.0, 8.0, "mass of the neighbour"),
    Feature("latency_left", "s", 1.0, 0.0, 4.0, "time until the neighbour's commands take effect"),
    Feature("hit", "1", 1.0, 0.0, 1.0, "1 once this vehicle has had an impact on the neighbour's side"),
    Feature("stopping_margin", "m", 10.0, -15.0, 20.0, "gap at rest if both brake fully as soon as possible"),
    Feature(
        "fitting_deceleration", "m/s2", 10.0, 0.0, 2.0,
        "own constant deceleration with which both stop with gap 0 if the neighbour brakes fully",
    ),
)  # fmt: skip
ROLE = (
    Feature("vehicles_ahead", "1", 1.0, 0.0, 2.0, "number of vehicles ahead that can matter; 2 means 2 or more"),
    Feature("vehicles_behind", "1", 1.0, 0.0, 2.0, "number of vehicles behind that can matter; 2 means 2 or more"),
)
OBSTACLE_FEATURES = (
    Feature("known", "1", 1.0, 0.0, 1.0, "1 if there is an obstacle ahead of the line and this vehicle knows of it"),
    Feature("gap", "m", 10.0, 0.0, 10.0, "sum of the gaps from this vehicle to the obstacle"),
    Feature("hit", "1", 1.0, 0.0, 1.0, "1 once Vehicle 1 has had an impact with the obstacle"),
    Feature("stopping_margin", "m", 10.0, -15.0, 20.0, "distance to the obstacle at rest after full braking"),
    Feature("fitting_deceleration", "m/s2", 10.0, 0.0, 2.0, "own deceleration that stops exactly at the obstacle"),
)
WHOLE_GROUPS = {"own": OWN, "role": ROLE, "obstacle": OBSTACLE_FEATURES}  # and the neighbours front_K, rear_K
LISTS = {  # a name for several features of different groups
    "paper": (
        *("own.speed", "own.acceleration", "front_1.gap", "front_1.closing_speed", "front_1.acceleration"),
        *("rear_1.gap", "rear_1.closing_speed", "rear_1.acceleration"),
    )
}
SIDE = re.compile(r"(front|rear)_([1-9][0-9]?)")


class ComputedFeature(NamedTuple):
    """A feature that a registered function computes, of the observer or of a neighbour (``register_feature``)."""

    feature: Feature
    of: Of
    function: Callable[..., Floats]  # (state, body) or (state, body, other body) -> value in the unit, [n]
    unknown: float = 0.0  # value for a neighbour that is not known, in the unit


class Group(NamedTuple):
    """Features that one function computes together (``register_feature_group``)."""

    features: tuple[Feature, ...]
    function: Callable[[State, Ints, float], Floats]  # (state, bodies, time step) -> values, [n, bodies, ...], unscaled
    columns: slice = slice(None)  # of these values: groups may share a function


def _build_up_s(state: State, body: int) -> Floats:
    return state.braking_capacity_mps2[:, body - 1] / state.car[:, BRAKE_RATE, body]


def _release_s(state: State, body: int) -> Floats:
    return state.braking_capacity_mps2[:, body - 1] / state.car[:, RELEASE_RATE, body]


def _own_and_neighbour(
    name: str, unit: str, high: float, function: Callable[[State, int], Floats], meaning: str
) -> dict[str, ComputedFeature]:
    """Two features with the same function: ``own_NAME`` of the observer, and ``NAME`` of a neighbour."""
    return {
        f"own_{name}": ComputedFeature(Feature(f"own_{name}", unit, 1.0, 0.0, high, f"own {meaning}"), "own", function),
        name: ComputedFeature(
            Feature(name, unit, 1.0, 0.0, high, f"the neighbour's {meaning}"),
            "neighbour",
            lambda state, body, neighbour: function(state, neighbour),
        ),
    }


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
    """Register a feature for ``observation:`` lists. Entry points: ``ethbrake_marl.features``.

    The docstring of ``function`` describes the feature. Raises ``AlreadyExists`` for a name in use, and
    ``InvalidInput`` for a bad argument.

    Args:
        name: 1 to 64 characters ``a-z``, ``0-9``, ``_``. In a list, the feature of a neighbour is written
        ``front_1.NAME``.
        function: ``function(state, body)``, or ``function(state, body, neighbour)``, returns the value in every world,
            [n], in ``unit``. ``body`` is the observer; 1 is the front vehicle.
        unit: unit of the value.
        scale: number above 0; the observation is ``clip(value / scale, low, high)``.
        low: smallest observed number.
        high: largest observed number.
        of: what the feature describes. ``own``: the observer itself; ``neighbour``: a vehicle that the observer knows.
        unknown: value for a neighbour that the observer does not know, in ``unit``.

    """
    meaning = description_of(
        "feature", name, function, r"[a-z][a-z0-9_]{0,63}", "a-z, 0-9 and _, beginning with a letter"
    )
    if name in WHOLE_GROUPS or name in GROUPS or name in LISTS or SIDE.fullmatch(name):
        raise InvalidInput(f"feature {name!r}: this is the name of a group; give another name")
    groups = {**WHOLE_GROUPS, "front_1": NEIGHBOUR}
    inside = [group for group, features in groups.items() if name in [feature.name for feature in features]]
    if inside:
        raise InvalidInput(f"feature {name!r}: the group {inside[0]} has a feature of this name; give another name")
    numbers = {"scale": scale, "low": low, "high": high, "unknown": unknown}
    for key, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise InvalidInput(f"feature {name!r}: {key} = {value!r}: must be a finite number")
    if not scale > 0.0 or not low < high:
        raise InvalidInput(
            f"feature {name!r}: scale = {scale:g}, low = {low:g}, high = {high:g}: scale must be above 0, and low below"
            " high"
        )
    if of not in get_args(Of):
        raise InvalidInput(f"feature {name!r}: of = {of!r}: must be 'own' or 'neighbour'")
    entry = ComputedFeature(
        Feature(name, str(unit), float(scale), float(low), float(high), meaning), of, function, float(unknown)
    )
    FEATURES.add(name, entry, lambda registered: registered == entry)


def register_feature_group(
    name: str,
    features: Sequence[Feature],
    function: Callable[[State, Ints, float], Floats],
    columns: slice = slice(None),  # a constant
) -> None:
    """Register features that one function computes together. Entry points: ``ethbrake_marl.feature_groups``.

    ``function(state, bodies, time_step_s)`` returns unscaled values, [n, bodies, K]; ``columns`` of these K values
    belong to ``features``. If several groups have the same function, one call serves all of them.
    """
    group = Group(tuple(features), function, columns)
    GROUPS.add(name, group, lambda registered: registered == group)


FEATURES: Registry[ComputedFeature] = Registry(
    "feature",
    "features",
    register_feature,
    {
        "place": ComputedFeature(
            Feature("place", "1", 1.0, 0.0, 63.0, "number of vehicles ahead in the line"),
            "own",
            lambda state, body: np.full(state.n, body - 1.0),
        ),
        **_own_and_neighbour(
            "build_up_time", "s", 4.0, _build_up_s, "time until brakes are fully applied; 0 if at once"
        ),
        **_own_and_neighbour("release_time", "s", 4.0, _release_s, "time until full brakes are released; 0 if at once"),
    },
)
GROUPS: Registry[Group] = Registry("group of features", "feature_groups", register_feature_group)


def side_of(name: str) -> int | None:
    """Offset from the observer to a neighbour: -2 for the group ``front_2``, 1 for ``rear_1``, None for other names."""
    match = SIDE.fullmatch(name)
    if match is None or int(match[2]) > MOST_NEIGHBOURS:
        return None
    return -int(match[2]) if match[1] == "front" else int(match[2])


def group_named(name: str) -> tuple[Feature, ...] | None:
    """Features of the group with this name, such as ``own``, ``front_1`` or ``contact``; None if there is none."""
    if side_of(name) is not None:
        return NEIGHBOUR
    return WHOLE_GROUPS[name] if name in WHOLE_GROUPS else GROUPS[name].features if name in GROUPS else None


def feature_named(name: str) -> Feature:
    """Feature with a full name such as ``front_1.gap`` or ``place``.

    Raises ``UnknownName``, or ``InvalidInput`` if the name of a neighbour's feature lacks the neighbour.
    """
    group, dot, feature_name = name.partition(".")
    if not dot and name in FEATURES and FEATURES[name].of == "own":
        return FEATURES[name].feature
    if side_of(group) is not None and feature_name in FEATURES and FEATURES[feature_name].of == "neighbour":
        return FEATURES[feature_name].feature._replace(name=name)
    for feature in group_named(group) or () if dot else ():
        if feature.name == feature_name:
            return feature._replace(name=name)
    if name in FEATURES:
        raise InvalidInput(f"feature {name!r} describes a neighbour; write front_1.{name} or rear_1.{name}")
    raise unknown_name("feature", name, known_names(), may_be_own=True)


def known_names() -> list[str]:
    """All names for an ``observation:`` list: groups, then features. Of the neighbours, only the nearest are listed."""
    groups = [*WHOLE_GROUPS, "front_1", "rear_1", *GROUPS]
    inside = [f"{group}.{feature.name}" for group in groups for feature in group_named(group) or ()]
    return [*groups, *LISTS, *inside, *(name if FEATURES[name].of == "own" else f"front_1.{name}" for name in FEATURES)]


def _names_of(group_or_feature: str) -> list[str]:
    group = group_named(group_or_feature)
    return (
        [feature_named(group_or_feature).name]
        if group is None
        else [f"{group_or_feature}.{feature.name}" for feature in group]
    )


def listed_features(observation: object) -> tuple[str, ...]:
    """Full names of all features in an ``observation:`` list.

    ``["own", "front_1.gap"]`` gives ``("own.speed", ..., "front_1.gap")``. Raises ``InvalidInput`` unless the list
    contains only known names, and no feature twice.
    """
    if isinstance(observation, str) or not isinstance(observation, Sequence) or not observation:
        raise InvalidInput("observation: must be a list of groups and features, for instance [own, front_1, rear_1]")
    names: list[str] = []
    for group_or_feature in observation:
        if not isinstance(group_or_feature, str):
            raise InvalidInput(f"observation: {group_or_feature!r:.60}: must be the name of a group or of a feature")
        for name in LISTS.get(group_or_feature) or _names_of(group_or_feature):
            if name in names:
                raise InvalidInput(f"observation: {name} is listed twice; list it once")
            names.append(name)
    return tuple(names)
