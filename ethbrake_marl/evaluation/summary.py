"""The table of results: one row per team, with means, rates and comparisons."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from textwrap import fill
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.counts import BUILT_IN_COUNTS, COUNTS, HONEST
from ethbrake_marl.episode.layer import MODEL, STATE
from ethbrake_marl.errors import InvalidInput, count_of, naming_extras, unknown_name
from ethbrake_marl.evaluation import statistics
from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.measures import HORIZON, PUSHED_FAR_M, Measure, MeasureValues, Statistic, usual_measures
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, flat_row, terminal_text
from ethbrake_marl.worlds.quantities import OPTIONAL, QUANTITIES

BASELINE = "full_brake"
SEES_THROUGH, EXPLOITS = "†", "‡"  # marks of teams
OUTSIDE_SHARE = 0.1  # a policy drives elsewhere if a larger share of its decisions is outside its training's range
MOVING_SHARE = 0.05  # an exploit if a vehicle still moves at the horizon in a larger share of worlds
IDENTITY = ("worlds_sha256", "scenario_sha256", "physics_digest", "versions")
COMPARE = {"difference": statistics.difference, "decrease": statistics.decrease}
_PERCENT: dict[str, Any] = {"digits": 1, "scale": 100.0, "unit": " %"}
_FORMATS = {"rate": _PERCENT, "decrease": _PERCENT}
WIDE = 30  # characters of a line about a team in a terminal
FEW = 3  # teams whose intervals fit beside each other in a terminal
FIRST_COLUMNS = (
    "collision_rate",
    *(count.column for count in BUILT_IN_COUNTS),
)  # columns whose intervals stand below the values

SYMBOLS = {
    "gaps_m": ("d", "m"), "speeds_mps": ("v", "m/s"), "braking_capacity_mps2": ("braking capacity", "m/s²"),
    "driving_capacity_mps2": ("driving capacity", "m/s²"), "latency_s": ("τ", "s"), "mass_t": ("m", "t"),
    "restitution": ("e", ""), "obstacle_gap_m": ("obstacle at", "m"), "friction": ("friction", ""),
    "grip": ("grip", ""),
    "brake_rate_mps3": ("brake rate", "m/s³"), "release_rate_mps3": ("release rate", "m/s³"),
}  # fmt: skip
STAY = "\u00a0"  # a space at which no line ends

CLUSTERS = {  # entry of parameters -> words for one, and for several
    "recordings": ("all worlds come from one recording", "recordings"),
    "different_rows": ("all worlds come from one row of the table", "different rows of the table"),
    "different_worlds": ("all worlds are equal", "different worlds"),
}

HEADINGS = {
    "Agent": "The agent that controls the vehicle. All other vehicles follow the scripts of the scenario. full_brake is"
    " the paper's non-ethical strategy (Non-E). e_v2x_bm brakes with the constant deceleration that is best in this"
    " simulation; e_v2x_bm:pairwise uses the paper's closed form, which treats the pairs as independent.",
    "Knows": "What the agent must know about the line. own sensors: its own vehicle and what its sensors see. messages:"
    " also the messages that have reached it. true state: the true states, capacities and latencies of all vehicles,"
    " even if no message contained them. true model: also masses, restitution and scripts. † marks omniscient agents:"
    " they read values that the V2X channel hides in these worlds.",
    "Decrease": "1 − (mean harm) / (mean harm of the baseline in the same worlds). Interval: delta method.",
}


@dataclass(frozen=True)
class SummaryRow:
    """Results of one team. ``row["total_harm"]`` is the estimate with this key in JSON, or None if it is not defined.

    >>> import ethbrake_marl as eb
    >>> (row,) = eb.summarise(eb.evaluate("paper-random", "full_brake", episodes=3))
    >>> row.agent, row.knows, row.collisions, round(row["total_harm"].value, 2)
    ('full_brake', 'own sensors', 2, 36.99)

    """

    agent: str
    knows: str  # what the team has to know
    estimates: Mapping[str, Estimate | None]
    collisions: int  # number of worlds with an impact
    horizon_ends: int  # number of worlds in which a vehicle still moves at the horizon
    episodes: int  # number of worlds
    hidden_share: float  # share of worlds in which the V2X channel hides something from a controlled vehicle
    drivers: Mapping[str, str]  # vehicle -> name of its agent
    policies: Mapping[str, str]  # vehicle -> SHA-256 of its policy
    remarks: Sequence[str] = ()  # other counts of harm that the team minimises

    def __getitem__(self, key: str) -> Estimate | None:
        if key not in self.estimates:
            raise unknown_name("estimate", key, self.estimates)
        return self.estimates[key]

    @property
    def sees_through(self) -> bool:
        """Whether the team is omniscient: it reads values that the V2X channel hides in these worlds."""
        return self.hidden_share > 0.0 and any(word in self.knows for word in (STATE, MODEL))

    @property
    def outside(self) -> float:
        """Share of its policies' decisions outside the range of their training; 0 if unknown."""
        share = self.estimates.get("outside")
        return 0.0 if share is None else share.value

    @property
    def is_outside(self) -> bool:
        return self.outside > OUTSIDE_SHARE

    @property
    def exploits(self) -> dict[str, str]:
        """Conduct that harm does not count, in words: ``pushes`` Vehicle 1 far, ``moving`` at the horizon."""
        pushed, moving = self.estimates.get("pushed_m_1"), self.horizon_ends / self.episodes
        words = {}
        if pushed is not None and pushed.value > PUSHED_FAR_M:
            words["pushes"] = f"pushes Vehicle 1 by {pushed.value:.1f} m on average"
        if moving > MOVING_SHARE:
            words["moving"] = f"runs past the horizon in {100 * moving:.1f} % of worlds"
        return words

    @property
    def marked(self) -> str:
        return f"{self.agent} {EXPLOITS}" if self.exploits else self.agent

    @property
    def about(self) -> str:
        """What the team knows, with † if it is omniscient; its other counts of harm; who drives which vehicle."""
        mixed = len({*self.drivers.values()}) > 1
        drivers = [f"{vehicle}: {agent}" for vehicle, agent in self.drivers.items() if mixed]
        return "; ".join([f"{SEES_THROUGH} " * self.sees_through + self.knows, *self.remarks, *drivers])

    def to_json(self) -> dict[str, Any]:
        """Row as plain data: each estimate with interval, standard error and degrees of freedom; None if unknown."""
        plain: dict[str, Any] = {
            "agent": self.agent, "knows": self.knows, "sees_through_channel": self.sees_through,
            "hidden_share": self.hidden_share, "episodes": self.episodes, "collisions": self.collisions,
            "horizon_ends": self.horizon_ends, "exploits": list(self.exploits),
            "drivers": dict(self.drivers), "remarks": [*self.remarks],
        }  # fmt: skip
        for key, estimate in self.estimates.items():
            plain |= Estimate.side_by_side({key: estimate})
            plain[f"{key}_error"] = None if estimate is None else estimate.error
            plain[f"{key}_freedom"] = None if estimate is None else estimate.freedom
        return plain | {"policy_sha256": dict(self.policies)}


class SummaryTable(list[SummaryRow]):
    """The table of results. ``print`` shows it; ``to_pandas`` is for notebooks and documents.

    >>> import ethbrake_marl as eb
    >>> table = eb.summarise(eb.evaluate("paper-random", "full_brake,coast", episodes=3))
    >>> [row.agent for row in table], table.parameters["scenario"], table.to_json()[0]["collisions"]
    (['full_brake', 'coast'], 'paper-random', 2)
    """

    def __init__(
        self,
        rows: Iterable[SummaryRow],
        statistics: Mapping[str, tuple[Measure, Statistic]],
        parameters: Mapping[str, Any],
    ) -> None:
        super().__init__(rows)
        self.statistics = dict(statistics)  # key of an estimate -> its measure and statistic
        self.parameters = dict(parameters)  # plain data: scenario, seed, times, quantities, digests, versions

    def __repr__(self) -> str:
        return f"SummaryTable({', '.join(row.agent for row in self)})"

    def __str__(self) -> str:
        return terminal_text(*self.tables())

    @property
    def heading(self) -> str:
        """Which count of harm the agents minimise; "" if the result does not say it."""
        name = self.parameters.get("agent_settings", {}).get("harm_count")
        words = COUNTS[name].words if name in COUNTS else name
        return f"Agents minimise {words}" if words else ""

    def sheet(self) -> Sheet:
        """Table with all columns that have a heading."""
        columns = [
            Column(statistic.heading, key, short=statistic.short, **_FORMATS.get(statistic.kind, {}))
            for key, (_, statistic) in self.statistics.items()
            if statistic.heading
        ]
        rows = [(row.marked, row.about, *(row.estimates[c.name] for c in columns)) for row in self]
        return Sheet(self.heading, ["Agent", "Knows", *columns], rows)

    def terminal(self) -> Sheet:
        """Table for a terminal; only the first columns have intervals."""
        sheet, agent = self.sheet(), Column("Agent,\nwhat it knows", text=True)
        columns = [
            replace(column, interval="below" if column.name in FIRST_COLUMNS else "hidden")
            for column in sheet.columns[2:]
            if isinstance(column, Column)
        ]
        rows = []
        for name, about, *cells in map(list, sheet.rows):
            rows.append(("\n".join([name, *(fill(part, WIDE) for part in about.split("; "))]), *cells))
        first = [column for column in columns if column.name in FIRST_COLUMNS]
        return Sheet(self.heading, [agent, *columns], rows, self._below(), gap=1, keep=1 + len(first))

    def measures(self) -> Sheet | None:
        """Table of the measures without a column in the main table; None if there are none.

        Vehicles whose values are equal under every team share a row.
        """
        keys: dict[tuple[Any, ...], list[str]] = {}  # measure, unit and a cell for each team -> keys of estimates
        for key, (measure, statistic) in self.statistics.items():
            if not statistic.heading and measure not in usual_measures():
                unit = f" ({measure.unit})" if measure.unit and statistic.kind != "decrease" else ""
                keys.setdefault((measure.name, unit, *(row.estimates[key] for row in self)), []).append(key)
        rows = [
            (", ".join([first, *(key.removeprefix(name) for key in others)]) + unit, *cells)
            for (name, unit, *cells), [first, *others] in keys.items()
        ]
        few = len(self) <= FEW
        interval: Literal["below", "hidden"] = "below" if few else "hidden"
        columns = [Column(row.agent, short=fill(row.agent, 16 if few else 10), interval=interval) for row in self]
        return Sheet("Means or rates of further measures", ["Measure", *columns], rows, gap=1) if rows else None

    def tables(self) -> list[Sheet]:
        return [self.terminal(), *filter(None, [self.measures()])]

    def notes(self) -> list[str]:
        """Warnings: rejected worlds, exploits, policies outside their training, hidden values."""
        notes, rejected = [], self.parameters.get("rejected_draws", 0)
        if rejected:
            draws = rejected + self.parameters["count"]
            notes.append(
                f"{rejected:,} of {draws:,} drawn worlds ({100.0 * rejected / draws:.1f} %) were rejected and drawn"
                " again, because an impact happened before a learner could act (early_impacts: reject). These results"
                " do not apply to such worlds."
            )
        exploits = [f"{row.agent} {' and '.join(row.exploits.values())}" for row in self if row.exploits]
        if exploits:
            notes.append(f"{EXPLOITS} Harm does not count this: {'; '.join(exploits)} (docs/train.md).")
        elsewhere = [f"{row.agent} in {100 * row.outside:.0f} %" for row in self if row.is_outside]
        if elsewhere:
            notes.append(
                "Share of decisions with observations outside the range of the policy's training:"
                f" {'; '.join(elsewhere)}. There a policy may be worse than full braking"
                " (docs/reference/policies.md)."
            )
        through = [row.agent for row in self if row.sees_through]
        if through:
            notes.append(
                f"{SEES_THROUGH} In {100 * self[0].hidden_share:.1f} % of these worlds the V2X channel hides something"
                f" from a controlled vehicle at its first decision. {', '.join(through)}: reads hidden values"
                " nevertheless (omniscient). No vehicle with this channel could do so; use the result as a limit to"
                " compare with."
            )
        return notes

    def meanings(self) -> dict[str, str]:
        """Heading of a column, or name of a measure without one -> meaning."""
        texts = {
            statistic.heading: statistic.meaning or measure.meaning
            for measure, statistic in self.statistics.values()
            if statistic.heading
        }
        for measure, statistic in self.statistics.values():
            if not statistic.heading and measure not in usual_measures():
                texts[measure.name] = measure.meaning
        return HEADINGS | {
            name: text.replace("``", "") for name, text in texts.items() if not name.startswith("Decrease")
        }

    def to_json(self) -> list[dict[str, Any]]:
        """One JSON object per team, with the result's digests, versions and ``parameters``."""
        identity = {key: self.parameters[key] for key in IDENTITY if key in self.parameters}
        parameters = {key: value for key, value in self.parameters.items() if key not in IDENTITY}
        return [{"kind": "evaluate", **row.to_json(), **identity, "parameters": parameters} for row in self]

    def to_pandas(self) -> Any:
        """``DataFrame`` with one row per team; ``x_low`` and ``x_high`` are the ends of ``x``. ``MissingExtra`` without
        pandas.
        """
        with naming_extras():
            from pandas import DataFrame

        rows = [{"agent": row.agent, **flat_row(Estimate.side_by_side(row.estimates))} for row in self]
        return DataFrame(rows).set_index("agent").astype(float)

    def _below(self) -> str:
        worlds = (
            f"Worlds: {caption(self.parameters)}. Harms are means per world in m²/s². The 95 % interval of a value is"
            " in brackets or below the value."
        )
        compared = [key for key, (_, statistic) in self.statistics.items() if statistic.kind in COMPARE]
        if any(row[key] is not None for row in self for key in compared):
            worlds += " A decrease is relative to the baseline, by default full braking."
        return "\n\n".join([worlds, *self.notes()])


def summarise(result: Result, *, baseline: str = BASELINE) -> SummaryTable:
    """Table of a result, one row per team, each compared with the ``baseline``, paired by world.

    Without full braking, the default, there are no comparisons; another missing team raises ``UnknownName``.
    """
    if baseline != BASELINE and baseline not in result:
        raise unknown_name("baseline", baseline, result)
    named = result.clusters
    clusters = None if named is None else np.unique(named, return_inverse=True)[1]
    table_entries, columns = _statistics_of(result), result.columns
    rows = [
        SummaryRow(
            team,
            result.knows[team],
            {
                key: _estimate(statistic, team_columns.get(column), columns.get(baseline, {}).get(column), clusters)
                for key, (column, _, statistic) in table_entries.items()
            },
            collisions=int(team_columns["collided"].sum()),
            horizon_ends=int((team_columns["ended"] == HORIZON).sum()),
            episodes=result.n,
            hidden_share=float(result.worlds["hidden"].mean()),
            drivers=result.drivers[team],
            policies=result.policies[team],
            remarks=result.remarks[team],
        )
        for team, team_columns in columns.items()
    ]
    meant = {key: (measure, statistic) for key, (_, measure, statistic) in table_entries.items()}
    return SummaryTable(rows, meant, {**result.about, **result.independent, **ranges_of(result.worlds)})


def _statistics_of(result: Result) -> dict[str, tuple[str, Measure, Statistic]]:
    """Statistics of a table, key -> column, measure and statistic; comparisons and predictions come last."""
    entries: dict[str, tuple[str, Measure, Statistic]] = {}
    kinds = {
        name: column.dtype.kind for team_columns in result.columns.values() for name, column in team_columns.items()
    }
    for name, kind in kinds.items():
        measure = result.measure_of(name)
        ending = name.removeprefix(measure.name).removeprefix("_")
        declared = [statistic for statistic in measure.all_statistics() if statistic.ending == ending]
        for statistic in declared or [Statistic(name, "rate" if kind == "b" else "mean")]:
            if kind != "U":
                entries[statistic.key] = name, measure, statistic
    return dict(sorted(entries.items(), key=_sort_position))


def _sort_position(entry: tuple[str, tuple[str, Measure, Statistic]]) -> int:
    _, measure, statistic = entry[1]
    return 2 if measure.name == "predicted_harm" else int(statistic.kind in COMPARE)


def _estimate(
    statistic: Statistic, values: MeasureValues | None, baseline: MeasureValues | None, clusters: NDArray[Any] | None
) -> Estimate | None:
    """Estimate of a statistic from the columns of team and baseline, [n]; None if one of them is missing."""
    if values is None or (statistic.kind in COMPARE and baseline is None):
        return None
    if statistic.kind == "rate":
        return statistics.rate(values, clusters)
    numbers = values.astype(np.float64, copy=False)
    if statistic.kind == "worst":
        return statistics.worst(numbers, clusters)
    if statistic.kind == "mean" or baseline is None:
        return statistics.mean(numbers, clusters)
    return COMPARE[statistic.kind](numbers, baseline.astype(np.float64, copy=False), clusters)


def summarise_by(result: Result, by: str, *, baseline: str = BASELINE) -> dict[str, SummaryTable]:
    """One table for each group of worlds, in alphabetical order.

    ``by``: ``scenario`` (in a mixture), ``recording``, a vehicle's type such as ``vehicle_2_type``, or a label
    (``worlds_from_table``). Raises ``InvalidInput`` without groups, ``UnknownName`` for none of these.
    """
    kinds = {name: column for name, column in result.worlds.items() if column.dtype.kind == "U"}
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
    """One table of several evaluations, such as the tests of a standard: a section for each. No impact: passed."""
    columns: list[Column | str] = [
        Column("Agent", "agent", text=True), Column("Result", "result"),
        Column("Collisions", "collision_rate", **_PERCENT),
        Column("Hardest, km/h", "hardest_impact_kmh", digits=1, short="Hardest,\nkm/h"),
        Column("First-impact harm", "first_impact_harm", short="First-impact\nharm"),
        Column("Total harm", "total_harm", short="Total\nharm"),
    ]  # fmt: skip
    keys = [key for key in FIRST_COLUMNS if all(key in table.statistics for table in tables.values())]
    rows: list[Any] = []
    if HONEST.column in keys:
        columns.append(Column("Honest cost", HONEST.column, short="Honest\ncost"))
    for name, table in tables.items():
        rows.append(name)
        for row in table:
            hardest = 3.6 * float(results[name][row.agent]["hardest_impact_mps"].max())
            means = [estimate.value for key in keys if (estimate := row[key]) is not None]
            rows.append((row.agent, "failed" if row.collisions else "passed", means[0], hardest, *means[1:]))
    note = (
        "Passed: no vehicle collides in any world. Harm: mean per world in m²/s². Hardest: largest closing speed of any"
        " first impact."
    )
    elsewhere = [f"{row.agent} in {name}" for name, table in tables.items() for row in table if row.is_outside]
    if elsewhere:
        note += f" More than 10 % of its decisions are outside the range of its training: {', '.join(elsewhere)}."
    return Sheet(next(iter(tables.values())).heading, columns, rows, note)


def ranges_of(worlds: Mapping[str, Any]) -> dict[str, Any]:
    """Quantities of worlds, key -> value, or ``[smallest, largest]`` if they differ; a list for each vehicle or pair.

    ``worlds``: columns, name -> [n]. A column without any number is left out.
    """
    ranges: dict[str, Any] = {}
    for key, rule in QUANTITIES.items():
        names = [name for i in range(len(worlds)) if (name := rule.column_of(i)) in worlds] if rule.column else []
        columns = [worlds[name] for name in dict.fromkeys(names) if not np.isnan(worlds[name]).all()]
        ends = [[float(np.nanmin(column)), float(np.nanmax(column))] for column in columns]
        plain = [low if low == high else [low, high] for low, high in ends]
        if plain:
            ranges[key] = plain[0] if rule.per == "world" else plain
    return ranges


def caption(parameters: Mapping[str, Any]) -> str:
    """One line about the worlds, from ``SummaryTable.parameters``."""
    parts = []
    for key in (*SYMBOLS, *(key for key in OPTIONAL if key not in SYMBOLS)):
        if key in parameters:
            symbol, unit = SYMBOLS.get(key, (key, ""))
            entries = [parameters[key]] if QUANTITIES[key].per == "world" else parameters[key]
            texts = [f"{e[0]:.3g}–{e[1]:.3g}" if isinstance(e, list) else f"{e:.4g}" for e in entries]
            value = texts[0] if len(set(texts)) == 1 else f"({f',{STAY}'.join(texts)})"
            parts.append(f"{symbol}{STAY}={STAY}{value}{f'{STAY}{unit}' if unit else ''}")
    seed = "" if parameters.get("seed") is None else f", seed {parameters['seed']}"
    worlds = f"{count_of(parameters['count'], 'world')}{seed}{on_what_intervals_rest(parameters)}"
    physics = f" (physics: {parameters['physics']})" if "physics" in parameters else ""
    return f"{parameters['scenario']}{physics}: {worlds}; {'; '.join(parts)}"


def on_what_intervals_rest(parameters: Mapping[str, Any]) -> str:
    """End of a caption; empty if all worlds are independent."""
    for key, (one, several) in CLUSTERS.items():
        if key in parameters:
            count = parameters[key]
            return f"; no 95 % intervals: {one}" if count == 1 else f"; 95 % intervals by {count:,} {several}"
    return ""
