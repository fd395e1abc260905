"""Trying to break the step shield: ``make test-shield`` (``python -m tests.shield.programme --worlds 2000``).

Adversaries of ``tests.shield.lines`` propose in every step; harm is read from the engine's ledger. One line per gate:
no realised harm above the bound at the alert (tolerance 1e-9), for both counts, N = 3 and 5, e from 0 to 0.3; the
search is not too weak (restarts whose accepted actions bring at least 99 % of the bound); the speed of a decision.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np

from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield.certify import certify
from ethbrake_marl.shield.guard import StepShield
from tests.shield.lines import ADVERSARIES, attack, line

TOLERANCE = 1e-9  # m2/s2
CLOSE = 0.99
RATE, P50_S, P99_S = 100_000, 100e-6, 300e-6


def falsify(worlds: int, seed: int) -> bool:
    """Every adversary, count and length of line."""
    total, decisions, above, close, restarts = 0, 0, 0, 0, 0
    for N in (3, 5):
        scenario = line(N)
        sample = scenario.sample(worlds, seed).worlds
        for count in ("first", "total"):
            for name, adversary in ADVERSARIES.items():
                found = attack(scenario, sample, adversary, count=count, seed=seed)
                excess = found.realised - found.bound
                near = (found.realised >= CLOSE * found.bound) & (found.accepted > 0) & (found.bound > 0.0)
                print(
                    f"N={N} {count:5s} {name:15s} {worlds} worlds, {found.decisions:9,} decisions,"
                    f" {found.accepted.sum():9,} deviations accepted, largest excess {excess.max():.1e},"
                    f" within 1 %: {near.sum()}",
                    flush=True,
                )
                total += worlds
                decisions += found.decisions
                above += int((excess > TOLERANCE).sum())
                close += int(near.sum())
                restarts += int((found.bound > 0.0).sum())
    verdict = "PASS" if above == 0 else "FAIL"
    print(f"bound: {total:,} episodes, {decisions:,} decisions, {above} above the bound: {verdict}")
    print(f"search: {close:,} of {restarts:,} come within 1 % of the bound: {'PASS' if close else 'FAIL'}")
    return above == 0 and close > 0


def speed(decisions: int) -> bool:
    """Batched decisions per second and the latency of one, N = 3."""
    scenario = load_scenario("paper-random")
    shield = StepShield(scenario, 1)
    n = 4096
    shield.begin(scenario.sample(n, 3).worlds, np.arange(n))
    rng = np.random.default_rng(0)
    shield.decide(rng.uniform(-1.0, 1.0, n))
    done, begun = 0, time.process_time()
    while not shield.running.ended.all():
        done += int((~shield.running.ended).sum())
        shield.decide(rng.uniform(-1.0, 1.0, n))
    rate = done / (time.process_time() - begun)
    took = []
    while len(took) < decisions:
        shield = StepShield(scenario, 1)
        shield.begin(scenario.sample(1, 3, first=len(took)).worlds, np.arange(1))
        while not shield.running.ended.all():
            proposed = rng.uniform(-1.0, 1.0, 1)
            begun = time.perf_counter()
            decision = certify(shield.running, proposed, shield.backup, shield.budget)
            took.append(time.perf_counter() - begun)
            shield.running, shield.backup = decision.after, decision.backup
    p50, p99 = np.quantile(took, [0.5, 0.99])
    good = rate >= RATE and p50 <= P50_S and p99 <= P99_S
    print(
        f"speed: {rate:,.0f} decisions/s batched; one decision p50 {p50 * 1e6:.0f} us, p99 {p99 * 1e6:.0f} us:"
        f" {'PASS' if good else 'FAIL'}"
    )
    return bool(good)


def main() -> int:
    """All gates; exit status 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--worlds", type=int, default=2_000, help="for each adversary, count and length of line")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--decisions", type=int, default=5_000, help="timed one by one")
    given = parser.parse_args()
    good = falsify(given.worlds, given.seed)
    return 0 if speed(given.decisions) and good else 1


if __name__ == "__main__":
    sys.exit(main())
