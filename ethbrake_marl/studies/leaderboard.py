"""The leaderboard: entries of one suite, sorted by their score."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from ethbrake_marl.errors import InvalidInput, one_line
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.pages.frame import Block, Cell, Section, facts, page, paragraph, table
from ethbrake_marl.studies.benchmark import Entry, ListResult, NotDriven, Suite, load_suite, read_entry


@dataclass(frozen=True, slots=True)
class Row:
    """One entry of the table."""

    path: Path
    entry: Entry

    @property
    def ranked(self) -> bool:
        """Whether it drove every list; only then its mean is a score that can be compared."""
        return self.entry.overall is not None

    @property
    def score(self) -> Estimate:
        """Mean realised share over the lists that it drove."""
        return self.entry.mean_of_driven

    @property
    def policies(self) -> frozenset[str]:
        """Every policy that drove for it."""
        return frozenset(sha256 for each in self.entry.driven.values() for sha256 in each.policies.values())

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        entry = self.entry
        return {
            "file": self.path.name,
            "agent": entry.agent,
            "overall": None if entry.overall is None else entry.overall.to_json(),
            "mean_of_driven": entry.mean_of_driven.to_json(),
            "lists_driven": entry.lists_driven,
            "policies": sorted(self.policies),
            "lists": {name: each.model_dump(mode="json") for name, each in entry.lists.items()},
        }


@dataclass(frozen=True, slots=True)
class Leaderboard:
    """Entries of one suite: those of all lists by their score, then the others by how many lists they drove."""

    suite: Suite
    rows: tuple[Row, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        told = {"suite": self.suite.name, "suite_sha256": self.suite.sha256}
        return {**told, "entries": [row.to_json() for row in self.rows]}


def read_leaderboard(paths: Sequence[Path], suite: Suite | None = None) -> Leaderboard:
    """Read and sort entries of one suite (default: the one that the first entry names).

    Raises ``InvalidInput`` naming the first file that is refused: no entry, changed since it was made, or of another
    suite.
    """
    if not paths:
        raise InvalidInput("leaderboard: no entries given; ethbrake benchmark writes them")
    rows = [Row(path, read_entry(path)) for path in paths]
    suite = load_suite(rows[0].entry.suite) if suite is None else suite
    names = {each.name for each in suite.lists}
    for row in rows:
        if row.entry.suite_sha256 != suite.sha256 or row.entry.lists.keys() != names:
            raise InvalidInput(
                f"{row.path}: is about another suite: {row.entry.suite} with SHA-256 {row.entry.suite_sha256:.12}, and"
                f" this is {suite.name} with {suite.sha256:.12}"
            )
    rows.sort(key=lambda row: (-row.entry.lists_driven, -row.score.value, row.entry.agent))
    return Leaderboard(suite, tuple(rows))


# Entries and leaderboards as text and as Markdown; ``page`` has the page.

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


# The leaderboard as a page.


def leaderboard_page(found: Leaderboard) -> str:
    """The leaderboard as a page: the ranking, each list, and where each entry comes from."""
    suite = found.suite
    lead = f"Suite {suite.name}, SHA-256 {suite.sha256}. {SCORE}"
    names = [each.name for each in suite.lists]
    head = ["Agent", "Rank", "Overall", "Lists", *names]
    rows = [
        [
            row.entry.agent,
            rank,
            _cell(row.score),
            lists_told(row, suite),
            *(_list_cell(row.entry, name) for name in names),
        ]
        for rank, row in ranks(found)
    ]
    ranking = Section("Ranking", [table(head, rows, caption="Realised share, %"), paragraph(RANK, "quiet")])
    return page(f"Benchmark {suite.name}", [ranking, _each_list(found), _entries(found)], lead=lead)


def _each_list(found: Leaderboard) -> Section:
    """Every list with the figures of every entry."""
    head = (
        "Agent", "Realised share, %", "Worst decile: regret", "First-impact harm", "Total harm", "Collisions, %",
        "Moving at the horizon, %",
    )  # fmt: skip
    rows: list[Block | Sequence[object]] = []
    for each in found.suite.lists:
        content = each.content
        rows.append(
            Block(
                f"{each.name}: {content.worlds} worlds of seed {content.seed}, {content.harm_count} harm; full braking"
                f" {content.full_brake_harm:.2f}, best known {content.best_known_harm:.2f} m²/s²"
            )
        )
        for row in found.rows:
            result = row.entry.lists[each.name]
            if isinstance(result, ListResult):
                rows.append([row.entry.agent, *_cells(result)])
            else:
                rows.append([row.entry.agent, Cell("not driven", result.not_driven, words=True), *["–"] * 5])
    return Section("Lists", [table(head, rows, caption="Harm is in m²/s², mean per world")])


def _entries(found: Leaderboard) -> Section:
    """How each entry was made."""
    told = {
        row.entry.agent: f"{row.entry.command}; policies: {', '.join(sorted(row.policies)) or 'none'}; "
        + ", ".join(f"{name} {version}" for name, version in row.entry.versions.items())
        + f"; entry SHA-256 {row.entry.entry_sha256}"
        for row in found.rows
    }
    return Section("Entries", [facts(told)])


def _cells(result: ListResult) -> list[Cell]:
    """The same as cells of a page."""
    shares = (result.realised_share, result.collision_rate)
    harms = [result.worst_decile_regret, result.first_impact_harm, result.total_harm]
    first, last = (_cell(told) for told in shares)
    moving = Cell(f"{100.0 * result.horizon_ends / result.worlds:.1f}")
    return [first, *(_cell(told, scale=1.0, digits=2) for told in harms), last, moving]


def _list_cell(entry: Entry, name: str) -> Cell:
    result = entry.lists[name]
    return _cell(result.realised_share) if isinstance(result, ListResult) else Cell("–")


def _cell(estimate: Estimate, *, scale: float = 100.0, digits: int = 1) -> Cell:
    value, _, interval = estimate.in_words(digits=digits, scale=scale).partition(" ")
    return Cell(value, interval)
