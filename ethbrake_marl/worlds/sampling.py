"""Draw worlds from a scenario. World k of a seed is always the same, bit for bit, however many are drawn with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.state import NUMBER, State
from ethbrake_marl.episode.step import at_alert, begin
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    CAR_ROWS as CAR_ROW_COUNT,
    COUNT,
    FAR_M,
    GAP,
    LATENCY,
    LINE_ROWS,
    MASS,
    OWN_LATENCY,
    RELEASE_RATE,
    RESTITUTION,
    SPEED,
    WEIGHT,
    Bools,
    Floats,
    Ints,
)
from ethbrake_marl.worlds.channel import PER_LINK, Equipped
from ethbrake_marl.worlds.counters import Channel, Numbers, numbers_of, world_numbers
from ethbrake_marl.worlds.derived import Values, obstacle_gap, on_road, world_values
from ethbrake_marl.worlds.quantity import WithLoad, pick, values
from ethbrake_marl.worlds.roles import first_command
from ethbrake_marl.worlds.rules import (
    BLOCK,
    BRAKES,
    CAR_ROWS,
    MAIN,
    MIXTURE,
    NEWS,
    OF_WORLD,
    PER_TYPE,
    ROW,
    RULES,
    TYPES,
)
from ethbrake_marl.worlds.table import TableColumn

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

MOST_ATTEMPTS = 1000  # draws of one world after which its scenario counts as unusable
_PATIENCE = 10  # draws of all rejected worlds, after which one of them is tried alone: an error comes sooner

Texts = NDArray[np.str_]


class Drawn(NamedTuple):
    """Worlds at the alert, and what was drawn that a state does not say."""

    worlds: State
    rejected: int = 0  # draws with an impact before the first learner could act
    friction: Floats | None = None  # [n] of the road; NaN where it has none. None: no world has one
    types: Texts | None = None  # [n, N] vehicle types; "" without. None: no world has types
    scenarios: Texts | None = None  # [n] member of the mixture
    recordings: Texts | None = None  # [n] cell of the table's column `recording`; "" without


def draw(scenario: Scenario, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Drawn:
    """Return worlds ``first`` to ``first + n - 1`` of the endless list of the seed.

    World k of a mixture is world k of the member that is chosen for it. Raises ``InvalidInput`` for bad arguments, and
    for a world that is rejected in ``MOST_ATTEMPTS`` draws.
    """
    index = world_numbers(n, seed, first, channel)
    if not scenario.members:
        return _accepted(scenario, seed, channel, index)
    chosen, parts = members_of(scenario, seed, channel, index), []
    for k, member in enumerate(scenario.members):
        if (chosen == k).any():
            part = _accepted(member, seed, channel, index[chosen == k])
            parts.append(part._replace(scenarios=np.full(part.worlds.n, member.name)))
    return _join(parts)


def members_of(scenario: Scenario, seed: int, channel: str, index: Ints) -> Ints:
    """Return which member of a mixture each of the worlds ``index`` comes from, [n]."""
    u = numbers_of(seed, channel, 0, index)(OF_WORLD, MIXTURE)[:, 0]
    return pick([member.weight for member in scenario.mixture or ()], u)


def draw_once(scenario: Scenario, numbers: Numbers, index: Ints) -> Drawn:
    """Return the worlds of these random numbers, early impacts included. The scenario is no mixture."""
    n, N, line = len(index), scenario.vehicles, scenario.types_of_line
    kind, load = (None, None) if line is None else line.draw(numbers(PER_TYPE * N, TYPES).reshape(n, N, PER_TYPE))
    declared = _declared_values(scenario, numbers, n, kind, load)
    whole = world_values(scenario, declared)
    dry, whole = whole, on_road(whole)
    gap = obstacle_gap(scenario, whole, declared)
    if gap is not None:
        whole["obstacle_gap_m"] = gap
    state = state_of(scenario, whole, numbers, scenario.equipped(kind), index)
    friction = dry["friction"][:, 0] if "friction" in dry else None
    types = None if line is None or kind is None else np.array(line.names)[kind]
    column = scenario.recordings
    recordings = None if column is None else column.value(numbers(OF_WORLD, ROW[0])[:, ROW[1]])
    return Drawn(state, 0, friction, types, None, recordings)


def _declared_values(
    scenario: Scenario, numbers: Numbers, n: int, kind: Ints | None, load: Floats | None
) -> Callable[[str], Floats]:
    """Return a function: key -> values of a declared quantity, [n, entries]. ``kind`` and ``load`` are [n, N]."""
    streams: dict[tuple[int, ...], Floats] = {}

    def uniform(place: tuple[tuple[int, ...], int]) -> Floats:
        stream, column = place
        if stream not in streams:
            streams[stream] = numbers(BLOCK * scenario.vehicles if stream in (MAIN, BRAKES) else OF_WORLD, stream)
        return streams[stream][:, column]

    def declared(key: str) -> Floats:
        entries = scenario.declarations(key)
        drawn = np.empty((n, len(entries)))
        for i, possible in enumerate(entries):
            for k, quantity in possible.items():
                rows: Any = slice(None) if kind is None or len(possible) == 1 else kind[:, i] == k
                if isinstance(quantity, float):
                    drawn[rows, i] = quantity
                    continue
                u = uniform(ROW if isinstance(quantity, TableColumn) else RULES[key].place(i))[rows]
                if isinstance(quantity, WithLoad):
                    assert load is not None  # only vehicle types declare it
                    drawn[rows, i] = quantity.value(load[rows, i], u)
                else:
                    drawn[rows, i] = values(quantity, u)
        return drawn

    return declared


def state_of(scenario: Scenario, whole: Values, numbers: Numbers, equipped: Equipped, index: Ints) -> State:
    """Return worlds at the alert from all their quantities, and the random numbers of their links.

    With the channel of the paper a vehicle knows everything once its own latency is over.
    """
    n, N = whole["speeds_mps"].shape
    line, car = np.zeros((n, LINE_ROWS, N + 1)), np.zeros((n, CAR_ROW_COUNT, N + 1))
    line[:, SPEED, 1:], line[:, GAP, 1:N], line[:, GAP, N] = whole["speeds_mps"], whole["gaps_m"], np.inf
    line[:, GAP, 0] = whole["obstacle_gap_m"][:, 0] if "obstacle_gap_m" in whole else FAR_M
    car[:, MASS, 0] = car[:, BRAKE_RATE] = car[:, RELEASE_RATE] = np.inf
    car[:, RESTITUTION], car[:, WEIGHT, 1:] = whole["restitution"], 1.0
    for key, row in CAR_ROWS.items():
        if key in whole:
            car[:, row, 1:] = whole[key]
    know = np.zeros((n, N + 1, N + 1))
    car[:, OWN_LATENCY, 1:] = whole["latency_s"]
    if not scenario.v2x.by_link:
        know[:, 1:, 1:] = whole["latency_s"][:, :, np.newaxis]
    else:
        links = numbers(PER_LINK * N * N, NEWS)
        car[:, LATENCY, 1:], know[:, 1:, 1:] = scenario.v2x.channel.news(whole["latency_s"], links, equipped)
    wanted = np.zeros((n, N + 1))
    for i, name in enumerate(scenario.vehicle_names):
        wanted[:, i + 1] = first_command(scenario.roles[name], car[:, BRAKING, i + 1])
    memories = {each.name: each.at_alert(scenario, numbers, equipped, n) for each in scenario.v2x.extensions}
    return at_alert(line, car, know, wanted, index)._replace(memories=memories)


def _accepted(scenario: Scenario, seed: int, channel: str, index: Ints) -> Drawn:
    """Return the worlds ``index``; draw those with an early impact again, if the scenario rejects them."""
    drawn = draw_once(scenario, numbers_of(seed, channel, 0, index), index)
    if scenario.early_impacts == "keep" or not scenario.learners:
        return drawn
    pending = np.flatnonzero(has_early_impact(scenario, drawn.worlds))
    rejected = len(pending)
    for attempt in range(1, MOST_ATTEMPTS):
        if not len(pending):
            return drawn._replace(rejected=rejected)
        if attempt == _PATIENCE and len(pending) > 1:
            _accepted(scenario, seed, channel, index[pending[:1]])
        again = draw_once(scenario, numbers_of(seed, channel, attempt, index[pending]), index[pending])
        drawn.worlds.put(pending, again.worlds, donate=True)
        for whole, part in zip(drawn[2:], again[2:], strict=True):
            if whole is not None:
                whole[pending] = part
        pending = pending[has_early_impact(scenario, again.worlds)]
        rejected += len(pending)
    learners = ", ".join(scenario.vehicle_names[i - 1] for i in scenario.learners)
    gaps = "time_gaps_s" if scenario.gaps_m is None else "gaps_m"
    raise InvalidInput(
        f"scenario {scenario.name!r}: early_impacts: reject, but in all {MOST_ATTEMPTS} draws of world"
        f" {index[pending[0]]} an impact happens before {learners} can act; use larger"
        f" {gaps}, a smaller latency_s, or early_impacts: keep"
    )


def has_early_impact(scenario: Scenario, alert: State) -> Bools:
    """Return whether an impact happens no later than the first learner can act, [n]: nobody can prevent it."""
    deciders = np.array(scenario.learners, np.int64)
    state = begin(alert, deciders, scenario.time_step_s, scenario.horizon_s)
    return np.asarray(state.line[:, COUNT].any(axis=1))


def _join(parts: Sequence[Drawn]) -> Drawn:
    """Return the worlds of all parts in the order of their numbers."""
    if len(parts) == 1:
        return parts[0]
    whole = State.join([part.worlds for part in parts])
    order = np.argsort(whole.clock[:, NUMBER])
    blanks = {"friction": np.nan, "types": "", "scenarios": "", "recordings": ""}
    columns = {}
    for name, blank in blanks.items():
        given = [getattr(part, name) for part in parts]
        some = next((each for each in given if each is not None), None)
        if some is not None:
            shape = some.shape[1:]
            full = (
                np.full((part.worlds.n, *shape), blank) if each is None else each
                for part, each in zip(parts, given, strict=True)
            )
            columns[name] = np.concatenate(list(full))[order]
    return Drawn(whole.take(order), sum(part.rejected for part in parts), **columns)
