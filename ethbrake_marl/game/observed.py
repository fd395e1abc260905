"""What each vehicle of a game observes."""

from __future__ import annotations

from collections.abc import Mapping

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.game.definition import Game
from ethbrake_marl.game.observations import Observation, ObservationSpec, choose_observation


def observation_for(scenario: Game, vehicle: str | None = None) -> ObservationSpec:
    """Return the observation of a vehicle, or of all learners, that the scenario declares.

    By default a vehicle observes one neighbour on each side; with an obstacle ahead also its own place in the line and
    the obstacle. Raises ``InvalidInput`` naming two learners with different observations, if ``vehicle`` is None.
    """
    observations = observations_of(scenario)
    if vehicle is None:
        return common_observation(observations, scenario)
    if vehicle not in scenario.vehicle_names:
        raise unknown_name("vehicle", vehicle, scenario.vehicle_names)
    return observations[scenario.vehicle_names.index(vehicle)]


def observations_of(scenario: Game, given: Observation | None = None) -> tuple[ObservationSpec, ...]:
    """Return the observation of each vehicle, front to rear, [N]: from ``given``, otherwise from the scenario.

    Both give one observation for all vehicles, or one by name for some: ``{"vehicle_2": ["own", "front_1"]}``. Raises
    ``UnknownName`` for an unknown vehicle, and what ``choose_observation`` raises.
    """
    names, step_s, said = scenario.vehicle_names, scenario.time_step_s, scenario.observation
    usual = ObservationSpec(role=scenario.has_obstacle, obstacle=scenario.has_obstacle)
    each = dict.fromkeys(names, usual)
    for told in (said, given):
        if isinstance(told, Mapping) and any(str(name).startswith("vehicle_") for name in told):
            for name, listed in told.items():
                if name not in each:
                    raise unknown_name("vehicle", name, names)
                try:
                    each[name] = choose_observation(listed, step_s)
                except InvalidInput as error:
                    raise type(error)(f"{name}: {error}") from None
        elif told is not None:
            each = dict.fromkeys(names, choose_observation(told, step_s))
    return tuple(each.values())


def common_observation(observations: tuple[ObservationSpec, ...], scenario: Game) -> ObservationSpec:
    """Return the observation that all learners share, of one per vehicle; without learners, that all vehicles share.

    Raises ``InvalidInput`` naming two of them with different observations.
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
