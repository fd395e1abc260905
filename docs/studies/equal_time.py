"""Harm and processor time of agents on the same worlds: the table `equal-time` of docs/results/baselines.md.

    .venv/bin/python docs/studies/equal_time.py [AGENT ...]

All agents are compared with the first one. The time is for whole episodes: the work at the alert, all decisions, and
the motion of the worlds. No shipped table contains the worlds of this list, so ``best_harm:K`` has to search.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence

import numpy as np

from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.first_edition.agents.protocol import Driver
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.evaluation.outcome import Outcome
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.statistics import paired_difference
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario

AGENTS = (
    "ppo+search", "ppo", "universal", "full_brake+search", "e_v2x_bm",
    *(f"best_harm:{candidates}" for candidates in (1000, 3000, 10_000, 40_000)),
)  # fmt: skip
WORLDS, SEED, REPEATS = 1000, 8, 2
CHUNK = 500  # worlds simulated together, equal for all agents
HEAD = ("agent", "knows", "CPU, ms per world", "first-impact", "total", "difference")


def drive(
    sample: Sample, agents: Mapping[str, Driver], scenario: Scenario, repeats: int
) -> dict[str, tuple[float, Outcome]]:
    """Return the median processor time per world (ms) and the outcome of every agent. The agents drive in turn."""
    few = sample.take(np.arange(min(sample.worlds.n, 2)))
    evaluate(few, agents, scenario=scenario, chunk=CHUNK)  # compiles kernels and reads tables, before the measurement
    spent: dict[str, list[float]] = {name: [] for name in agents}
    outcomes: dict[str, Outcome] = {}
    for _ in range(repeats):
        for name, agent in agents.items():
            begin = time.process_time()
            outcomes[name] = evaluate(sample, {name: agent}, scenario=scenario, chunk=CHUNK).outcome(name)
            spent[name].append(1e3 * (time.process_time() - begin) / sample.worlds.n)
    return {name: (float(np.median(spent[name])), outcomes[name]) for name in agents}


def rows_of(driven: Mapping[str, tuple[float, Outcome]], against: str) -> list[Sequence[str]]:
    """Return the rows of the table, fastest agent first.

    The difference in first-impact harm from agent ``against`` is paired by world, with its 95 % interval.
    """
    reference, rows = driven[against][1].first_impact_harm, []
    for name, (spent_ms, outcome) in sorted(driven.items(), key=lambda each: each[1][0]):
        harm = outcome.first_impact_harm
        change = paired_difference(harm, reference)
        low, high = change.interval or (change.value, change.value)
        difference = "" if name == against else f"{change.value:+.3f} [{low:+.3f}, {high:+.3f}]"
        means = [f"{each.mean():.3f}" for each in (harm, outcome.total_harm)]
        rows.append([f"`{name}`", outcome.knows.text, f"{spent_ms:.2f}", *means, difference])
    return rows


if __name__ == "__main__":
    scenario = load_scenario("paper-random")
    agents = make_lineup(sys.argv[1:] or AGENTS, scenario)
    rows = rows_of(drive(scenario.sample(WORLDS, SEED), agents, scenario, REPEATS), next(iter(agents)))
    print("\n".join(f"| {' | '.join(cells)} |" for cells in (HEAD, ["---"] * len(HEAD), *rows)))
    print(f"\nMachine: {this_machine()}")
