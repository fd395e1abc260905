"""Full state of a world as one vector, for centralised critics: all vehicles, all pairs, and the time."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.game.definition import Game
from ethbrake_marl.first_edition.game.features import GROUPS, Feature
from ethbrake_marl.first_edition.game.observations import Observations, ObservationSpec, observe
from ethbrake_marl.first_edition.physics.state import Vehicles, Worlds

Appended = Literal["number", "state"]  # what training appends to a vehicle's own observation

_OWN_ONLY = ObservationSpec(front=0, rear=0)

_PAIR_MEANING = {"gap": "gap between the two vehicles", "hit": "1 if the pair has had an impact"}

_OBSTACLE_FEATURES = tuple(
    replace(f, name=f"obstacle.{f.name}", meaning=meaning)
    for f in GROUPS.obstacle
    for name, meaning in (("gap", "distance from Vehicle 1 to the obstacle"), ("hit", f.meaning))
    if f.name == name
)

_PAIR_FEATURES = tuple(replace(f, meaning=_PAIR_MEANING[f.name]) for f in GROUPS.neighbour if f.name in _PAIR_MEANING)


def state_features(scenario: Game) -> tuple[Feature, ...]:
    """Return the features of the full state in order: own features of each vehicle, features of each pair, and time.

    The features of a pair are its gap and its hit flag (1 after an impact of the pair, otherwise 0). With an obstacle
    ahead, the gap from Vehicle 1 to the obstacle and the hit flag of the obstacle follow.
    """
    vehicles = [replace(f, name=f"{name}.{f.name}") for name in scenario.vehicle_names for f in GROUPS.own]
    pairs = [replace(f, name=f"pair_{p}.{f.name}") for p in range(1, scenario.vehicles) for f in _PAIR_FEATURES]
    time = Feature("time", "s", scenario.horizon_s, 0.0, 1.0, "time since Vehicle 1 began to brake; scale: the horizon")
    obstacle = _OBSTACLE_FEATURES if scenario.has_obstacle else ()
    return (*vehicles, *pairs, time, *obstacle)


def full_state(worlds: Worlds, scenario: Game) -> Observations:
    """Return the full state of every world, [n, S] float32.

    There are S = 7 N + 2 P + 1 features, and two more if there is an obstacle ahead.
    """
    latency = worlds.vehicles.latency_s  # includes the delays of the channel
    whole_latency = replace(worlds.vehicles, own_latency_s=latency, known_from_s=Vehicles.known_at_once(latency))
    vehicles = [observe(replace(worlds, vehicles=whole_latency), i, _OWN_ONLY) for i in range(worlds.N)]
    pair_values = {"gap": worlds.gaps_m, "hit": worlds.pair_hit.astype(np.float64)}
    columns = [pair_values[f.name][:, p] for p in range(worlds.N - 1) for f in _PAIR_FEATURES]
    columns.append(worlds.time_s)
    if scenario.has_obstacle:
        columns += [worlds.obstacle_gap_m, worlds.obstacle_hit.astype(np.float64)]
    features = state_features(scenario)[-len(columns) :]
    rest = [np.clip(c / f.scale, f.low, f.high) for c, f in zip(columns, features, strict=True)]
    return np.concatenate([*vehicles, np.stack(rest, axis=1)], axis=1, dtype=np.float32)


def row_features(own: tuple[Feature, ...], appended: Appended | None, scenario: Game) -> tuple[Feature, ...]:
    """Return the features that a learner's network receives, in order: ``own``, then the appended features.

    ``appended`` is ``"number"`` (the position of the learner among all learners, from 0), ``"state"`` (the full state),
    or None (no features). Raises ``InvalidInput`` for any other value.
    """
    if appended not in (None, *get_args(Appended)):
        raise InvalidInput(f"appended = {appended!r}: must be {', '.join(map(repr, get_args(Appended)))} or None")
    if appended is None:
        return own
    if appended == "state":
        return (*own, *state_features(scenario))
    last = len(scenario.learners) - 1
    return (*own, Feature("learner", "1", 1.0, 0.0, float(max(last, 1)), "index of the learner among the learners"))
