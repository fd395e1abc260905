"""Texts below a table of results: the worlds, and what a reader should know before believing the numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.summary_row import EXPLOITS, SEES_THROUGH, SummaryRow
from ethbrake_marl.worlds.rules import RULES

SYMBOLS = {
    "gaps_m": ("d", "m"), "speeds_mps": ("v", "m/s"), "braking_capacity_mps2": ("braking capacity", "m/s²"),
    "driving_capacity_mps2": ("driving capacity", "m/s²"), "latency_s": ("τ", "s"), "mass_t": ("m", "t"),
    "restitution": ("e", ""), "obstacle_gap_m": ("obstacle at", "m"), "friction": ("friction", ""),
    "brake_rate_mps3": ("brake rate", "m/s³"), "release_rate_mps3": ("release rate", "m/s³"),
    "harm_weight": ("weight of harm", ""),
}  # fmt: skip
STAY = "\u00a0"  # a space at which no line ends


def ranges_of(worlds: Mapping[str, Any]) -> dict[str, Any]:
    """Return for each quantity its value, or ``[smallest, largest]``: a list with one per vehicle or pair.

    ``{"gaps_m": [7.0, [5.0, 9.0]], "restitution": 0.1}``. Rates that no vehicle has are left out.
    """
    ranges: dict[str, Any] = {}
    for key, rule in RULES.items():
        names = [name for i in range(len(worlds)) if (name := rule.column_of(i)) in worlds] if rule.column else []
        ends = [[float(np.nanmin(worlds[name])), float(np.nanmax(worlds[name]))] for name in dict.fromkeys(names)]
        plain = [low if low == high else [low, high] for low, high in ends]
        if plain:
            ranges[key] = plain[0] if rule.per == "world" else plain
    return ranges


def caption(parameters: Mapping[str, Any]) -> str:
    """Return one line: scenario, number of worlds, seed, recordings and quantities."""
    parts = []
    for key, (symbol, unit) in SYMBOLS.items():
        if key in parameters:
            entries = [parameters[key]] if RULES[key].per == "world" else parameters[key]
            texts = [f"{e[0]:.3g}–{e[1]:.3g}" if isinstance(e, list) else f"{e:.4g}" for e in entries]
            value = texts[0] if len(set(texts)) == 1 else f"({f',{STAY}'.join(texts)})"
            parts.append(f"{symbol}{STAY}={STAY}{value}{f'{STAY}{unit}' if unit else ''}")
    seed = "" if parameters.get("seed") is None else f", seed {parameters['seed']}"
    worlds = f"{count_of(parameters['count'], 'world')}{seed}{by_recording(parameters.get('recordings', 0))}"
    return f"{parameters['scenario']}: {worlds}; {'; '.join(parts)}"


def by_recording(recordings: int) -> str:
    """Return the part of a caption that says how intervals count recordings; "" without recordings."""
    if recordings == 1:
        return "; no 95 % intervals: all worlds come from one recording"
    return f"; 95 % intervals by {recordings:,} recordings" if recordings else ""


def notes_of(rows: Sequence[SummaryRow], parameters: Mapping[str, Any]) -> list[str]:
    """Return what to say below a table: rejected draws, ends at the horizon, exploits, no impact, hidden values."""
    notes = [_rejected(parameters), _cut_off(rows, parameters), exploits_of({row.agent: row for row in rows})]
    return [*filter(None, [*notes, _no_impact(rows, parameters), _knowledge(rows)])]


def exploits_of(rows: Mapping[str, SummaryRow]) -> str:
    """Return a sentence about agents that do damage which harm does not count; "" if there are none."""
    each = "; ".join(f"{agent} {' and '.join(row.exploits.values())}" for agent, row in rows.items() if row.exploits)
    return f"{EXPLOITS} Harm does not count this: {each} (docs/train.md)." if each else ""


def _rejected(parameters: Mapping[str, Any]) -> str:
    rejected = parameters.get("rejected_draws", 0)
    draws = rejected + parameters["count"]
    text = (
        f"{rejected:,} of {draws:,} drawn worlds ({100.0 * rejected / draws:.1f} %) were rejected and drawn again,"
        " because an impact happened before a learner could act (early_impacts: reject). These results do not apply to"
        " such worlds."
    )
    return text if rejected else ""


def _cut_off(rows: Sequence[SummaryRow], parameters: Mapping[str, Any]) -> str:
    moving = ", ".join(f"{row.agent} {row.horizon_ends:,}" for row in rows if row.horizon_ends)
    text = (
        f"In some of the {parameters['count']:,} worlds a vehicle still moved at the horizon"
        f" ({parameters['horizon_s']:g} s): {moving}. Harm after the horizon is not counted."
    )
    return text if moving else ""


def _no_impact(rows: Sequence[SummaryRow], parameters: Mapping[str, Any]) -> str:
    unhurt = [row for row in rows if not row.collisions]
    if not unhurt:
        return ""
    where = f"No impact in {count_of(parameters['count'], 'world')}: {', '.join(row.agent for row in unhurt)}."
    rate = unhurt[0]["collision_rate"]
    if rate is None or rate.interval is None:
        return f"{where} All worlds come from one recording, so nothing is known about other recordings."
    return (
        f"{where} With 95 % confidence, at most {100 * rate.interval[1]:.2g} % of all such worlds have an impact. The"
        " harm of those impacts is not known."
    )


def _knowledge(rows: Sequence[SummaryRow]) -> str:
    hidden = rows[0].hidden_share
    if not hidden:
        return ""
    text = (
        f"In {100 * hidden:.1f} % of these worlds the V2X channel hides something from a controlled vehicle at its"
        " first decision: messages have not arrived, are old or lack something, or another vehicle reacts later than"
        " its message says."
    )
    through = ", ".join(row.agent for row in rows if row.sees_through)
    if through:
        text += (
            f" {SEES_THROUGH} {through}: reads hidden values nevertheless (omniscient). No vehicle with this channel"
            " could do so; use the result as a limit to compare with."
        )
    silent = ", ".join(row.agent for row in rows if "not stated" in row.knows)
    return text + (f" These agents do not state what they know: {silent}." if silent else "")
