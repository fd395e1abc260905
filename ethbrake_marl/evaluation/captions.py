"""One-line captions that describe the worlds of a result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ethbrake_marl.errors import count_of
from ethbrake_marl.worlds.quantities import QUANTITIES

SYMBOLS = {
    "gaps_m": ("d", "m"), "speeds_mps": ("v", "m/s"), "braking_capacity_mps2": ("braking capacity", "m/s²"),
    "driving_capacity_mps2": ("driving capacity", "m/s²"), "latency_s": ("τ", "s"), "mass_t": ("m", "t"),
    "restitution": ("e", ""), "obstacle_gap_m": ("obstacle at", "m"), "friction": ("friction", ""),
    "brake_rate_mps3": ("brake rate", "m/s³"), "release_rate_mps3": ("release rate", "m/s³"),
    "harm_weight": ("weight of harm", ""),
}  # fmt: skip
STAY = "\u00a0"  # a space at which no line ends


def ranges_of(worlds: Mapping[str, Any]) -> dict[str, Any]:
    """Quantities of worlds, key -> value, or ``[smallest, largest]`` if the worlds differ.

    A quantity of vehicles or pairs has a list with an entry for each of them: ``{"gaps_m": [7.0, [5.0, 9.0]],
    "restitution": 0.1}``. ``worlds``: columns, name -> [n]. A column without any number is left out.
    """
    ranges: dict[str, Any] = {}
    for key, rule in QUANTITIES.items():
        names = [name for i in range(len(worlds)) if (name := rule.column_of(i)) in worlds] if rule.column else []
        columns = [worlds[name] for name in dict.fromkeys(names) if not np.isnan(worlds[name]).all()]
        ends = [[float(np.nanmin(column)), float(np.nanmax(column))] for column in columns]
        plain = [low if low == high else [low, high] for low, high in ends]
        if plain:
            ranges[key] = plain[0] if rule.per == "world" else plain
    return ranges


def caption(parameters: Mapping[str, Any]) -> str:
    """One line with scenario, number of worlds, seed, recordings and quantities, from ``SummaryTable.parameters``."""
    parts = []
    for key, (symbol, unit) in SYMBOLS.items():
        if key in parameters:
            entries = [parameters[key]] if QUANTITIES[key].per == "world" else parameters[key]
            texts = [f"{e[0]:.3g}–{e[1]:.3g}" if isinstance(e, list) else f"{e:.4g}" for e in entries]
            value = texts[0] if len(set(texts)) == 1 else f"({f',{STAY}'.join(texts)})"
            parts.append(f"{symbol}{STAY}={STAY}{value}{f'{STAY}{unit}' if unit else ''}")
    seed = "" if parameters.get("seed") is None else f", seed {parameters['seed']}"
    worlds = f"{count_of(parameters['count'], 'world')}{seed}{by_recording(parameters.get('recordings', 0))}"
    physics = f" (physics: {parameters['physics']})" if "physics" in parameters else ""
    return f"{parameters['scenario']}{physics}: {worlds}; {'; '.join(parts)}"


def by_recording(recordings: int) -> str:
    """End of a caption: the number of traffic recordings on which the 95 % intervals rest; empty for 0 recordings."""
    if recordings == 1:
        return "; no 95 % intervals: all worlds come from one recording"
    return f"; 95 % intervals by {recordings:,} recordings" if recordings else ""
