"""The front that CAPQL of morl-baselines learns in a given processor time, with the library's own settings.

    pip install . mo-gymnasium morl-baselines
    python docs/studies/morl_front.py docs/studies/morl_front.json --seconds 300 --seeds 3

One network observes the weights of the vehicles' harm in addition to the usual observation. It is trained on
`EthBrakeMO-v1`. Then it drives in worlds that no training uses, once for each weight vector of a grid. Harm is the mean
over these worlds in m2/s2. The hypervolume (m6/s6) is the volume that the points dominate, up to a reference point.
There are two reference points: full braking, and `ROOF` for each vehicle. Most points of a front do not count with the
first, because full braking does little harm to Vehicle 1, and only points with even less count.

Seconds are processor seconds of learning in one thread, without imports, compiling and evaluation.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mo_gymnasium
import numpy as np
import torch
from gymnasium import Wrapper
from morl_baselines.common.pareto import filter_pareto_dominated
from morl_baselines.common.performance_indicators import hypervolume
from morl_baselines.multi_policy.capql.capql import CAPQL

import ethbrake_marl as eb
from ethbrake_marl.extensions.studies.machine import this_machine

SCENARIO, WORLDS, SEED, PARTS = "paper-random", 2000, 990201, 5
HARM = {"first": "first_impact_harm", "total": "total_harm"}  # count -> column of a result
WEIGHTS = [(i / PARTS, j / PARTS, (PARTS - i - j) / PARTS) for i in range(PARTS + 1) for j in range(PARTS + 1 - i)]
ROOF = 20.0  # m2/s2, above each vehicle's harm in every point
PACKAGES = ("morl-baselines", "mo-gymnasium", "gymnasium", "torch", "numpy", "ethbrake-marl")


class TimeIsUpError(Exception):
    """The processor time of a training is over."""


class Limited(Wrapper):  # type: ignore[misc]
    """Wrapper that ends any training after ``seconds`` of processor time, and counts its steps."""

    def __init__(self, env: Any, seconds: float) -> None:
        super().__init__(env)
        self.steps, self.ends = 0, time.process_time() + seconds

    def step(self, action: Any) -> Any:
        """Make a step. Raise ``TimeIsUpError`` if the time is over."""
        if time.process_time() > self.ends:
            raise TimeIsUpError
        self.steps += 1
        return self.env.step(action)


def train(seconds: float, seed: int) -> tuple[CAPQL, float, int]:
    random.seed(seed)
    torch.manual_seed(seed)
    env = Limited(mo_gymnasium.make("EthBrakeMO-v1", scenario=SCENARIO, reward="first-impact-harm"), seconds)
    env.reset(seed=seed)
    env.action_space.seed(seed)
    start, agent = time.process_time(), CAPQL(env, seed=seed, log=False)
    with suppress(TimeIsUpError):  # these arguments have no effect without a log
        agent.train(10**9, eval_env=None, ref_point=np.zeros(3), num_eval_weights_for_front=3)
    return agent, time.process_time() - start, env.steps


def measure(agent: CAPQL, scenario: eb.Scenario) -> dict[str, Any]:
    """Mean harm of every vehicle for each weight and for full braking, and the hypervolumes."""

    def driver(weight: tuple[float, ...]) -> Any:
        return eb.policy_agent(lambda seen: agent.eval(seen, np.tile(weight, (len(seen), 1))), clip=True)

    agents = {"full": "full_brake", **{str(weight): driver(weight) for weight in WEIGHTS}}
    result = eb.evaluate(scenario, agents, episodes=WORLDS, seed=SEED)
    numbers: dict[str, Any] = {}
    for count, column in HARM.items():
        each = ([result[name][f"{column}_{i}"].mean() for i in (1, 2, 3)] for name in agents)
        full, *points = (np.round(harm, 4) for harm in each)
        numbers[count] = {
            "full_braking": full.tolist(),
            "hypervolume": float(hypervolume(-full, [-point for point in points])),
            "hypervolume_below_roof": float(hypervolume(np.full(3, -ROOF), [-point for point in points])),
            "non_dominated": len(filter_pareto_dominated([-point for point in points])),
            "harm": [point.tolist() for point in points],  # by weight
        }
    return numbers


def main(words: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, help="file for the numbers, JSON")
    parser.add_argument("--seconds", type=float, default=300.0, help="processor seconds of each training")
    parser.add_argument("--seeds", type=int, default=3, help="trainings, with seeds 0, 1, ...")
    given = parser.parse_args(words)
    torch.set_num_threads(1)
    scenario = eb.load_scenario(SCENARIO)
    eb.evaluate(scenario, "coast", episodes=10)  # compiles the physics
    numbers: dict[str, Any] = {
        "algorithm": "CAPQL",
        "scenario": SCENARIO,
        "worlds": WORLDS,
        "seed": SEED,
        "roof": ROOF,
        "versions": {name: version(name) for name in PACKAGES},
        "machine": this_machine(),
        "weights": WEIGHTS,
        "trainings": [],
    }
    for seed in range(given.seeds):
        agent, seconds, steps = train(given.seconds, seed)
        found = measure(agent, scenario)
        numbers["trainings"].append({"seed": seed, "cpu_seconds": round(seconds, 1), "steps": steps, **found})
        given.output.write_text(json.dumps(numbers) + "\n", "utf-8")
        print(seed, steps, {count: found[count]["hypervolume_below_roof"] for count in HARM}, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
