"""How much sooner ``ethbrake search falsify`` finds planted weaknesses than worlds drawn at random.

``python -m tests.benchmarks.falsification_speed [--seeds N] [--leaks WORD,WORD]``: an agent with a hole in 0.1 % of the
worlds, and shields with planted leaks (of ``make shield-bugs``), each in a copy of the repository.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.falsification import Measure
from tests.programme.copies import KERNELS, working_copy
from tests.programme.planting import plant
from tests.shield.planted_bugs import BUGS
from tests.studies.test_falsification import Holed

BUDGET = 6_000
LEAK_BUDGET = 1_024
COMMAND = "from ethbrake_marl.cli.app import main; main()"


def hole(seeds: int) -> None:
    """Worlds tried until the first and the tenth in the hole, and how many in all: medians over seeds."""
    scenario = load_scenario("paper-random")
    measure = Measure("regret", {"holed": Holed(), "full_brake": eb.make_agent("full_brake")}, scenario, "first")
    for adaptive in (True, False):
        rows = []
        for seed in range(seeds):
            hits = np.flatnonzero(measure.falsify(BUDGET, seed, adaptive=adaptive).scores > 0.0) + 1
            rows.append([*(hits[k] if len(hits) > k else np.inf for k in (0, 9)), len(hits)])
        first, tenth, count = np.median(rows, axis=0)
        name = "adaptive" if adaptive else "at random"
        print(f"hole, {name}: first after {first:g}, tenth after {tenth:g}, {count:g} of {BUDGET:,} worlds", flush=True)


def leak(name: str, seeds: int) -> None:
    """The same of a shield with a planted leak: worlds above its bound."""
    with working_copy() as folder:
        plant(folder, BUGS[name])
        for how in ([], ["--at-random"]):
            rows = []
            for seed in range(seeds):
                options = ["--agent", "ppo@shipped+step", "--measure", "bound", "--seed", str(seed), *how]
                call = [
                    sys.executable,
                    "-c",
                    COMMAND,
                    "search",
                    "falsify",
                    *options,
                    "--budget",
                    str(LEAK_BUDGET),
                    "--json",
                ]
                environment = {**os.environ, "PYTHONPATH": str(folder), "NUMBA_CACHE_DIR": str(folder / KERNELS)}
                done = subprocess.run(call, cwd=folder, env=environment, capture_output=True, text=True, check=True)
                told = json.loads(done.stdout)
                rows.append([told["first_above_zero"] or np.inf, told["share_above_zero"], told["worst"]])
            first, share, worst = np.median(rows, axis=0)
            text = f"first after {first:g}, {share:.1%} of {LEAK_BUDGET:,} above the bound, worst by {worst:.3g} m2/s2"
            print(f"{name}, {'at random' if how else 'adaptive'}: {text}", flush=True)


def main() -> None:
    """Print one line for each weakness and way to search."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--leaks", default="", help="parts of the names of leaks")
    given = parser.parse_args()
    hole(given.seeds)
    for word in filter(None, given.leaks.split(",")):
        for name in (name for name in BUGS if word in name):
            leak(name, 3)


if __name__ == "__main__":
    main()
