"""Harm of agents if brakes build up, by rate and by vehicle, for docs/results/evaluation.md.

.venv/bin/python docs/studies/build_up.py        # prints first-impact / total harm in m2/s2; five minutes on one core
"""

from __future__ import annotations

import argparse
import warnings
from typing import Any

import numpy as np

import ethbrake_marl as eb

WORLDS, SEARCHED, SEED = 1_000, 400, 7
BASE = eb.load_scenario("paper-random")
AGENTS = {"full_brake": "full_brake", "e_v2x_bm": "e_v2x_bm", "universal-paper": "universal-paper", "main": "ppo"}
HARMS = ("first_impact_harm", "total_harm")
AT_ONCE = 1e6
CASES = {
    "at once": (AT_ONCE,) * 3,
    "100": (100.0,) * 3,
    "30": (30.0,) * 3,
    "12.65": (12.65,) * 3,
    "Vehicle 1 alone": (12.65, AT_ONCE, AT_ONCE),
    "Vehicle 2 alone": (AT_ONCE, 12.65, AT_ONCE),
    "Vehicle 3 alone": (AT_ONCE, AT_ONCE, 12.65),
}


class WithoutRates:
    """An E-V2X-BM that assumes brakes without build-up: it decides in the same worlds of ``BASE``."""

    name, knows = "e_v2x_bm without rates", "true model"

    def __init__(self) -> None:
        self.agent = eb.make_agent("e_v2x_bm", scenario=BASE)

    def begin(self, alert: eb.State, body: int) -> np.ndarray:
        plain = BASE.sample(WORLDS, SEED)
        return self.agent.act(plain, self.agent.begin(plain, body), body)[0][: alert.n]

    def act(self, state: eb.State, memory: np.ndarray, body: int) -> tuple[np.ndarray, np.ndarray]:
        return memory, memory


def harms(worlds: eb.State, scenario: eb.Scenario, agents: dict[str, Any]) -> dict[str, str]:
    """Return the mean harms of each agent as text."""
    result = eb.evaluate(worlds, agents, scenario=scenario)
    return {name: " / ".join(f"{result[name][each].mean():.2f}" for each in HARMS) for name in agents}


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    warnings.simplefilter("ignore")  # the policies were not trained with these brakes, and warn
    for name, rates in CASES.items():
        scenario = BASE
        if min(rates) < AT_ONCE:
            scenario = BASE.replace(name="rates", brake_rate_mps3=list(rates), release_rate_mps3=list(rates))
        worlds = scenario.sample(WORLDS, SEED)
        row = harms(worlds, scenario, {**AGENTS, "e_v2x_bm without rates": WithoutRates()})
        row |= harms(worlds.take(slice(0, SEARCHED)), scenario, {f"best_harm, {SEARCHED} worlds": "best_harm"})
        print(name, row, flush=True)
