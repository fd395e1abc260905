"""When several threads pay: ``.venv/bin/python docs/studies/threads.py``.

``advance(threads=1)`` and ``threads=2`` in turn, on worlds that brake; wall time, since processor time does not show
what waiting costs. The figures mean something only where two cores are idle; what the second thread costs where they
are not is worth seeing, too.
"""

from __future__ import annotations

import os
import statistics
import time

from ethbrake_marl.envs import make_engine
from ethbrake_marl.physics import advance

SCENARIO, SEED = "paper-random", 7
WORLDS = (1000, 3000, 10_000, 30_000, 100_000)
REPETITIONS, WORLD_STEPS = 15, 200_000


def main() -> None:
    """Print one line for each number of worlds."""
    for n in WORLDS:
        worlds = make_engine(SCENARIO, n, seed=SEED).worlds
        command = -worlds.vehicles.braking_capacity_mps2
        calls = max(3, WORLD_STEPS // n)
        found: dict[int, list[float]] = {1: [], 2: []}
        for _ in range(REPETITIONS):
            for threads, durations in found.items():
                begin = time.perf_counter()
                for _ in range(calls):
                    advance(worlds, command, 0.1, threads=threads)
                durations.append((time.perf_counter() - begin) / calls * 1e6)
        one, two = (statistics.median(durations) for durations in found.values())
        gain = f"{one / two:.2g} times as fast"
        print(f"n = {n:7,}: 1 thread {one:9,.0f} us, 2 threads {two:9,.0f} us: {gain}", flush=True)
    print(f"load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
