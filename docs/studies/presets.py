"""Delays of the news with each preset, for docs/cooperation.md, "The delay of a message".

.venv/bin/python docs/studies/presets.py
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl import load_scenario
from ethbrake_marl.first_edition.scenario.channel import PRESETS

base = load_scenario("cooperation-2-paper")
for preset in PRESETS[1:]:
    vehicles = base.replace(v2x=preset, latency_s=0).sample(100_000, seed=7).worlds.vehicles
    reacts, known = vehicles.latency_s, vehicles.known_from_s
    columns = (reacts[:, 1], reacts[:, 2], known[:, 1, 2])
    cells = [f"{np.median(c):.2f}, {np.quantile(c, 0.95):.2f}" for c in columns]
    print(f"| `{preset}` | {' | '.join(cells)} | {np.isinf(known[:, 2, 0]).mean():.1%} |")
