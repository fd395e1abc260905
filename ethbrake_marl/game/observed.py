"""Observations of the vehicles of a game: which features each vehicle observes."""

from __future__ import annotations

from collections.abc import Mapping

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.game.definition import Game
from ethbrake_marl.game.observations import Observation, ObservationSpec, choose_observation


def observation_for(scenario: Game, vehicle: str | None = None) -> ObservationSpec:
    """Return the observation that the scenario declares for ``vehicle``, such as ``"vehicle_2"``.

    None: the observation that all learners share; raises ``InvalidInput`` naming two learners whose observations
    differ. By default a vehicle observes one neighbour on each side; with an obstacle ahead also its own place in the
    line and the obstacle.
    """
    observations = observations_of(scenario)
    if vehicle is None:
        return common_observation(observations, scenario)
    if vehicle not in scenario.vehicle_names:
        raise unknown_name("vehicle", vehicle, scenario.vehicle_names)
    return observations[scenario.vehicle_names.index(vehicle)]


def observations_of(scenario: Game, given: Observation | None = None) -> tuple[ObservationSpec, ...]:
    """Return the observation of each vehicle, front to rear, [N].

    Raises ``UnknownName`` for an unknown vehicle, and what ``choose_observation`` raises.

    Args:
        scenario: the game, whose own declaration applies unless ``given`` replaces it.
        given: one observation for all vehicles, or by name for some: ``{"vehicle_2": ["own", "front_1"]}``; None: what
            the scenario declares.

    """
    names, step_s, said = scenario.vehicle_names, scenario.time_step_s, scenario.observation
    usual = ObservationSpec(role=scenario.has_obstacle, obstacle=scenario.has_obstacle)
    each = dict.fromkeys(names, usual)
    for specification in (said, given):
        if isinstance(specification, Mapping) and any(str(name).startswith("vehicle_") for name in specification):
            for name, listed in specification.items():
                if name not in each:
                    raise unknown_name("vehicle", name, names)
                try:
                    each[name] = choose_observation(listed, step_s)
                except InvalidInput as error:
                    raise type(error)(f"{name}: {error}") from None
        elif specification is not None:
            each = dict.fromkeys(names, choose_observation(specification, step_s))
    return tuple(each.values())


def common_observation(observations: tuple[ObservationSpec, ...], scenario: Game) -> ObservationSpec:
    """Return the observation that all learners share; without learners, the one that all vehicles share.

    Raises ``InvalidInput`` naming two vehicles whose observations differ. ``observations``: one per vehicle, front to
    rear.
    """
    first, *others = scenario.learners or range(scenario.vehicles)
    for other in others:
        if observations[other] != observations[first]:
            one, two = (scenario.vehicle_names[i] for i in (first, other))
            raise InvalidInput(
                f"observation: {one} and {two} of {scenario.name!r} observe different features, here learners must"
                " observe the same: give one list for all, let one learn, or use parallel_env or scheme independent"
            )
    return observations[first]
