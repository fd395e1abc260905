"""The features that each vehicle of a game observes."""

from __future__ import annotations

from collections.abc import Mapping

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.first_edition.game.definition import Game
from ethbrake_marl.first_edition.game.observations import Observation, ObservationSpec, choose_observation


def observation_for(scenario: Game, vehicle: str | None = None) -> ObservationSpec:
    """Return the observation that the scenario declares for ``vehicle``, such as ``"vehicle_2"``.

    If ``vehicle`` is None, return the observation that all learners share, or raise ``InvalidInput`` if learners
    observe different features. If the scenario declares no observation, a vehicle observes itself and one neighbour on
    each side; in a scenario with an obstacle, it also observes its own place in the line and the obstacle.
    """
    observations = observations_of(scenario)
    if vehicle is None:
        return common_observation(observations, scenario)
    if vehicle not in scenario.vehicle_names:
        raise unknown_name("vehicle", vehicle, scenario.vehicle_names)
    return observations[scenario.vehicle_names.index(vehicle)]


def observations_of(scenario: Game, given: Observation | None = None) -> tuple[ObservationSpec, ...]:
    """Return the observation of each of the N vehicles, front to rear.

    The observations of the scenario are replaced by ``given``: one observation for all vehicles, or a mapping for some
    vehicles, such as ``{"vehicle_2": ["own", "front_1"]}``; None: no observation is replaced. Raises ``UnknownName``
    for an unknown vehicle, and the same errors as ``choose_observation``.
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
    """Return the observation that all learners share or, without learners, the observation that all vehicles share.

    Raises ``InvalidInput``, which names two vehicles, if the observations of these vehicles differ.
    """
    first, *others = scenario.learners or range(scenario.vehicles)
    for other in others:
        if observations[other] != observations[first]:
            one, two = (scenario.vehicle_names[i] for i in (first, other))
            raise InvalidInput(
                f"observation: {one} and {two} of {scenario.name!r} observe different features, but must observe the"
                " same features here; give one list of features for all vehicles, use a single learner, or use"
                " parallel_env (in a recipe: scheme: independent)"
            )
    return observations[first]
