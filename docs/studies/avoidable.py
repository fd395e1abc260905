"""How many worlds of the paper's lists nobody could have got through, and what asking costs.

``PYTHONPATH=. .venv/bin/python docs/studies/avoidable.py`` prints the rows of docs/results/avoidability.json, 10,000
worlds of seed 7 each, and the speeds of docs/avoidability.md. The witnesses of all avoidable worlds are played.
"""

from __future__ import annotations

import time

from ethbrake_marl.limits.lower_bound import avoidability, lower_bound
from ethbrake_marl.scenario import load_scenario
from tests.reference.play_profile import play_profile

LISTS = ("paper-random", "paper-random-early", "paper-delay-low", "paper-delay-middle", "paper-delay-high")
WORLDS, SEED, REPEATS = 10_000, 7, 10


def row(name: str) -> str:
    """One row of the table."""
    worlds = load_scenario(name).sample(WORLDS, SEED).worlds
    verdict, bound = avoidability(worlds), lower_bound(worlds)
    good = verdict.avoidable
    _, ledger = play_profile(worlds.take(good), 1, verdict.switch_s[good], verdict.command_mps2[good])
    front, rear = (verdict.reason == 2).mean(), (verdict.reason == 3).mean()
    return (
        f"| {name} | {1 - good.mean():.2%} | {front:.2%} | {rear:.2%} | {bound.impact_proven.mean():.2%} |"
        f" {bound.harm.mean():.2f} | {ledger.count.sum()} |"
    )


if __name__ == "__main__":
    print("\n".join(map(row, LISTS)))
    worlds = load_scenario("paper-random").sample(WORLDS, SEED).worlds
    for question in (avoidability, lower_bound):
        start = time.process_time()
        for _ in range(REPEATS):
            question(worlds)
        print(f"{question.__name__}: {REPEATS * worlds.n / (time.process_time() - start):,.0f} worlds/s")
