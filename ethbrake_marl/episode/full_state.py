"""The full state of a world as one vector, for centralised critics: all vehicles, all pairs, the time, the obstacle."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.episode.features import NEIGHBOUR, OBSTACLE_FEATURES, OWN, Feature
from ethbrake_marl.episode.observe import Observations, View
from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.layout import GAP, HIT, LATENCY, OWN_LATENCY

OF_PAIR = {feature.name: feature for feature in NEIGHBOUR if feature.name in ("gap", "hit")}
OF_OBSTACLE = {feature.name: feature for feature in OBSTACLE_FEATURES if feature.name in ("gap", "hit")}
OWN_VIEW = View(["own"])


def state_features(vehicles: int, horizon_s: float, obstacle: bool) -> tuple[Feature, ...]:
    """Features of ``full_state``, in order: 7 of each vehicle, 2 of each pair, the time, 2 of the obstacle, if any."""
    vehicle_features = [f._replace(name=f"vehicle_{i}.{f.name}") for i in range(1, vehicles + 1) for f in OWN]
    pairs = [f._replace(name=f"pair_{p}.{f.name}") for p in range(1, vehicles) for f in OF_PAIR.values()]
    time = Feature("time", "s", horizon_s, 0.0, 1.0, "time since the alert; scale: the horizon")
    obstacle_features = [f._replace(name=f"obstacle.{f.name}") for f in OF_OBSTACLE.values()] if obstacle else []
    return (*vehicle_features, *pairs, time, *obstacle_features)


def full_state(state: State, horizon_s: float, obstacle: bool) -> Observations:
    """Scaled values of all ``state_features``, [n, features] float32, also of those that no vehicle knows."""
    car = state.car.copy()
    car[:, OWN_LATENCY] = car[:, LATENCY]
    vehicle_values = OWN_VIEW.observe(state._replace(car=car), np.arange(1, state.vehicles + 1), 0.0).reshape(
        state.n, -1
    )
    columns = [state.line[:, row, p] for p in range(1, state.vehicles) for row in (GAP, HIT)] + [state.time_s]
    if obstacle:
        columns += [state.obstacle_gap_m, state.line[:, HIT, 0]]
    features = state_features(state.vehicles, horizon_s, obstacle)[vehicle_values.shape[1] :]
    other_values = [np.clip(c / f.scale, f.low, f.high) for c, f in zip(columns, features, strict=True)]
    return np.concatenate([vehicle_values, np.stack(other_values, axis=1)], axis=1, dtype=np.float32)
