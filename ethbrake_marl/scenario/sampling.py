"""From what a scenario declares, or a table gives, to worlds."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.files.store import read_plain
from ethbrake_marl.files.yaml import parse_numeral, suggestion
from ethbrake_marl.physics.advance import advance
from ethbrake_marl.physics.kernel import first_decision_s, stopping_distances
from ethbrake_marl.physics.worlds import Bools, Floats, Ints, Worlds, make_worlds
from ethbrake_marl.scenario.fields import (
    ALTERNATIVES,
    BLOCK,
    DECLARED,
    OPTIONAL,
    QUANTITIES,
    QuantityRule,
    Sample,
    ScenarioFields,
    WithLoad,
    constant_command,
    join_samples,
    support,
    values,
)
from ethbrake_marl.scenario.v2x import PER_LINK, with_channel, with_fixed_news


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


# Worlds whose initial conditions the user gives: a table (one row per world) or one state for ``reset``.

Entry = tuple[str, int]  # quantity and index (from 0) of the vehicle or pair

SIZE_LIMIT = 64 << 20  # bytes of a table

_ALWAYS_IN_A_TABLE = ("gaps_m", "speeds_mps")


@dataclass(frozen=True, slots=True)
class _Naming:
    """How messages call a value: by column and row of a table, or by key and index of one state."""

    where: str
    kind: Literal["file", "table", "state"]
    lines: Sequence[int] = ()  # of a file: on which each row begins

    def entry(self, entry: Entry) -> str:
        field, index = entry
        if self.kind != "state":
            return f"column {DECLARED[field].column_of(index)}"
        return field if DECLARED[field].per == "world" else f"{field}[{index}]"

    def value(self, entry: Entry, row: int) -> str:
        if self.kind == "state":
            return f"{self.where}: {self.entry(entry)}"
        place = f"line {self.lines[row]}" if self.kind == "file" else f"row {row}"
        return f"{self.where}, {place}, {self.entry(entry)}"


def _quantities(scenario: ScenarioFields) -> dict[str, QuantityRule]:
    """What a world of this scenario has."""
    return {**QUANTITIES, **OPTIONAL} if scenario.has_obstacle else QUANTITIES


def table_columns(scenario: ScenarioFields) -> dict[str, Entry]:
    """Columns that a table of initial states may have for this scenario: ``gap_1_m``, ``speed_1_mps``, ..."""
    return {
        rule.column_of(index): (field, index)
        for field, rule in _quantities(scenario).items()
        for index in range(rule.count(scenario.vehicles))
    }


def read_initial_states(path: str | Path, scenario: ScenarioFields) -> Worlds:
    """Read worlds from a CSV file with a header line; columns as ``worlds_from_table``.

    Raises ``InvalidInput`` with file, line and column for an unknown, repeated or missing column, a value that is
    not a number or out of range, a row of another length, a file without rows, or one beyond ``SIZE_LIMIT``.
    """
    file = Path(path)
    header, rows, lines = _read_csv(file)
    entries = _known_columns(header, scenario, f"{file}, line 1")
    table = np.empty((len(rows), len(header)))
    for r, row in enumerate(rows):
        if len(row) != len(header):
            raise InvalidInput(f"{file}, line {lines[r]}: {len(row)} values, but the header has {len(header)} columns")
        for c, text in enumerate(row):
            number = parse_numeral(text.strip())
            if number is None:
                raise InvalidInput(f"{file}, line {lines[r]}, column {header[c]}: {text!r:.60} is not a number")
            table[r, c] = number
    given = {entry: table[:, c] for c, entry in enumerate(entries)}
    return _worlds(given, scenario, _Naming(str(file), "file", lines))


def worlds_from_table(columns: Mapping[str, ArrayLike], scenario: ScenarioFields) -> Worlds:
    """Worlds from columns of equal length n: ``gap_1_m`` ..., ``speed_1_mps`` ..., and optionally the others.

    Optional: ``braking_capacity_1_mps2``, ``driving_capacity_1_mps2``, ``latency_1_s``, ``mass_1_t``,
    ``speed_limit_1_mps`` and so on for each vehicle, ``restitution``, and ``obstacle_gap_m`` where the scenario has it.
    What is left out comes from the scenario, where it must be a fixed number. Raises ``InvalidInput`` naming the column
    and the row (from 0).
    """
    entries = _known_columns(list(columns), scenario, "initial states")
    given = {
        entry: _numbers(f"initial states: {name}", column)
        for entry, (name, column) in zip(entries, columns.items(), strict=True)
    }
    shapes = {column.shape for column in given.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 1:
        lengths = ", ".join(f"{name} {list(np.shape(column))}" for name, column in columns.items())
        raise InvalidInput(f"initial states: columns must be lists of one and the same length, not {lengths}")
    return _worlds(given, scenario, _Naming("initial states", "table"))


def initial_state_worlds(initial_state: Mapping[str, Any], scenario: ScenarioFields) -> Worlds:
    """The one world of ``{"gaps_m": [7, 7], "speeds_mps": [20, 18, 20], ...}``; keys are a scenario's quantities.

    A single number stands for every vehicle. What is left out comes from the scenario, where it must be a fixed
    number. Raises ``InvalidInput`` naming the key and the entry.
    """
    if not isinstance(initial_state, Mapping):
        raise InvalidInput(f"initial_state = {initial_state!r}: must be a mapping such as {{'gaps_m': [7, 7]}}")
    given: dict[Entry, Floats] = {}
    known = _quantities(scenario)
    for field, value in initial_state.items():
        if field not in known:
            if field in OPTIONAL:
                raise InvalidInput(f"initial_state: {field} is not of this scenario: {scenario.name!r} has no {field}")
            hint = suggestion(str(field), known) or f"known: {', '.join(known)}"
            raise InvalidInput(f"initial_state: unknown key {field!r}; {hint}")
        count = known[field].count(scenario.vehicles)
        numbers = _numbers(f"initial_state: {field}", value)
        if numbers.shape not in ((), (count,)):
            several = f"{scenario.vehicles} vehicles need {count} numbers, or one for all"
            right = "must be one number" if known[field].per == "world" else several
            raise InvalidInput(f"initial_state: {field} has shape {list(numbers.shape)}; {right}")
        for index, number in enumerate(np.broadcast_to(numbers, (count,))):
            given[field, index] = np.array([number])
    return _worlds(given, scenario, _Naming("initial_state", "state"))


def _worlds(given: Mapping[Entry, Floats], scenario: ScenarioFields, naming: _Naming) -> Worlds:
    """Check the given columns, each [n], fill in the scenario's fixed numbers, and build the worlds."""
    if scenario.members:
        raise InvalidInput(
            f"{naming.where}: scenario {scenario.name!r} is a mixture, and nothing says which of its scenarios a world"
            f" belongs to; take one of them: {', '.join(member.name for member in scenario.members)}"
        )
    n = len(next(iter(given.values()))) if given else 1
    full: dict[str, Floats] = {}
    rules = _quantities(scenario)
    for field, rule in sorted(rules.items(), key=lambda item: item[0] == "gaps_m"):  # gaps may need the speeds
        full[field] = np.empty((n, rule.count(scenario.vehicles)))
        for index in range(rule.count(scenario.vehicles)):
            column = given.get((field, index))
            if column is None:
                column = _fixed(scenario, field, index, full)
            if column is None:
                missing = naming.entry((field, index))
                raise InvalidInput(f"{naming.where}: {missing} is missing, and random in scenario {scenario.name!r}")
            good = (column > 0.0 if rule.positive else column >= 0.0) & (column <= rule.high)
            _require_all(good, naming, (field, index), column, f"must be {rule.interval}")
            full[field][:, index] = column
    _check_together(full, scenario, naming)
    of_world = {field: full.pop(field)[:, 0] for field, rule in rules.items() if rule.per == "world"}
    worlds = make_worlds(full.pop("gaps_m"), full.pop("speeds_mps"), **of_world, **full)
    return with_fixed_news(scenario.v2x, worlds, scenario.time_step_s, naming.where)


def _fixed(scenario: ScenarioFields, field: str, index: int, full: Mapping[str, Floats]) -> Floats | None:
    """What the scenario fixes for this entry, [n] or [1]; None if random.

    A time gap is taken at the speeds in ``full``, the margin to an obstacle from where Vehicle 1 stops there.
    """
    if field in OPTIONAL:
        declared = ALTERNATIVES[field] if getattr(scenario, field) is None else field
        low, high = support(scenario.quantities(declared)[0])
        return obstacle_gap(scenario, full, lambda key: np.array([low])) if low == high else None
    by_time = field == "gaps_m" and scenario.time_gaps_s is not None
    low, high = (
        support(scenario.quantities("time_gaps_s")[index]) if by_time else quantity_bounds(scenario, field)[index]
    )
    if low != high:
        return None
    return low * full["speeds_mps"][:, index + 1] if by_time else np.array([low])


def _check_together(full: Mapping[str, Floats], scenario: ScenarioFields, naming: _Naming) -> None:
    for index in range(scenario.vehicles):
        latency, speed, limit = (full[f][:, index] for f in ("latency_s", "speeds_mps", "speed_limit_mps"))
        right = f"must be below the scenario's horizon_s ({scenario.horizon_s:g} s)"
        _require_all(latency < scenario.horizon_s, naming, ("latency_s", index), latency, right)
        good = speed <= limit
        limit_mps = limit[np.argmin(good)]  # of the world that the message is about
        right = f"must not be above speed_limit_mps of vehicle_{index + 1}, {limit_mps:g} m/s"
        _require_all(good, naming, ("speeds_mps", index), speed, right)


def _require_all(good: Bools, naming: _Naming, entry: Entry, column: Floats, right: str) -> None:
    """Refuse the first world for which ``good`` does not hold."""
    if not good.all():
        row = int(np.argmin(good))
        raise InvalidInput(f"{naming.value(entry, row)} = {column[row]:.12g}: {right}")


def _known_columns(header: list[str], scenario: ScenarioFields, where: str) -> list[Entry]:
    """The entry of each column; unknown, repeated and missing columns are errors."""
    known = table_columns(scenario)
    if twice := [name for name, times in Counter(header).items() if times > 1]:
        raise InvalidInput(f"{where}: column {twice[0]!r} is given twice")
    for name in header:
        if name not in known:
            hint = suggestion(name, known) or f"known: {', '.join(known)}"
            separator = "; columns are separated by commas" if ";" in name or "\t" in name else ""
            raise InvalidInput(f"{where}: unknown column {name!r}; {hint}{separator}")
    for name, (field, _) in known.items():
        if field in _ALWAYS_IN_A_TABLE and name not in header:
            raise InvalidInput(f"{where}: column {name!r} is missing; {scenario.vehicles} vehicles need it")
    return [known[name] for name in header]


def _numbers(what: str, value: ArrayLike) -> Floats:
    try:
        array = np.asarray(value)
    except ValueError:
        raise InvalidInput(f"{what}: must be a number or a list of numbers") from None
    if array.dtype.kind not in "iuf":
        raise InvalidInput(f"{what} = {value!r}: must be a number or a list of numbers")
    return array.astype(np.float64)


def _read_csv(file: Path) -> tuple[list[str], list[list[str]], list[int]]:
    """Header and rows of a CSV file, unchecked, and the line on which each row begins; there is at least one row."""
    rows: list[list[str]] = []
    lines: list[int] = []
    data = read_plain(file, SIZE_LIMIT)
    try:
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        begins = 1
        for row in reader:
            rows.append(row)
            lines.append(begins)
            begins = reader.line_num + 1
    except (csv.Error, ValueError) as error:
        raise InvalidInput(f"{file}: cannot be read as CSV: {error}") from None
    while rows and not rows[-1]:
        rows.pop()  # blank lines at the end
    if not rows or not rows[0]:
        raise InvalidInput(f"{file}, line 1: must name the columns, for instance gap_1_m,gap_2_m,speed_1_mps,...")
    if len(rows) == 1:
        raise InvalidInput(f"{file}: has a header but no rows; one row is one world")
    return [name.strip() for name in rows[0]], rows[1:], lines[1:]


# The ranges of a scenario as a unit cube: one coordinate for each number that it draws.
#
# A search moves in the cube, where every point is as likely as any other and gives one world; a list is a random sample
# of it.

Place = tuple[tuple[int, ...], int]  # a stream of uniform numbers, and the column in it

_UNUSED = 0.5  # in the place of numbers that change nothing


@dataclass(frozen=True, slots=True)
class Ranges:
    """The numbers that a scenario draws: their names, and where each stands among a world's uniform numbers."""

    scenario: ScenarioFields
    names: tuple[str, ...]
    places: tuple[Place, ...]

    def sample(self, points: Floats) -> tuple[Sample, Bools]:
        """The worlds at ``points`` [n, coordinates] of [0, 1), and which of them the scenario would accept, [n].

        A scenario that rejects early impacts does not accept worlds that have one.
        """
        n, vehicles = len(points), self.scenario.vehicles
        widths = {(): BLOCK * vehicles, TYPES: PER_TYPE * vehicles, OBSTACLE: OBSTACLE_WIDTH}
        streams = {of: np.full((n, width), _UNUSED) for of, width in widths.items()}
        for (of, column), u in zip(self.places, points.T, strict=True):
            streams[of][:, column] = u
        found = make_sample(self.scenario, lambda _, of: streams[of], np.arange(n, dtype=np.int64))
        if self.scenario.early_impacts == "keep" or not self.scenario.learners:
            return found, np.ones(n, np.bool_)
        return found, ~early_impact(self.scenario, found.worlds)


def ranges_of(scenario: ScenarioFields) -> Ranges:
    """Every number that the scenario draws.

    Raises ``InvalidInput`` for a scenario that draws nothing, a mixture, and a channel whose delays are drawn: worlds
    of these cannot be given one by one.
    """
    if scenario.members:
        members = ", ".join(member.name for member in scenario.members)
        raise InvalidInput(f"scenario {scenario.name!r}: is a mixture; take one of its scenarios: {members}")
    if scenario.v2x.by_link:
        raise InvalidInput(
            f"scenario {scenario.name!r}: v2x: draws delays and losses, which no table of worlds holds; give v2x: paper"
            " (--set v2x=paper)"
        )
    found = {**_of_types(scenario), **_of_quantities(scenario)}
    if not found:
        raise InvalidInput(f"scenario {scenario.name!r}: draws nothing: all its worlds are the same")
    return Ranges(scenario, tuple(found), tuple(found.values()))


def _of_quantities(scenario: ScenarioFields) -> dict[str, Place]:
    """Name -> place of every quantity that is drawn."""
    used: list[str] = []

    def note(key: str) -> Floats:
        used.append(key)
        return np.ones((1, len(scenario.possible_quantities(key))))

    world_quantities(scenario, note)
    places: dict[str, Place] = {
        _name(key, i): ((), DECLARED[key].place(i))
        for key in used
        for i, possible in enumerate(scenario.possible_quantities(key))
        if any(not isinstance(entry, WithLoad) and _drawn(entry) for entry in possible.values())
    }
    for key in ("obstacle_gap_m", "obstacle_margin_m"):
        if getattr(scenario, key) is not None and _drawn(scenario.quantities(key)[0]):
            places[key] = (OBSTACLE, 0)
    return places


def _of_types(scenario: ScenarioFields) -> dict[str, Place]:
    """Name -> place of the type and the load of every vehicle that has several, or moves something with its load."""
    if scenario.types_of_line is None:
        return {}
    places: dict[str, Place] = {}
    keys = ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "latency_s", "speed_limit_mps")
    for i, vehicle in enumerate(scenario.vehicle_names):
        possible = [scenario.possible_quantities(key)[i] for key in keys]
        if any(len(each) > 1 for each in possible):
            places[f"{vehicle} type"] = (TYPES, PER_TYPE * i)
        if any(isinstance(entry, WithLoad) for each in possible for entry in each.values()):
            places[f"{vehicle} load"] = (TYPES, PER_TYPE * i + 1)
    return places


def _drawn(entry: object) -> bool:
    low, high = support(entry)  # type: ignore[arg-type]
    return low != high


def _name(key: str, index: int) -> str:
    owner = DECLARED[key].owner(index)
    return f"{key} of {owner}" if owner else key
