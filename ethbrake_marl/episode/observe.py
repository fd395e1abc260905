"""Observations: the listed features of every observer, in every world."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.features import (
    FEATURES,
    GROUPS,
    NEIGHBOUR,
    OBSTACLE,
    OWN,
    ROLE,
    WHOLE_GROUPS,
    Feature,
    Group,
    Own,
    feature_named,
    group_named,
    listed_features,
    side_of,
)
from ethbrake_marl.episode.state import TIME, State
from ethbrake_marl.errors import InvalidInput, describe_error
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.layout import (
    BRAKING,
    DRIVING,
    FAR_M,
    FORCE,
    GAP,
    HIT,
    MASS,
    OWN_LATENCY,
    RESTITUTION,
    SPEED,
    Floats,
    Ints,
)

Observations = NDArray[np.float32]
N_OWN, N_NEIGHBOUR, N_ROLE, N_OBSTACLE = len(OWN), len(NEIGHBOUR), len(ROLE), len(OBSTACLE)


class Plan(NamedTuple):
    """How a view is computed."""

    offsets: Ints  # of the observed neighbours: -1 is the next vehicle ahead
    role: bool
    obstacle: bool
    scaling: Floats  # [3, F] 1 / scale, low and high of the kernel's features
    groups: tuple[tuple[Group, int, Floats], ...]  # groups of other packages: group, first column, scaling
    width: int  # number of all these features
    picked: Ints | None  # columns of the view among them; None: all, in this order
    own: tuple[tuple[int, Own, int, int], ...]  # column, feature, offset, column of the neighbour's `known`


class View:
    """What a vehicle observes: a list of features, by name.

    >>> from ethbrake_marl.episode.observe import View
    >>> View(["own", "front_1.gap"]).features[-1].name
    'front_1.gap'

    """

    def __init__(self, listed: object = ("own", "front_1", "rear_1")) -> None:
        self.names = listed_features(listed)
        self.features: tuple[Feature, ...] = tuple(feature_named(name) for name in self.names)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, View) and self.names == other.names

    def __hash__(self) -> int:
        return hash(self.names)

    def __repr__(self) -> str:
        return f"View({list(self.names)})"

    def observe(self, state: State, observers: Ints, time_step_s: float) -> Observations:
        """Return the observations of the bodies ``observers`` (1: Vehicle 1), [n, observers, F]."""
        plan = self.plan
        whole = np.empty((state.n, len(observers), plan.width), np.float32)
        observe_worlds(
            state.line, state.car, state.clock, state.know, observers, plan.offsets, plan.role, plan.obstacle,
            plan.scaling, np.empty(plan.scaling.shape[1]), whole,
        )  # fmt: skip
        if plan.picked is None:
            return whole
        values = {
            function: function(state, observers, time_step_s) for function in {g.function for g, *_ in plan.groups}
        }
        for group, at, scaling in plan.groups:
            whole[:, :, at : at + scaling.shape[1]] = scaled(values[group.function][..., group.columns], scaling)
        seen: Observations = whole.take(plan.picked, axis=2)
        for column, own, offset, known in plan.own:
            for o, body in enumerate(observers.tolist()):
                seen[:, o, column] = own_feature(own, state, body, offset, whole[:, o, known] == 1.0)
        return seen

    @cached_property
    def plan(self) -> Plan:
        """How this view is computed."""
        listed = list(dict.fromkeys(name.partition(".")[0] for name in self.names if "." in name))
        sides = [offset for name in listed if (offset := side_of(name)) is not None]
        front, rear = max([0, *(-s for s in sides)]), max([0, *sides])
        groups = ["own", *(f"front_{k + 1}" for k in range(front)), *(f"rear_{k + 1}" for k in range(rear))]
        groups += [name for name in ("role", "obstacle") if name in listed]
        others = [name for name in listed if name not in WHOLE_GROUPS and side_of(name) is None]
        names = [f"{group}.{f.name}" for group in (*groups, *others) for f in group_named(group) or ()]
        kernel_features = [feature_named(name) for name in names if name.partition(".")[0] not in others]
        offsets = [offset for name in groups if (offset := side_of(name)) is not None]
        place = {name: c for c, name in enumerate(names)}
        own = []
        for column, name in enumerate(self.names):
            if name not in place:
                side, _, last = name.rpartition(".")
                own.append((column, FEATURES[last], side_of(side) or 0, place.get(f"{side}.known", 0)))
        packages = [(GROUPS[name], place[f"{name}.{GROUPS[name].features[0].name}"]) for name in others]
        picked = None if list(self.names) == names and not others else np.array([place.get(n, 0) for n in self.names])
        return Plan(
            np.array(offsets, np.int64), "role" in groups, "obstacle" in groups, scaling_of(kernel_features),
            tuple((group, at, scaling_of(group.features)) for group, at in packages), len(names), picked, tuple(own),
        )  # fmt: skip


def scaling_of(features: Sequence[Feature]) -> Floats:
    """Return 1 / scale, low and high of features, [3, F]."""
    return np.array([[1.0 / f.scale for f in features], [f.low for f in features], [f.high for f in features]])


def scaled(values: Floats, scaling: Floats) -> Floats:
    """Return what is observed of ``values`` [..., F]."""
    return np.clip(values * scaling[0], scaling[1], scaling[2])


def own_feature(own: Own, state: State, body: int, offset: int, known: NDArray[np.bool_]) -> Floats:
    """Return what is observed of a feature with a function, [n]. Raises ``InvalidInput`` for a bad result.

    ``offset`` is that of the neighbour, who is ``known`` [n] or not; 0: a feature of the vehicle itself.
    """
    name = own.feature.name
    if offset and not known.any():
        value = np.full(state.n, own.unknown)
    else:
        of = (body, body + offset) if offset else (body,)
        try:
            value = np.asarray(own.function(state.read_only(), *of))
        except Exception as error:
            raise InvalidInput(
                f"feature {name!r}: its function fails for vehicle_{body}: {describe_error(error)}"
            ) from error
        if value.shape != (state.n,) or value.dtype.kind not in "fiub":
            raise InvalidInput(
                f"feature {name!r}: its function returned {value.dtype} values of shape {value.shape}; must return"
                f" numbers of shape ({state.n},), one per world"
            )
        value = np.where(known, value, own.unknown) if offset else value
    if not np.isfinite(value).all():
        k = int(np.argmin(np.isfinite(value)))
        raise InvalidInput(
            f"feature {name!r}: its value is {value[k]} for vehicle_{body} in row {k} at {state.time_s[k]:g} s; must be"
            " finite"
        )
    return scaled(value, scaling_of([own.feature])[:, 0])


@kernel
def full_stop_m(speed, latency_left, capacity):
    """Return the distance (m) until a vehicle is at rest whose brakes act at once (``forces.stopping_m``)."""
    speed = max(speed, 0.0)
    return speed * latency_left + speed * speed / (2.0 * capacity)


@kernel
def fitting_deceleration(speed, latency_left, room):
    """Return the deceleration (m/s2) that stops a vehicle after ``room`` (m): ``v^2 / (2 (room - v tau))``.

    Less than 1 mm after the latency counts as 1 mm, which is clipped in the observation.
    """
    speed = max(speed, 0.0)
    return speed * speed / (2.0 * max(room - speed * latency_left, 1e-3))


@large
def observe_worlds(line, car, clock, know, observers, offsets, role, obstacle, scaling, value, out):
    """Write the groups own, neighbours, role and obstacle, scaled, to ``out`` [n, observers, F]."""
    bodies = line.shape[2]
    for k in range(len(out)):
        w, c, time = line[k], car[k], clock[k, TIME]
        for o in range(len(observers)):
            i = observers[o]
            left = max(c[OWN_LATENCY, i] - time, 0.0)
            own = full_stop_m(w[SPEED, i], left, c[BRAKING, i])
            value[0], value[1], value[2], value[3] = w[SPEED, i], w[FORCE, i], c[BRAKING, i], c[DRIVING, i]
            value[4], value[5], value[6] = c[MASS, i], left, c[RESTITUTION, i]
            f = N_OWN
            for offset in offsets:
                j = i + offset
                value[f : f + N_NEIGHBOUR] = 0.0
                if 0 < j < bodies and time >= know[k, i, j]:
                    gap, front = 0.0, j < i
                    for p in range(min(i, j), max(i, j)):
                        gap += w[GAP, p]
                    wait = max(c[OWN_LATENCY, j] - time, 0.0)
                    stop = full_stop_m(w[SPEED, j], wait, c[BRAKING, j])
                    value[f], value[f + 1], value[f + 3] = 1.0, gap, w[FORCE, j]
                    value[f + 2] = w[SPEED, i] - w[SPEED, j] if front else w[SPEED, j] - w[SPEED, i]
                    value[f + 4], value[f + 5], value[f + 6] = c[BRAKING, j], c[MASS, j], wait
                    value[f + 7] = w[HIT, i - 1 if front else i]
                    value[f + 8] = gap + stop - own if front else gap + own - stop
                    value[f + 9] = fitting_deceleration(w[SPEED, i], left, gap + stop if front else stop - gap)
                f += N_NEIGHBOUR
            if role:
                value[f], value[f + 1] = i - 1, bodies - 1 - i
                f += N_ROLE
            if obstacle:
                value[f : f + N_OBSTACLE] = 0.0
                if w[GAP, 0] < FAR_M and (i == 1 or time >= know[k, i, 1]):
                    gap = 0.0
                    for p in range(i):
                        gap += w[GAP, p]
                    value[f], value[f + 1], value[f + 2] = 1.0, gap, w[HIT, 0]
                    value[f + 3], value[f + 4] = gap - own, fitting_deceleration(w[SPEED, i], left, gap)
            for f in range(scaling.shape[1]):
                out[k, o, f] = min(max(value[f] * scaling[0, f], scaling[1, f]), scaling[2, f])
