"""Describe each world of a scenario as a point of a unit cube; a coordinate is one random number of the world."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.physics.state import Bools, Floats
from ethbrake_marl.first_edition.scenario.declared import ScenarioFields, world_quantities
from ethbrake_marl.first_edition.scenario.distributions import AnyTypeQuantity, TableColumn, WithLoad, support
from ethbrake_marl.first_edition.scenario.fields import (
    BLOCK,
    BRAKES,
    OBSTACLE,
    OF_WORLD,
    PER_TYPE,
    QUANTITY,
    ROW,
    SURROUNDINGS,
    TYPES,
    Place,
)
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.sampling import early_impact, sample_by

_UNUSED = 0.5  # value of uniform numbers without effect


@dataclass(frozen=True, slots=True)
class Ranges:
    """Coordinates of a scenario's unit cube: name, stream (``scenario.sampling``) and column of each random number."""

    scenario: ScenarioFields  # the scenario whose worlds the points of the cube determine
    names: tuple[str, ...]  # name of each coordinate, such as ``mass_t of vehicle_1``
    places: tuple[Place, ...]  # stream and column of each coordinate among the uniform numbers of a world

    def sample(self, points: Floats) -> tuple[Sample, Bools]:
        """Return the worlds at ``points`` of the unit cube, and whether the scenario accepts each world, [n].

        The coordinates of the points, [n, coordinates], are in [0, 1) and in the order of ``names``. A world is not
        accepted if the scenario says ``early_impacts: reject`` and an impact happens in this world before the first
        learner can act.
        """
        n, vehicles = len(points), self.scenario.vehicles
        widths = {(): BLOCK * vehicles, TYPES: PER_TYPE * vehicles, OBSTACLE: OF_WORLD, SURROUNDINGS: OF_WORLD}
        widths[BRAKES] = widths[()]
        streams = {of: np.full((n, width), _UNUSED) for of, width in widths.items()}
        for (of, column), u in zip(self.places, points.T, strict=True):
            streams[of][:, column] = u
        worlds = sample_by(self.scenario, lambda _, of: streams[of], np.arange(n, dtype=np.int64))
        if self.scenario.early_impacts == "keep" or not self.scenario.learners:
            return worlds, np.ones(n, np.bool_)
        return worlds, ~early_impact(self.scenario, worlds.worlds)


def _of_quantities(scenario: ScenarioFields) -> dict[str, Place]:
    """Return which uniform number determines each random quantity: name -> (stream, column of the stream)."""
    used: list[str] = []

    def note(key: str) -> Floats:
        used.append(key)
        return np.ones((1, len(scenario.possible_quantities(key))))

    world_quantities(scenario, note)
    used += [key for key in ("obstacle_gap_m", "obstacle_margin_m") if getattr(scenario, key) is not None]
    places: dict[str, Place] = {
        _name(key, i): QUANTITY.declared[key].place(i)
        for key in used
        for i, possible in enumerate(scenario.possible_quantities(key))
        if any(_drawn(entry.spread if isinstance(entry, WithLoad) else entry) for entry in possible.values())
    }
    if any(_drawn(column, tabled=True) for column in scenario.table_entries.values()):
        places["row of the table"] = ROW
    return places


def _of_types(scenario: ScenarioFields) -> dict[str, Place]:
    """Return which uniform numbers determine types and loads of vehicles: name -> (stream, column of the stream).

    Random numbers without effect are left out: the number that draws a vehicle's type if only one type is possible, and
    the number that draws its load if no quantity depends on the load.
    """
    if scenario.types_of_line is None:
        return {}
    places: dict[str, Place] = {}
    for i, vehicle in enumerate(scenario.vehicle_names):
        possible = [scenario.possible_quantities(key)[i] for key in QUANTITY.of_a_type if scenario.declares(key)]
        if any(len(each) > 1 for each in possible):
            places[f"{vehicle} type"] = (TYPES, PER_TYPE * i)
        if any(isinstance(entry, WithLoad) for each in possible for entry in each.values()):
            places[f"{vehicle} load"] = (TYPES, PER_TYPE * i + 1)
    return places


def _drawn(entry: AnyTypeQuantity, *, tabled: bool = False) -> bool:
    low, high = support(entry)
    return low != high and isinstance(entry, TableColumn) == tabled


def _name(key: str, index: int) -> str:
    owner = QUANTITY.declared[key].owner(index)
    return f"{key} of {owner}" if owner else key


def ranges(scenario: ScenarioFields) -> Ranges:
    """Return the coordinates of the scenario's unit cube, one for every random number of a world.

    Raises ``InvalidInput`` if the scenario has nothing random. Also raises ``InvalidInput`` for a mixture, or a channel
    with delays or losses (``V2X.delays``), because then a point of the unit cube would not determine a world.
    """
    if scenario.members:
        members = ", ".join(member.name for member in scenario.members)
        raise InvalidInput(f"scenario {scenario.name!r}: is a mixture; use one of its scenarios: {members}")
    if scenario.v2x.delays:
        raise InvalidInput(
            f"scenario {scenario.name!r}: its v2x channel has delays and losses, which a table of worlds cannot store;"
            " use v2x: paper (--set v2x=paper)"
        )
    entries = {**_of_types(scenario), **_of_quantities(scenario)}
    if not entries:
        raise InvalidInput(
            f"scenario {scenario.name!r}: no quantity is random, so all its worlds are the same; give at least one"
            " quantity a distribution"
        )
    return Ranges(scenario, tuple(entries), tuple(entries.values()))
