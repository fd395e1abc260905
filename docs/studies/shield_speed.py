"""Speed of the shields: ``.venv/bin/python docs/studies/shield_speed.py [DECISIONS]``.

Prints the decisions per second of a batch, and the time of one decision, also with a learned policy behind the shield.
Measure on idle cores.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.episode.game import Shield

SCENARIO, GAME = eb.open_game("paper-random")


def batch_rate(shield: Shield, n: int) -> float:
    """Decisions per second of processor time in a batch of ``n`` worlds with random proposals."""
    game, rng, done = GAME._replace(shield=shield), np.random.default_rng(0), 0
    state = game.reset(SCENARIO.sample(n, 3))
    game.step(state, rng.uniform(-1.0, 1.0, (n, 1)))  # compiles
    start = time.process_time()
    while not state.ended.all():
        done += int((~state.ended).sum())
        state, _ = game.step(state, rng.uniform(-1.0, 1.0, (n, 1)), donate=True)
    return done / (time.process_time() - start)


def single_times(shield: Shield, decisions: int, *, asks: bool = False) -> list[float]:
    """Wall-clock seconds of each decision, one world at a time. ``asks``: the shield's agents propose."""
    game, rng, took = GAME._replace(shield=shield), np.random.default_rng(0), list[float]()
    while len(took) < decisions:
        state = game.reset(SCENARIO.sample(1, 3, first=len(took)))
        while not state.ended.all():
            proposed = None if asks else rng.uniform(-1.0, 1.0, (1, 1))
            begun = time.perf_counter()
            shield.decide(game, state, proposed, donate=False)
            took.append(time.perf_counter() - begun)
            state, _ = game.step(state, proposed)
    return took


def main(decisions: int) -> None:
    teams = {
        name: eb.make_agent(f"ppo+{name}", scenario=SCENARIO)
        for name in ("step", "robust:gaps_m=0.5", "robust:braking_capacity_mps2=10%:gaps_m=0.5")
    }
    for (name, team), n in zip(teams.items(), (4096, 1000, 1000), strict=True):
        team.shield.rests, team.shield.drivers = team.shield.rests[:1], {}
        print(f"{name}: {batch_rate(team.shield, n):,.0f} decisions/s batched", flush=True)
    alone, behind = (eb.make_agent("ppo+step", scenario=SCENARIO).shield for _ in range(2))
    alone.rests, alone.drivers = alone.rests[:1], {}
    for label, took in (
        ("one decision", single_times(alone, decisions)),
        ("one decision with ppo, inference included", single_times(behind, decisions, asks=True)),
    ):
        middle, slow = np.quantile(took, [0.5, 0.99]) * 1e6
        print(f"{label}: p50 {middle:.0f} us, p99 {slow:.0f} us", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("decisions", type=int, nargs="?", default=5_000)
    main(parser.parse_args().decisions)
