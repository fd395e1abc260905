"""Harm against processor time, on the same worlds and the same clock: table `equal-time` of docs/results/baselines.md.

    .venv/bin/python docs/studies/equal_time.py [AGENT ...]

The first agent is what the others are compared with. Each is measured with its whole episode: what it does at the
alert, every decision, and the motion of the worlds. No shipped table holds the worlds of this list, so ``best_harm:K``
has to search them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence

import numpy as np

from ethbrake_marl.agents.protocol import Driver
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.evaluation.outcome import Outcome
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.statistics import paired_difference
from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario

AGENTS = (
    "ppo+search", "ppo", "universal", "full_brake+search", "e_v2x_bm",
    *(f"best_harm:{candidates}" for candidates in (1000, 3000, 10_000, 40_000)),
    *(f"planner:{candidates}" for candidates in (64, 256, 1024)),
)  # fmt: skip
WORLDS, SEED, REPEATS = 1000, 8, 2
CHUNK = 500  # worlds driven together, for every agent alike
HEAD = ("agent", "knows", "CPU, ms per world", "first-impact", "total", "difference")


def drive(
    sample: Sample, agents: Mapping[str, Driver], scenario: Scenario, repeats: int
) -> dict[str, tuple[float, Outcome]]:
    """Median processor time per world (ms) and outcome of every agent, which drive in turn."""
    few = sample.take(np.arange(min(sample.worlds.n, 2)))
    evaluate(few, agents, scenario=scenario, chunk=CHUNK)  # not counted: kernels are compiled, tables are read
    spent: dict[str, list[float]] = {name: [] for name in agents}
    outcomes: dict[str, Outcome] = {}
    for _ in range(repeats):
        for name, agent in agents.items():
            begin = time.process_time()
            outcomes[name] = evaluate(sample, {name: agent}, scenario=scenario, chunk=CHUNK).outcome(name)
            spent[name].append(1e3 * (time.process_time() - begin) / sample.worlds.n)
    return {name: (float(np.median(spent[name])), outcomes[name]) for name in agents}


def rows_of(driven: Mapping[str, tuple[float, Outcome]], against: str) -> list[Sequence[str]]:
    """The cells of the table, quickest first; the difference is paired by world, with its 95 % interval."""
    reference, rows = driven[against][1].first_impact_harm, []
    for name, (spent_ms, outcome) in sorted(driven.items(), key=lambda each: each[1][0]):
        harm = outcome.first_impact_harm
        found = paired_difference(harm, reference)
        low, high = found.interval or (found.value, found.value)
        difference = "" if name == against else f"{found.value:+.3f} [{low:+.3f}, {high:+.3f}]"
        means = [f"{each.mean():.3f}" for each in (harm, outcome.total_harm)]
        rows.append([f"`{name}`", outcome.knows.text, f"{spent_ms:.2f}", *means, difference])
    return rows


if __name__ == "__main__":
    scenario = load_scenario("paper-random")
    agents = make_lineup(sys.argv[1:] or AGENTS, scenario)
    rows = rows_of(drive(scenario.sample(WORLDS, SEED), agents, scenario, REPEATS), next(iter(agents)))
    print("\n".join(f"| {' | '.join(cells)} |" for cells in (HEAD, ["---"] * len(HEAD), *rows)))
    print(f"\nMachine: {this_machine()}")
