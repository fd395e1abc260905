"""Harm that no bound of a shield covers, for docs/shield.md: between the corners, and after the horizon.

python docs/studies/uncovered.py --intervals mass_t=20% --draws 10000
python docs/studies/uncovered.py --horizon
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.extensions.certified.robust import RobustShield, reset_without_shield

BATCH, BOXES = 50_000, 20  # worlds inside a box that are simulated together; number of boxes


def between(intervals: str, draws: int) -> str:
    """Count the worlds between the corners that do more harm than the bound, if somebody proposes to coast.

    The actions do not depend on which world of the box is the true one. So one shield decides per box, and many worlds
    of the box are played with its actions.
    """
    scenario, game = eb.open_game("paper-random")
    nominal, rng = scenario.sample(BOXES, 1), np.random.default_rng(1)
    shield = RobustShield(uncertainty=intervals, harm_count="first")
    guarded = game._replace(shield=shield)
    state = guarded.reset(nominal)
    applied = np.full((BOXES, state.memories["shield"].plan.shape[1], 1), np.nan)
    while not state.ended.all():
        rows = np.flatnonzero(~state.ended)
        steps = state.steps[rows]
        state, _ = guarded.step(state, np.zeros((BOXES, 1)))
        applied[rows, steps] = state.memories["shield"].applied[rows]
    memory, above, excess = state.memories["shield"], 0, -np.inf
    plans = np.where(np.isnan(applied), memory.plan, applied)
    sizes = [min(BATCH, draws - first) for first in range(0, draws, BATCH)]
    for k, n in product(range(BOXES), sizes):
        truth = reset_without_shield(game, shield.uncertainty.draw(nominal.take(np.full(n, k)), rng))
        over = eb.price(game, truth, plans[k : k + 1].repeat(n, axis=0), "first") - memory.first[k]
        above, excess = above + int((over > 1e-9).sum()), max(excess, over.max())
    worlds = BOXES * draws
    return (
        f"{worlds:,} worlds, above: {above:,} ({above / worlds:.2%}), most by {excess:.2g}; bound"
        f" {memory.first.mean():.2f}"
    )


def beyond_horizon(proposer: str) -> str:
    """Count worlds above the bound if the episode ends at 3 s, once all vehicles have braked from then on to rest."""
    scenario, game = eb.open_game(eb.load_scenario("paper-random").replace(horizon_s=3.0))
    team = eb.shield(eb.make_agent(proposer), scenario=scenario, harm_count="first")
    last = eb.play_to_end(game, scenario.sample(2_000, 7), team)
    bound = last.memories["shield"].first
    later = eb.hold(last, -last.car[:, 3], [2], -last.car[:, np.newaxis, 3, [2]], 60.0, "first")[0, :, 0]
    return f"{proposer}: above the bound when all vehicles are at rest: {(later > bound + 1e-9).mean():.1%}"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--intervals", default="gaps_m=0.5")
    parser.add_argument("--draws", type=int, default=50_000, help="worlds from each box")
    parser.add_argument("--horizon", action="store_true", help="after the horizon")
    given = parser.parse_args()
    if given.horizon:
        print("\n".join(map(beyond_horizon, ("coast", "full_brake"))))
    else:
        print(between(given.intervals, given.draws))
