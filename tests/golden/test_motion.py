"""Motion of random lines to the last bit.

``physics_worlds.json`` has a digest, which changes with the order of floating point operations, and rounded sums, which
change only with the physics. ``python -m tests.golden.test_motion`` records both anew.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.interval import FAILED
from ethbrake_marl.motion.layout import Floats
from tests.motion.lines import driven, lines

FILE = Path(__file__).with_name("physics_worlds.json")
WORLDS = {  # by name: vehicles and number of worlds
    "all": {2: 2_000, 3: 6_000, 5: 1_500, 10: 450, 50: 50},
    "few": {2: 60, 3: 90, 5: 40, 10: 8, 50: 2},
}
UNTIL_S = (0.1, 0.2, 0.7, 1.3, 2.0, 4.0, 8.0)  # the commands change at each


class Draws:
    """Uniform doubles from the raw words of a counter: the same on any machine and with any version of numpy."""

    def __init__(self, key: int) -> None:
        self.words = np.random.Philox(key=key)

    def uniform(self, low: float, high: float, shape: tuple[int, ...]) -> Floats:
        words = np.asarray(self.words.random_raw(int(np.prod(shape))), np.uint64).reshape(shape)
        return low + (high - low) * ((words >> np.uint64(11)).astype(np.float64) * 2.0**-53)

    def choice(self, values: list[float], shape: tuple[int, ...]) -> Floats:
        return np.asarray(values)[self.uniform(0.0, len(values), shape).astype(np.int64)]


def driving_lines(key: int, n: int, N: int) -> tuple[Floats, Floats]:
    """Lines, [n], some of which touch or rest at the start."""
    draws = Draws(key)
    gaps = draws.uniform(0.2, 10.0, (n, N - 1)) * draws.choice([1.0] * 9 + [0.0], (n, N - 1))
    speeds = draws.uniform(5.0, 25.0, (n, N)) * draws.choice([1.0] * 19 + [0.0], (n, N))
    latency, mass, limit = (draws.uniform(low, high, (n, N)) for low, high in ((0.0, 1.0), (1.0, 8.0), (25.0, 30.0)))
    restitution = draws.choice([0.0, 0.1, 0.3, 0.7], (n,))
    return lines(gaps, speeds, latency_s=latency, mass_t=mass, speed_limit_mps=limit, restitution=restitution)


def columns(N: int, n: int) -> tuple[Floats, ...]:
    """Final gaps and speeds, harm by both counts and number of impacts, of n lines of N vehicles."""
    line, car = driving_lines(1_000 + N, n, N)
    draws, start = Draws(2_000 + N), 0.0
    for until in UNTIL_S:
        line, met, _ = driven(line, car, draws.uniform(-8.0, 3.0, (n, N)), start, until)
        assert (met != FAILED).all()
        start = until
    pairs = (line[:, row, 1:-1] for row in (at.FIRST, at.TOTAL, at.IMPACTS))
    return line[:, at.GAP, 1:-1], line[:, at.SPEED, 1:], *pairs


def figures(name: str) -> dict[str, str | int | float]:
    """Digest of all columns, and rounded sums over all worlds."""
    digest, results = hashlib.sha256(), [columns(N, n) for N, n in WORLDS[name].items()]
    for arrays in results:
        for array in arrays:
            digest.update(np.ascontiguousarray(array, "<f8").tobytes())
    gaps, speeds, first, total, count = (sum(float(arrays[k].sum()) for arrays in results) for k in range(5))
    return {
        "worlds": sum(WORLDS[name].values()),
        "sha256": digest.hexdigest(),
        "impacts": int(count),
        "first_impact_harm_m2ps2": round(first, 2),
        "total_harm_m2ps2": round(total, 2),
        "gaps_m": round(gaps, 2),
        "speeds_mps": round(speeds, 2),
    }


@pytest.mark.parametrize("name", WORLDS)
def test_motion__has_the_bits_of_the_record(name: str) -> None:
    assert figures(name) == json.loads(FILE.read_text("utf-8"))[name]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    FILE.write_text(json.dumps({name: figures(name) for name in WORLDS}, indent=2) + "\n", "utf-8")
