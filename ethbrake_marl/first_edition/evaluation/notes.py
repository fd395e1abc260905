"""Notes below a results table: warnings and explanations that apply to the agents and worlds of the table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from ethbrake_marl.errors import count_of
from ethbrake_marl.first_edition.agents.protocol import Source
from ethbrake_marl.first_edition.evaluation.exploits import Exploits
from ethbrake_marl.first_edition.evaluation.measure_sets import MEASURE_SETS, MeasureSet
from ethbrake_marl.first_edition.evaluation.outcome import LeftOut
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow

Note = tuple[Literal["note", "quiet"], str]  # kind and text; the kind "note" is shown more prominently than "quiet"

SEES_THROUGH = "† "  # mark of an omniscient agent, which reads values that no message carried


def notes_of(rows: Sequence[SummaryRow]) -> list[Note]:
    """Return the notes to print below a results table."""
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
    """Return all warnings about a results table, as sentences."""
    return [f"WARNING: {warning}." for each in _sets_in(rows) for warning in each.warnings(rows)]


def identity_line(rows: Sequence[SummaryRow]) -> str:
    """Return a sentence with the hashes of worlds, scenario and policies of a results table ("" for an empty table)."""
    if not rows:
        return ""
    policies = [f"{row.agent} ({', '.join(row.policy_sha256.values())})" for row in rows if row.policy_sha256]
    text = f"SHA-256 of the worlds {rows[0].worlds_sha256}, of the scenario {rows[0].scenario_sha256}"
    return f"{text}{', of policies: ' + '; '.join(policies) if policies else ''}."


def _sets_in(rows: Sequence[SummaryRow]) -> list[MeasureSet]:
    """Return the registered sets of measures that added fields to the rows (``SummaryRow.more``)."""
    return [each for name, each in MEASURE_SETS.items() if rows and name in rows[0].more]


def _left_out(row: SummaryRow) -> str:
    """Return the note about worlds that were left out for all agents; "" without such worlds."""
    if not row.left_out:
        return ""
    return LeftOut.line([str(left) for left in row.left_out], row.episodes + len(row.left_out))


def _rejected(row: SummaryRow) -> str:
    """Return the note about drawn worlds that were rejected because of an early impact; "" without such worlds."""
    rejected = row.parameters.get("rejected_draws", 0)
    draws = rejected + row.episodes + len(row.left_out)
    text = (
        f"{rejected:,} of {draws:,} drawn worlds ({100.0 * rejected / draws:.1f} %) were rejected and drawn again,"
        " because an impact happened before a learner could act (early_impacts: reject). These results do not apply to"
        " such worlds."
    )
    return text if rejected else ""


def _cut_off(rows: Sequence[SummaryRow]) -> str:
    """Return the note about worlds in which a vehicle still moved at the horizon; "" without such worlds."""
    moving = ", ".join(f"{row.agent} {row.horizon_ends:,}" for row in rows if row.horizon_ends)
    if not moving:
        return ""
    return (
        f"In some of the {rows[0].episodes:,} worlds a vehicle still moved at the horizon"
        f" ({rows[0].parameters['horizon_s']:g} s): {moving}. Harm after the horizon is not counted."
    )


def _no_impact(rows: Sequence[SummaryRow]) -> str:
    """Return the note about agents that had no impact in any world; "" without such agents."""
    unhurt = [row for row in rows if not row.collisions]
    if not unhurt:
        return ""
    where = f"No impact in {count_of(unhurt[0].episodes, 'world')}: {', '.join(row.agent for row in unhurt)}."
    if unhurt[0].collision_rate.interval is None:
        return f"{where} All worlds come from one recording, so nothing is known about other recordings."
    most = 100 * unhurt[0].collision_rate.ends[1]
    return (
        f"{where} With 95 % confidence, at most {most:.2g} % of all such worlds have an impact. The harm of those"
        " impacts is not known."
    )


def _knowledge(rows: Sequence[SummaryRow]) -> str:
    """Return the note about what the V2X channel hides, and which agents know it anyway; "" if it hides nothing."""
    hidden = rows[0].hidden_share
    if not hidden:
        return ""
    text = (
        f"In {100 * hidden:.1f} % of these worlds the V2X channel hides something from a controlled vehicle at its"
        " first decision: messages have not arrived, another vehicle reacts later than its message says, or no message"
        " contains a quantity."
    )
    through = ", ".join(row.agent for row in rows if row.sees_through)
    if through:
        text += (
            f" {SEES_THROUGH.strip()} {through}: reads hidden values nevertheless (omniscient). No vehicle with this"
            " channel could do so; use the result as a limit to compare with."
        )
    silent = ", ".join(row.agent for row in rows if Source.UNSTATED in row.knows)
    return text + (f" These agents do not state what they know: {silent}." if silent else "")
