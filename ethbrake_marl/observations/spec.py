"""The features that an observation holds, in order."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.scenario.features import (
    CONTACT_FAR_FEATURES,
    CONTACT_FEATURES,
    MOST_NEIGHBOURS,
    NEIGHBOUR_FEATURES,
    OBSTACLE_FEATURES,
    OWN_FEATURES,
    ROLE_FEATURES,
    Feature,
    feature_named,
    listed_features,
    side_of,
)


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
        groups = [("own", OWN_FEATURES), *((prefix, NEIGHBOUR_FEATURES) for prefix, _ in self.sides)]
        groups += [("role", ROLE_FEATURES)] if self.role else []
        groups += [("obstacle", OBSTACLE_FEATURES)] if self.obstacle else []
        groups += [("contact", CONTACT_FEATURES)] if self.contact else []
        groups += [("contact_far", CONTACT_FAR_FEATURES)] if self.far else []
        return tuple(
            Feature(f"{prefix}.{f.name}", f.unit, f.scale, f.low, f.high, f.meaning)
            for prefix, group in groups
            for f in group
        )

    @property
    def far(self) -> bool:
        """Whether any of CONTACT_FAR_FEATURES is chosen."""
        return any(name.startswith("contact_far.") for name in self.chosen)

    @property
    def size(self) -> int:
        """Length F of an observation."""
        further = self.role * len(ROLE_FEATURES) + self.obstacle * len(OBSTACLE_FEATURES)
        further += self.contact * len(CONTACT_FEATURES)
        return len(self.chosen) or len(OWN_FEATURES) + (self.front + self.rear) * len(NEIGHBOUR_FEATURES) + further

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
    spec = _spec_of(listed)
    return spec if time_step_s is None else spec.at_steps_of(time_step_s)


def _spec_of(listed: Observation) -> ObservationSpec:
    if isinstance(listed, ObservationSpec):
        return listed
    if isinstance(listed, Mapping):
        return _spec_of_fields(listed)
    names = listed_features(listed)
    front, rear, role, obstacle, contact = _reach(names)
    usual = ObservationSpec(front, rear, role, obstacle, contact=contact)
    if tuple(feature.name for feature in usual.features) == names:
        return usual
    return replace(usual, chosen=names)


def _spec_of_fields(given: Mapping[str, Any]) -> ObservationSpec:
    known = [field.name for field in fields(ObservationSpec)]
    for name in given:
        if name not in known:
            raise unknown_name("observation", name, known)
    chosen = given.get("chosen", ())
    if not isinstance(chosen, list | tuple):
        raise InvalidInput(f"observation: chosen = {chosen!r}; must be a list of features")
    return ObservationSpec(**{**given, "chosen": listed_features(chosen) if chosen else ()})


def _reach(names: Sequence[str]) -> tuple[int, int, bool, bool, bool]:
    """How far features look: neighbours in front and behind, the own place, the obstacle, contacts."""
    sides = [side for name in names if (side := side_of(name)) is not None]
    front, rear = (max((k for at, k in sides if at == wanted), default=0) for wanted in ("front", "rear"))
    groups = {name.partition(".")[0] for name in names}
    return front, rear, "role" in groups, "obstacle" in groups, bool(groups & {"contact", "contact_far"})


def observation_for(scenario: Scenario) -> ObservationSpec:
    """What vehicles observe in this scenario unless somebody says otherwise: what it declares.

    Where it declares nothing: one neighbour on each side; where Vehicle 1 has an obstacle ahead, also the own place in
    the line and the obstacle.
    """
    if scenario.observation is not None:
        return choose_observation(scenario.observation, scenario.time_step_s)
    return ObservationSpec(role=scenario.has_obstacle, obstacle=scenario.has_obstacle)
