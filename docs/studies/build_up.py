"""Harm of agents if brakes build up, by rate and by vehicle: the table ``build-up`` of docs/results/evaluation.md.

.venv/bin/python docs/studies/build_up.py        # prints first-impact / total harm in m2/s2; five minutes on one core
"""

from __future__ import annotations

import warnings

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.physics.advance import advance

WORLDS, SEARCHED, SEED = 1_000, 400, 7
BASE = eb.load_scenario("paper-random")
AGENTS = {"full_brake": "full_brake", "e_v2x_bm": "e_v2x_bm", "universal": "universal", "main": "ppo"}
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


def without_rates(worlds: eb.Worlds) -> str:
    """Return the harms of an E-V2X-BM that assumes brakes without build-up, as text."""
    agent, full = make_agent("e_v2x_bm", scenario=BASE), make_agent("full_brake")
    alert = BASE.sample(WORLDS, SEED).worlds
    chosen, _ = agent.act(alert, agent.begin(alert, 1, {0: full, 2: full}), 1)
    command = -worlds.vehicles.braking_capacity_mps2
    command[:, 1] = chosen
    _, impacts = advance(worlds, command, until_s=BASE.horizon_s)
    return f"{impacts.first_impact_harm.sum(axis=1).mean():.2f} / {impacts.total_harm.sum(axis=1).mean():.2f}"


def harms(worlds: eb.Worlds, scenario: eb.Scenario, agents: dict[str, str]) -> dict[str, str]:
    drivers = {name: make_agent(spec, scenario=scenario) for name, spec in agents.items()}
    result = eb.evaluate(worlds, drivers, scenario=scenario)
    outcomes = {name: result.outcome(name) for name in agents}
    return {n: f"{each.first_impact_harm.mean():.2f} / {each.total_harm.mean():.2f}" for n, each in outcomes.items()}


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # the policies were not trained with these brakes, and warn
    for name, rates in CASES.items():
        scenario = BASE
        if min(rates) < AT_ONCE:
            scenario = BASE.replace(name="rates", brake_rate_mps3=list(rates), release_rate_mps3=list(rates))
        worlds = scenario.sample(WORLDS, SEED).worlds
        row = harms(worlds, scenario, AGENTS)
        row |= {"e_v2x_bm without rates": without_rates(worlds)}
        row |= harms(worlds.take(np.arange(SEARCHED)), scenario, {f"best_harm, {SEARCHED} worlds": "best_harm"})
        print(name, row, flush=True)
