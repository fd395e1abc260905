"""The simplest reading that comes near to the first two strategies of ``Table:Random``: the table of docs/paper.md.

    .venv/bin/python docs/studies/paper/nearest.py

Vehicle 2 acts at 0.2 s, impacts are exact, and E-V2X-BM plans for the stated 0.5 s, by a scan of decelerations in steps
of 0.25 m/s2 of which it takes the first that does least. Its collisions are those that happen, its harm the planned
one. Then the study prints which latencies the printed collision rates imply. Made once: 2026-12-01.
"""

from __future__ import annotations

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.agents.pairwise import harm_of_deceleration
from ethbrake_marl.extensions.reproduction.paper_rows import RANDOM_TEST
from ethbrake_marl.motion.layout import BRAKING, LATENCY, Floats

WORLDS, SEED, VEHICLE_2 = 10_000, 7, 2
STEP_MPS2, PLANNED_S, ACTS_S = 0.25, 0.5, 0.2


def world(acts_s: float, rear_s: float = 0.8) -> eb.Scenario:
    return eb.load_scenario("paper-random").replace(latency_s=[0.0, acts_s, rear_s])


def scanned(scenario: eb.Scenario) -> tuple[Floats, Floats]:
    """First deceleration of the scan with the least predicted harm (m/s2), and this harm (m2/s2), [n] each."""
    alert = scenario.sample(WORLDS, SEED)
    at = np.arange(0.0, alert.car[0, BRAKING, VEHICLE_2] + 1e-9, STEP_MPS2)
    harm = np.array(
        [
            [harm_of_deceleration(line, car[BRAKING], car[LATENCY], VEHICLE_2, a) for a in at]
            for line, car in zip(alert.line, alert.car.copy(), strict=True)
        ]
    )
    return at[harm.argmin(axis=1)], harm.min(axis=1)


def driven(scenario: eb.Scenario, deceleration_mps2: Floats | float) -> tuple[float, float]:
    """Collision rate and mean first-impact harm if Vehicle 2 brakes so."""
    _, game = eb.open_game(scenario)
    alert = scenario.sample(WORLDS, SEED)
    car = alert.car.copy()
    car[:, BRAKING, VEHICLE_2] = deceleration_mps2
    state = game.reset(alert._replace(car=car))
    while not state.ended.all():
        state, _ = game.step(state, np.full((WORLDS, 1), -1.0))
    return float(state.collided.mean()), float(state.harm("first").mean())


def main() -> None:
    print("| | this reading | printed |\n|---|---:|---:|")
    deceleration, planned = scanned(world(PLANNED_S))
    ours = driven(world(ACTS_S), 7.0), (driven(world(ACTS_S), deceleration)[0], float(planned.mean()))
    for (rate, harm), row in zip(ours, RANDOM_TEST, strict=False):
        print(f"| {row.agent}, collision rate | {rate:.2%} | {row.collision_rate:.2%} |".replace("%", " %"))
        print(f"| {row.agent}, average harm | {harm:.3f} | {row.average_harm:.3f} |")
    print("\nrates of Non-E and E-V2X-BM if Vehicles 2 and 3 act at (s):")
    for acts_s in (0.15, 0.2, 0.25, 0.3):
        for rear_s in (0.75, 0.8, 0.83, 0.9):
            rates = [driven(world(acts_s, rear_s), each)[0] for each in (7.0, deceleration)]
            print(f"{acts_s:g}, {rear_s:g}: " + ", ".join(f"{rate:.2%}" for rate in rates))


if __name__ == "__main__":
    main()
