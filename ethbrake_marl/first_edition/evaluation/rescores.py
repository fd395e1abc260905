"""Mean values of several objectives in an agent's results: one row per agent, objective and count of harm."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from ethbrake_marl.files.sheet import Column, Estimate, Sheet, terminal_text
from ethbrake_marl.first_edition.evaluation.conditions import Conditions
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount


@dataclass(frozen=True, slots=True)
class Rescored:
    """Mean value of one objective for each vehicle, over all worlds that one agent drives. Smaller is better."""

    agent: str
    objective: str  # as in scenarios: ``total``, ``own``, ``social:45``
    harm_count: HarmCount
    each: tuple[Estimate, ...]  # mean value per world (m2/s2) for each vehicle, front to rear

    def to_json(self) -> dict[str, Any]:
        """Return the objective, the count of harm, and each vehicle's mean with its interval, for JSON."""
        each = Estimate.side_by_side({f"vehicle_{i + 1}": estimate for i, estimate in enumerate(self.each)})
        return {"objective": self.objective, "harm_count": self.harm_count, **each}


class Rescores(list[Rescored]):
    """List of ``Rescored`` rows, shown by ``print`` and in notebooks as two tables: first-impact and total harm.

    Args:
        rows: one row for each agent, objective and count of harm.
        recordings: number of recordings that the worlds come from, or 0.

    """

    def __init__(self, rows: Iterable[Rescored] = (), recordings: int = 0) -> None:
        super().__init__(rows)
        self.recordings = recordings

    def __str__(self) -> str:
        return terminal_text(self.sheet("first"), "", self.sheet("total"), whole_rows=True)

    def _repr_html_(self) -> str:
        return "\n".join(self.sheet(harm_count).html() for harm_count in HARM_COUNTS)

    def sheet(self, harm_count: HarmCount) -> Sheet:
        """Return the table for one count of harm, with a row per agent and objective, and a column per vehicle."""
        shown = [row for row in self if row.harm_count == harm_count]
        vehicles = range(len(shown[0].each) if shown else 0)
        columns = [Column(f"Vehicle {i + 1}", interval="below") for i in vehicles]
        names = ["" if k and shown[k - 1].agent == row.agent else row.agent for k, row in enumerate(shown)]
        lines = [(name, row.objective, *row.each) for name, row in zip(names, shown, strict=True)]
        by = Conditions(recordings=self.recordings).by_recording
        title = f"Objectives, {'first-impact' if harm_count == 'first' else 'total'} harm"
        note = (
            f"Means per world in m²/s² (injury:CURVE: injuries in 1,000 lines), with their 95 % intervals{by}. own: the"
            " harm that the vehicle bears."
        )
        return Sheet(title, ["Agent", "Objective", *columns], lines, note)
