"""How much of the harm does the spread of vehicles on one road decide? The table of docs/findings.md.

    .venv/bin/python docs/studies/one_road.py

Each world has one road. Each vehicle's brakes reach between 1 - s and 1 + s of the road's middle value, which is drawn
as in ``realistic-motorway``.
"""

from __future__ import annotations

import argparse

import ethbrake_marl as eb

SPREADS = (0.0, 0.1, 0.2, 0.28)
AGENTS = ("full_brake", "idm", "plan")
SCENARIOS = ("realistic-motorway", "recorded-openacc")
MIDDLE = (0.45, 0.81)  # friction 0.5 to 0.9 times the middle of a grip of 0.8 to 1
NOT_THE_LIMIT_MPS2 = 20.0


def with_spread(scenario: eb.Scenario, spread: float) -> eb.Scenario:
    friction = {"uniform": [middle * (1.0 + spread) for middle in MIDDLE]}
    grip = {"uniform": [(1.0 - spread) / (1.0 + spread), 1.0]}
    return scenario.replace(friction=friction, grip=grip, braking_capacity_mps2=NOT_THE_LIMIT_MPS2)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=2000)
    worlds = parser.parse_args().worlds
    print("| scenario | spread | " + " | ".join(f"`{agent}`" for agent in AGENTS) + " |")
    print("|---|---:|" + "---:|" * len(AGENTS))
    for name in SCENARIOS:
        for spread in SPREADS:
            result = eb.evaluate(with_spread(eb.load_scenario(name), spread), AGENTS, episodes=worlds)
            means = [(result[agent]["collided"].mean(), result[agent]["honest_cost"].mean()) for agent in AGENTS]
            cells = [f"{100.0 * rate:.1f} % / {cost:.2f}" for rate, cost in means]
            print(f"| `{name}` | {100 * spread:.0f} % | " + " | ".join(cells) + " |", flush=True)
