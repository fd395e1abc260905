"""The leaderboard as a page."""

from __future__ import annotations

from collections.abc import Sequence

from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.pages.frame import Section, page, paragraph
from ethbrake_marl.pages.parts import Block, Cell, facts, table
from ethbrake_marl.studies.benchmark.entry import Entry, ListResult
from ethbrake_marl.studies.benchmark.leaderboard import Leaderboard
from ethbrake_marl.studies.benchmark.table import RANK, SCORE, lists_told, ranks


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
