"""Observations: the scaled values of a list of features, for every observer in every world."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.departures import BRAKES_EXACTLY
from ethbrake_marl.episode.features import (
    FEATURES,
    GROUPS,
    NEIGHBOUR,
    OBSTACLE_FEATURES,
    OWN,
    ROLE,
    ComputedFeature,
    Feature,
    Group,
    feature_named,
    group_named,
    listed_features,
    side_of,
)
from ethbrake_marl.episode.functions import call_function, check_finite_values
from ethbrake_marl.episode.reach import clock_of_reach, row_within_reach, within_reach
from ethbrake_marl.episode.state import TIME, State, require
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.forces import capacity
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
# places of the features in their groups (`episode.features`)
OWN_SPEED, OWN_ACCELERATION, OWN_BRAKING, OWN_DRIVING, OWN_MASS, OWN_LATENCY_LEFT, OWN_RESTITUTION = range(len(OWN))
(
    NEAR_KNOWN, NEAR_GAP, NEAR_CLOSING_SPEED, NEAR_ACCELERATION, NEAR_BRAKING, NEAR_MASS, NEAR_LATENCY_LEFT, NEAR_HIT,
    NEAR_STOPPING_MARGIN, NEAR_FITTING_DECELERATION,
) = range(len(NEIGHBOUR))  # fmt: skip
ROLE_AHEAD, ROLE_BEHIND = range(len(ROLE))
(
    OBSTACLE_KNOWN, OBSTACLE_GAP, OBSTACLE_HIT, OBSTACLE_STOPPING_MARGIN, OBSTACLE_FITTING_DECELERATION,
) = range(len(OBSTACLE_FEATURES))  # fmt: skip
ASSUME_BRAKES = (".stopping_margin", ".fitting_deceleration")  # ends of the names of features
N_OWN, N_NEIGHBOUR, N_ROLE, N_OBSTACLE = len(OWN), len(NEIGHBOUR), len(ROLE), len(OBSTACLE_FEATURES)


class ObservationPlan(NamedTuple):
    offsets: Ints  # of the observed neighbours: -1 is the next vehicle ahead
    role: bool
    obstacle: bool
    places: (
        Ints  # [F] index of each feature in the kernel's ``value``; -1: of ``groups`` or ``computed``; empty: in order
    )
    groups: tuple[tuple[Group, list[int], list[int]], ...]  # of other packages: group, columns, features in the group
    computed: tuple[tuple[int, ComputedFeature, int], ...]  # column, feature, offset (0: of the vehicle itself)
    scaling: Floats  # [3, F] 1 / scale, low and high


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

    def __reduce__(self) -> tuple[type[View], tuple[list[str]]]:
        """Pickle only the names, because functions of features may not be picklable."""
        return View, ([*self.names],)

    def observe(self, state: State, observers: Ints, time_step_s: float) -> Observations:
        """Observations of the bodies ``observers`` (1: Vehicle 1), [n, len(observers), F]; this view has F features.

        Raises ``InvalidInput`` for features that assume exact braking in a physics that departs from it.
        """
        plan = self.plan
        for name in () if state.is_exact else self.names:
            if name.endswith(ASSUME_BRAKES):
                require(state, f"feature {name!r}, which an observation may leave out,", BRAKES_EXACTLY)
        observations = np.empty((state.n, len(observers), len(self.names)), np.float32)
        observe_worlds(
            state.line, state.car, clock_of_reach(state), state.know, observers, plan.offsets, plan.role, plan.obstacle,
            plan.places, plan.scaling, np.empty(N_OWN + N_NEIGHBOUR * len(plan.offsets) + N_ROLE + N_OBSTACLE),
            observations,
        )  # fmt: skip
        if not plan.groups and not plan.computed:
            return observations
        functions = {group.function for group, *_ in plan.groups}
        values = {function: function(state, observers, time_step_s) for function in functions}
        for group, columns, places in plan.groups:
            parts = values[group.function][..., group.columns][..., places]
            observations[:, :, columns] = scale_values(parts, plan.scaling[:, columns])
        for column, entry, offset in plan.computed:
            for o, body in enumerate(observers.tolist()):
                observations[:, o, column] = observe_computed(
                    entry, state, body, offset, knows(state, body, body + offset)
                )
        return observations

    @cached_property
    def plan(self) -> ObservationPlan:
        """Source of each feature of this view: ``observe_worlds``, a group's function or a feature's function."""
        group_names = list(dict.fromkeys(name.partition(".")[0] for name in self.names if "." in name))
        offsets = [offset for name in group_names if (offset := side_of(name)) is not None]
        kernel_groups = ["own", *(name for name in group_names if side_of(name) is not None)]
        kernel_groups += [name for name in ("role", "obstacle") if name in group_names]
        kernel_names = [f"{group}.{feature.name}" for group in kernel_groups for feature in group_named(group) or ()]
        place = {name: number for number, name in enumerate(kernel_names)}
        groups = []
        for group in (name for name in group_names if name in GROUPS):
            names = [f"{group}.{feature.name}" for feature in GROUPS[group].features]
            columns = [column for column, name in enumerate(self.names) if name in names]
            groups.append((GROUPS[group], columns, [names.index(self.names[column]) for column in columns]))
        split = [name.rpartition(".") for name in self.names]
        computed_features = [
            (column, FEATURES[feature_name], side_of(side) or 0)
            for column, (side, _, feature_name) in enumerate(split)
            if self.names[column] not in place and side not in GROUPS
        ]
        places = [] if list(self.names) == kernel_names else [place.get(name, -1) for name in self.names]
        return ObservationPlan(
            np.array(offsets, np.int64), "role" in group_names, "obstacle" in group_names, np.array(places, np.int64),
            tuple(groups), tuple(computed_features), scaling_of(self.features),
        )  # fmt: skip


def knows(state: State, body: int, neighbour: int) -> NDArray[np.bool_]:
    """Whether ``body`` already knows ``neighbour`` and may react to it, [n].

    False if there is no such vehicle, or if it cannot matter (``episode.reach``).
    """
    if not 0 < neighbour <= state.vehicles:
        return np.zeros(state.n, np.bool_)
    first, last = within_reach(state, body).T
    return np.asarray((first <= neighbour) & (neighbour <= last) & (state.time_s >= state.know[:, body, neighbour]))


def has_unknown(state: State, body: int) -> NDArray[np.bool_]:
    """Whether some quantity of ``body`` is unknown (NaN) in this state, [n]."""
    parts = (state.line[:, :, body], state.car[:, :, body], state.wanted[:, [body]])
    return np.asarray(np.isnan(np.concatenate(parts, axis=1)).any(axis=1))


def scaling_of(features: Sequence[Feature]) -> Floats:
    """Scaling of F features, [3, F]: the rows are 1 / scale, low and high."""
    return np.array([[1.0 / f.scale for f in features], [f.low for f in features], [f.high for f in features]])


def scale_values(values: Floats, scaling: Floats) -> Floats:
    return np.clip(values * scaling[0], scaling[1], scaling[2])


def observe_computed(entry: ComputedFeature, state: State, body: int, offset: int, known: NDArray[np.bool_]) -> Floats:
    """Scaled value of a feature that a registered function computes, as ``body`` observes it, [n].

    ``offset`` leads from ``body`` to the neighbour that the feature describes (-1: the vehicle ahead); ``known`` [n]
    says whether ``body`` knows this neighbour. With ``offset`` 0 the feature describes ``body`` itself.
    """
    what = f"feature {entry.feature.name!r} of vehicle_{body}"
    if offset and not known.any():
        value = np.full(state.n, entry.unknown)
    else:
        arguments = (state.read_only(), body, body + offset) if offset else (state.read_only(), body)
        value = call_function(what, entry.function, arguments, (state.n,))
        if offset:
            is_missing = np.isnan(value)  # a layer shows what a vehicle does not know as NaN
            known = known & ~(is_missing & has_unknown(state, body + offset)) if is_missing.any() else known
            value = np.where(known, value, entry.unknown)
    check_finite_values(what, value, state.time_s)
    return scale_values(value, scaling_of([entry.feature])[:, 0])


@kernel
def full_stop_m(speed, latency_left, capacity):
    """Stopping distance (m) if brakes act at once: ``v tau + v^2 / (2 a)``. For other brakes: ``forces.stopping_m``.

    Speed v (m/s), time ``latency_left`` tau (s) without braking, braking ``capacity`` a (m/s2).
    """
    speed = max(speed, 0.0)
    return speed * latency_left + speed * speed / (2.0 * capacity)


@kernel
def fitting_deceleration(speed, latency_left, room):
    """Deceleration (m/s2) that stops a vehicle within the distance ``room`` (m): ``v^2 / (2 (room - v tau))``.

    Speed v (m/s), time ``latency_left`` tau (s) without braking. If less than 1 mm is left after tau, the formula uses
    1 mm; the observation is clipped in this case.
    """
    speed = max(speed, 0.0)
    return speed * speed / (2.0 * max(room - speed * latency_left, 1e-3))


@kernel
def scale_value(value, scaling, f):
    return min(max(value * scaling[0, f], scaling[1, f]), scaling[2, f])


@large
def observe_worlds(line, car, clock, know, observers, offsets, role, obstacle, places, scaling, value, out):
    """Write the scaled features of the built-in groups to ``out`` [n, observers, F].

    ``line``, ``car``, ``clock`` and ``know`` are arrays of a ``State``. ``observers`` are bodies; ``offsets`` lead from
    an observer to its neighbours (-1: the vehicle ahead). ``role`` and ``obstacle`` say whether to compute the groups
    of these names. ``scaling`` is from ``scaling_of``. ``value`` is working memory: the unscaled features of one
    observer, in the order own, neighbours, role, obstacle. ``places`` [F] has the position in ``value`` of each feature
    of ``out`` (-1: the feature is not written); if ``places`` is empty, all values are written in order.
    """
    if line.shape[2] == 4 and car.shape[2] == 4 and know.shape[2] == 4:  # as in `is_line_of_three`
        write_observations(line, car, clock, know, observers, offsets, role, obstacle, places, scaling, value, out)
    else:
        write_observations(line, car, clock, know, observers, offsets, role, obstacle, places, scaling, value, out)


@kernel
def write_observations(line, car, clock, know, observers, offsets, role, obstacle, places, scaling, value, out):
    """Write features as ``observe_worlds`` does."""
    for k in range(len(out)):
        w, c, time = line[k], car[k], clock[k, TIME]
        for o in range(len(observers)):
            i = observers[o]
            first, last = row_within_reach(w, c, clock[k], know[k], i)
            latency_left = max(c[OWN_LATENCY, i] - time, 0.0)
            own_stop = full_stop_m(w[SPEED, i], latency_left, capacity(c, BRAKING, i))
            value[OWN_SPEED], value[OWN_ACCELERATION], value[OWN_MASS] = w[SPEED, i], w[FORCE, i], c[MASS, i]
            value[OWN_BRAKING], value[OWN_DRIVING] = capacity(c, BRAKING, i), capacity(c, DRIVING, i)
            value[OWN_LATENCY_LEFT], value[OWN_RESTITUTION] = latency_left, c[RESTITUTION, i]
            f = N_OWN
            for offset in offsets:
                j = i + offset
                near = value[f : f + N_NEIGHBOUR]
                near[:] = 0.0
                if first <= j <= last and time >= know[k, i, j]:
                    gap, front = 0.0, j < i
                    for p in range(min(i, j), max(i, j)):
                        gap += w[GAP, p]
                    wait = max(c[OWN_LATENCY, j] - time, 0.0)
                    stop = full_stop_m(w[SPEED, j], wait, capacity(c, BRAKING, j))
                    room = gap + stop if front else stop - gap
                    near[NEAR_KNOWN], near[NEAR_GAP], near[NEAR_ACCELERATION] = 1.0, gap, w[FORCE, j]
                    near[NEAR_CLOSING_SPEED] = w[SPEED, i] - w[SPEED, j] if front else w[SPEED, j] - w[SPEED, i]
                    near[NEAR_BRAKING], near[NEAR_MASS] = capacity(c, BRAKING, j), c[MASS, j]
                    near[NEAR_LATENCY_LEFT] = wait
                    near[NEAR_HIT] = w[HIT, i - 1 if front else i]
                    near[NEAR_STOPPING_MARGIN] = gap + stop - own_stop if front else gap + own_stop - stop
                    near[NEAR_FITTING_DECELERATION] = fitting_deceleration(w[SPEED, i], latency_left, room)
                f += N_NEIGHBOUR
            if role:
                value[f + ROLE_AHEAD], value[f + ROLE_BEHIND] = i - first, last - i
                f += N_ROLE
            if obstacle:
                ahead = value[f : f + N_OBSTACLE]
                ahead[:] = 0.0
                if w[GAP, 0] < FAR_M and first == 1 and (i == 1 or time >= know[k, i, 1]):
                    gap = 0.0
                    for p in range(i):
                        gap += w[GAP, p]
                    ahead[OBSTACLE_KNOWN], ahead[OBSTACLE_GAP], ahead[OBSTACLE_HIT] = 1.0, gap, w[HIT, 0]
                    ahead[OBSTACLE_STOPPING_MARGIN] = gap - own_stop
                    ahead[OBSTACLE_FITTING_DECELERATION] = fitting_deceleration(w[SPEED, i], latency_left, gap)
            if len(places) == 0:
                for f in range(scaling.shape[1]):
                    out[k, o, f] = scale_value(value[f], scaling, f)
            for f in range(len(places)):
                if places[f] >= 0:
                    out[k, o, f] = scale_value(value[places[f]], scaling, f)
