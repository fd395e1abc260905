"""The cells of the summary table: columns, their meanings, and one line for each agent and row of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ethbrake_marl.agents.knowledge import knowledge_text
from ethbrake_marl.evaluation.harm_metrics import metric_headings, metric_meanings
from ethbrake_marl.evaluation.paper import PAPER_ROWS, PaperRow
from ethbrake_marl.evaluation.regret import Distance
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.evaluation.table import SummaryRow

NONE = "–"
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
    knows: str = NONE


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
    return tuple(k for k in columns if not lines or any(line.cells[k].value != NONE for line in lines))


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
    decrease = NONE if row.harm_decrease is None else f"{100 * row.harm_decrease:.4g} %"
    cells = (
        f"{100 * row.collision_rate:.4g} %",
        f"{row.average_harm:.6g}",
        *[NONE] * 4,
        decrease,
        *[NONE] * (4 + metrics),
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
        return Cell(NONE)
    value = f"{scale * estimate.value:.{digits}f}{unit}"
    if estimate.interval is None:
        return Cell(value)
    low, high = (f"{scale * end:.{digits}f}" for end in estimate.interval)
    return Cell(value, f"{low}, {high}")
