"""Harm over total distance: the agents of the paper's figure 4 on ``paper-distance``, by total gap.

``.venv/bin/python docs/studies/distances.py`` prints the table of docs/results/paper.json: 5,000 worlds of seed 7.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.scenario import load_scenario

SPECS = ("full_brake", "e_v2x_bm:pairwise", "e_v2x_bm", "ppo@shipped/ppo", "sac@shipped/sac")
ENDS_M = (12.0, 14.0, 16.0, 18.0)
WORLDS, SEED = 5_000, 7


if __name__ == "__main__":
    scenario = load_scenario("paper-distance")
    result = evaluate(scenario.sample(WORLDS, SEED), make_lineup(SPECS, scenario), scenario=scenario)
    groups = np.digitize(result.worlds.gaps_m.sum(axis=1), ENDS_M)
    print("total gap (m) 10-12, 12-14, 14-16, 16-18, 18-20")
    for spec, outcome in result.outcomes.items():
        print(f"{spec:17}", *(f"{outcome.first_impact_harm[groups == g].mean():6.2f}" for g in range(5)))
    predicted = result.outcome("e_v2x_bm:pairwise").predicted_harm
    assert predicted is not None
    print("its prediction   ", *(f"{predicted[groups == g].mean():6.2f}" for g in range(5)))
