"""The table of an evaluation: a row per agent, for a terminal and for a document, and the sentences below it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ethbrake_marl.agents.protocol import Knowledge, Source
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.agent_tally import AgentTally, estimate_all, lower_bounds, tally_agents
from ethbrake_marl.evaluation.conditions import Conditions
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.exploits import MARK, Exploits
from ethbrake_marl.evaluation.identity import result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.evaluation.measures import (
    BASELINE,
    EPISODE,
    MEASURE_SETS,
    MeasureSet,
    RegisteredMeasures,
    contexts_of,
    every_set,
    measures,
)
from ethbrake_marl.evaluation.outcome import COLUMN, UNSTATED, LeftOut
from ethbrake_marl.evaluation.own_measures import heading_of, registered_measure
from ethbrake_marl.files.sheet import Column, Estimate, Row, Sheet, Shown, terminal_text

SEES_THROUGH = "† "  # before what an agent knows that no channel brought

_HEAD = {
    "Agent": "What drives the controlled vehicle; all other vehicles follow the scenario. full_brake is the paper's"
    " non-ethical strategy (Non-E). e_v2x_bm is the best constant deceleration found in this simulation;"
    " e_v2x_bm:pairwise is the paper's closed form, which treats the pairs as independent.",
    "Knows": "What the agent has to know of the line. own sensors: its own vehicle and what its sensors see. messages:"
    " also the messages that have reached it. true state: the others' states, capacities and latencies as they are,"
    " received or not. true model: also masses, restitution and scripts, enough to simulate the line ahead. Of a policy"
    " behind a shield or +search both parts are told. † marks agents that see through a channel that hides"
    " something here.",
}

_ALWAYS_SHOWN = (
    "collision_rate",
    "first_impact_harm",
    "total_harm",
    "sampled_harm",
    "vehicle_1_shoved_m",
)  # narrow too

_BELOW = ("collision_rate", "first_impact_harm", "total_harm")  # a terminal shows their intervals; JSON has all


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """What one agent achieved over the list of worlds; harms are means per world, m2/s2.

    ``row["harm_decrease_total"]`` is the estimate of any measure, by its name in JSON; None where it does not exist.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {name: eb.make_agent(name) for name in ("full_brake", "coast")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> rows[0].agent, rows[0].collisions, round(rows[0].total_harm.value, 2), rows[0]["predicted_harm"]
    ('full_brake', 2, 36.99, None)

    """

    agent: str  # its name
    episodes: int  # worlds
    estimates: Mapping[str, Estimate | None]  # of every measure, by its name in JSON
    collisions: int  # worlds with at least one impact
    horizon_ends: int  # worlds that the horizon cut off before the line stood
    parameters: Conditions  # of the test
    policy_share: float | None = None  # share of worlds in which a hybrid drove by its policy
    more: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # fields of sets of measures, by set
    bounds: frozenset[str] = frozenset()  # measures whose means are lower bounds
    left_out: tuple[LeftOut, ...] = ()  # worlds of the list that no row counts: they could not be advanced
    knows: Knowledge = UNSTATED  # what the agent says it knows of the line
    hidden_share: float = 0.0  # worlds in which the channel hides something from a driven vehicle, whoever drives
    worlds_sha256: str = ""  # of the list; results on the same worlds have the same
    scenario_sha256: str = ""  # of all that shapes an episode
    policy_sha256: Mapping[str, str] = field(default_factory=dict)  # vehicle -> its policy's, where one drives
    versions: Mapping[str, str] = field(default_factory=dict)  # of what computed it

    def __getitem__(self, measure: str) -> Estimate | None:
        return self.estimates[measure]

    @property
    def collision_rate(self) -> Estimate:
        """Share of worlds."""
        return self.estimates["collision_rate"]  # type: ignore[return-value]  # every agent has it in every world

    @property
    def first_impact_harm(self) -> Estimate:
        """Each pair's first impact."""
        return self.estimates["first_impact_harm"]  # type: ignore[return-value]  # all have it in all worlds

    @property
    def total_harm(self) -> Estimate:
        """Every impact."""
        return self.estimates["total_harm"]  # type: ignore[return-value]  # all have it in all worlds

    @property
    def metrics(self) -> dict[str, Estimate]:
        """Registered measures, by column."""
        found = {name.removeprefix(COLUMN): each for name, each in self.estimates.items() if name.startswith(COLUMN)}
        return {name: each for name, each in found.items() if each is not None}

    @property
    def sees_through(self) -> bool:
        """Whether the channel hides something here that this agent reads all the same."""
        return self.hidden_share > 0.0 and self.knows.sees_through

    @property
    def exploits(self) -> Exploits:
        """What it does that harm does not count."""
        shoved = self.estimates["vehicle_1_shoved_m"]
        return Exploits(None if shoved is None else shoved.value, self.horizon_ends / self.episodes)

    @property
    def marked(self) -> str:
        """Its agent, marked where it exploits what harm does not count."""
        return f"{self.agent} {MARK}" if self.exploits.names else self.agent

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON; what does not exist is null, intervals are ``[low, high]``."""
        registered = RegisteredMeasures(n.removeprefix(COLUMN) for n in self.estimates if n.startswith(COLUMN))
        more: dict[str, Any] = {}
        for name, each in MEASURE_SETS.items():
            more |= self._estimates_of(each) | self.more.get(name, {})
        return {
            "kind": "evaluate",
            "agent": self.agent,
            "knows": self.knows.text,
            "sees_through_channel": self.sees_through,
            "hidden_share": self.hidden_share,
            "episodes": self.episodes,
            "collisions": self.collisions,
            "horizon_ends": self.horizon_ends,
            "exploits": list(self.exploits.names),
            **self._estimates_of(EPISODE),
            **self._estimates_of(registered),
            **({"policy_share": self.policy_share} if self.policy_share is not None else {}),
            **more,
            "left_out": [left._asdict() for left in self.left_out],
            "worlds_sha256": self.worlds_sha256,
            "scenario_sha256": self.scenario_sha256,
            "policy_sha256": dict(self.policy_sha256),
            "versions": dict(self.versions),
            **({"metrics": {name: heading_of(name) for name in self.metrics}} if self.metrics else {}),
            "parameters": self.parameters,
        }

    def _estimates_of(self, of: MeasureSet) -> dict[str, Any]:
        """The estimates of one set, side by side."""
        there = {m.name: self.estimates[m.name] for m in of.measures if m.name in self.estimates}
        optional = {measure.name for measure in of.measures if not measure.always}
        return Estimate.side_by_side({name: each for name, each in there.items() if each or name not in optional})


@dataclass(frozen=True, slots=True)
class RowsBeside:
    """Printed rows of another source that stand below a table of ours, and what must be said of them.

    A row is a name and texts by measure; a text alone begins a section.
    """

    rows: Sequence[str | tuple[str, Mapping[str, str]]]
    notes: Sequence[tuple[str, str]]  # as ``SummaryTable.notes``


class SummaryTable(list[SummaryRow]):
    """The rows of ``summarise``: a list that ``print`` and a notebook show as a table.

    >>> import ethbrake_marl as eb
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
        note += "".join(f" {warning}" for warning in self._warnings())
        worlds = f"{self[0].parameters['scenario']}, {count_of(self[0].episodes, 'world')}" if self else "no agent"
        sheet = replace(SummaryTable(self).sheet(), title=worlds, note=note)
        shown = {"Agent", "Knows"}.union(*(each.notebook for _, each in every_set()))
        return sheet.only(k for k, name in enumerate(sheet.names) if name in shown).html()

    @classmethod
    def of_tallies(
        cls,
        tallies: Mapping[str, AgentTally],
        conditions: Conditions,
        contexts: Mapping[str, Any],
        knows: Mapping[str, Knowledge],
        policies: Mapping[str, Mapping[str, str]],
        *,
        baseline: str = BASELINE,
        **shared: Any,
    ) -> SummaryTable:
        """One row per agent, from what was counted in the worlds of a list.

        Args:
            tallies: of every agent.
            conditions: of the test.
            contexts: what each set of measures knows of the worlds.
            knows: by agent.
            policies: by agent: vehicle's name -> SHA-256 of its policy.
            baseline: what is compared with.
            shared: what is the same in all rows.

        """
        worlds = conditions["count"]
        return cls(
            SummaryRow(
                agent=agent,
                episodes=worlds,
                estimates=estimate_all(tallies, agent, worlds, baseline=baseline),
                collisions=tally.count("collision_rate"),
                horizon_ends=tally.count("horizon_ends"),
                policy_share=tally.share("policy_share", worlds),
                more={name: each.row(tally, worlds, contexts.get(name)) for name, each in MEASURE_SETS.items()},
                bounds=lower_bounds(tally, worlds),
                knows=knows[agent],
                policy_sha256=policies[agent],
                parameters=conditions,
                **shared,
            )
            for agent, tally in tallies.items()
        )

    def meanings(self) -> dict[str, str]:
        """What the columns mean, by the beginning of their headings; those of registered measures last."""
        about = {each.heading.partition(",")[0]: each.about for each in measures() if each.about and each.heading}
        own = [registered_measure(column) for column in self[0].metrics] if self else []
        return _HEAD | about | {metric.name: metric.about for metric in own if metric is not None}

    def sheet(self) -> Sheet:
        """The table: agent, what it knows, and every measure that has a heading, registered measures last.

        Where a set of measures holds in some of the worlds alone, its means are marked as lower bounds. Rows of other
        sources stand below.
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
        """The table for a terminal of 80 columns or more: our rows, rows beside them, then the conditions of each."""
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
        """Columns of a narrow terminal: the usual ones, and those of the last set that has values for them."""
        last = EPISODE.narrow
        for _, each in every_set():
            if self and any(self[0].estimates.get(name) is not None for name in each.narrow):
                last = each.narrow
        return (*_ALWAYS_SHOWN, *last)

    def tables(self) -> list[Sheet]:
        """``terminal``, and below it the registered measures: a line per agent, the mean per world, its interval."""
        lines = [(row.agent, heading_of(column), value) for row in self for column, value in row.metrics.items()]
        own = Sheet("Measures", ["Agent", Column("Measure", text=True), Column("Mean or rate")], lines)
        return [self.terminal(), own] if lines else [self.terminal()]

    def markdown(self) -> str:
        """The table for a document, with the conditions of our rows and of those beside them below it."""
        return f"{self.sheet().markdown()}\n\n{self._conditions()}\n"

    def _conditions(self) -> str:
        if not self:
            return ""
        ours = (
            f"Ours: {self[0].parameters.line}. Harms are means per world in m²/s²; in brackets or"
            " below a value: its 95 % interval; decreases are relative to full braking."
        )
        return "\n\n".join([ours, *(text for _, text in self.notes())])

    def notes(self) -> list[tuple[str, str]]:
        """What must be said beside the table: ``quiet`` or ``note`` (it must not be overlooked), and the sentences.

        Which worlds no row counts, warnings of sets of measures, where the horizon cut a motion off, who exploits what
        harm does not count, who met no impact at all, the notes of sets, who knows what, and notes on rows beside.
        """
        if not self:
            return []
        row = self[0]
        left_out = LeftOut.line([str(left) for left in row.left_out], row.episodes + len(row.left_out))
        moving = ", ".join(f"{each.agent} {each.horizon_ends:,}" for each in self if each.horizon_ends)
        cut_off = (
            f"At the horizon ({row.parameters['horizon_s']:g} s) something still moved; harm after it is not counted."
            f" Worlds, of {row.episodes:,}: {moving}."
        )
        notes = [
            ("note", left_out if row.left_out else ""),
            *(("note", warning) for warning in self._warnings()),
            ("note", cut_off if moving else ""),
            ("note", Exploits.sentence({each.agent: each.exploits for each in self})),
            ("note", self._nothing_seen_line()),
            *(("quiet", text) for _, each in self._sets() for text in each.notes(self)),
            ("note", self._knowledge_line()),
            *(self.beside.notes if self.beside else ()),
        ]
        return [(kind, text) for kind, text in notes if text]

    def _sets(self) -> list[tuple[str, MeasureSet]]:
        """The sets of measures that are in these rows."""
        return [(name, each) for name, each in MEASURE_SETS.items() if self and name in self[0].more]

    def _warnings(self) -> list[str]:
        """What sets of measures warn of, as sentences."""
        return [f"WARNING: {warning}." for _, each in self._sets() for warning in each.warnings(self)]

    def _nothing_seen_line(self) -> str:
        """What may be said of agents that met no impact in any world, as a sentence; empty without one."""
        unhurt = ", ".join(row.agent for row in self if not row.collisions)
        if not unhurt:
            return ""
        row = next(row for row in self if not row.collisions)
        most = 100 * row.collision_rate.ends[1]
        return (
            f"No impact in {count_of(row.episodes, 'world')}: {unhurt}. With 95 % confidence at most {most:.2g} % of"
            " all such worlds have one; how much harm these would do is not known."
        )

    def identity_line(self) -> str:
        """By which hashes this result is recognised, as a sentence; empty without rows."""
        if not self:
            return ""
        policies = [f"{row.agent} ({', '.join(row.policy_sha256.values())})" for row in self if row.policy_sha256]
        text = f"SHA-256 of the worlds {self[0].worlds_sha256}, of the scenario {self[0].scenario_sha256}"
        return f"{text}{', of policies: ' + '; '.join(policies) if policies else ''}."

    def _knowledge_line(self) -> str:
        """Who sees through the channel, and who does not say, as sentences; empty where the channel hides nothing."""
        hidden = self[0].hidden_share
        if not hidden:
            return ""
        text = (
            f"In {100 * hidden:.1f} % of these worlds the channel hides something of the line from a driven vehicle at"
            " its first decision: news that has not arrived, or how late another vehicle will react."
        )
        through = ", ".join(row.agent for row in self if row.sees_through)
        if through:
            text += (
                f" {SEES_THROUGH.strip()} {through}: drives by the line as it is all the same. That is a limit to"
                " compare with, and nothing that a vehicle on this channel could do."
            )
        silent = ", ".join(row.agent for row in self if Source.UNSTATED in row.knows)
        return text + (f" Not stated what it knows: {silent}." if silent else "")


def summarise(evaluation: Evaluation, *, baseline: str = BASELINE) -> SummaryTable:
    """One row per agent, in the order of the evaluation.

    Args:
        evaluation: of the agents.
        baseline: agent to compare with, where it was evaluated.

    """
    contexts = contexts_of(evaluation)
    return SummaryTable.of_tallies(
        tally_agents(evaluation.outcomes, contexts, baseline=baseline),
        evaluation.conditions,
        contexts,
        {name: outcome.knows for name, outcome in evaluation.outcomes.items()},
        {name: outcome.policies for name, outcome in evaluation.outcomes.items()},
        baseline=baseline,
        left_out=evaluation.left_out,
        hidden_share=float(evaluation.hidden.mean()),
        worlds_sha256=worlds_sha256(evaluation.worlds, evaluation.index),
        scenario_sha256=scenario_sha256(evaluation.scenario),
        versions=result_versions(),
    )
