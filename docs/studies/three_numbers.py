"""Predicted, realised and coupled harm: docs/baselines.md, "Three numbers that are never confused".

.venv/bin/python docs/studies/three_numbers.py
"""

from __future__ import annotations

from ethbrake_marl import load_scenario
from ethbrake_marl.agents import make_agent, pairwise_harm
from ethbrake_marl.physics import advance

worlds = load_scenario("paper-random").sample(10_000, seed=7).worlds
for spec, count in [
    ("full_brake", "first"),
    ("e_v2x_bm:pairwise", "first"),
    ("e_v2x_bm", "first"),
    ("e_v2x_bm", "total"),
]:
    agent = make_agent(spec, harm_count=count)
    memory = agent.begin(worlds, 1, {}) if hasattr(agent, "begin") else {}
    command = -worlds.vehicles.braking_capacity_mps2
    command[:, 1] = agent.act(worlds, memory, 1)[0] if memory else agent.act(worlds, 1)
    _, impacts = advance(worlds, command, until_s=8.0)
    predicted = memory.get("predicted_harm", pairwise_harm(worlds, -command).sum(axis=1)).mean()
    print(
        f"{spec:18} {count} {predicted:6.2f} {(impacts.count.sum(axis=1) > 0).mean():7.2%}"
        f" {impacts.first_impact_harm.sum(axis=1).mean():6.2f} {impacts.total_harm.sum(axis=1).mean():6.2f}"
    )
