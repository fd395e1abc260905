"""Speed of the step shield: ``.venv/bin/python docs/studies/shield_speed.py [DECISIONS]``.

Prints the decisions per second of a batch, the time of one decision, and the time of one decision with a learned policy
behind the shield. Measure single decisions on idle cores.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.names import team_of

SCENARIO, GAME = eb.open_game("paper-random")


def shielded(spec: str) -> eb.Game:
    """Return the game behind the shield of an agent."""
    return team_of(eb.make_agent(spec, scenario=SCENARIO), SCENARIO).game(GAME)


def batch_rate(spec: str, n: int) -> float:
    """Return decisions per processor second of a batch of ``n`` worlds with random proposals."""
    game, rng = shielded(spec), np.random.default_rng(0)
    game.step(game.begin(SCENARIO.sample(2, 3)), np.zeros((2, 1)))  # compiles
    state = game.begin(SCENARIO.sample(n, 3))
    done, start = 0, time.process_time()
    while not state.ended.all():
        done += int((~state.ended).sum())
        state, _ = game.step(state, rng.uniform(-1.0, 1.0, (n, 1)))
    return done / (time.process_time() - start)


def single_times(spec: str, decisions: int, clock: str) -> list[float]:
    """Return the seconds of each decision, one world at a time; without proposals the shield's own agent proposes."""
    game, rng, took = shielded(spec), np.random.default_rng(0), list[float]()
    assert game.shield is not None
    now = time.perf_counter if clock == "wall" else time.process_time
    for world in range(decisions):
        state = game.begin(SCENARIO.sample(1, 3, first=world))
        while not state.ended.all() and len(took) < decisions:
            proposed = rng.uniform(-1.0, 1.0, (1, 1)) if clock == "wall" else None
            begun = now()
            game.shield.decide(game, state, proposed, donate=False)
            took.append(now() - begun)
            state, _ = game.step(state, proposed)
    return took


def main(decisions: int = 5_000) -> None:
    """Print one line per measurement."""
    for spec, n in (
        ("coast+step", 4096),
        ("coast+robust:gaps_m=0.5", 1000),
        ("coast+robust:braking_capacity_mps2=10%,gaps_m=0.5", 1000),
    ):
        print(f"{spec}: {batch_rate(spec, n):,.0f} decisions/s batched", flush=True)
    for label, took in (
        ("one decision", single_times("coast+step", decisions, "wall")),
        ("one decision with ppo, inference included", single_times("ppo+step", decisions, "processor")),
    ):
        middle, slow = np.quantile(took, [0.5, 0.99]) * 1e6
        print(f"{label}: p50 {middle:.0f} us, p99 {slow:.0f} us", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
