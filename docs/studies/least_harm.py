"""Harm for each budget of the search, and of a Vehicle 2 that may only brake: docs/best-harm.md.

.venv/bin/python docs/studies/least_harm.py
"""

from __future__ import annotations

import time

from ethbrake_marl import load_scenario
from ethbrake_marl.limits.limits import best_harm

scenario = load_scenario("paper-random")
worlds = scenario.sample(200, seed=7).worlds
best_harm(scenario, worlds.take([0]), budget=10, threads=1)  # compiles, once
for budget in (100, 1_000, 10_000, 60_000, 100_000):
    for count in ("first", "total"):
        start = time.process_time()
        harm = best_harm(scenario, worlds, counts=[count], budget=budget, threads=1).best[count].harm
        print(f"{budget:9,} {count} {harm.mean():.4f} {1e3 * (time.process_time() - start) / worlds.n:.1f} ms/world")
for driving in (7.0, 0.0):
    chosen = scenario.replace(driving_capacity_mps2=[6.0, driving, 6.0])
    table = best_harm(chosen, chosen.sample(200, seed=7).worlds, budget=20_000)
    print(driving, table.best["first"].harm.mean(), table.best["total"].harm.mean())
