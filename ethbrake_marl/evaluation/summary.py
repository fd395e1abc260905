"""The table of an evaluation: a row per agent, for a terminal and for a document, and the sentences below it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from ethbrake_marl.agents.protocol import Knowledge, Source
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.agent_tally import AgentTally, estimate_all
from ethbrake_marl.evaluation.conditions import Conditions
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.exploits import MARK, Exploits
from ethbrake_marl.evaluation.identity import result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.evaluation.measures import BASELINE, BELOW, CHOSEN, HORIZON, KNOWN, measures
from ethbrake_marl.evaluation.outcome import COLUMN, UNSTATED, LeftOut
from ethbrake_marl.evaluation.own_measures import heading_of, registered_measure
from ethbrake_marl.extensions.report.paper_rows import PAPER_NOTE, PAPER_PARAMETERS, PAPER_ROWS, check_papers_test
from ethbrake_marl.extensions.report.three_tests import TESTS
from ethbrake_marl.extensions.search.limits import Limits
from ethbrake_marl.extensions.search.regret import Between
from ethbrake_marl.files.sheet import DASH, Column, Estimate, Row, Sheet, Shown, terminal_text
from ethbrake_marl.scenario.task import Task

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

_ALWAYS_SHOWN = ("collision_rate", "first_impact_harm", "total_harm", "sampled_harm", "vehicle_1_shoved_m")

_NARROW = (  # in a narrow terminal too, where there is no regret to show, and where there is
    ("harm_decrease_first", "harm_decrease_total"),
    ("mean_regret_first", "share_of_possible_reduction_first"),
)

_IN_NOTEBOOKS = (
    *("Agent", "Knows", "collision_rate", "first_impact_harm", "total_harm"),
    *("mean_regret_first", "harm_decrease_first", "share_of_possible_reduction_first"),
)

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
    known_best_share: float | None = None  # worlds whose best is known without the agents of this evaluation
    below_best_known: int | None = None  # worlds in which the agent is below it
    between: Between | None = None  # the worlds in which contact is proven and no impact
    warning: str = ""  # a table of best known harm holds some of the worlds, and not the others
    left_out: tuple[LeftOut, ...] = ()  # worlds of the list that no row counts: they could not be advanced
    beside_paper: bool = False  # the paper's rows stand below
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
        return self.estimates["collision_rate"]  # type: ignore[return-value]  # all have it in all worlds

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
        of_limits = {measure.name for measure in measures() if measure.limits}
        optional = {measure.name for measure in measures() if not measure.always}
        told = {name: each for name, each in self.estimates.items() if each or name not in optional}
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
            **Estimate.side_by_side({name: each for name, each in told.items() if name not in of_limits}),
            **({"policy_share": self.policy_share} if self.policy_share is not None else {}),
            **Estimate.side_by_side({name: each for name, each in told.items() if name in of_limits}),
            "known_best_share": self.known_best_share,
            "best_known_warning": self.warning or None,
            "below_best_known": self.below_best_known,
            "impact_unproven": None if self.between is None else asdict(self.between),
            "left_out": [left._asdict() for left in self.left_out],
            "worlds_sha256": self.worlds_sha256,
            "scenario_sha256": self.scenario_sha256,
            "policy_sha256": dict(self.policy_sha256),
            "versions": dict(self.versions),
            **({"metrics": {name: heading_of(name) for name in self.metrics}} if self.metrics else {}),
            "parameters": self.parameters,
        }


class SummaryTable(list[SummaryRow]):
    """The rows of ``summarise``: a list that ``print`` and a notebook show as a table.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> isinstance(rows, eb.SummaryTable), len(rows)
    (True, 1)

    """

    def __repr__(self) -> str:
        return f"SummaryTable({', '.join(row.agent for row in self)})"

    def __str__(self) -> str:
        return terminal_text(*self.tables())

    def _repr_html_(self) -> str:
        note = "Harm: means per world in m²/s². In brackets: 95 % intervals. Decrease: of full braking's harm."
        note += f" WARNING: {self[0].warning}." if self and self[0].warning else ""
        worlds = f"{self[0].parameters['scenario']}, {count_of(self[0].episodes, 'world')}" if self else "no agent"
        sheet = self.sheet()
        ours = replace(sheet, title=worlds, rows=sheet.rows[: len(self)], note=note)
        return ours.only(k for k, name in enumerate(sheet.names) if name in _IN_NOTEBOOKS).html()

    @classmethod
    def of_tallies(
        cls,
        tallies: Mapping[str, AgentTally],
        conditions: Conditions,
        task: Task,
        knows: Mapping[str, Knowledge],
        policies: Mapping[str, Mapping[str, str]],
        *,
        baseline: str = BASELINE,
        paper: bool = False,
        **shared: Any,
    ) -> SummaryTable:
        """One row per agent, from what was counted in the worlds of a list.

        Args:
            tallies: of every agent.
            conditions: of the test.
            task: who is driven where.
            knows: by agent.
            policies: by agent: vehicle's name -> SHA-256 of its policy.
            baseline: what is compared with.
            paper: show the paper's rows below.
            shared: what all rows say alike.

        Raises ``InvalidInput`` for ``paper`` where its rows are about something else.

        """
        worlds = conditions["count"]
        if paper:
            check_papers_test(task, conditions["seed"])
        return cls(
            SummaryRow(
                agent=agent,
                episodes=worlds,
                estimates=estimate_all(tallies, agent, worlds, baseline=baseline),
                collisions=tally.count("collision_rate"),
                horizon_ends=tally.count(HORIZON),
                policy_share=tally.share(CHOSEN, worlds),
                known_best_share=tally.share(KNOWN, worlds),
                below_best_known=tally.count(BELOW) if BELOW in tally.counts else None,
                knows=knows[agent],
                policy_sha256=policies[agent],
                parameters=conditions,
                beside_paper=paper,
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
        """The table: agent, what it knows, and every measure that has a heading, those of registered ones last.

        A regret is marked as a lower bound where the best of some world is not known beforehand. Below it stand the
        paper's rows, if they were asked for.
        """
        columns = [each.column() for each in measures() if each.heading]
        columns += [Column(heading_of(name), COLUMN + name) for name in (self[0].metrics if self else ())]
        lines: list[Row] = []
        for row in self:
            cells: dict[str, Any] = {column.name: row[column.name] for column in columns}
            value, interval = Column("").show(row["mean_regret_first"])
            bound = row.known_best_share is not None and row.known_best_share < 1.0
            cells["mean_regret_first"] = Shown(f"≥ {value}" if bound else value, interval)
            lines.append((row.marked, SEES_THROUGH * row.sees_through + row.knows.text, *cells.values()))
        for paper in PAPER_ROWS if self and self[0].beside_paper else ():
            printed = {
                "collision_rate": f"{100 * paper.collision_rate:.4g} %",
                "first_impact_harm": f"{paper.average_harm:.6g}",
            }
            if paper.harm_decrease is not None:
                printed["harm_decrease_first"] = f"{100 * paper.harm_decrease:.4g} %"
            section = f"paper, {paper.table}"
            lines += [] if section in lines else [section]
            lines.append((paper.agent, None, *(printed.get(column.name) for column in columns)))
        return Sheet("", ["Agent", "Knows", *columns], lines)

    def terminal(self) -> Sheet:
        """The table for a terminal of 80 columns or more: ours, then the paper's rows, then the conditions of each."""
        narrow = (*_ALWAYS_SHOWN, *_NARROW[bool(self.limit_line())])
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

    def tables(self) -> list[Sheet]:
        """``terminal``, and below it the registered measures: a line per agent, the mean per world, its interval."""
        lines = [(row.agent, heading_of(column), value) for row in self for column, value in row.metrics.items()]
        own = Sheet("Measures", ["Agent", Column("Measure", text=True), Column("Mean or rate")], lines)
        return [self.terminal(), own] if lines else [self.terminal()]

    def brief(self, beside: Mapping[str, SummaryTable]) -> Sheet:
        """The table on one screen: collisions and both harms, also in the tests ``beside``, and what must be told.

        The paper's rows, and the other measures, are not in it.
        """
        ours = SummaryTable(replace(row, beside_paper=False) for row in self)
        sheet = ours.terminal()
        kept = sheet.only(k for k, name in enumerate(sheet.names) if k == 0 or name in _BELOW)
        columns, rows = list(kept.columns), [list(row) for row in kept.rows]
        note = f"{ours[0].parameters.line}. Harm: mean per world in m²/s², below it the 95 % interval."
        notes = [note, *(text for _, text in ours.notes())]
        for test, table in beside.items():
            drove = {row.agent: row for row in table}
            columns.append(Column(f"{TESTS[test].partition(' test')[0]}:\nfirst, total"))
            for row, each in zip(rows, (drove.get(row.agent) for row in self), strict=True):
                row.append(each and f"{each.first_impact_harm.value:.2f}, {each.total_harm.value:.2f}")
            must = [text for kind, text in table.notes() if kind == "note"]
            notes.append(" ".join([TESTS[test], f"{count_of(table[0].episodes, 'world')}.", *must]))
        return replace(kept, columns=columns, rows=rows, note="\n".join(notes))

    def markdown(self) -> str:
        """The table for a document, with the conditions of ours and of the paper's below it."""
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
        """What must be told beside the table: ``quiet`` or ``note`` (it must not be overlooked), and the sentences.

        Which worlds no row counts, that a table of best known harm lacks some of these worlds, where the horizon cut a
        motion off, who exploits what harm does not count, who met no impact at all, the limits, who knows what, and the
        conditions of the paper's rows.
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
        paper = [("quiet", f"Paper, {name}: {told}.") for name, told in PAPER_PARAMETERS.items()]
        told = [
            ("note", left_out if row.left_out else ""),
            ("note", f"WARNING: {row.warning}." if row.warning else ""),
            ("note", cut_off if moving else ""),
            ("note", Exploits.sentence({each.agent: each.exploits for each in self})),
            ("note", self._nothing_seen_line()),
            ("quiet", self.limit_line()),
            ("note", self._knowledge_line()),
            *([*paper, ("note", PAPER_NOTE)] if row.beside_paper else []),
        ]
        return [(kind, text) for kind, text in told if text]

    def limit_line(self) -> str:
        """What nobody could avoid here and the best known harm, as sentences; empty where nothing is proven."""
        first, total = (
            (self[0][f"best_known_{name}_harm"] for name in ("first_impact", "total")) if self else (None, None)
        )
        if first is None or total is None:
            return ""
        row = self[0]
        driven = row.parameters.get("controlled_vehicle")
        command = f"command of {str(driven).replace('vehicle_', 'Vehicle ')}" if driven else "joint command"
        share = Column("", digits=1, scale=100.0, unit=" %")
        contact, impact = (share.show(row[name]).in_words for name in ("unavoidable_rate", "impact_proven_rate"))
        if row["unavoidable_rate"] is None:
            text = f"In {impact} of these worlds no {command} avoids an impact (proven)."
        else:
            text = f"In {contact} of these worlds no {command} avoids contact, in {impact} none avoids an impact (both"
            text += f" proven).{row.between.text if row.between else ''}"
        proven = row["proven_harm"]
        least = 0.0 if proven is None else proven.value
        gaps = []
        for best in (first.value, total.value):
            part = f"{100 * (best - least) / best:.1f} %" if best > 0.0 else DASH
            gaps.append(f"{best - least:.2f} ({part})")
        text += (
            f" Best known harm: {first.value:.2f} first-impact, {total.value:.2f} total; proven: no less than"
            f" {least:.2f}; gap: {' and '.join(gaps)}."
        )
        known = row.known_best_share
        if known is not None and known < 1.0:
            text += (
                f" Found beforehand in {100 * known:.1f} % of the worlds; in the others it is the best of"
                " the agents above, so that regrets are lower bounds and no share of the possible reduction is stated."
            )
        below = [
            f"{each.agent} in {count_of(each.below_best_known, 'world')}" for each in self if each.below_best_known
        ]
        return text + (f" Less harm than the best known before: {', '.join(below)}." if below else "")

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


def summarise(evaluation: Evaluation, *, baseline: str = BASELINE, paper: bool = False) -> SummaryTable:
    """One row per agent, in the order of the evaluation.

    Args:
        evaluation: of the agents.
        baseline: agent to compare with, where it was evaluated.
        paper: print the rows of the paper's tables below; ``InvalidInput`` where they are about another test.

    """
    limits, regrets = evaluation.limits, evaluation.regrets
    return SummaryTable.of_tallies(
        evaluation.tally(baseline=baseline),
        evaluation.conditions,
        evaluation.task,
        {name: outcome.knows for name, outcome in evaluation.outcomes.items()},
        {name: outcome.policies for name, outcome in evaluation.outcomes.items()},
        baseline=baseline,
        paper=paper,
        between=None if regrets is None else regrets.between,
        warning=limits.warning if isinstance(limits, Limits) else "",
        left_out=evaluation.left_out,
        hidden_share=float(evaluation.hidden.mean()),
        worlds_sha256=worlds_sha256(evaluation.worlds, evaluation.index),
        scenario_sha256=scenario_sha256(evaluation.scenario),
        versions=result_versions(),
    )
