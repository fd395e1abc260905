"""From what a scenario declares to what a world has.

Speeds from the speed of the line, gaps from time gaps, the distance to an obstacle from its margin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.kernel import first_decision_s, stopping_distances
from ethbrake_marl.physics.worlds import Bools, Floats, Ints, Worlds, make_worlds
from ethbrake_marl.scenario.lines import ScenarioFields, constant_command
from ethbrake_marl.scenario.quantities import (
    BLOCK,
    DECLARED,
    QUANTITIES,
    Sample,
    WithLoad,
    join_samples,
    support,
    values,
)
from ethbrake_marl.scenario.v2x import PER_LINK, with_channel


def world_quantities(scenario: ScenarioFields, declared: Callable[[str], Floats]) -> dict[str, Floats]:
    """Every quantity of k worlds, each [k, entries], from what ``declared(key)`` gives for the keys in use.

    ``speed = line speed + own deviation`` and ``gap = time gap x speed of the rear vehicle of the pair``. Both only
    grow with what they are made of, so the bounds of what is declared give the bounds of what the worlds have.
    """
    other = {"gaps_m": scenario.time_gaps_s, "speeds_mps": scenario.line_speed_mps}
    found = {key: declared(key) for key in QUANTITIES if other.get(key) is None}
    if scenario.line_speed_mps is not None:
        found["speeds_mps"] = declared("line_speed_mps") + declared("speed_deviations_mps")
    if scenario.time_gaps_s is not None:
        found["gaps_m"] = declared("time_gaps_s") * found["speeds_mps"][:, 1:]
    return {key: found[key] for key in QUANTITIES}


def obstacle_gap(
    scenario: ScenarioFields, found: Mapping[str, Floats], declared: Callable[[str], Floats]
) -> Floats | None:
    """Distance from Vehicle 1 to the obstacle ahead, [k], of worlds with the quantities ``found``; None without one.

    As declared, or ``margin + v_1 tau_1 + v_1^2 / (2 a_1)``: so far beyond where Vehicle 1 stops by itself.
    """
    if scenario.obstacle_gap_m is not None:
        return declared("obstacle_gap_m")
    if scenario.obstacle_margin_m is None:
        return None
    speed, latency, capacity = (found[key][:, 0] for key in ("speeds_mps", "latency_s", "braking_capacity_mps2"))
    return declared("obstacle_margin_m") + stopping_distances(speed, latency, capacity)


def farthest_obstacle_m(scenario: ScenarioFields) -> float:
    """Upper bound of the distance to an obstacle that is declared by its margin."""
    low, high = ({key: bounds[[row]] for key, bounds in _all_bounds(scenario).items()} for row in (0, 1))
    slowest = high | {"braking_capacity_mps2": low["braking_capacity_mps2"]}
    farthest = obstacle_gap(scenario, slowest, lambda key: np.array([support(scenario.quantities(key)[0])[1]]))
    assert farthest is not None
    return float(farthest[0])


def drawn_quantities(
    scenario: ScenarioFields, u: Floats, typed: tuple[Ints, Floats] | None = None
) -> dict[str, Floats]:
    """Every quantity of n worlds, each [n, entries], from their uniform numbers ``u`` [n, width].

    ``typed``: type (index) and load of every vehicle, both [n, N], where the scenario has types.
    """

    def drawn(key: str) -> Floats:
        entries, rule = scenario.possible_quantities(key), DECLARED[key]
        found = np.empty((len(u), len(entries)))
        for i, possible in enumerate(entries):
            for kind, entry in possible.items():
                rows = slice(None) if typed is None or len(possible) == 1 else typed[0][:, i] == kind
                if isinstance(entry, WithLoad):
                    assert typed is not None
                    found[rows, i] = entry.value(typed[1][rows, i])
                else:
                    found[rows, i] = values(entry, u[rows, rule.place(i)])
        return found

    return world_quantities(scenario, drawn)


def quantity_bounds(scenario: ScenarioFields, key: str) -> tuple[tuple[float, float], ...]:
    """Smallest and largest value of every entry of one quantity of a world, however it is declared."""
    return tuple((float(low), float(high)) for low, high in _all_bounds(scenario)[key].T)


def _all_bounds(scenario: ScenarioFields) -> dict[str, Floats]:
    """The same of every quantity: each [2, entries]."""
    return world_quantities(scenario, lambda key: np.array(scenario.supports(key)).T)


Channel = Literal["list", "training"]

CHANNELS: dict[str, int] = {"list": 0, "training": 1}
V2X_NEWS = (1,)  # the stream of the links' delays and losses
OBSTACLE = (2,)  # the stream of the obstacle's distance
OBSTACLE_WIDTH = 4  # its numbers per world, of which the first is used
TYPES = (3,)  # the stream of the vehicles' types and loads
LATER_LOSSES = (5,)  # the stream of a world's key, from which its later messages are lost or not
KEY_WIDTH = 4  # its numbers per world, of which the first is used
PER_TYPE = 4  # its numbers per vehicle: type, load, and two that are free; one Philox counter
MOST_ATTEMPTS = 1000  # draws of one world before its scenario is declared unusable
_PATIENCE = 10  # attempts of a whole list before one world is tried to its end

MOST_AT_ONCE = 10_000_000  # worlds of one sample; a longer list is drawn in parts

_MOST_WORLDS = 2**62  # their numbers are 64-bit integers
_NUMBERS_PER_COUNTER = 4  # 64-bit integers that Philox makes from one counter


def uniform_numbers(
    seed: int, channel: Channel, attempt: int, first: int, n: int, width: int, *, of: tuple[int, ...] = ()
) -> Floats:
    """Uniform numbers in [0, 1) of worlds ``first`` to ``first + n - 1``: [n, width], width a multiple of 4.

    Row k depends on (seed, channel, attempt, of, first + k, width) only; ``of`` names a stream of its own, such as
    ``V2X_NEWS``. u is the upper 53 bits of a Philox integer.
    """
    sequence = np.random.SeedSequence([seed], spawn_key=(CHANNELS[channel], attempt, *of))
    key = sequence.generate_state(2, np.uint64)
    stream = np.random.Philox(key=key, counter=first * (width // _NUMBERS_PER_COUNTER))
    integers = np.asarray(stream.random_raw(n * width)).reshape(n, width)
    upper: Floats = (integers >> np.uint64(11)).astype(np.float64)
    return upper * 2.0**-53


def draw_list(scenario: ScenarioFields, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Sample:
    """Worlds ``first`` to ``first + n - 1`` of the scenario's list; see ``Scenario.sample``."""
    check_request(n, seed, first, channel)
    return draw_numbers(scenario, np.arange(first, first + n, dtype=np.int64), int(seed), channel)


def draw_numbers(scenario: ScenarioFields, index: Ints, seed: int, channel: Channel) -> Sample:
    """The worlds with these numbers (ascending) of the scenario's list; the request has been checked."""
    drawn = _draw(scenario, seed, channel, 0, index)
    if scenario.early_impacts == "keep" or not scenario.learners:
        return drawn
    early = early_impact(scenario, drawn.worlds)
    if not early.any():
        return drawn
    return _redraw(scenario, seed, channel, drawn, early)


def early_impact(scenario: ScenarioFields, worlds: Worlds) -> Bools:
    """Which worlds have an impact before (or just when) the first learner may act: [n].

    Vehicles follow their state-free scripts and learners coast, which nobody can change before that moment. Needs a
    learner: without one no impact is early, and ``draw_list`` refuses nothing.
    """
    vehicles = worlds.vehicles
    command = np.zeros(worlds.speeds_mps.shape)
    for i, script in scenario.scripts.items():
        scripted = constant_command(script, vehicles.braking_capacity_mps2[:, i], vehicles.driving_capacity_mps2[:, i])
        if scripted is None:
            raise InvalidInput(f"scenario {scenario.name!r}: early_impacts reject: {script!r} depends on the state")
        command[:, i] = scripted
    first_action_s = first_decision_s(worlds, scenario.learners)
    _, impacts = advance(worlds, command, until_s=first_action_s)
    return np.asarray(impacts.count.sum(axis=1) + impacts.obstacle_count > 0)


def _redraw(scenario: ScenarioFields, seed: int, channel: Channel, drawn: Sample, early: Bools) -> Sample:
    """Draw refused worlds again, attempt by attempt, until every one is accepted."""
    parts, pending, rejected = [drawn.take(~early)], drawn.index[early], int(early.sum())
    for attempt in range(1, MOST_ATTEMPTS):
        if attempt == _PATIENCE and len(pending) > 1:
            _redraw_one(scenario, seed, channel, pending[:1])
        drawn = _draw(scenario, seed, channel, attempt, pending)
        early = early_impact(scenario, drawn.worlds)
        if not early.all():
            parts.append(drawn.take(~early))
        pending = pending[early]
        rejected += len(pending)
        if len(pending) == 0:
            return join_samples(parts, rejected)
    raise _unusable(scenario, int(pending[0]))


def _redraw_one(scenario: ScenarioFields, seed: int, channel: Channel, index: Ints) -> None:
    """Follow one world to its end; if it fails the whole list fails, and this way soon."""
    for attempt in range(_PATIENCE, MOST_ATTEMPTS):
        if not early_impact(scenario, _draw(scenario, seed, channel, attempt, index).worlds)[0]:
            return
    raise _unusable(scenario, int(index[0]))


def _unusable(scenario: ScenarioFields, world: int) -> InvalidInput:
    learners = ", ".join(scenario.vehicle_names[i] for i in scenario.learners)
    gaps = "time_gaps_s" if scenario.gaps_m is None else "gaps_m"
    return InvalidInput(
        f"scenario {scenario.name!r}: early_impacts: reject, but {MOST_ATTEMPTS} draws of world {world} all have an"
        f" impact before {learners} may act; give larger {gaps}, a smaller latency_s, or early_impacts: keep"
    )


def _draw(scenario: ScenarioFields, seed: int, channel: Channel, attempt: int, index: Ints) -> Sample:
    """The worlds with these numbers (ascending), as drawn in this attempt."""
    first, last = int(index[0]), int(index[-1])

    def numbers(width: int, of: tuple[int, ...] = ()) -> Floats:
        u = uniform_numbers(seed, channel, attempt, first, last - first + 1, width, of=of)
        return u if len(u) == len(index) else u[index - first]

    return make_sample(scenario, numbers, index)


def make_sample(scenario: ScenarioFields, numbers: Callable[[int, tuple[int, ...]], Floats], index: Ints) -> Sample:
    """The worlds that ``numbers(width, of)`` describe: uniform numbers [n, width] of a stream, ``()`` the first one."""
    line, typed = scenario.types_of_line, None
    if line is not None:
        u = numbers(PER_TYPE * scenario.vehicles, TYPES)
        typed = line.draw(u.reshape(len(u), scenario.vehicles, PER_TYPE))
    drawn = drawn_quantities(scenario, numbers(BLOCK * scenario.vehicles, ()), typed)
    obstacle_gap_m = obstacle_gap(
        scenario, drawn, lambda key: values(scenario.quantities(key)[0], numbers(OBSTACLE_WIDTH, OBSTACLE)[:, 0])
    )
    restitution = drawn.pop("restitution")[:, 0]
    worlds = make_worlds(
        drawn.pop("gaps_m"), drawn.pop("speeds_mps"), restitution=restitution, obstacle_gap_m=obstacle_gap_m, **drawn
    )
    if scenario.v2x.by_link:
        u = numbers(PER_LINK * scenario.vehicles * scenario.vehicles, V2X_NEWS)
        periodic = scenario.v2x.channel.persistence == "periodic"
        key = numbers(KEY_WIDTH, LATER_LOSSES)[:, 0] if periodic else np.zeros(len(u))
        worlds = with_channel(scenario.v2x, worlds, u, key, scenario.time_step_s)
    return Sample(worlds, index, 0, None if typed is None or line is None else np.array(line.names)[typed[0]])


def check_request(n: int, seed: int, first: int, channel: str) -> None:
    """Refuse, with ``InvalidInput``, worlds that no list has."""
    for name, value, least in (("n", n, 1), ("seed", seed, 0), ("first", first, 0)):
        check_whole_number(f"sample: {name}", value, least)
    if not n <= MOST_AT_ONCE:
        raise InvalidInput(f"sample: n = {n}: at most {MOST_AT_ONCE:,} worlds at once; draw a longer list in parts")
    if not int(first) + int(n) <= _MOST_WORLDS:
        raise InvalidInput(f"sample: first = {first!r}: a list has {_MOST_WORLDS} worlds")
    if channel not in CHANNELS:
        raise InvalidInput(f"sample: channel {channel!r}: must be one of {', '.join(CHANNELS)}")
