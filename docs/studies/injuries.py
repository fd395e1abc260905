"""Evaluate agents with injuries beside harm, by three curves from the literature; prints JSON.

``python docs/studies/injuries.py --agents full_brake,e_v2x_bm --scenario paper-random --episodes 2000``
"""

from __future__ import annotations

import argparse
import json

import ethbrake_marl as eb
from ethbrake_marl.evaluation import make_lineup, register_injury
from ethbrake_marl.harm import HARM_COUNTS


def main() -> None:
    """Print one row for each agent."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", required=True)
    parser.add_argument("--scenario", default="paper-random")
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--harm-count", choices=HARM_COUNTS, default="first", help="harm that agents minimise")
    given = parser.parse_args()
    register_injury()
    scenario = eb.load_scenario(given.scenario)
    agents = make_lineup(given.agents, scenario, harm_count=given.harm_count)
    found = eb.evaluate(agents=agents, scenario=scenario, episodes=given.episodes)
    print(json.dumps(eb.summarise(found).to_json(), indent=2))


if __name__ == "__main__":
    main()
