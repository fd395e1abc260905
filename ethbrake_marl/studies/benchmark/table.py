"""Entries and leaderboards as text and as Markdown; ``page`` has the page."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.table import Table
from rich.text import Text

from ethbrake_marl.errors import one_line
from ethbrake_marl.studies.benchmark.entry import Entry, ListResult, NotDriven
from ethbrake_marl.studies.benchmark.leaderboard import Leaderboard, Row
from ethbrake_marl.studies.benchmark.suite import Suite

SCORE = (
    "Realised share of what is possible, in %: (full braking - agent) / (full braking - best known) of the mean harm"
    " of a list; 0 is full braking, 100 the best known. 95 % intervals in brackets."
)
RANK = (
    "Only who drives every list is ranked, by the mean over all lists. A mean over some of them is shown, and is no"
    " score: those lists may be the easy ones."
)


def leaderboard_table(found: Leaderboard) -> Table:
    """One line per entry, for a terminal; lists that were not driven show a dash."""
    drawn = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    drawn.add_column("", justify="right", no_wrap=True)
    drawn.add_column("Agent", overflow="fold")
    drawn.add_column("Overall", justify="right", no_wrap=True)
    drawn.add_column("Lists", justify="right", no_wrap=True)
    drawn.add_column("Realised share of each list, in the suite's order", overflow="fold")
    for rank, row in ranks(found):
        each = "  ".join(f"{name} {_share(row.entry, name)}" for name in row.entry.lists)
        drawn.add_row(rank, Text(row.entry.agent), _overall(row), lists_told(row, found.suite), Text(each))
    return drawn


def list_table(entry: Entry, suite: Suite) -> Table:
    """One line per list of one entry, for a terminal; means per world."""
    drawn = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    drawn.add_column("List", no_wrap=True)
    for heading in ("Share %", "Worst decile", "First", "Total", "Collided %", "Moving %"):
        drawn.add_column(heading, justify="right", no_wrap=True)
    reasons = []
    for each in suite.lists:
        result = entry.lists[each.name]
        if isinstance(result, NotDriven):
            drawn.add_row(each.name, "not driven", *["–"] * 5)
            reasons.append(f"{each.name}: {result.not_driven}")
        else:
            drawn.add_row(each.name, *_short_figures(result))
    drawn.caption = Text("\n".join(reasons)) if reasons else None
    drawn.caption_justify = "left"
    return drawn


def leaderboard_markdown(found: Leaderboard) -> str:
    """The leaderboard as a table of Markdown, one column per list."""
    names = [each.name for each in found.suite.lists]
    head = ["", "Agent", "Overall", *names]
    lines = [_line(head), _line(["---:", "---", *["---:"] * (len(names) + 1)])]
    for rank, row in ranks(found):
        overall = _overall(row) if row.ranked else f"({_overall(row)}, {lists_told(row, found.suite)} lists)"
        agent = one_line(row.entry.agent).replace("`", "'").replace("|", "/")
        lines.append(_line([rank, f"`{agent}`", overall, *(_share(row.entry, name) for name in names)]))
    return "\n".join(lines) + "\n"


def ranks(found: Leaderboard) -> list[tuple[str, Row]]:
    """Every entry with its rank; a dash for who did not drive every list."""
    return [(str(k + 1) if row.ranked else "–", row) for k, row in enumerate(found.rows)]


def lists_told(row: Row, suite: Suite) -> str:
    """How many lists it drove, of how many."""
    return f"{row.entry.lists_driven} of {len(suite.lists)}"


def _overall(row: Row) -> str:
    return row.score.in_words(digits=1, scale=100.0)


def _share(entry: Entry, name: str) -> str:
    result = entry.lists[name]
    return f"{100.0 * result.realised_share.value:z.1f}" if isinstance(result, ListResult) else "–"


def _short_figures(result: ListResult) -> list[str]:
    """The figures of a list in words, in the order of the headings; intervals of the two that rank."""
    harms = (result.first_impact_harm, result.total_harm)
    return [
        result.realised_share.in_words(digits=1, scale=100.0),
        result.worst_decile_regret.in_words(digits=1),
        *(f"{told.value:.2f}" for told in harms),
        f"{100.0 * result.collision_rate.value:.1f}",
        f"{100.0 * result.horizon_ends / result.worlds:.1f}",
    ]


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"
