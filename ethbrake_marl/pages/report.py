"""The report of an evaluation as one page: results, episodes to watch, what was avoidable, shield, figures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ethbrake_marl.agents.team import Driver
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.cells import Line, filled_columns, our_lines, paper_blocks, table_columns, table_meanings
from ethbrake_marl.evaluation.conditions import parameter_line
from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.evaluation.paper import PAPER_NOTE, PAPER_PARAMETERS
from ethbrake_marl.evaluation.per_world import write_output
from ethbrake_marl.evaluation.table import SummaryRow
from ethbrake_marl.evaluation.text import identity_lines, knowledge_lines, left_out_lines, limit_lines, warning_lines
from ethbrake_marl.figures.report import harm_by_agent
from ethbrake_marl.figures.style import Figure
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.limits.limits import Unproven
from ethbrake_marl.pages.chosen import choose_shown, play_chosen
from ethbrake_marl.pages.evidence import ShieldEvidence, avoidable_section, shield_section, worst_section
from ethbrake_marl.pages.frame import Part, Section, page, paragraph
from ethbrake_marl.pages.parts import Block, Cell, Row, facts, table
from ethbrake_marl.pages.player import Played, player
from ethbrake_marl.pages.vector import drawing

_HEADLINE = (0, 1, 2, 6, 7, 9, 10)  # of the table's columns; those of registered harm metrics follow
_OTHERS = (3, 4, 5, 8)


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """A figure of the report; ``description`` says in words what it shows (and is read to those who cannot see it)."""

    title: str
    description: str
    figure: Figure


@dataclass(frozen=True, slots=True)
class ReportTest:
    """Results on another test, to stand below the main table."""

    title: str
    description: str  # what differs from the main table's test
    rows: Sequence[SummaryRow]


@dataclass(frozen=True, slots=True)
class Report:
    """Everything on the page. ``settings`` and ``versions`` are printed as they are given, name and value."""

    title: str
    rows: Sequence[SummaryRow]
    evaluation: Evaluation | None = None  # that the rows sum up
    played: Sequence[Played] = ()  # episodes to watch
    shield: ShieldEvidence | None = None  # of what is behind a shield
    focus: str = ""  # the agent whose worst worlds are shown
    figures: Sequence[ReportFigure] = ()
    tests: Sequence[ReportTest] = ()  # the same agents elsewhere
    summary: str = ""  # a sentence or two below the title
    settings: Mapping[str, object] = field(default_factory=dict)  # command, seeds, training set-up
    versions: Mapping[str, str] = field(default_factory=dict)


def focus_of(rows: Sequence[SummaryRow]) -> str:
    """The agent whose worst worlds a report shows: the last that drives by a trained policy, or the last."""
    learned = [row.agent for row in rows if row.policy_sha256]
    return learned[-1] if learned else rows[-1].agent


def play_for_report(
    evaluation: Evaluation,
    agents: Mapping[str, Driver],
    focus: str,
    *,
    spellings: Mapping[str, str] | None = None,
    harm_count: HarmCount = "first",
    on_agent: Callable[[str], None] | None = None,
) -> list[Played]:
    """The episodes of a report: see ``choose_shown`` and ``play_chosen``, whose arguments these are."""
    chosen = choose_shown(evaluation, focus)
    return play_chosen(evaluation, chosen, agents, spellings=spellings, harm_count=harm_count, on_agent=on_agent)


def render_report(report: Report) -> str:
    """The page as HTML; it loads nothing from anywhere."""
    sections = [_results(report), *_episodes(report)]
    if report.evaluation is not None and report.focus:
        sections.append(worst_section(report.evaluation, report.focus, {one.number for one in report.played}))
    if report.evaluation is not None:
        sections.append(avoidable_section(report.evaluation))
    if report.shield is not None:
        sections.append(shield_section(report.shield))
    if report.figures:
        drawn = [drawing(each.figure, each.title, each.description) for each in report.figures]
        sections.append(Section("Figures", drawn))
    sections += [_other_test(test) for test in report.tests]
    sections += [_measures(report), _reading(report), *_settings(report)]
    return page(report.title, sections, lead=report.summary)


def write_report(path: str | Path, report: Report, *, force: bool = False) -> None:
    """Write the page; raises ``AlreadyExists`` unless ``force``, ``InvalidInput`` without a folder."""
    write_output(path, render_report(report).encode("utf-8"), force=force)


def _results(report: Report) -> Section:
    rows = report.rows
    body: list[str | Part] = []
    if rows:
        body.append(
            drawing(
                harm_by_agent(rows),
                "Harm of each agent",
                "Mean per world of the squared closing speed of impacts: each pair's first one, and every one.",
            )
        )
    columns = table_columns(rows)
    blocks = paper_blocks(rows)
    shown = filled_columns(_all_lines(rows), (*_HEADLINE, *range(len(table_columns(())), len(columns))))
    lines: list[Row] = [_row(line, shown) for line in our_lines(rows)]
    for name, paper in blocks:
        lines += [Block(f"The paper's {name}, as printed"), *(_row(line, shown) for line in paper)]
    body.append(table(["Agent", *(columns[k] for k in shown)], lines, caption="Means with 95 % intervals"))
    if rows:
        body.append(paragraph(f"{parameter_line(rows[0].parameters)}. Harm in m²/s².", "quiet"))
    body += [paragraph(text, "quiet") for text in _empty_lines(report)]
    body += [paragraph(text, "note") for text in (*left_out_lines(rows), *warning_lines(rows))]
    body += [paragraph(f"The limit: {text}", "quiet") for text in limit_lines(rows)]
    body += [paragraph(f"Who knows what: {text}", "note") for text in knowledge_lines(rows)]
    body += [paragraph(f"The paper's {name}: {PAPER_PARAMETERS[name]}.", "quiet") for name, _ in blocks]
    body += [paragraph(PAPER_NOTE, "note")] if blocks else []
    return Section("Results", body)


def _empty_lines(report: Report) -> list[str]:
    """Which columns of the tables hold nothing, and why where that is known, as a sentence; none where all do."""
    names = _empty(report.rows, _all_lines(report.rows))
    if not names:
        return []
    limits = report.evaluation.limits if report.evaluation is not None else None
    because = f" Nothing is proven of these worlds: {limits.because}." if isinstance(limits, Unproven) else ""
    return [f"Columns without a value in any row are left out: {'; '.join(names)}.{because}"]


def _all_lines(rows: Sequence[SummaryRow]) -> list[Line]:
    """Our lines and the paper's."""
    return [*our_lines(rows), *(line for _, paper in paper_blocks(rows) for line in paper)]


def _empty(rows: Sequence[SummaryRow], lines: Sequence[Line]) -> list[str]:
    """Columns of the table of these rows in which none of the lines has a value."""
    columns = table_columns(rows)
    filled = filled_columns(lines, range(len(columns)))
    return [name for k, name in enumerate(columns) if k not in filled]


def _row(line: Line, columns: Sequence[int]) -> Row:
    return [line.agent, *(Cell(line.cells[k].value, line.cells[k].interval) for k in columns)]


def _episodes(report: Report) -> list[Section]:
    if not report.played or report.evaluation is None:
        return []
    shown, every = len(report.played), report.evaluation.worlds.n
    told = f"{shown} of the {every:,} worlds" if shown < every else f"All {shown} worlds"
    notes = [paragraph(text, "note") for text in _unrepeated(report.played, report.evaluation)]
    played = player(report.played, report.evaluation.vehicles, focus=report.focus)
    return [Section("Episodes", [f"{told}, {_until(report.played, report.evaluation)}", *notes, played])]


def _until(played: Sequence[Played], evaluation: Evaluation) -> str:
    """Where the episodes end, as the end of a sentence."""
    moving = sum(not all(motion.at_rest for motion in world.motions.values()) for world in played)
    if not moving:
        return "from the alert to rest."
    return (
        f"from the alert to rest, or to the horizon of {evaluation.scenario.horizon_s:g} s: in"
        f" {count_of(moving, 'world')} the line of some agent was not at rest then, and the player says whose."
    )


def _unrepeated(played: Sequence[Played], evaluation: Evaluation) -> list[str]:
    """Which agents drove otherwise when they drove once more, as sentences; none where all did the same to the bit."""
    rows = {int(number): row for row, number in enumerate(evaluation.index)}
    found: dict[str, int] = {}
    for world in played:
        for agent, motion in world.motions.items():
            outcome, row = evaluation.outcome(agent), rows[world.number]
            counted = (float(outcome.first_impact_harm[row]), float(outcome.total_harm[row]))
            found[agent] = found.get(agent, 0) + (motion.harm != counted)
    return [
        f"{agent} did not repeat itself in {count_of(count, 'world')} of these: what is played there is another episode"
        " than the one that the tables count."
        for agent, count in found.items()
        if count
    ]


def _other_test(test: ReportTest) -> Section:
    columns = table_columns(test.rows)
    filled = filled_columns(our_lines(test.rows), range(len(columns)))
    lines = [_row(line, filled) for line in our_lines(test.rows)]
    head = ["Agent", *(columns[k] for k in filled)]
    body: list[str | Part] = [test.description, table(head, lines, caption=test.title)]
    if empty := _empty(test.rows, our_lines(test.rows)):
        body.append(paragraph(f"Columns without a value in any row are left out: {'; '.join(empty)}.", "quiet"))
    if test.rows:
        told = [f"{parameter_line(test.rows[0].parameters)}.", *limit_lines(test.rows), *identity_lines(test.rows)]
        body += [paragraph(text, "note") for text in warning_lines(test.rows)]
        body += [paragraph(text, "quiet") for text in told]
    return Section(test.title, body)


def _measures(report: Report) -> Section:
    filled = filled_columns(our_lines(report.rows), _OTHERS)
    lines = [[line.agent, Cell(line.knows, words=True), *_row(line, filled)[1:]] for line in our_lines(report.rows)]
    head = ["Agent", "Knows", *(table_columns(())[k] for k in filled)]
    return Section("Other measures", [table(head, lines, caption="In the same worlds")])


def _reading(report: Report) -> Section:
    empty = set(_empty(report.rows, _all_lines(report.rows)))
    empty = empty.intersection(*(_empty(test.rows, our_lines(test.rows)) for test in report.tests))
    columns = table_columns(report.rows)
    told = {}
    for name, meaning in table_meanings(report.rows).items():
        about = {column for column in columns if column.startswith(name)}
        if not about or about - empty:
            told[name] = meaning
    return Section("How to read the tables", [facts(told)])


def _settings(report: Report) -> list[Section]:
    found = []
    if report.settings:
        found.append(Section("Settings and seeds", [facts(report.settings)]))
    identity = [paragraph(text, "quiet") for text in identity_lines(report.rows)]
    if report.versions or identity:
        found.append(Section("Versions", [*([facts(report.versions)] if report.versions else []), *identity]))
    return found
