"""Train the shipped `universal`: one policy for any vehicle of any line.

    python docs/studies/lines.py runs/lines --seed 0

First the recipe `three-tests` trains a policy on the paper's three tests, in runs/lines/three-tests (ten minutes of
processor time). Then the recipe `universal` trains a network that begins as this policy in the range of its training,
and as the plan elsewhere, on the tests and 33 other lines, in runs/lines/universal (35 minutes). The shipped policy is
the last one, runs/lines/universal/policy-last. The same command resumes a training that was stopped.

The values of every line are drawn from ranges that contain those of most shipped scenarios; nothing else is taken from
them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import ethbrake_marl as eb
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.progress import Progress
from ethbrake_marl.training.job import Job
from ethbrake_marl.training.training import Training
from ethbrake_marl.training.training_range import record_ranges

RANGE_WORLDS, RANGE_SEED = 4_000, 1007  # worlds that give the range of the first policy
TESTS = {"paper-random": 8.0, "paper-random-brake-only": 4.0, "paper-random-obstacle": 8.0}  # weights


def uniform(low: float, high: float) -> dict[str, Any]:
    return {"uniform": [low, high]}


NEAR = {
    "braking_capacity_mps2": uniform(5.5, 7.5), "driving_capacity_mps2": uniform(0, 8), "mass_t": uniform(4, 7),
    "gaps_m": uniform(4, 12), "line_speed_mps": uniform(16, 25), "speed_deviations_mps": uniform(-2, 2),
    "restitution": uniform(0, 0.2),
}  # fmt: skip
WIDE = {
    "braking_capacity_mps2": uniform(4, 9), "driving_capacity_mps2": uniform(0, 8), "mass_t": {"loguniform": [1.2, 12]},
    "time_gaps_s": {"loguniform": [0.2, 1.5]}, "line_speed_mps": uniform(10, 34),
    "speed_deviations_mps": uniform(-2, 2), "restitution": uniform(0, 0.3), "horizon_s": 12,
}  # fmt: skip
CLOSE, ANY = {"obstacle_margin_m": uniform(0.5, 4)}, {"obstacle_margin_m": uniform(0.5, 14)}  # obstacles
FAR = {"obstacle_margin_m": uniform(4, 20)}
SLOW_BRAKES = {"brake_rate_mps3": uniform(8, 25), "release_rate_mps3": uniform(8, 25)}


def trucks(*places: int) -> dict[str, Any]:
    """A line of three cars with trucks at these places."""
    pairs = [
        (uniform(10, 40), uniform(4, 6.5)) if i in places else (uniform(1.2, 2.5), uniform(5, 9)) for i in (1, 2, 3)
    ]
    return {"mass_t": [mass for mass, _ in pairs], "braking_capacity_mps2": [capacity for _, capacity in pairs]}


# weight, quantities, number of vehicles, learners, changed quantities
LINES: dict[str, tuple[float, dict[str, Any], int, list[int], dict[str, Any]]] = {
    "near-2-of-3": (2, NEAR, 3, [2], {}), "near-2-of-3-obstacle": (2, NEAR, 3, [2], CLOSE),
    "near-2-of-3-far-obstacle": (1.5, NEAR, 3, [2], FAR), "near-2-of-5": (2, NEAR, 5, [2], {}),
    "near-3-of-5-far": (1, NEAR, 5, [3], {"gaps_m": uniform(6, 14)}),
    "near-2-of-2": (0.5, NEAR, 2, [2], {}), "near-1-of-2": (0.5, NEAR, 2, [1], ANY),
    "near-3-of-3": (0.5, NEAR, 3, [3], {}), "near-1-of-3": (1, NEAR, 3, [1], ANY),
    "near-2-of-4": (1, NEAR, 4, [2], {}), "near-3-of-4-obstacle": (1, NEAR, 4, [3], CLOSE),
    "near-3-of-5": (1, NEAR, 5, [3], {}), "near-5-of-6": (0.5, NEAR, 6, [5], {}),
    "near-4-of-8": (0.5, NEAR, 8, [4], {}), "near-pair-of-3": (1.2, NEAR, 3, [2, 3], {}),
    "near-all-of-3": (0.8, NEAR, 3, [1, 2, 3], ANY), "near-2-and-3-of-4-obstacle": (0.6, NEAR, 4, [2, 3], CLOSE),
    "near-followers-of-5": (0.4, NEAR, 5, [2, 3, 4, 5], {}), "near-all-of-5": (0.3, NEAR, 5, [1, 2, 3, 4, 5], ANY),
    "near-followers-of-8": (0.2, NEAR, 8, [2, 3, 4, 5, 6, 7, 8], {}),
    "wide-2-of-3": (1.5, WIDE, 3, [2], {}), "wide-2-of-3-obstacle": (0.5, WIDE, 3, [2], ANY),
    "wide-pair-of-4": (1, WIDE, 4, [2, 3], {}),
    "truck-behind": (1, NEAR, 3, [2], trucks(3)), "truck-build-up": (1, NEAR, 3, [2], trucks(3) | SLOW_BRAKES),
    "truck": (0.5, NEAR, 3, [2], trucks(2)),
    "build-up": (1, NEAR, 3, [2], SLOW_BRAKES), "build-up-pair-of-4": (0.5, NEAR, 4, [2, 3], SLOW_BRAKES),
    "slippery": (0.5, NEAR, 3, [2], {"friction": uniform(0.2, 0.7), "horizon_s": 16}),
    "nominal-pair": (0.5, NEAR, 3, [2, 3], {"v2x": "nominal"}),
    "congested-followers-of-4": (0.5, NEAR, 4, [2, 3, 4], {"v2x": "congested"}),
    "front": (1, NEAR, 3, [2], {"v2x": {"preset": "paper", "hears": "front"}}),
    "blocked": (0.5, NEAR, 3, [2], {"v2x": "sensors-only"}),
}  # fmt: skip


def mixture() -> eb.Scenario:
    """The paper's three tests, and the lines of ``LINES``."""
    members: list[dict[str, Any]] = [
        {"scenario": eb.load_scenario(name).declared(), "weight": weight} for name, weight in TESTS.items()
    ]
    for name, (weight, quantities, vehicles, learners, changes) in LINES.items():
        roles = {"vehicle_1": "full_brake", **{f"vehicle_{i}": "learner" for i in learners}}
        late = uniform(0 if quantities is WIDE else 0.2, 1.2)
        line = {"name": name, "vehicles": vehicles, "roles": roles, "latency_s": [0, *[late] * (vehicles - 1)]}
        members.append({"scenario": {**line, **quantities, **changes}, "weight": weight})
    return eb.load_scenario({"name": "lines", "mixture": members})


def train(recipe: str, scenario: eb.Scenario, folder: Path, **changes: Any) -> None:
    """Train in ``folder``, or resume a training there. Ctrl-C ends the program after the current update."""
    if not Job(Training.of(recipe, scenario, **changes), folder).finish(Progress.listener("show")):
        raise SystemExit(f"stopped; the same command resumes {folder}")


def train_both(folder: Path, seed: int) -> None:
    tests, first = eb.load_scenario("mixture-three-tests"), folder / "three-tests"
    train("three-tests", tests, first, seed=seed)
    policies = record_ranges({"vehicle_2": eb.load_policy(first)}, tests, RANGE_WORLDS, RANGE_SEED)
    policies["vehicle_2"].save(folder / "start", replace=True)
    train("universal", mixture(), folder / "universal", seed=seed, start=f"policy@{folder / 'start'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of both trainings")
    parser.add_argument("--seed", type=int, default=0, help="seed of both trainings")
    given = parser.parse_args()
    try:
        train_both(given.folder, given.seed)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
