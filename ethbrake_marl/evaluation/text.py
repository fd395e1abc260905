"""The summary table as text, for a terminal (rich) and for a document (markdown), and the sentences below it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from ethbrake_marl.agents.knowledge import Source
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.cells import (
    NONE,
    SEES_THROUGH,
    Cell,
    Line,
    our_lines,
    paper_blocks,
    percent_cell,
    table_columns,
)
from ethbrake_marl.evaluation.conditions import parameter_line
from ethbrake_marl.evaluation.harm_metrics import metric_headings
from ethbrake_marl.evaluation.paper import PAPER_NOTE, PAPER_PARAMETERS
from ethbrake_marl.evaluation.regret import Between, Distance
from ethbrake_marl.evaluation.table import SummaryRow

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


def metrics_table(rows: Sequence[SummaryRow]) -> Table:
    """The registered harm metrics for a terminal: one line per agent, the mean per world with its interval."""
    table = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title="Harm metrics", title_justify="left")
    table.add_column("Agent", overflow="fold")
    for heading in metric_headings(rows[0].metrics).values() if rows else ():
        table.add_column(Text(heading), justify="right", overflow="fold")
    for row in rows:
        table.add_row(Text(row.agent), *(Text(estimate.in_words()) for estimate in row.metrics.values()))
    return table


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
    return f"{100 * part / whole:.1f} %" if whole > 0.0 else NONE


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
