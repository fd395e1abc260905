"""The state that the sliders set: its sliders, and the strict reading of what a page sends.

A state is plain data: a quantity of every vehicle or pair is a list, one of the whole world a number.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.conditions import quantities
from ethbrake_marl.files.messages import suggestion
from ethbrake_marl.physics import Worlds
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.scenario.initial_states import initial_state_worlds
from ethbrake_marl.scenario.quantities import OPTIONAL, QUANTITIES, SYMBOLS, QuantityRule

State = dict[str, Any]


class Group(NamedTuple):
    """The sliders of one quantity."""

    field: str  # key in a state
    title: str
    unit: str  # "" for a plain number
    low: float
    high: float  # sliders end here, the numbers beside them at ``most``
    step: float
    most: float
    names: tuple[str, ...]  # of each slider: vehicle, pair or world
    usual: bool  # shown at once; the others open


# title, least, greatest and step of a slider, and whether it is shown at once
_SLIDERS: dict[str, tuple[str, float, float, float, bool]] = {
    "gaps_m": ("Gap", 0.0, 30.0, 0.1, True),
    "speeds_mps": ("Speed", 0.0, 40.0, 0.1, True),
    "latency_s": ("Delay until it may act", 0.0, 2.0, 0.05, True),
    "braking_capacity_mps2": ("Braking capacity", 0.5, 12.0, 0.1, True),
    "driving_capacity_mps2": ("Driving capacity", 0.0, 12.0, 0.1, False),
    "mass_t": ("Mass", 0.5, 40.0, 0.1, False),
    "restitution": ("Restitution", 0.0, 1.0, 0.01, False),
    "obstacle_gap_m": ("Obstacle ahead of Vehicle 1 at", 1.0, 150.0, 0.5, True),
    "speed_limit_mps": ("Speed limit of driving", 1.0, 60.0, 0.5, False),
}


def slider_groups(scenario: Scenario, state: State) -> list[Group]:
    """The sliders of a scenario's worlds; they reach as far as the scenario draws, and as the state is."""
    found = []
    for field, (title, low, high, step, usual) in _SLIDERS.items():
        if field not in state:
            continue
        rule = _rules()[field]
        values = state[field] if isinstance(state[field], list) else [state[field]]
        bounds = [] if field in OPTIONAL else scenario.bounds(field)
        reach = max(high, *values, *(most for _, most in bounds))
        unit = SYMBOLS.get(rule.unit, rule.unit).replace("2", "²")
        names = tuple(_owner(rule, i) for i in range(rule.count(scenario.vehicles)))
        least = min(low, *values, *(least for least, _ in bounds))
        found.append(Group(field, title, unit, least, min(reach, rule.high), step, rule.high, names, usual))
    return found


def state_of(world: Worlds) -> State:
    """The state of one world (n = 1)."""
    return quantities(world)


def read_state(given: object, scenario: Scenario) -> Worlds:
    """The world (n = 1) that a page asks for; every quantity must be there.

    Raises ``InvalidInput`` for an unknown or missing key, what is no number, and what ``initial_state_worlds`` refuses.
    """
    if not isinstance(given, Mapping):
        raise InvalidInput("world: must be an object such as {'gaps_m': [7, 7], ...}")
    known = {**QUANTITIES, **OPTIONAL} if scenario.has_obstacle else QUANTITIES
    for key in given:
        if key not in known:
            hint = suggestion(str(key), known) or f"known: {', '.join(known)}"
            raise InvalidInput(f"world: unknown key {key!r:.60}; {hint}")
    if missing := [key for key in known if key not in given]:
        raise InvalidInput(f"world: {missing[0]} is missing; every quantity must be given")
    for key, value in given.items():
        if known[key].per == "world":
            read_number(value, f"world: {key}")
        elif not isinstance(value, list):
            raise InvalidInput(f"world: {key}: must be a list of {known[key].count(scenario.vehicles)} numbers")
        else:
            for i, each in enumerate(value):
                read_number(each, f"world: {key}[{i}]")
    return initial_state_worlds(given, scenario)


def read_number(value: object, what: str) -> float:
    """A finite number of JSON; raises ``InvalidInput`` for anything else, truth values too."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
        raise InvalidInput(f"{what} = {value!r:.60}: must be a number")
    return float(value)


def _rules() -> dict[str, QuantityRule]:
    return {**QUANTITIES, **OPTIONAL}


def _owner(rule: QuantityRule, index: int) -> str:
    names = {"vehicle": f"Vehicle {index + 1}", "pair": f"{index + 1} to {index + 2}", "world": ""}
    return names[rule.per]
