"""One hash for the final state and harm of 10,000 worlds, one for 200 others, and how to print both.

``python -m tests.physics.state_hash`` prints the figures of ``tests/golden/physics_worlds.json``. They change only with
a change of the physics or of the order of its floating point operations; then the sums tell which of the two it was.
"""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import numpy as np

from ethbrake_marl.harm import empty_ledger
from ethbrake_marl.physics import Floats, advance
from tests.physics.random_worlds import Draws, driving_lines

GOLDEN = Path(__file__).parents[1] / "golden" / "physics_worlds.json"
LINES = {  # by name: vehicles and worlds
    "all": {2: 2_000, 3: 6_000, 5: 1_500, 10: 450, 50: 50},
    "few": {2: 60, 3: 90, 5: 40, 10: 8, 50: 2},  # for runs without compilation
}
UNTIL_S = (0.1, 0.2, 0.7, 1.3, 2.0, 4.0, 8.0)  # the command changes at each


def run(N: int, n: int) -> tuple[Floats, ...]:
    """Final gaps and speeds, harm by both counts, and impacts, of ``n`` lines of ``N`` vehicles."""
    worlds, _ = driving_lines(1_000 + N, n, N)
    draws = Draws(2_000 + N)
    ledger = empty_ledger(worlds)
    for until in UNTIL_S:
        worlds, impacts = advance(worlds, draws.uniform(-8.0, 3.0, (n, N)), until_s=until)
        ledger = ledger.add(impacts)
    count = ledger.count.astype(np.float64)
    return worlds.gaps_m, worlds.speeds_mps, ledger.pair_harm("first"), ledger.pair_harm("total"), count


def figures(name: str = "all") -> dict[str, str | int | float]:
    """The hash over the little-endian bytes of all columns, and rounded sums over all worlds."""
    digest = hashlib.sha256()
    results = [run(N, n) for N, n in LINES[name].items()]
    for columns in results:
        for column in columns:
            digest.update(np.ascontiguousarray(column, "<f8").tobytes())
    gaps, speeds, first, total, count = (sum(float(columns[k].sum()) for columns in results) for k in range(5))
    return {
        "worlds": sum(LINES[name].values()),
        "sha256": digest.hexdigest(),
        "impacts": int(count),
        "first_impact_harm_m2ps2": round(first, 2),
        "total_harm_m2ps2": round(total, 2),
        "gaps_m": round(gaps, 2),
        "speeds_mps": round(speeds, 2),
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps({name: figures(name) for name in LINES}, indent=2) + "\n")
