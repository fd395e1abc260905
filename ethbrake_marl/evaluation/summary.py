"""Tables of an evaluation: one row per agent, and the same outcomes under other objectives."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from ethbrake_marl.agents.protocol import Knowledge, Source, knowledge_text, sees_through
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput, count_of, unknown_name
from ethbrake_marl.evaluation.harm_metrics import COLUMN, metric_headings, metric_meanings
from ethbrake_marl.evaluation.inputs import policies_by_name, result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.evaluation.outcome import (
    PAPER_NOTE,
    PAPER_PARAMETERS,
    PAPER_ROWS,
    Evaluation,
    LeftOut,
    Outcome,
    PaperRow,
    is_papers_test,
    parameter_line,
    parameters,
)
from ethbrake_marl.evaluation.regret import Between, Distance, assess, distance
from ethbrake_marl.evaluation.statistics import (
    Estimate,
    estimates_to_json,
    mean,
    paired_difference,
    rate,
    relative_decrease,
)
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.harm import Declared, objectives_of, scored, standard_objectives

ALL = "standard"


@dataclass(frozen=True, slots=True)
class Rescored:
    """One agent under one objective and count: the mean for each vehicle, front to rear (m2/s2); less is better."""

    agent: str
    objective: str
    harm_count: HarmCount
    each: tuple[Estimate, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON: objective, harm count, and each vehicle's mean with its interval."""
        each = estimates_to_json({f"vehicle_{i + 1}": estimate for i, estimate in enumerate(self.each)})
        return {"objective": self.objective, "harm_count": self.harm_count, **each}


def declared_objectives(texts: Sequence[str], vehicles: int) -> list[str]:
    """Objectives by name, ``standard`` standing for all that need no knowledge of the scenario.

    Raises ``InvalidInput`` for one that is unknown, given twice, or made for another number of vehicles.
    """
    names = [name for text in texts for name in (standard_objectives() if text == ALL else (text,))]
    for k, name in enumerate(names):
        objectives_of(name, vehicles)
        if name in names[:k]:
            raise InvalidInput(f"objective {name!r} is given twice")
    return names


def rescore(evaluation: Evaluation, declared: Sequence[Declared] | None = None) -> list[Rescored]:
    """Every agent under every objective and both counts, in that order."""
    return [
        Rescored(agent, objective, harm_count, tuple(mean(column) for column in values.T))
        for agent, outcome in evaluation.outcomes.items()
        for harm_count in HARM_COUNTS
        for objective, values in scored(outcome.ledger, harm_count, declared).items()
    ]


def rescored_table(rows: Sequence[Rescored], harm_count: HarmCount) -> Sheet:
    """The means under one count: one line per agent and objective, one column per vehicle."""
    shown = [row for row in rows if row.harm_count == harm_count]
    vehicles = range(len(shown[0].each) if shown else 0)
    columns: list[Column | str] = [
        "Agent",
        "Objective",
        *(Column(f"Vehicle {i + 1}", interval="hidden") for i in vehicles),
    ]
    names = ["" if k and shown[k - 1].agent == row.agent else row.agent for k, row in enumerate(shown)]
    lines = [(name, row.objective, *row.each) for name, row in zip(names, shown, strict=True)]
    return Sheet(f"Objectives, {'first-impact' if harm_count == 'first' else 'total'} harm", columns, lines)


BASELINE = "full_brake"
FAR_M = 5.0  # Vehicle 1 counts as shoved far beyond this


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """What one agent achieved over the list of worlds; harms are means per world, m2/s2.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {name: eb.make_agent(name) for name in ("full_brake", "coast")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> rows[0].agent, rows[0].collisions, round(rows[0].total_harm.value, 2)
    ('full_brake', 2, 36.99)

    """

    agent: str  # its name
    episodes: int  # worlds
    collisions: int  # worlds with at least one impact
    horizon_ends: int  # worlds that the horizon cut off before the line stood
    collision_rate: Estimate  # share of worlds
    first_impact_harm: Estimate  # each pair's first impact
    total_harm: Estimate  # every impact
    first_difference: Estimate | None  # first-impact harm minus the baseline's, paired by world
    total_difference: Estimate | None  # the same of total harm
    first_decrease: Estimate | None  # 1 - harm / the baseline's harm
    total_decrease: Estimate | None  # the same of total harm
    predicted_harm: Estimate | None  # where the agent predicts, and a finite harm in every world
    policy_share: float | None  # share of worlds in which a hybrid drove by its policy
    parameters: dict[str, Any]  # of the test, for JSON
    distance: Distance = field(default_factory=Distance)  # to the best known harm
    shoved_m: Estimate | None = None  # how far Vehicle 1 ends beyond where it would by itself
    shoved_far: Estimate | None = None  # share of worlds in which that is more than ``FAR_M``
    sampled_harm: Estimate | None = None  # the paper's sum over samples
    left_out: tuple[LeftOut, ...] = ()  # worlds of the list that no row counts: they could not be advanced
    beside_paper: bool = False  # these are results of the test that the paper's rows are about
    knows: Knowledge = (Source.UNSTATED,)  # what the agent says it knows of the line
    hidden_share: float = 0.0  # worlds in which the channel hides something from a driven vehicle, whoever drives
    worlds_sha256: str = ""  # of the list; results on the same worlds have the same
    scenario_sha256: str = ""  # of all that shapes an episode
    policy_sha256: Mapping[str, str] = field(default_factory=dict)  # vehicle -> its policy's, where one drives
    versions: Mapping[str, str] = field(default_factory=dict)  # of what computed it
    metrics: Mapping[str, Estimate] = field(default_factory=dict)  # registered harm metrics, mean per world

    @property
    def sees_through(self) -> bool:
        """Whether the channel hides something here that this agent reads all the same."""
        return self.hidden_share > 0.0 and sees_through(self.knows)

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON; what does not exist is null, intervals are ``[low, high]``."""
        return {
            "kind": "evaluate",
            "agent": self.agent,
            "knows": knowledge_text(self.knows),
            "sees_through_channel": self.sees_through,
            "hidden_share": self.hidden_share,
            "episodes": self.episodes,
            "collisions": self.collisions,
            "horizon_ends": self.horizon_ends,
            **estimates_to_json(self._estimates()),
            **({"policy_share": self.policy_share} if self.policy_share is not None else {}),
            **self._distance_to_json(),
            "left_out": [left._asdict() for left in self.left_out],
            "worlds_sha256": self.worlds_sha256,
            "scenario_sha256": self.scenario_sha256,
            "policy_sha256": dict(self.policy_sha256),
            "versions": dict(self.versions),
            **({"metrics": metric_headings(self.metrics)} if self.metrics else {}),
            "parameters": self.parameters,
        }

    def _estimates(self) -> dict[str, Estimate | None]:
        """What was measured, by its names in JSON."""
        return {
            "collision_rate": self.collision_rate,
            "first_impact_harm": self.first_impact_harm,
            "total_harm": self.total_harm,
            "sampled_harm": self.sampled_harm,
            "vehicle_1_shoved_m": self.shoved_m,
            "vehicle_1_shoved_far_rate": self.shoved_far,
            "first_impact_harm_difference": self.first_difference,
            "total_harm_difference": self.total_difference,
            "harm_decrease_first": self.first_decrease,
            "harm_decrease_total": self.total_decrease,
            **({"predicted_harm": self.predicted_harm} if self.predicted_harm else {}),
            **{f"{COLUMN}{name}": estimate for name, estimate in self.metrics.items()},
        }

    def _distance_to_json(self) -> dict[str, Any]:
        return {
            **estimates_to_json(self.distance.estimates()),
            "known_best_share": self.distance.known_best_share,
            "best_known_warning": self.distance.warning or None,
            "below_best_known": self.distance.below_best_known,
            "impact_unproven": None if self.distance.between is None else asdict(self.distance.between),
        }


class SummaryTable(list[SummaryRow]):
    """The rows of ``summarise``: a list that a notebook shows as a table.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> isinstance(rows, eb.SummaryTable), len(rows)
    (True, 1)

    """

    def _repr_html_(self) -> str:
        rows = []
        for row in self:
            harms = (row.first_impact_harm, row.total_harm, row.distance.regret_first)
            shares = (row.collision_rate, row.first_decrease, row.distance.realised_first)
            cells = [NO_VALUE if each is None else each.in_words() for each in harms]
            rates = [NO_VALUE if each is None else each.in_words(digits=1, scale=100.0, unit=" %") for each in shares]
            rows.append((row.agent, knowledge_text(row.knows), *rates[:1], *cells, *rates[1:]))
        note = "Harm: means per world in m²/s². In brackets: 95 % intervals. Decrease: of full braking's harm."
        note += f" WARNING: {self[0].distance.warning}." if self and self[0].distance.warning else ""
        worlds = f"{self[0].parameters['scenario']}, {count_of(self[0].episodes, 'world')}" if self else "no agent"
        return Sheet(worlds, _HEAD, rows, note).html()


NO_VALUE = "–"
_HEAD = (
    "Agent",
    "Knows",
    "Collisions",
    "First-impact harm",
    "Total harm",
    "Regret, first",
    "Decrease, first",
    "Realised share, first",
)


def summarise(evaluation: Evaluation, *, baseline: str = BASELINE) -> SummaryTable:
    """One row per agent, in the order of the evaluation; compared with ``baseline`` where that was evaluated."""
    conditions = parameters(evaluation)
    reference = evaluation.outcomes.get(baseline)
    beside, regrets, braking = is_papers_test(evaluation), assess(evaluation), evaluation.outcomes.get(BASELINE)
    hidden = float(evaluation.hidden.mean())
    worlds, scenario = worlds_sha256(evaluation.worlds, evaluation.index), scenario_sha256(evaluation.scenario)
    versions = result_versions()
    rows = [_row(agent, outcome, reference, conditions) for agent, outcome in evaluation.outcomes.items()]
    return SummaryTable(
        replace(
            row,
            beside_paper=beside,
            left_out=evaluation.left_out,
            distance=distance(regrets, evaluation.outcome(row.agent), braking),
            knows=evaluation.outcome(row.agent).knows,
            hidden_share=hidden,
            worlds_sha256=worlds,
            scenario_sha256=scenario,
            policy_sha256=policies_by_name(evaluation.outcome(row.agent).policies, evaluation.scenario),
            versions=versions,
        )
        for row in rows
    )


def horizon_note(moving: Mapping[str, int], worlds: int, horizon_s: float) -> str:
    """What must be said of shielded drivers: in how many worlds, by driver, something still ``moving`` was cut off.

    Empty where there is nothing to say.
    """
    found = ", ".join(f"{name} {count}" for name, count in moving.items() if count)
    if not found:
        return ""
    return (
        f"note: bounds of the shield end at the horizon ({horizon_s:g} s) and say nothing of what comes after;"
        f" worlds, of {worlds}, that were not at rest then: {found}"
    )


def _row(agent: str, outcome: Outcome, reference: Outcome | None, conditions: dict[str, Any]) -> SummaryRow:
    first, total = outcome.first_impact_harm, outcome.total_harm
    collisions, episodes = int(outcome.collided.sum()), len(first)
    against = None if reference is None else (reference.first_impact_harm, reference.total_harm)
    predicted = outcome.predicted_harm
    return SummaryRow(
        agent=agent,
        episodes=episodes,
        collisions=collisions,
        horizon_ends=int((~outcome.at_rest).sum()),
        collision_rate=rate(collisions, episodes),
        first_impact_harm=mean(first),
        total_harm=mean(total),
        first_difference=None if against is None else paired_difference(first, against[0]),
        total_difference=None if against is None else paired_difference(total, against[1]),
        first_decrease=None if against is None else relative_decrease(first, against[0]),
        total_decrease=None if against is None else relative_decrease(total, against[1]),
        predicted_harm=None if predicted is None or not np.isfinite(predicted).all() else mean(predicted),
        policy_share=None if outcome.chosen_policy is None else float(outcome.chosen_policy.mean()),
        parameters=conditions,
        shoved_m=None if outcome.shoved_m is None else mean(outcome.shoved_m),
        shoved_far=None if outcome.shoved_m is None else rate(int((outcome.shoved_m > FAR_M).sum()), episodes),
        sampled_harm=None if outcome.sampled_harm is None else mean(outcome.sampled_harm),
        metrics={name: mean(column) for name, column in outcome.metrics.items()},
    )


# The cells of the summary table: columns, their meanings, and one line for each agent and row of the paper.

DASH = "–"
SEES_THROUGH = "† "  # before what an agent knows that no channel brought


@dataclass(frozen=True, slots=True)
class Cell:
    """One entry of the table: the value, and its 95 % interval or nothing."""

    value: str
    interval: str = ""


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the table."""

    agent: str
    cells: tuple[Cell, ...]
    knows: str = DASH


COLUMNS = (
    "Collisions",
    "First-impact harm",
    "Total harm",
    "Sampled harm",
    "Vehicle 1 shoved (m)",
    "Vehicle 1 shoved > 5 m",
    "Decrease, first-impact",
    "Decrease, total",
    "Predicted harm",
    "Regret, first-impact",
    "Realised share, first-impact",
)


MEANINGS = {
    "Agent": "What drives the controlled vehicle; all other vehicles follow the scenario. full_brake is the paper's"
    " non-ethical strategy (Non-E). e_v2x_bm is the best constant deceleration found in this simulation;"
    " e_v2x_bm:pairwise is the paper's closed form, which treats the pairs as independent.",
    "Knows": "What the agent has to know of the line. own sensors: its own vehicle and what its sensors see. messages:"
    " also the messages that have reached it. true state: the others' states, capacities and latencies as they are,"
    " received or not. true model: also masses, restitution and scripts, enough to simulate the line ahead. Of a policy"
    " behind a shield, or a refined one, both parts are told. † marks agents that see through a channel that hides"
    " something here.",
    "Collisions": "Share of worlds with at least one impact; Wilson's interval. Every agent meets the same worlds, each"
    " once.",
    "First-impact harm": "Squared closing speed (m²/s²), summed over the pairs, each pair's first impact only (the"
    " paper's protocol); mean per world.",
    "Total harm": "The same over every impact. A light early touch makes a later, harder impact of the same pair free"
    " under the first count, so both are shown.",
    "Sampled harm": "The paper's own sum (its eq. Jharm): the agent's commands replayed through the paper's fixed-step"
    " map at the time step; at every sample each pair that overlaps and closes adds its squared closing speed (m²/s²),"
    " so pushing costs harm for as long as it lasts.",
    "Vehicle 1 shoved (m)": "How far Vehicle 1 ends beyond the point where it would stop by itself, mean per world; and"
    " the share of worlds in which that is more than 5 m. Both counts of harm leave pushing free unless something"
    " stands ahead; Vehicle 1 brakes for something.",
    "Decrease": "1 − harm / harm of full braking in the same worlds; interval by the delta method, paired by world.",
    "Predicted harm": "What the agent itself expected at the alert, under the count that it minimises.",
    "Regret": "First-impact harm minus the best known first-impact harm of the same world; mean per world. The best"
    " known is 0 where contact is proven avoidable, else the result of a search over whole profiles of Vehicle 2,"
    " or of an agent in this table that did better. With ≥: the best of some world is known from these agents alone.",
    "Realised share": "(Full braking − agent) / (full braking − best known), first-impact harm: how much of the"
    " reduction of harm that is known to be possible the agent brings.",
}


def table_columns(rows: Sequence[SummaryRow]) -> tuple[str, ...]:
    """The columns, those of registered harm metrics last."""
    return (*COLUMNS, *(metric_headings(rows[0].metrics).values() if rows else ()))


def filled_columns(lines: Sequence[Line], columns: Sequence[int]) -> tuple[int, ...]:
    """Those of the columns in which some line has a value; all of them for no lines."""
    return tuple(k for k in columns if not lines or any(line.cells[k].value != DASH for line in lines))


def table_meanings(rows: Sequence[SummaryRow]) -> dict[str, str]:
    """What the columns mean, those of registered harm metrics last."""
    return MEANINGS | (metric_meanings(rows[0].metrics) if rows else {})


def our_lines(rows: Sequence[SummaryRow]) -> list[Line]:
    """Our results, one line per agent."""
    return [
        Line(
            row.agent,
            (
                percent_cell(row.collision_rate, 1),
                _number_cell(row.first_impact_harm),
                _number_cell(row.total_harm),
                _number_cell(row.sampled_harm),
                _number_cell(row.shoved_m),
                percent_cell(row.shoved_far, 1),
                percent_cell(row.first_decrease, 1),
                percent_cell(row.total_decrease, 1),
                _number_cell(row.predicted_harm),
                _regret(row.distance),
                percent_cell(row.distance.realised_first, 1),
                *(_number_cell(estimate) for estimate in row.metrics.values()),
            ),
            SEES_THROUGH * row.sees_through + knowledge_text(row.knows),
        )
        for row in rows
    ]


def paper_blocks(rows: Sequence[SummaryRow]) -> list[tuple[str, list[Line]]]:
    """The paper's tables that belong beside these rows, as (table, lines)."""
    blocks: dict[str, list[Line]] = {}
    for paper in PAPER_ROWS if rows and rows[0].beside_paper else ():
        blocks.setdefault(paper.table, []).append(_paper_line(paper, len(rows[0].metrics)))
    return list(blocks.items())


def _paper_line(row: PaperRow, metrics: int) -> Line:
    """The paper's figures with the digits that it prints; nothing under the ``metrics`` that somebody registered."""
    decrease = DASH if row.harm_decrease is None else f"{100 * row.harm_decrease:.4g} %"
    cells = (
        f"{100 * row.collision_rate:.4g} %",
        f"{row.average_harm:.6g}",
        *[DASH] * 4,
        decrease,
        *[DASH] * (4 + metrics),
    )
    return Line(row.agent, tuple(Cell(cell) for cell in cells))


def _regret(distance: Distance) -> Cell:
    cell = _number_cell(distance.regret_first)
    lower_bound = distance.known_best_share is not None and distance.known_best_share < 1.0
    return Cell(f"≥ {cell.value}", cell.interval) if lower_bound else cell


def percent_cell(estimate: Estimate | None, digits: int) -> Cell:
    """A share as per cent; a dash for what does not exist."""
    return _cell(estimate, 100.0, digits, " %")


def _number_cell(estimate: Estimate | None) -> Cell:
    return _cell(estimate, 1.0, 2, "")


def _cell(estimate: Estimate | None, scale: float, digits: int, unit: str) -> Cell:
    if estimate is None:
        return Cell(DASH)
    value = f"{scale * estimate.value:.{digits}f}{unit}"
    if estimate.interval is None:
        return Cell(value)
    low, high = (f"{scale * end:.{digits}f}" for end in estimate.interval)
    return Cell(value, f"{low}, {high}")


# The summary table as text, for a terminal (rich) and for a document (markdown), and the sentences below it.

_TERMINAL_HEADINGS = (
    "Collisions",
    "First-impact\nharm",
    "Total\nharm",
    "Sampled\nharm",
    "Shoved\nm",
    "Shoved\n> 5 m",
    "Decrease\nfirst",
    "Decrease\ntotal",
    "Pre-\ndicted",
    "Regret\nfirst",
    "Realised\nfirst",
)
_ALL = tuple(range(len(_TERMINAL_HEADINGS)))
_NARROW, _NARROW_WITHOUT = (0, 1, 2, 3, 4, 9, 10), (0, 1, 2, 3, 4, 6, 7)  # with and without a regret to show
_NAMED = 10  # worlds left out that are named one by one; all stand in the JSON
_WIDE = 120  # terminal columns that all of them need


def rich_table(rows: Sequence[SummaryRow]) -> RenderableType:
    """The table for a terminal of 80 columns or more: ours, then the paper's rows, then the conditions of each."""
    return Group(_TerminalTable(rows), Text(), Text(_conditions(rows), style="dim"))


def metrics_table(rows: Sequence[SummaryRow]) -> Sheet:
    """The registered harm metrics: one line per agent, the mean per world with its interval."""
    headings = metric_headings(rows[0].metrics).values() if rows else ()
    lines = [(row.agent, *row.metrics.values()) for row in rows]
    return Sheet("Harm metrics", ["Agent", *map(Column, headings)], lines)


@dataclass(frozen=True, slots=True)
class _TerminalTable:
    """The lines of the table; a narrow terminal gets fewer columns."""

    rows: Sequence[SummaryRow]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        wide = options.max_width >= _WIDE
        yield self._table(_ALL if wide else _NARROW if limit_lines(self.rows) else _NARROW_WITHOUT)

    def _table(self, shown: Sequence[int]) -> Table:
        table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=0, pad_edge=False)
        table.add_column("Agent,\nwhat it knows", overflow="fold")
        for k in shown:
            table.add_column(_TERMINAL_HEADINGS[k], justify="right", no_wrap=True)
        for line in our_lines(self.rows):
            table.add_row(
                Text(line.agent).append(f"\n{line.knows}", style="dim"),
                *(_terminal_cell(k, line.cells[k]) for k in shown),
            )
        for name, lines in paper_blocks(self.rows):
            table.add_section()
            table.add_row(Text(f"paper, {name}", style="dim"))
            for line in lines:
                table.add_row(line.agent, *(line.cells[k].value for k in shown))
        return table


def _terminal_cell(column: int, cell: Cell) -> Text:
    """Value, and in the first three columns its interval below; the others' are in the JSON and the report."""
    text = Text(cell.value)
    return text.append(f"\n{cell.interval}", style="dim") if cell.interval and column < 3 else text


def markdown_table(rows: Sequence[SummaryRow]) -> str:
    """The table for a document, with the conditions of ours and of the paper's below it."""
    columns = table_columns(rows)
    head = ["Agent", "Knows", *columns]
    lines = ["| " + " | ".join(head) + " |", "|" + 2 * " --- |" + " ---: |" * len(columns)]
    lines += [_markdown_line(line) for line in our_lines(rows)]
    for name, block in paper_blocks(rows):
        lines += [_markdown_line(Line(f"paper, {name}: {line.agent}", line.cells)) for line in block]
    return "\n".join([*lines, "", _conditions(rows), ""])


def _bracket(cell: Cell) -> str:
    return f"{cell.value} [{cell.interval}]" if cell.interval else cell.value


def _markdown_line(line: Line) -> str:
    cells = map(_bracket, line.cells)
    return "| " + " | ".join([line.agent.replace("|", "\\|"), line.knows, *cells]) + " |"


def _conditions(rows: Sequence[SummaryRow]) -> str:
    if not rows:
        return ""
    texts = [
        f"Ours: {parameter_line(rows[0].parameters)}. Harms are means per world in m²/s²; in brackets or"
        " below a value: its 95 % interval; decreases are relative to full braking."
    ]
    texts += left_out_lines(rows) + warning_lines(rows) + limit_lines(rows) + knowledge_lines(rows)
    blocks = paper_blocks(rows)
    texts += [f"Paper, {name}: {PAPER_PARAMETERS[name]}." for name, _ in blocks]
    return "\n\n".join([*texts, *([PAPER_NOTE] if blocks else [])])


def left_out_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """Which worlds no row counts, as a sentence; none where every world counts."""
    left_out = rows[0].left_out if rows else ()
    if not left_out:
        return []
    whole = rows[0].episodes + len(left_out)
    return [left_out_line([str(left) for left in left_out], whole)]


def left_out_line(worlds: Sequence[str], whole: int) -> str:
    """That these of ``whole`` worlds, each named with its reason, count in no figure."""
    named = [*worlds[:_NAMED], *(["and so on"] if len(worlds) > _NAMED else [])]
    return (
        f"LEFT OUT for every agent: {len(worlds):,} of {whole:,} worlds, which the physics could not advance"
        f" (please report them): {'; '.join(named)}."
    )


def warning_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """That a table of best known harm lacks some of these worlds, and where the horizon cut a motion off, as sentences.

    None where all is well.
    """
    lines = [f"WARNING: {rows[0].distance.warning}."] if rows and rows[0].distance.warning else []
    moving = [f"{row.agent} {row.horizon_ends:,}" for row in rows if row.horizon_ends]
    if moving:
        lines.append(
            f"At the horizon ({rows[0].parameters['horizon_s']:g} s) something still moved, and what came after counts"
            f" nowhere; worlds, of {rows[0].episodes:,}: {', '.join(moving)}."
        )
    return lines


def limit_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """What nobody could avoid in these worlds and the best known harm, as sentences; none where nothing is proven."""
    found = rows[0].distance if rows else None
    if found is None or not (found.best_known_first and found.best_known_total):
        return []
    contact = _bracket(percent_cell(found.unavoidable_rate, 1))
    first, total = found.best_known_first.value, found.best_known_total.value
    text = f"In {contact} of these worlds no {_command_of(rows[0])} avoids contact"
    if found.unavoidable_rate is None:
        impact = _bracket(percent_cell(found.impact_proven_rate, 1))
        text = f"In {impact} of these worlds no {_command_of(rows[0])} avoids an impact (proven)."
        text += _tell_proven(found, first, total)
    else:
        impact = _bracket(percent_cell(found.impact_proven_rate, 1))
        text += f", in {impact} none avoids an impact (both proven).{_tell_gap(found.between)}"
        text += _tell_proven(found, first, total)
    if found.known_best_share is not None and found.known_best_share < 1.0:
        text += (
            f" Found beforehand in {100 * found.known_best_share:.1f} % of the worlds; in the others it is the best of"
            " the agents above, so that regrets are lower bounds and no realised share is stated."
        )
    below = {row.agent: row.distance.below_best_known for row in rows if row.distance.below_best_known}
    if below:
        counts = ", ".join(f"{agent} in {count_of(count, 'world')}" for agent, count in below.items())
        text += f" Below what was known: {counts}."
    return [text]


def _command_of(row: SummaryRow) -> str:
    """Whose command it is: ``command of Vehicle 2``, or ``joint command`` where several are driven."""
    driven = row.parameters.get("controlled_vehicle")
    return "joint command" if driven is None else f"command of {str(driven).replace('vehicle_', 'Vehicle ')}"


def _tell_proven(found: Distance, first: float, total: float) -> str:
    """The best known and the proven harm, and what lies between, as a sentence."""
    proven = 0.0 if found.proven_harm is None else found.proven_harm.value
    return (
        f" Best known harm: {first:.2f} first-impact, {total:.2f} total; proven: no less than {proven:.2f}; gap:"
        f" {first - proven:.2f} ({_share(first - proven, first)}) and {total - proven:.2f}"
        f" ({_share(total - proven, total)})."
    )


def _tell_gap(found: Between | None) -> str:
    """What is known of the worlds with proven contact and no proven impact, as a sentence."""
    if found is None or found.rate == 0.0:
        return ""
    text = f" In the {100 * found.rate:.1f} % between, whether an impact can be avoided is open"
    if found.mean_first is None or found.harmless_rate is None:
        return f"{text}."
    return (
        f"{text}: the best known do {found.mean_first:.2f} there on average, and next to none in"
        f" {100 * found.harmless_rate:.0f} % of them."
    )


def _share(part: float, whole: float) -> str:
    return f"{100 * part / whole:.1f} %" if whole > 0.0 else DASH


def identity_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """By which hashes this result is recognised, as a sentence; none without rows."""
    if not rows:
        return []
    policies = [f"{row.agent} ({', '.join(row.policy_sha256.values())})" for row in rows if row.policy_sha256]
    text = f"SHA-256 of the worlds {rows[0].worlds_sha256}, of the scenario {rows[0].scenario_sha256}"
    return [f"{text}{', of policies: ' + '; '.join(policies) if policies else ''}."]


def knowledge_lines(rows: Sequence[SummaryRow]) -> list[str]:
    """Who sees through the channel, and who does not say, as sentences; none where the channel hides nothing."""
    hidden = rows[0].hidden_share if rows else 0.0
    if not hidden:
        return []
    text = (
        f"In {100 * hidden:.1f} % of these worlds the channel hides something of the line from a driven vehicle at its"
        " first decision: news that has not arrived, or how late another vehicle will react."
    )
    through = ", ".join(row.agent for row in rows if row.sees_through)
    if through:
        text += (
            f" {SEES_THROUGH.strip()} {through}: drives by the line as it is all the same. That is a limit to compare"
            " with, and nothing that a vehicle on this channel could do."
        )
    silent = ", ".join(row.agent for row in rows if Source.UNSTATED in row.knows)
    return [text + (f" Not stated what it knows: {silent}." if silent else "")]


# An evaluation by group: the worlds of each scenario of a mixture, or those in which a vehicle is of one type.

NO_TYPE = "no type"  # of a vehicle of a mixture's member without types


def summarise_by(evaluation: Evaluation, by: str, *, baseline: str = BASELINE) -> dict[str, SummaryTable]:
    """Rows as ``summarise`` for each group of worlds, by the group's name, sorted.

    Args:
        evaluation: of a mixture, or of a scenario with types of vehicles.
        by: ``scenario``, or whose type: ``vehicle_2_type``.
        baseline: as in ``summarise``.

    Raises ``InvalidInput`` for worlds that were drawn without such, ``UnknownName`` for another column.

    >>> import ethbrake_marl as eb
    >>> delays = eb.load_scenario("mixture-delays")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> found = eb.summarise_by(eb.evaluate(delays.sample(30, seed=7), agents, scenario=delays), "scenario")
    >>> {name: rows[0].episodes for name, rows in found.items()}
    {'paper-delay-high': 11, 'paper-delay-low': 8, 'paper-delay-middle': 11}

    """
    return {name: summarise(part, baseline=baseline) for name, part in _groups(evaluation, by)}


def check_group(kinds: Collection[str], by: str) -> None:
    """Raise what ``summarise_by`` would for worlds with these columns of ``Evaluation.kinds``."""
    if not kinds:
        raise InvalidInput(
            f"by {by!r}: these worlds have no groups; those of a mixture have scenario, those with vehicle_types have"
            " vehicle_1_type and so on"
        )
    if by not in kinds:
        raise unknown_name("group", by, kinds)


def _groups(evaluation: Evaluation, by: str) -> Iterator[tuple[str, Evaluation]]:
    check_group(evaluation.kinds, by)
    column = evaluation.kinds[by]
    for name in np.unique(column).tolist():
        yield name or NO_TYPE, evaluation.take(column == name)
