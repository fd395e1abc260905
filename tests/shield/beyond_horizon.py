"""What a bound is worth beyond its horizon: ``python -m tests.shield.beyond_horizon``.

Step mode on ``paper-random`` with a horizon of 3 s; from there on everybody brakes fully until all stand.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.physics import advance
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import ShieldedDriver

HORIZON_S, REST_S = 3.0, 8.0


def above_later(proposer: str, worlds: int) -> tuple[float, float]:
    """Share of the worlds above their bound at the horizon, and once all stand."""
    scenario = load_scenario("paper-random").replace(horizon_s=HORIZON_S)
    agent = ShieldedDriver(make_agent(proposer), scenario)
    episodes = drive(scenario.sample(worlds, 7).worlds, agent, scenario, 1)
    final, bound = episodes.final, episodes.guarded.shield.predicted_harm
    braking = -final.vehicles.braking_capacity_mps2
    _, impacts = advance(final, braking, until_s=np.full(worlds, REST_S))
    now, later = (ledger.world_harm("first") for ledger in (episodes.ledger, episodes.ledger.add(impacts)))
    return float((now > bound).mean()), float((later > bound + 1e-9).mean())


def main() -> None:
    """One line per proposer."""
    for proposer in ("coast", "full_brake", "e_v2x_bm"):
        now, later = above_later(proposer, 2_000)
        print(f"{proposer:12s} above the bound at {HORIZON_S:g} s: {now:.1%}, once all stand: {later:.1%}")


if __name__ == "__main__":
    main()
