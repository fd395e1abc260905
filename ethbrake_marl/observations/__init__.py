"""Observations: named features with fixed analytic scalings, the same for every vehicle.

An observation is the vehicle's own features followed by those of its nearest neighbours, front ones first. Each
feature is ``clip(value / scale, low, high)``. What this vehicle does not know, or a neighbour that is absent, reads 0
with its ``known`` flag 0. There are no running statistics: an observation means the same in every run. Over a channel
(``v2x``), ``latency_left`` and what follows from it count the own part of a latency only: nobody knows beforehand when
news that has not arrived will.

Where an obstacle stands ahead of Vehicle 1 (``observation_for``), the vehicle's place in the line and what it knows of
the obstacle follow. Vehicle 1 sees it; any other vehicle knows of it as soon as it has Vehicle 1's news.

Where an observation lists the group ``contact``, it is followed by what three forecasts say (``observations.contact``).
"""

from ethbrake_marl.observations.observe import Observations, observe, observe_packed, plan_of
from ethbrake_marl.observations.spec import Observation, ObservationSpec, choose_observation, observation_for
from ethbrake_marl.scenario.features import (
    CONTACT_FEATURES,
    NEIGHBOUR_FEATURES,
    OBSTACLE_FEATURES,
    OWN_FEATURES,
    ROLE_FEATURES,
    Feature,
)
from ethbrake_marl.scenario.registered_features import register_feature

__all__ = [
    "CONTACT_FEATURES",
    "NEIGHBOUR_FEATURES",
    "OBSTACLE_FEATURES",
    "OWN_FEATURES",
    "ROLE_FEATURES",
    "Feature",
    "Observation",
    "ObservationSpec",
    "Observations",
    "choose_observation",
    "observation_for",
    "observe",
    "observe_packed",
    "plan_of",
    "register_feature",
]
