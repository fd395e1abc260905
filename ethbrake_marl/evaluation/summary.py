"""The table of results: one row per team, with means, rates and comparisons, for terminals, documents and notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, naming_extras, unknown_name
from ethbrake_marl.evaluation import statistics
from ethbrake_marl.evaluation.captions import caption, notes_of, ranges_of
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.measures import DEFAULT, HORIZON, Measure, Statistic, Values
from ethbrake_marl.evaluation.summary_row import SEES_THROUGH, SummaryRow
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, terminal_text

BASELINE = "full_brake"
FIRST_COLUMNS = ("collision_rate", "first_impact_harm", "total_harm")  # their intervals stand below the values

HEAD = {
    "Agent": "The agent that controls the vehicle. All other vehicles follow the scripts of the scenario. full_brake is"
    " the paper's non-ethical strategy (Non-E). e_v2x_bm brakes with the constant deceleration that is best in this"
    " simulation; e_v2x_bm:pairwise uses the paper's closed form, which treats the pairs as independent.",
    "Knows": "What the agent must know about the line. own sensors: its own vehicle and what its sensors see. messages:"
    " also the messages that have reached it. true state: the true states, capacities and latencies of all vehicles,"
    " even if no message contained them. true model: also masses, restitution and scripts. † marks omniscient agents:"
    " they read values that the V2X channel hides in these worlds.",
    "Decrease": "1 − (mean harm) / (mean harm of the baseline in the same worlds). Interval: delta method.",
}


class SummaryTable(list[SummaryRow]):
    """The rows of a table of results, which ``print`` and notebooks show.

    >>> import ethbrake_marl as eb
    >>> table = eb.summarise(eb.evaluate("paper-random", "full_brake,coast", episodes=3))
    >>> [row.agent for row in table], table.parameters["scenario"], table.to_json()[0]["collisions"]
    (['full_brake', 'coast'], 'paper-random', 2)

    """

    def __init__(
        self, rows: Iterable[SummaryRow], shown: Mapping[str, tuple[Measure, Statistic]], parameters: Mapping[str, Any]
    ) -> None:
        super().__init__(rows)
        self.shown = dict(shown)  # key of an estimate -> its measure and statistic
        self.parameters = dict(parameters)  # plain data: scenario, seed, times, quantities, digests, versions

    def __repr__(self) -> str:
        return f"SummaryTable({', '.join(row.agent for row in self)})"

    def __str__(self) -> str:
        return terminal_text(*self.tables())

    def _repr_html_(self) -> str:
        note = "Harm: means per world in m²/s². In brackets: 95 % intervals. Decrease: of the baseline's harm."
        sheet = replace(self.sheet(), title=caption(self.parameters).partition("; ")[0], note=note)
        names = {"Agent", *FIRST_COLUMNS, "harm_decrease_first"}
        return sheet.only(k for k, name in enumerate(sheet.names) if name in names).html()

    def columns(self) -> list[Column]:
        """Return the columns of the estimates that have a heading."""
        return [
            Column(each.heading, key, short=each.short, **_FORMATS.get(each.kind, {}))
            for key, (_, each) in self.shown.items()
            if each.heading
        ]

    def sheet(self) -> Sheet:
        """Return the table with all columns that have a heading."""
        columns = self.columns()
        rows = [
            (row.marked, f"{SEES_THROUGH} " * row.sees_through + row.knows, *(row.estimates[c.name] for c in columns))
            for row in self
        ]
        return Sheet("", ["Agent", "Knows", *columns], rows)

    def terminal(self) -> Sheet:
        """Return the table for a terminal: one that is too narrow leaves columns out, but no harm, and breaks no name.

        What was asked for stays longer than comparisons and predictions.
        """
        columns = []
        for place, column in enumerate(self.columns()):
            measure = self.shown[column.name][0]
            gives_way = 1 if column.name == "collision_rate" else 2 + place + 100 * (measure in DEFAULT)
            below = column.name in FIRST_COLUMNS
            never = below and column.name != "collision_rate"
            columns.append(
                replace(column, interval="below" if below else "hidden", gives_way=0 if never else gives_way)
            )
        rows = [(f"{row[0]}\n{row[1]}", *row[2:]) for row in self.sheet().rows]
        return Sheet("", [Column("Agent,\nwhat it knows", text=True, whole=True), *columns], rows, self._below(), gap=1)

    def measures(self) -> Sheet | None:
        """Return the table of what was asked for and has no column of its own; None without any."""
        asked = {
            key: _in_words(key, measure, "" if each.kind == "decrease" else measure.unit)
            for key, (measure, each) in self.shown.items()
            if not each.heading and measure not in DEFAULT
        }
        rows = [(row.agent, words, row.estimates[key]) for row in self for key, words in asked.items()]
        columns = [Column("Agent", text=True, whole=True), Column("Measure", text=True), Column("Mean or rate")]
        return Sheet("Measures", columns, rows, gap=1) if rows else None

    def tables(self) -> list[Sheet]:
        """Return the tables to print."""
        return [self.terminal(), *filter(None, [self.measures()])]

    def notes(self) -> list[str]:
        """Return the notes below the table."""
        return notes_of(self, self.parameters)

    def meanings(self) -> dict[str, str]:
        """Return what the columns mean: heading -> text."""
        own = {each.heading: measure.meaning for measure, each in self.shown.values() if each.heading}
        return HEAD | {name: text for name, text in own.items() if not name.startswith("Decrease")}

    def to_markdown(self) -> str:
        """Return the table as Markdown, with the texts below it."""
        return f"{self.sheet().markdown()}\n\n{self._below()}\n"

    def to_latex(self) -> str:
        """Return the table as LaTeX ``tabular`` with the rules of the package ``booktabs``."""
        return self.sheet().latex()

    def to_json(self) -> list[dict[str, Any]]:
        """Return plain data: one object per team, with the digests, versions and ``parameters`` of the result."""
        identity = {key: self.parameters[key] for key in IDENTITY if key in self.parameters}
        parameters = {key: value for key, value in self.parameters.items() if key not in IDENTITY}
        return [{"kind": "evaluate", **row.to_json(), **identity, "parameters": parameters} for row in self]

    def to_pandas(self) -> Any:
        """Return a ``DataFrame`` with one row per team; ``x_low`` and ``x_high`` are the ends of the interval of ``x``.

        A missing number is NaN. Raises ``MissingExtra`` without pandas.
        """
        with naming_extras():
            from pandas import DataFrame, Index

        table: dict[str, list[float | None]] = {}
        for key in self.shown:
            each = [row.estimates[key] for row in self]
            ends = [(None, None) if e is None or e.interval is None else e.interval for e in each]
            table |= {key: [None if e is None else e.value for e in each]}
            table |= {f"{key}_low": [low for low, _ in ends], f"{key}_high": [high for _, high in ends]}
        return DataFrame(table, index=Index([row.agent for row in self], name="agent"), dtype=float)

    def _below(self) -> str:
        worlds = (
            f"Worlds: {caption(self.parameters)}. Harms are means per world in m²/s². The 95 % interval of a value is"
            " in brackets or below the value. A decrease is relative to the baseline, by default full braking."
        )
        return "\n\n".join([worlds, *self.notes()])


IDENTITY = ("worlds_sha256", "scenario_sha256", "physics_digest", "versions")
_PERCENT: dict[str, Any] = {"digits": 1, "scale": 100.0, "unit": " %"}
_FORMATS = {"rate": _PERCENT, "decrease": _PERCENT}


def _in_words(key: str, measure: Measure, unit: str) -> str:
    stem, _, number = key.rpartition("_")
    name = f"{stem}, vehicle {number}" if number.isdecimal() and key != measure.name else key
    return f"{name} ({unit})" if unit else name


def summarise(result: Result, *, baseline: str = BASELINE) -> SummaryTable:
    """Return the table of a result, one row per team.

    ``baseline``: team that the others are compared with, paired by world. Without full braking, the default, there are
    no comparisons; any other team must be in the result (``UnknownName``).
    """
    if baseline != BASELINE and baseline not in result:
        raise unknown_name("baseline", baseline, result)
    names = dict.fromkeys(name for own in result.columns.values() for name in own)
    shown: dict[str, tuple[Measure, Statistic]] = {}
    column_of: dict[str, str] = {}
    for name in names:
        measure = result.measure_of(name)
        kinds = {own[name].dtype.kind for own in result.columns.values() if name in own}
        ending = name.removeprefix(measure.name).removeprefix("_")
        usual = Statistic(name, "rate" if kinds == {"b"} else "mean", ending=ending)
        for each in [each for each in measure.shown if each.ending == ending] or [usual]:
            if "U" not in kinds:
                shown[each.key], column_of[each.key] = (measure, each), name
    shown = dict(sorted(shown.items(), key=_place))
    named = result.clusters
    clusters = None if named is None else np.unique(named, return_inverse=True)[1]
    rows = []
    for team, own in result.columns.items():
        other = result.columns.get(baseline, {})
        estimates = {
            key: _estimate(each, own.get(column_of[key]), other.get(column_of[key]), clusters)
            for key, (_, each) in shown.items()
        }
        collisions, horizon_ends = int(own["collided"].sum()), int((own["ended"] == HORIZON).sum())
        hidden = float(result.worlds["hidden"].mean())
        knows, policies = result.knows[team], result.policies[team]
        rows.append(SummaryRow(team, knows, estimates, collisions, horizon_ends, result.n, hidden, policies))
    recordings: dict[str, int] = {} if clusters is None else {"recordings": int(clusters.max()) + 1}
    return SummaryTable(rows, shown, {**result.about, **recordings, **ranges_of(result.worlds)})


def _place(shown: tuple[str, tuple[Measure, Statistic]]) -> int:
    measure, each = shown[1]
    return 2 if measure.name == "predicted_harm" else int(each.kind in ("difference", "decrease"))


def _estimate(
    each: Statistic, values: Values | None, baseline: Values | None, clusters: NDArray[Any] | None
) -> Estimate | None:
    if values is None or (baseline is None and each.kind in ("difference", "decrease")):
        return None
    if each.kind == "rate":
        return statistics.rate(values, clusters)
    numbers = values.astype(np.float64, copy=False)
    if each.kind == "mean" or baseline is None:
        return statistics.mean(numbers, clusters)
    compare = statistics.difference if each.kind == "difference" else statistics.decrease
    return compare(numbers, baseline.astype(np.float64, copy=False), clusters)


def summarise_by(result: Result, by: str, *, baseline: str = BASELINE) -> dict[str, SummaryTable]:
    """Return one table for each group of worlds, by its name, in alphabetical order.

    ``by``: ``scenario`` of a mixture, ``recording``, or a vehicle's type such as ``vehicle_2_type``. Raises
    ``InvalidInput`` if the worlds have no groups, ``UnknownName`` for another name.
    """
    kinds = {name: each for name, each in result.worlds.items() if each.dtype.kind == "U"}
    if not kinds:
        raise InvalidInput(
            f"by = {by!r}: these worlds have no groups; worlds of a mixture can be grouped by 'scenario', worlds of a"
            " scenario with vehicle_types by 'vehicle_1_type' and so on, worlds of a table with recordings by"
            " 'recording'"
        )
    if by not in kinds:
        raise unknown_name("group", by, kinds)
    groups = {str(name): result.take(kinds[by] == name) for name in np.unique(kinds[by])}
    return {name or f"no {by}": summarise(part, baseline=baseline) for name, part in groups.items()}


def summarise_lists(tables: Mapping[str, SummaryTable], results: Mapping[str, Result]) -> Sheet:
    """Return one table of several evaluations, such as the tests of a standard: a section for each, a row per team.

    A team has passed if no vehicle collides in any world.
    """
    columns: list[Column | str] = [
        Column("Agent", "agent", text=True, whole=True), Column("Result", "result"),
        Column("Collisions", "collision_rate", **_PERCENT),
        Column("Hardest, km/h", "hardest_impact_kmh", digits=1, short="Hardest,\nkm/h"),
        Column("First-impact harm", "first_impact_harm", short="First-impact\nharm"),
        Column("Total harm", "total_harm", short="Total\nharm"),
    ]  # fmt: skip
    rows: list[Any] = []
    for name, table in tables.items():
        rows.append(name)
        for row in table:
            hardest = 3.6 * float(results[name][row.agent]["hardest_impact_mps"].max())
            means = [each.value for key in FIRST_COLUMNS if (each := row[key]) is not None]
            rows.append((row.agent, "failed" if row.collisions else "passed", means[0], hardest, *means[1:]))
    note = (
        "Passed: no vehicle collides in any world. Harm: mean per world in m²/s². Hardest: largest closing speed of any"
        " first impact."
    )
    return Sheet("", columns, rows, note)
