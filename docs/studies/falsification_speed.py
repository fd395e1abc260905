"""How much sooner ``ethbrake study falsify`` finds a planted weakness than worlds drawn at random.

``python docs/studies/falsification_speed.py [--seeds N]``: an agent with a hole in 0.1 % of the worlds. Prints worlds
tried until the first and the tenth in the hole, and how many in all: medians over seeds.
"""

from __future__ import annotations

import argparse

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.falsification import Measure

BUDGET = 6_000


class Holed:
    """Brakes fully, but coasts where three conditions hold, each of which a tenth of the worlds meets."""

    name = "holed"

    def begin(self, alert, vehicle, scripts):
        return (alert.gaps_m < 5.5).all(axis=1) & (alert.speeds_mps[:, 1] > 21.6)

    def act(self, worlds, memory, vehicle):
        return np.where(memory, 0.0, -worlds.vehicles.braking_capacity_mps2[:, vehicle]), memory


def main() -> None:
    """Print one line for each way to search."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=12)
    seeds = parser.parse_args().seeds
    scenario = load_scenario("paper-random")
    measure = Measure("regret", {"holed": Holed(), "full_brake": eb.make_agent("full_brake")}, scenario, "first")
    for name, adaptive in (("adaptive", True), ("at random", False)):
        rows = []
        for seed in range(seeds):
            hits = np.flatnonzero(measure.falsify(BUDGET, seed, adaptive=adaptive).scores > 0.0) + 1
            rows.append([*(hits[k] if len(hits) > k else np.inf for k in (0, 9)), len(hits)])
        first, tenth, count = np.median(rows, axis=0)
        print(f"hole, {name}: first after {first:g}, tenth after {tenth:g}, {count:g} of {BUDGET:,} worlds", flush=True)


if __name__ == "__main__":
    main()
