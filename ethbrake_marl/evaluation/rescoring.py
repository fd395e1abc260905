"""The same outcomes told under other objectives: what each vehicle's would be, whatever the agents were made for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.rollout import Evaluation
from ethbrake_marl.evaluation.statistics import Estimate, mean
from ethbrake_marl.harm import COUNTS, HarmCount
from ethbrake_marl.objectives import STANDARD, Declared, objectives_of, scored

ALL = "standard"


@dataclass(frozen=True, slots=True)
class Rescored:
    """One agent under one objective and count: the mean for each vehicle, front to rear (m2/s2); less is better."""

    agent: str
    objective: str
    count: HarmCount
    each: tuple[Estimate, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON: objective, count, and each vehicle's mean with its interval."""
        found: dict[str, Any] = {"objective": self.objective, "count": self.count}
        for i, estimate in enumerate(self.each):
            interval = None if estimate.interval is None else list(estimate.interval)
            found |= {f"vehicle_{i + 1}": estimate.value, f"vehicle_{i + 1}_interval": interval}
        return found


def declared_objectives(texts: Sequence[str], vehicles: int) -> list[str]:
    """Objectives by name, ``standard`` standing for all that need no knowledge of the scenario.

    Raises ``InvalidInput`` for one that is unknown, given twice, or made for another number of vehicles.
    """
    names = [name for text in texts for name in (STANDARD if text == ALL else (text,))]
    for k, name in enumerate(names):
        objectives_of(name, vehicles)
        if name in names[:k]:
            raise InvalidInput(f"objective {name!r} is given twice")
    return names


def rescored(evaluation: Evaluation, declared: Sequence[Declared] = STANDARD) -> list[Rescored]:
    """Every agent under every objective and both counts, in that order."""
    return [
        Rescored(agent, objective, count, tuple(mean(column) for column in values.T))
        for agent, outcome in evaluation.outcomes.items()
        for count in COUNTS
        for objective, values in scored(outcome.ledger, count, declared).items()
    ]


def rescored_table(rows: Sequence[Rescored], count: HarmCount) -> Table:
    """The means under one count for a terminal: one line per agent and objective, one column per vehicle."""
    shown = [row for row in rows if row.count == count]
    harm = "first-impact" if count == "first" else "total"
    table = Table(
        box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, title=f"Objectives, {harm} harm", title_justify="left"
    )
    table.add_column("Agent", overflow="fold")
    table.add_column("Objective")
    for i in range(len(shown[0].each) if shown else 0):
        table.add_column(f"Vehicle {i + 1}", justify="right", no_wrap=True)
    for k, row in enumerate(shown):
        agent = "" if k and shown[k - 1].agent == row.agent else row.agent
        table.add_row(Text(agent), Text(row.objective), *(f"{estimate.value:.2f}" for estimate in row.each))
    return table
