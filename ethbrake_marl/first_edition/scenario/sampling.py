"""Draw worlds from a scenario. For a given seed, world k is the same, bit for bit, for any number of worlds.

Arguments that several functions share: ``seed`` names a list of worlds, a whole number of at least 0. ``channel`` is
``"list"`` (worlds for evaluation) or ``"training"``; each seed has one list for evaluation and one list for training,
and the two lists are independent. ``first`` is the number of the first world in the list, from 0, and ``n`` the number
of worlds. ``index`` has the number of each world in its list, [n], ascending. ``numbers`` is a function (width, stream)
that returns ``width`` uniform numbers in [0, 1) for each world, [n, width]. A stream is an independent sequence of
random numbers, named by a tuple such as ``fields.TYPES``; ``()`` is the main stream.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds, make_worlds
from ethbrake_marl.first_edition.scenario.declared import ScenarioFields, obstacle_gap, on_road, world_quantities
from ethbrake_marl.first_edition.scenario.distributions import TableColumn, WithLoad, values
from ethbrake_marl.first_edition.scenario.fields import (
    BLOCK,
    BRAKES,
    LATER_LOSSES,
    MIXTURE,
    OF_WORLD,
    PER_TYPE,
    QUANTITY,
    ROW,
    TYPES,
    V2X_NEWS,
    Place,
)
from ethbrake_marl.first_edition.scenario.roles import ScriptSpec
from ethbrake_marl.first_edition.scenario.sample import Sample

Channel = Literal["list", "training"]

CHANNELS: dict[str, int] = {"list": 0, "training": 1}

MOST_ATTEMPTS = 1000  # draws of one world after which its scenario counts as unusable

_PATIENCE = 10  # attempts for all rejected worlds together, before one of them is tried up to MOST_ATTEMPTS times

MOST_AT_ONCE = 10_000_000  # largest number of worlds in one sample; draw a longer list in parts

_MOST_WORLDS = 2**62  # world numbers are 64-bit integers

_NUMBERS_PER_COUNTER = 4  # 64-bit integers that Philox makes from one counter


def sample(scenario: ScenarioFields, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Sample:
    """Return worlds ``first`` to ``first + n - 1`` of the endless list of worlds that belongs to ``seed``.

    World k is the same, bit for bit, for every ``n`` and ``first``. World k of a mixture is drawn from one of its
    scenarios, chosen by weight, and equals world k of that scenario under the same seed, bit for bit. Results on a
    mixture can therefore be compared world by world with results on its scenarios.

    Raises ``InvalidInput`` for a negative ``seed`` or ``first``, and for ``n`` outside [1, ``MOST_AT_ONCE``]. If the
    scenario rejects early impacts (impacts before the first learner can act), ``InvalidInput`` is also raised for a
    world that has an early impact in each of ``MOST_ATTEMPTS`` draws.
    """
    for name, value, least in (("number of worlds", n, 1), ("seed of the list", seed, 0), ("first world", first, 0)):
        check_whole_number(name, value, least)
    if not n <= MOST_AT_ONCE:
        raise InvalidInput(f"number of worlds = {n}: must be at most {MOST_AT_ONCE:,}; draw more with several calls")
    if not int(first) + int(n) <= _MOST_WORLDS:
        raise InvalidInput(
            f"sample: first = {first!r}: first + n must be at most {_MOST_WORLDS}, the number of worlds of one seed"
        )
    if channel not in CHANNELS:
        raise InvalidInput(f"sample: channel = {channel!r}: must be one of {', '.join(CHANNELS)}")
    if scenario.mixture is None:
        return _draw_numbers(scenario, np.arange(first, first + n, dtype=np.int64), int(seed), channel)
    chosen = members_of(scenario, n, int(seed), first=first, channel=channel)
    typed = any(member.vehicle_types is not None for member in scenario.members)
    recorded = any(member.recordings is not None for member in scenario.members)
    parts = []
    for k, member in enumerate(scenario.members):
        index = first + np.flatnonzero(chosen == k)
        if len(index):
            drawn = _draw_numbers(member, index, int(seed), channel)
            no_type = np.full((len(index), scenario.vehicles), "") if typed and drawn.types is None else drawn.types
            no_recording = np.full(len(index), "") if recorded and drawn.recordings is None else drawn.recordings
            named = np.full(len(index), member.name)
            parts.append(replace(drawn, types=no_type, scenarios=named, recordings=no_recording))
    return Sample.join(parts, sum(part.rejected for part in parts))


def members_of(scenario: ScenarioFields, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Ints:
    """Return, for each world of a mixture, the index in ``scenario.members`` of the world's scenario, [n].

    All indices are 0 if the scenario is not a mixture.
    """
    cumulative = np.cumsum([member.weight for member in scenario.mixture or ()] or [1.0])
    u = uniform_numbers(seed, channel, 0, first, n, OF_WORLD, of=MIXTURE)[:, 0]
    return np.searchsorted(cumulative / cumulative[-1], u, side="right")


def middle_world(scenario: ScenarioFields) -> Worlds:
    """Return one world (n = 1) in which every random quantity of ``scenario`` is the median of its distribution."""
    alone = scenario.model_copy()
    alone._columns = {entry: column.middle for entry, column in scenario.table_entries.items()}
    return sample_by(alone, lambda width, of: np.full((1, width), 0.5), np.zeros(1, np.int64)).worlds


def sample_by(scenario: ScenarioFields, numbers: Callable[[int, tuple[int, ...]], Floats], index: Ints) -> Sample:
    """Return the worlds drawn with the random numbers that ``numbers`` returns; early impacts are not rejected.

    The scenario must not be a mixture. ``index`` becomes ``Sample.index``.
    """
    line, typed = scenario.types_of_line, None
    if line is not None:
        u = numbers(PER_TYPE * scenario.vehicles, TYPES)
        typed = line.draw(u.reshape(len(u), scenario.vehicles, PER_TYPE))
    declared = drawn_quantities(scenario, numbers, typed)
    drawn = world_quantities(scenario, declared)
    obstacle_gap_m = obstacle_gap(scenario, on_road(drawn), lambda key: declared(key)[:, 0])
    of_world = {key: drawn.pop(key)[:, 0] for key in ("restitution", "friction") if key in drawn}
    worlds = make_worlds(
        drawn.pop("gaps_m"), drawn.pop("speeds_mps"), obstacle_gap_m=obstacle_gap_m, **of_world, **drawn
    )
    if scenario.v2x.by_link:
        u = numbers(scenario.v2x.width(scenario.vehicles), V2X_NEWS)
        periodic = scenario.v2x.channel.persistence == "periodic"
        key = numbers(OF_WORLD, LATER_LOSSES)[:, 0] if periodic else np.zeros(len(u))
        equipped = scenario.equipped(None if typed is None else typed[0])
        worlds = scenario.v2x.with_channel(worlds, u, key, scenario.time_step_s, equipped)
    worlds = scenario.play_pieces(worlds)
    types = None if typed is None or line is None else np.array(line.names)[typed[0]]
    column, (stream, place) = scenario.recordings, ROW
    recordings = None if column is None else column.value(numbers(OF_WORLD, stream)[:, place])
    return Sample(worlds, index, 0, types, recordings=recordings)


def drawn_quantities(
    scenario: ScenarioFields, numbers: Callable[[int, tuple[int, ...]], Floats], typed: tuple[Ints, Floats] | None
) -> Callable[[str], Floats]:
    """Return a function: key of a declared quantity -> values of this quantity in n worlds, [n, entries].

    A quantity has one entry per vehicle, per pair or per world; ``fields.QUANTITY`` says which. ``typed`` has the type
    (index) and load of every vehicle, both [n, N]; None if the scenario has no vehicle types.
    """
    streams: dict[tuple[int, ...], Floats] = {(): numbers(BLOCK * scenario.vehicles, ())}

    def at(place: Place) -> Floats:
        of, column = place
        if of not in streams:
            streams[of] = numbers(BLOCK * scenario.vehicles if of == BRAKES else OF_WORLD, of)
        return streams[of][:, column]

    def drawn(key: str) -> Floats:
        entries, rule = scenario.possible_quantities(key), QUANTITY.declared[key]
        numbers = np.empty((len(streams[()]), len(entries)))
        for i, possible in enumerate(entries):
            for kind, entry in possible.items():
                rows = slice(None) if typed is None or len(possible) == 1 else typed[0][:, i] == kind
                u = at(ROW if isinstance(entry, TableColumn) else rule.place(i))[rows]
                if isinstance(entry, WithLoad):
                    assert typed is not None
                    numbers[rows, i] = entry.value(typed[1][rows, i], u)
                else:
                    numbers[rows, i] = values(entry, u)
        return numbers

    return drawn


def uniform_numbers(
    seed: int, channel: Channel, attempt: int, first: int, n: int, width: int, *, of: tuple[int, ...] = ()
) -> Floats:
    """Return uniform numbers in [0, 1) for worlds ``first`` to ``first + n - 1``, [n, width].

    Row k of the result depends only on ``seed``, ``channel``, ``attempt``, ``of``, ``width`` and the world number
    ``first + k``. Each number is the upper 53 bits of a 64-bit integer from the Philox generator, divided by 2^53.
    ``attempt`` numbers the draws of a world, from 0: a rejected world is drawn again with the next number. ``width``
    must be a multiple of 4. ``of`` names the stream.
    """
    sequence = np.random.SeedSequence([seed], spawn_key=(CHANNELS[channel], attempt, *of))
    key = sequence.generate_state(2, np.uint64)
    stream = np.random.Philox(key=key, counter=first * (width // _NUMBERS_PER_COUNTER))
    integers = np.asarray(stream.random_raw(n * width)).reshape(n, width)
    upper: Floats = (integers >> np.uint64(11)).astype(np.float64)
    return upper * 2.0**-53


def _draw_numbers(scenario: ScenarioFields, index: Ints, seed: int, channel: Channel) -> Sample:
    """Return the worlds ``index`` of the scenario's list.

    Worlds in which an impact happens before the first learner can act are drawn again if the scenario says
    ``early_impacts: reject``.
    """
    drawn = _draw(scenario, seed, channel, 0, index)
    if scenario.early_impacts == "keep" or not scenario.learners:
        return drawn
    early = early_impact(scenario, drawn.worlds)
    if not early.any():
        return drawn
    return _redraw(scenario, seed, channel, drawn, early)


def early_impact(scenario: ScenarioFields, worlds: Worlds) -> Bools:
    """Return for each world whether an impact happens no later than the time at which the first learner can act, [n].

    No learner can prevent this impact, because all learners coast until the first learner can act, and the other
    vehicles follow their scripts. Raises ``InvalidInput`` if a script depends on the state. The scenario must have a
    learner.
    """
    vehicles = worlds.vehicles
    command = np.zeros(worlds.speeds_mps.shape)
    for i, script in scenario.scripts.items():
        scripted = ScriptSpec.parse(script).command(
            vehicles.braking_capacity_mps2[:, i], vehicles.driving_capacity_mps2[:, i]
        )
        if scripted is None:
            raise InvalidInput(
                f"scenario {scenario.name!r}: with 'early_impacts: reject', no script may depend on the state, but the"
                f" script {script!r} of vehicle_{i + 1} depends on the state"
            )
        command[:, i] = scripted
    first_action_s = worlds.first_decision_s(scenario.learners)
    _, impacts = advance(scenario.play_pieces(worlds), command, until_s=first_action_s)
    return np.asarray(impacts.count.sum(axis=1) + impacts.obstacle_count > 0)


def _redraw(scenario: ScenarioFields, seed: int, channel: Channel, drawn: Sample, early: Bools) -> Sample:
    """Draw rejected worlds again, attempt by attempt, until all are accepted; return the complete sample.

    ``drawn`` has all worlds as drawn in the first attempt; ``early`` [n] is True for each rejected world.
    """
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
            return Sample.join(parts, rejected)
    raise _unusable(scenario, int(pending[0]))


def _redraw_one(scenario: ScenarioFields, seed: int, channel: Channel, index: Ints) -> None:
    """Raise ``InvalidInput`` if world number ``index`` [1] has an early impact in all remaining attempts to draw it.

    If no world of a scenario is acceptable, repeated draws of a single world show this sooner than draws of the whole
    list.
    """
    for attempt in range(_PATIENCE, MOST_ATTEMPTS):
        if not early_impact(scenario, _draw(scenario, seed, channel, attempt, index).worlds)[0]:
            return
    raise _unusable(scenario, int(index[0]))


def _unusable(scenario: ScenarioFields, world: int) -> InvalidInput:
    learners = ", ".join(scenario.vehicle_names[i] for i in scenario.learners)
    gaps = "time_gaps_s" if scenario.gaps_m is None else "gaps_m"
    return InvalidInput(
        f"scenario {scenario.name!r}: early_impacts: reject, but in all {MOST_ATTEMPTS} draws of world {world} an"
        f" impact happens before {learners} can act; use larger {gaps}, a smaller latency_s, or early_impacts: keep"
    )


def _draw(scenario: ScenarioFields, seed: int, channel: Channel, attempt: int, index: Ints) -> Sample:
    """Draw each of the worlds ``index`` once; do not reject any world for an early impact.

    ``attempt`` is the number of earlier draws of these worlds; every attempt uses other random numbers.
    """
    first, last = int(index[0]), int(index[-1])

    def numbers(width: int, of: tuple[int, ...] = ()) -> Floats:
        u = uniform_numbers(seed, channel, attempt, first, last - first + 1, width, of=of)
        return u if len(u) == len(index) else u[index - first]

    return sample_by(scenario, numbers, index)
