"""Notes below a results table: warnings and explanations, each only if it applies to the rows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from ethbrake_marl.agents.protocol import Source
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.exploits import Exploits
from ethbrake_marl.evaluation.measure_sets import MEASURE_SETS, MeasureSet
from ethbrake_marl.evaluation.outcome import LeftOut
from ethbrake_marl.evaluation.summary_row import SummaryRow

Note = tuple[Literal["note", "quiet"], str]  # kind and text; a "note" is shown more prominently than a "quiet" text

SEES_THROUGH = "† "  # mark of an agent whose knowledge did not come through the channel


def notes_of(rows: Sequence[SummaryRow]) -> list[Note]:
    """Return the notes to print below a results table with these rows, in the order in which they are printed."""
    if not rows:
        return []
    notes: list[Note] = [
        ("note", _left_out(rows[0])),
        ("note", _rejected(rows[0])),
        *(("note", warning) for warning in warnings_of(rows)),
        ("note", _cut_off(rows)),
        ("note", Exploits.sentence({row.agent: row.exploits for row in rows})),
        ("note", _no_impact(rows)),
        *(("quiet", text) for each in _sets_in(rows) for text in each.notes(rows)),
        ("note", _knowledge(rows)),
    ]
    return [(kind, text) for kind, text in notes if text]


def warnings_of(rows: Sequence[SummaryRow]) -> list[str]:
    """Return the warnings of all sets of measures about the rows of a results table, as sentences."""
    return [f"WARNING: {warning}." for each in _sets_in(rows) for warning in each.warnings(rows)]


def identity_line(rows: Sequence[SummaryRow]) -> str:
    """Return a sentence with the hashes of worlds, scenario and policies of a results table; empty without rows."""
    if not rows:
        return ""
    policies = [f"{row.agent} ({', '.join(row.policy_sha256.values())})" for row in rows if row.policy_sha256]
    text = f"SHA-256 of the worlds {rows[0].worlds_sha256}, of the scenario {rows[0].scenario_sha256}"
    return f"{text}{', of policies: ' + '; '.join(policies) if policies else ''}."


def _sets_in(rows: Sequence[SummaryRow]) -> list[MeasureSet]:
    """Return the registered sets of measures that added fields to these rows (``SummaryRow.more``)."""
    return [each for name, each in MEASURE_SETS.items() if rows and name in rows[0].more]


def _left_out(row: SummaryRow) -> str:
    """Return the note about worlds that were left out for every agent; empty if there are none."""
    if not row.left_out:
        return ""
    return LeftOut.line([str(left) for left in row.left_out], row.episodes + len(row.left_out))


def _rejected(row: SummaryRow) -> str:
    """Return the note about draws of a table's rows that were rejected for an early impact; empty if there are none."""
    rejected = row.parameters.get("rejected_draws", 0)
    draws = rejected + row.episodes + len(row.left_out)
    text = (
        f"Drawn again: {rejected:,} of {draws:,} draws ({100.0 * rejected / draws:.1f} %), which had an impact before a"
        " learner may act (early_impacts: reject). These results say nothing about such rows."
    )
    return text if rejected else ""


def _cut_off(rows: Sequence[SummaryRow]) -> str:
    """Return the note about worlds in which a vehicle still moved at the horizon; empty if there are none."""
    moving = ", ".join(f"{row.agent} {row.horizon_ends:,}" for row in rows if row.horizon_ends)
    if not moving:
        return ""
    return (
        f"At the horizon ({rows[0].parameters['horizon_s']:g} s) something still moved; harm after it is not counted."
        f" Worlds, of {rows[0].episodes:,}: {moving}."
    )


def _no_impact(rows: Sequence[SummaryRow]) -> str:
    """Return the note about agents that had no impact in any world; empty if there are none."""
    unhurt = [row for row in rows if not row.collisions]
    if not unhurt:
        return ""
    where = f"No impact in {count_of(unhurt[0].episodes, 'world')}: {', '.join(row.agent for row in unhurt)}."
    if unhurt[0].collision_rate.interval is None:
        return f"{where} They are all of one recording, which says nothing about others."
    most = 100 * unhurt[0].collision_rate.ends[1]
    return (
        f"{where} With 95 % confidence at most {most:.2g} % of all such worlds have one; how much harm these would do"
        " is not known."
    )


def _knowledge(rows: Sequence[SummaryRow]) -> str:
    """Return the note about what the V2X channel hides, and about agents that know it nevertheless.

    It also lists agents that do not state their knowledge. It is empty if the channel hides nothing in these worlds.
    """
    hidden = rows[0].hidden_share
    if not hidden:
        return ""
    text = (
        f"In {100 * hidden:.1f} % of these worlds the channel hides something of the line from a controlled vehicle at"
        " its first decision: news that has not arrived, how late another vehicle will react, or what no message"
        " contains."
    )
    through = ", ".join(row.agent for row in rows if row.sees_through)
    if through:
        text += (
            f" {SEES_THROUGH.strip()} {through}: sees the line as it is all the same. Take that as a limit to compare"
            " with; no vehicle on this channel could do it."
        )
    silent = ", ".join(row.agent for row in rows if Source.UNSTATED in row.knows)
    return text + (f" These agents do not state what they know: {silent}." if silent else "")
