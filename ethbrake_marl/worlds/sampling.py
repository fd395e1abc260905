"""Draws worlds from a scenario. World k of a seed always has the same bits, whatever else is drawn with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.state import KEY, ORIGIN, State, mark
from ethbrake_marl.episode.step import StepSettings, at_alert, first_decision
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.motion import layout
from ethbrake_marl.motion.layout import BRAKE_RATE, FAR_M, GAP, IMPACTS, LATENCY, Bools, Floats, Ints
from ethbrake_marl.worlds.channel import PER_LINK
from ethbrake_marl.worlds.counters import Numbers, Purpose, uniform_numbers, world_numbers
from ethbrake_marl.worlds.derived import QuantityValues, obstacle_gap, world_values
from ethbrake_marl.worlds.physics import departures_by
from ethbrake_marl.worlds.quantities import (
    CAR_QUANTITIES,
    GENERATORS,
    MIXTURE,
    NEWS,
    OF_WORLD,
    PER_TYPE,
    QUANTITIES,
    RECORDING,
    ROW,
    TYPES,
    stream_width,
)
from ethbrake_marl.worlds.quantity import pick
from ethbrake_marl.worlds.roles import first_command
from ethbrake_marl.worlds.table import TableColumn
from ethbrake_marl.worlds.vehicle_types import WithLoad

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

MOST_ATTEMPTS = 1000  # draws of one world after which its scenario counts as unusable
WORLDS_AT_ONCE = 1024  # worlds that are drawn together: drawing one alone takes a fifth of the time
IN_CACHE = 1024  # worlds whose arrays fit into a processor's cache

Texts = NDArray[np.str_]


class DrawnWorlds(NamedTuple):
    worlds: State
    friction: Floats  # [n] of the road; NaN where it has none
    grip: Floats  # [n, N] of each vehicle; NaN where it has none
    types: Texts  # [n, N] vehicle types; "" without
    scenarios: Texts  # [n] member of the mixture; "" without
    recordings: Texts  # [n] cell of the table's column `recording`; "" without
    rejected: int = 0  # draws with an impact before the first learner could act

    @property
    def road(self) -> dict[str, Floats]:
        """Key of a quantity of the road -> values, [n, entries]; only quantities that all worlds have."""
        quantities = {"friction": self.friction[:, np.newaxis], "grip": self.grip}
        return {key: values for key, values in quantities.items() if np.isfinite(values).all()}

    @classmethod
    def from_state(cls, worlds: State) -> DrawnWorlds:
        n, N = worlds.n, worlds.vehicles
        none, no_text = np.full((n, N), np.nan), np.full((n, N), "")
        return cls(worlds, none[:, 0], none, no_text, no_text[:, 0], no_text[:, 0])


class WorldPool:
    """Worlds that are drawn one after the other are drawn many at a time."""

    def __init__(self, scenario: Scenario, purpose: Purpose) -> None:
        self.scenario, self.purpose = scenario, purpose
        self.stored: tuple[int, int, Any] = -1, 0, None  # seed, number of the first world, worlds
        self.following = -1, -1  # seed and number of the world after those of the last call
        self.most = WORLDS_AT_ONCE // 4  # calls for fewer worlds may draw many at a time

    def __reduce__(self) -> tuple[Any, ...]:
        return WorldPool, (self.scenario, self.purpose)  # without the worlds

    def __call__(self, n: int, seed: int, first: int) -> State:
        """The arrays are new. Raises ``InvalidInput`` for bad arguments."""
        world_numbers(n, seed, first, self.purpose)
        n, seed, first = int(n), int(seed), int(first)
        follows, self.following = (seed, first) == self.following, (seed, first + n)
        worlds = self._stored_worlds(n, seed, first)
        if worlds is None and follows and n < self.most:
            try:
                many = draw_worlds(self.scenario, WORLDS_AT_ONCE, seed, first, self.purpose)
                self.stored = seed, first, many.worlds
            except EthBrakeError:  # of a world that nobody has asked for yet
                self.most = 0
            worlds = self._stored_worlds(n, seed, first)
        return draw_worlds(self.scenario, n, seed, first, self.purpose).worlds if worlds is None else worlds

    def _stored_worlds(self, n: int, seed: int, first: int) -> State | None:
        stored_seed, stored_first, worlds = self.stored
        row = first - stored_first
        return worlds.take(slice(row, row + n)) if seed == stored_seed and 0 <= row <= worlds.n - n else None


def draw_worlds(scenario: Scenario, n: int, seed: int, first: int, purpose: Purpose) -> DrawnWorlds:
    """Raises ``InvalidInput`` for bad arguments, or if a world has an early impact in ``MOST_ATTEMPTS`` draws."""
    index = world_numbers(n, seed, first, purpose)
    if not scenario.members:
        return _draw_accepted(scenario, seed, purpose, index)
    member_index, parts = member_numbers(scenario, index, seed, purpose), []
    for k in np.unique(member_index):
        part = _draw_accepted(scenario.members[k], seed, purpose, index[member_index == k])
        origin = part.worlds.clock[:, ORIGIN]
        origin[:] = np.where(origin > 0.0, origin * len(scenario.members) + k, 0.0)  # members have tables of their own
        parts.append(part._replace(scenarios=np.full(part.worlds.n, scenario.members[k].name)))
    return merge_draws(parts, np.argsort(member_index, kind="stable"))


def member_numbers(scenario: Scenario, index: Ints, seed: int, purpose: Purpose = "list") -> Ints:
    """Number (from 0) of the member from which each world is drawn, [n]. ``index`` [n] is in ascending order."""
    u = uniform_numbers(seed, purpose, 0, index)(OF_WORLD, MIXTURE)[:, 0]
    return pick([member.weight for member in scenario.mixture or ()], u)


def draw_once(scenario: Scenario, numbers: Numbers, index: Ints) -> DrawnWorlds:
    """A world with an early impact (``has_early_impact``) is not drawn again."""
    n, N, line, column = len(index), scenario.vehicles, scenario.types_of_line, scenario.columns.get(RECORDING)
    numbers, kind, load = cache(numbers), np.zeros((n, N), np.int64), np.zeros((n, N))
    if line is not None:
        kind, load = line.draw(numbers(PER_TYPE * N, TYPES).reshape(n, N, PER_TYPE))
    declared = _declared_values(scenario, numbers, n, kind, load)
    quantities = world_values(scenario, declared)
    if scenario.has_obstacle:
        quantities["obstacle_gap_m"] = obstacle_gap(scenario, quantities, declared)
    worlds = state_of(scenario, quantities, numbers, scenario.unheard(kind), index)
    if scenario.table is not None:
        u = numbers(OF_WORLD, ROW[0])[:, ROW[1]]
        worlds.clock[:, ORIGIN] = TableColumn(scenario.table.origins).value(u)
    return DrawnWorlds(
        worlds,
        quantities["friction"][:, 0] if "friction" in quantities else np.full(n, np.nan),
        quantities.get("grip", np.full((n, N), np.nan)),
        np.full((n, N), "") if line is None else np.array(line.names)[kind],
        np.full(n, ""),
        np.full(n, "") if column is None else column.value(numbers(OF_WORLD, ROW[0])[:, ROW[1]]),
    )


def _declared_values(scenario: Scenario, numbers: Numbers, n: int, kind: Ints, load: Floats) -> Callable[[str], Floats]:
    """Function from the key of a declared quantity to its values in all worlds, [n, entries].

    ``kind``: number of each vehicle's type, [n, N]. ``load``: load of each vehicle, from 0 (empty) to 1 (full), [n, N].
    """

    def declared(key: str) -> Floats:
        entries = scenario.sources[key]
        values = np.empty((n, len(entries)))
        for i, possible in enumerate(entries):
            for k, quantity in possible.items():  # each vehicle type that is possible here
                rows: Any = slice(None) if len(possible) == 1 else kind[:, i] == k
                if isinstance(quantity, float):
                    values[rows, i] = quantity
                    continue
                # All columns of a table take their number from one place, so a world takes them from the same row.
                stream, column = ROW if isinstance(quantity, TableColumn) else QUANTITIES[key].place(i)
                u = numbers(stream_width(stream, scenario.vehicles), stream)[rows, column]
                arguments = (load[rows, i], u) if isinstance(quantity, WithLoad) else (u,)
                values[rows, i] = quantity.value(*arguments)
        return values

    return declared


def state_of(scenario: Scenario, quantities: QuantityValues, numbers: Numbers, unheard: Bools, index: Ints) -> State:
    """``index`` [n]: numbers of the worlds, or -1. ``numbers``: source of random numbers for the delays of V2X links
    (``counters.uniform_numbers``). ``unheard`` [n or 1, N, N]: links that never deliver (``Scenario.unheard``).
    """
    n, N = quantities["speeds_mps"].shape
    line, car = np.zeros((n, layout.LINE_ROWS, N + 1)), np.zeros((n, layout.CAR_ROWS, N + 1))
    know, wanted = np.zeros((n, N + 1, N + 1)), np.zeros((n, N + 1))
    latency, reaction_time = quantities["latency_s"], quantities["latency_s"][:, :, np.newaxis]
    if scenario.v2x.by_link:
        latency, reaction_time = scenario.v2x.news(latency, numbers(PER_LINK * N * N, NEWS), unheard)
    obstacle = quantities.get("obstacle_gap_m", np.full((n, 1), FAR_M))
    of_car = [(row, quantities[key]) for key, row in CAR_QUANTITIES.items() if key in quantities and row != LATENCY]
    of_car += [(LATENCY, latency), (layout.OWN_LATENCY, quantities["latency_s"])]
    for first in range(0, n, IN_CACHE):
        rows = slice(first, first + IN_CACHE)
        line[rows, layout.SPEED, 1:], line[rows, GAP, 0] = quantities["speeds_mps"][rows], obstacle[rows, 0]
        line[rows, GAP, 1:N], line[rows, GAP, N] = quantities["gaps_m"][rows], np.inf
        car[rows, layout.MASS, 0] = car[rows, BRAKE_RATE] = car[rows, layout.RELEASE_RATE] = np.inf
        car[rows, layout.RESTITUTION, 0] = quantities["restitution"][rows, 0]
        for row, values in of_car:
            car[rows, row, 1:] = values[rows]
        know[rows, 1:, 1:] = reaction_time[rows]
    for i, name in enumerate(scenario.vehicle_names):
        wanted[:, i + 1] = first_command(scenario.roles[name], quantities["braking_capacity_mps2"][:, i])
    memories = {key.name: key.at_alert(scenario, numbers, unheard, n) for key in scenario.v2x.channel_keys}
    alert = at_alert(line, car, know, wanted, index)._replace(memories=memories)
    alert.clock[:, KEY] = numbers(OF_WORLD, GENERATORS)[:, 0]
    return mark(alert, departures_by(scenario.physics))


def _draw_accepted(scenario: Scenario, seed: int, purpose: str, index: Ints) -> DrawnWorlds:
    drawn_worlds = draw_once(scenario, uniform_numbers(seed, purpose, 0, index), index)
    if scenario.early_impacts == "keep" or not scenario.learners:
        return drawn_worlds
    pending, rejected, attempt = np.flatnonzero(has_early_impact(scenario, drawn_worlds.worlds)), 0, 0
    while len(pending) and attempt < MOST_ATTEMPTS - 1:
        rejected, attempt = rejected + len(pending), attempt + 1
        redrawn_worlds = draw_once(scenario, uniform_numbers(seed, purpose, attempt, index[pending]), index[pending])
        drawn_worlds.worlds.put(pending, redrawn_worlds.worlds, donate=True)
        for column, redrawn_column in zip(drawn_worlds[1:6], redrawn_worlds[1:6], strict=True):
            column[pending] = redrawn_column
        pending = pending[has_early_impact(scenario, redrawn_worlds.worlds)]
    if not len(pending):
        return drawn_worlds._replace(rejected=rejected)
    learners = ", ".join(scenario.vehicle_names[i - 1] for i in scenario.learners)
    gaps = "time_gaps_s" if scenario.gaps_m is None else "gaps_m"
    raise InvalidInput(
        f"scenario {scenario.name!r}: early_impacts: reject, but in all {MOST_ATTEMPTS} draws of world"
        f" {index[pending[0]]} an impact happens before {learners} can act; use larger"
        f" {gaps}, a smaller latency_s, or early_impacts: keep"
    )


def has_early_impact(scenario: Scenario, alert: State) -> Bools:
    """Whether an impact happens before or just when the first learner can act, so that nobody can prevent it, [n]."""
    deciders = np.array(scenario.learners, np.int64)
    state = first_decision(alert, deciders, StepSettings(deciders, scenario.time_step_s, scenario.horizon_s))
    return np.asarray(state.line[:, IMPACTS].any(axis=1))


def merge_draws(parts: Sequence[DrawnWorlds], place: Ints) -> DrawnWorlds:
    """Worlds of all ``parts`` in one batch: row i of the concatenated parts becomes row ``place[i]``."""
    order = np.argsort(place)

    def of_parts(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate(arrays)[order]

    worlds = State.join([part.worlds for part in parts], of_parts)
    friction, grip, types, scenarios, recordings = map(of_parts, zip(*(part[1:6] for part in parts), strict=True))
    rejected = sum(part.rejected for part in parts)
    return DrawnWorlds(worlds, friction, grip, types, scenarios, recordings, rejected)
