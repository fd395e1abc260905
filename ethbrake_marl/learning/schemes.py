"""Schemes of training several learners together, and the network that therefore drives each vehicle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import get_args

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.learning.recipe import Scheme, TrainingRecipe
from ethbrake_marl.scenario import Scenario

SCHEMES: tuple[Scheme, ...] = get_args(Scheme)
POLICY = "policy"  # folder of a run in which the policies stand


def scheme_of(recipe: TrainingRecipe, scenario: Scenario) -> Scheme:
    """The recipe's scheme; where it names none, ``single`` for one learner and ``shared`` for several.

    Raises ``InvalidInput`` where nobody learns, or for a scheme that does not fit the learners or the algorithm.
    """
    learners, where = len(scenario.learners), f"scenario {scenario.name!r}"
    if not learners:
        raise InvalidInput(f"{where}: no vehicle learns; give at least one the role learner")
    scheme = recipe.scheme or ("single" if learners == 1 else "shared")
    if scheme == "single" and learners > 1:
        raise InvalidInput(
            f"scheme single: {where} has {learners} learners; use shared, independent or centralised, or let one learn"
        )
    if scheme == "independent" and learners == 1:
        raise InvalidInput(f"scheme independent: {where} has one learner; use single")
    if scheme not in recipe.schemes:
        raise InvalidInput(
            f"scheme {scheme}: recipe {recipe.name!r} is for {recipe.algorithm.upper()}; it needs one for PPO"
        )
    return scheme


def check_scheme(name: str) -> Scheme:
    """``name`` if it is a scheme; raises ``UnknownName`` with a suggestion."""
    for scheme in SCHEMES:
        if scheme == name:
            return scheme
    raise unknown_name("scheme", name, SCHEMES)


def drivers(scheme: Scheme, scenario: Scenario) -> dict[str, str]:
    """Learner -> where in the run's folder the bundle stands that drives it, front to rear."""
    names = [scenario.vehicle_names[vehicle] for vehicle in scenario.learners]
    return {name: driver(scheme, name) for name in names}


def driver(scheme: Scheme, vehicle: str) -> str:
    """Where in the run's folder the bundle stands that drives a learner."""
    return f"{POLICY}/{vehicle}" if scheme == "independent" else POLICY


def who_drives_what(given: Mapping[str, str]) -> str:
    """``drivers`` as a line to read: ``policy drives vehicle_2, vehicle_3``."""
    bundles: dict[str, list[str]] = {}
    for vehicle, bundle in given.items():
        bundles.setdefault(bundle, []).append(vehicle)
    return "; ".join(f"{bundle} drives {', '.join(vehicles)}" for bundle, vehicles in bundles.items())
