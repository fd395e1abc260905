"""All keys of `v2x`, and delays of the news with each preset, for docs/cooperation.md.

.venv/bin/python docs/studies/presets.py
"""

from __future__ import annotations

import argparse

import numpy as np

from ethbrake_marl import load_scenario
from ethbrake_marl.worlds.channel import PRESETS
from ethbrake_marl.worlds.channel_table import page_table

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
print(page_table(), end="\n\n")
base = load_scenario("cooperation-2-paper")
for preset in [*PRESETS][1:]:
    worlds = base.replace(v2x=preset, latency_s=0).sample(100_000, seed=7)
    reacts, known = worlds.latency_s, worlds.know  # the latter by body: 1 is Vehicle 1
    columns = (reacts[:, 1], reacts[:, 2], known[:, 2, 3])
    cells = [f"{np.median(c):.2f}, {np.quantile(c, 0.95):.2f}" for c in columns]
    print(f"| `{preset}` | {' | '.join(cells)} | {np.isinf(known[:, 3, 1]).mean():.1%} |")
