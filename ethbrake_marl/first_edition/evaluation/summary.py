"""Results table of an evaluation, with one row per agent, for a terminal, a document or a notebook."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ethbrake_marl.errors import count_of, naming_extras
from ethbrake_marl.files.sheet import Column, Row, Sheet, Shown, terminal_text
from ethbrake_marl.first_edition.agents.protocol import Knowledge
from ethbrake_marl.first_edition.evaluation.agent_tally import AgentTally, estimate_all, lower_bounds, tally_agents
from ethbrake_marl.first_edition.evaluation.conditions import Conditions
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.identity import result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.first_edition.evaluation.measure_sets import (
    BASELINE,
    EPISODE,
    MEASURE_SETS,
    contexts_of,
    every_set,
    measures,
)
from ethbrake_marl.first_edition.evaluation.notes import SEES_THROUGH, Note, notes_of, warnings_of
from ethbrake_marl.first_edition.evaluation.outcome import COLUMN
from ethbrake_marl.first_edition.evaluation.own_measures import heading_of, registered_measure
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow

_HEAD = {
    "Agent": "The agent that controls the vehicle. All other vehicles follow the scripts of the scenario. full_brake is"
    " the paper's non-ethical strategy (Non-E). e_v2x_bm brakes with the constant deceleration that is best in this"
    " simulation; e_v2x_bm:pairwise uses the paper's closed form, which treats the pairs as independent.",
    "Knows": "What the agent must know about the line. own sensors: its own vehicle and what its sensors see. messages:"
    " also the messages that have reached it. true state: the true states, capacities and latencies of all vehicles,"
    " even if no message contained them. true model: also masses, restitution and scripts, so that the agent can"
    " simulate the line. For a policy behind a shield or +search, the knowledge of both is listed. † marks omniscient"
    " agents: they read values that the V2X channel hides in these worlds.",
}

# Measures that a narrow terminal always shows. It also shows ``narrow`` of the last set of measures that has values.
_ALWAYS_SHOWN = ("collision_rate", "first_impact_harm", "total_harm", "sampled_harm", "vehicle_1_shoved_m")

_BELOW = ("collision_rate", "first_impact_harm", "total_harm")  # measures whose intervals a terminal shows


@dataclass(frozen=True, slots=True)
class RowsBeside:
    """Rows from another source, such as the paper, to print below the rows of the evaluated agents."""

    # A row is a pair (name, texts of the cells by the measure's name). A plain text is the heading of the next rows.
    rows: Sequence[str | tuple[str, Mapping[str, str]]]
    notes: Sequence[Note]  # notes about these rows, to print below the table


class SummaryTable(list[SummaryRow]):
    """List with one row per agent, which ``print`` and notebooks show as a results table.

    Args:
        rows: one row per agent.
        beside: rows from another source, such as the paper, printed below the rows of the agents.

    >>> import ethbrake_marl.first_edition as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> isinstance(rows, eb.SummaryTable), len(rows)
    (True, 1)

    """

    def __init__(self, rows: Iterable[SummaryRow] = (), beside: RowsBeside | None = None) -> None:
        super().__init__(rows)
        self.beside = beside

    def __repr__(self) -> str:
        return f"SummaryTable({', '.join(row.agent for row in self)})"

    def __str__(self) -> str:
        return terminal_text(*self.tables())

    def _repr_html_(self) -> str:
        note = "Harm: means per world in m²/s². In brackets: 95 % intervals. Decrease: of full braking's harm."
        note += "".join(f" {warning}" for warning in warnings_of(self))
        conditions = self[0].parameters if self else Conditions()
        worlds = (
            f"{conditions['scenario']}, {count_of(self[0].episodes, 'world')}{conditions.by_recording}"
            if self
            else "no agent"
        )
        sheet = replace(SummaryTable(self).sheet(), title=worlds, note=note)
        shown = {"Agent", "Knows"}.union(*(each.notebook for _, each in every_set()))
        return sheet.only(k for k, name in enumerate(sheet.names) if name in shown).html()

    def meanings(self) -> dict[str, str]:
        """Return the explanations of the columns: heading of the column -> text.

        Columns whose headings agree up to a comma, such as "Decrease, total" and "Decrease, first-impact", have one
        common explanation under the heading "Decrease". Measures that the user registered come last.
        """
        about = {each.heading.partition(",")[0]: each.about for each in measures() if each.about and each.heading}
        own = [registered_measure(column) for column in self[0].metrics] if self else []
        return _HEAD | about | {metric.name: metric.meaning for metric in own if metric is not None}

    def sheet(self) -> Sheet:
        """Return the table with all columns: agent, its knowledge, and every measure that has a heading.

        The columns of measures that the user registered come last. Means that are lower bounds of the true means
        (``SummaryRow.bounds``) are marked ``≥``.
        """
        columns = [each.column() for each in measures() if each.heading]
        columns += [Column(heading_of(name), COLUMN + name) for name in (self[0].metrics if self else ())]
        bounded = {m.name for _, each in every_set() if each.whole for m in each.measures if not m.against}
        lines: list[Row] = []
        for row in self:
            cells: list[Any] = []
            for column in columns:
                cell: Any = row[column.name]
                if column.name in bounded:
                    value, interval = column.show(cell)
                    cell = Shown(f"≥ {value}" if column.name in row.bounds else value, interval)
                cells.append(cell)
            lines.append((row.marked, SEES_THROUGH * row.sees_through + row.knows.text, *cells))
        for other in self.beside.rows if self and self.beside else ():
            if isinstance(other, str):
                lines.append(other)
            else:
                name, texts = other
                lines.append((name, None, *(texts.get(column.name) for column in columns)))
        return Sheet("", ["Agent", "Knows", *columns], lines)

    def terminal(self) -> Sheet:
        """Return the table for a terminal of at least 80 characters, with the same text below as in ``markdown``."""
        narrow = self._narrow()
        columns = [
            replace(each, wide=each.name not in narrow, interval="below" if each.name in _BELOW else "hidden")
            for each in (measure.column() for measure in measures() if measure.heading)
        ]
        lines: list[Row] = []
        for row in self.sheet().rows:
            if not isinstance(row, str):
                row = (row[0] if row[1] is None else f"{row[0]}\n{row[1]}", *row[2 : 2 + len(columns)])
            lines.append(row)
        return Sheet("", [Column("Agent,\nwhat it knows", text=True), *columns], lines, self._conditions(), gap=1)

    def _narrow(self) -> tuple[str, ...]:
        """Return the names of the measures that a narrow terminal shows."""
        last: tuple[str, ...] = EPISODE.narrow
        for _, each in every_set():
            if self and any(self[0].estimates.get(name) is not None for name in each.narrow):
                last = each.narrow
        return (*_ALWAYS_SHOWN, *last)

    def tables(self) -> list[Sheet]:
        """Return the tables to print: ``terminal()`` and, if there are any, a table of the user's measures."""
        lines = [(row.agent, heading_of(column), value) for row in self for column, value in row.metrics.items()]
        own = Sheet("Measures", ["Agent", Column("Measure", text=True), Column("Mean or rate")], lines)
        return [self.terminal(), own] if lines else [self.terminal()]

    def markdown(self) -> str:
        """Return the table as Markdown, followed by a text about the worlds, the intervals and other notes."""
        return f"{self.sheet().markdown()}\n\n{self._conditions()}\n"

    def _conditions(self) -> str:
        if not self:
            return ""
        ours = (
            f"Worlds: {self[0].parameters.line}. Harms are means per world in m²/s². The 95 % interval of a value is in"
            " brackets or below the value. A decrease is relative to the baseline, by default full braking."
        )
        return "\n\n".join([ours, *(text for _, text in self.notes())])

    def to_pandas(self) -> Any:
        """Return a pandas ``DataFrame`` with one row per agent; the index is the agent's name.

        The columns are the measures of the JSON results, with the same names and units; ``x_low`` and ``x_high`` are
        the ends of the 95 % interval of measure ``x``. A missing number is NaN. Raises ``MissingExtra`` if pandas is
        not installed.
        """
        with naming_extras():
            from pandas import DataFrame, Index

        columns: dict[str, list[float | None]] = {}
        for row in self:
            for name, each in row.estimates.items():
                low, high = (None if each is None else each.interval) or (None, None)
                columns.setdefault(name, []).append(None if each is None else each.value)
                columns.setdefault(f"{name}_low", []).append(low)
                columns.setdefault(f"{name}_high", []).append(high)
        return DataFrame(columns, index=Index([row.agent for row in self], name="agent"), dtype=float)

    def notes(self) -> list[Note]:
        """Return the notes to print below the table: first about the agents, then about the rows ``beside``.

        A note is a pair: its kind (``note``, or ``quiet`` for a less prominent note) and its text.
        """
        return [*notes_of(self), *(self.beside.notes if self and self.beside else ())]


def summarise(evaluation: Evaluation, *, baseline: str = BASELINE) -> SummaryTable:
    """Return the results table of an evaluation: one row per agent, in the order of the evaluation.

    Args:
        evaluation: outcomes of the agents, from ``evaluate``.
        baseline: name of the agent with which the others are compared. If it was not evaluated, the table has no
            comparisons.

    """
    contexts = contexts_of(evaluation)
    return summarise_sums(
        tally_agents(evaluation.outcomes, contexts, baseline=baseline, clusters=evaluation.clusters),
        evaluation.conditions,
        contexts,
        baseline=baseline,
        knows={name: outcome.knows for name, outcome in evaluation.outcomes.items()},
        policies={name: outcome.policies for name, outcome in evaluation.outcomes.items()},
        left_out=evaluation.left_out,
        hidden_share=float(evaluation.hidden.mean()),
        worlds_sha256=worlds_sha256(evaluation.worlds, evaluation.index),
        scenario_sha256=scenario_sha256(evaluation.scenario),
        versions=result_versions(),
    )


def summarise_sums(
    tallies: Mapping[str, AgentTally],
    conditions: Conditions,
    contexts: Mapping[str, Any],
    *,
    knows: Mapping[str, Knowledge],
    policies: Mapping[str, Mapping[str, str]],
    baseline: str = BASELINE,
    **shared: Any,
) -> SummaryTable:
    """Return the results table, one row per agent, computed from sums of the measures over all worlds.

    ``tallies``, ``knows`` and ``policies`` (``SummaryRow.policy_sha256``) are by the agent's name, ``contexts`` by the
    set of measures (``contexts_of``). ``shared`` are the fields of ``SummaryRow`` that are equal in all rows, such as
    ``worlds_sha256``.
    """
    worlds = conditions["count"]
    return SummaryTable(
        SummaryRow(
            agent=agent,
            episodes=worlds,
            estimates=estimate_all(tallies, agent, worlds, baseline=baseline),
            collisions=tally.count("collision_rate"),
            horizon_ends=tally.count("horizon_ends"),
            parameters=conditions,
            policy_share=tally.share("policy_share", worlds),
            more={name: each.row(tally, worlds, contexts.get(name)) for name, each in MEASURE_SETS.items()},
            bounds=lower_bounds(tally, worlds),
            knows=knows[agent],
            policy_sha256=policies[agent],
            **shared,
        )
        for agent, tally in tallies.items()
    )
