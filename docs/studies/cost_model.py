"""Computing cost: processor seconds per million decisions and per million worlds, as in docs/results/scaling.json.

    python docs/studies/cost_model.py [--worlds 400]

Processor time is nearly independent of other programs on the machine. Compiling, loading, evaluations and the first
update do not count.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.training.recipe import load_recipe
from ethbrake_marl.training.session import train

SCENARIO = "paper-random"
UPDATES = {"ppo": 5, "vine": 4, "quick": 4}  # updates of each training; the first does not count
AGENTS = {"full_brake": 200, "e_v2x_bm": 50, "ppo": 50, "universal": 10, "ppo+step": 1}
LARGER = 2  # a second list has so many times the worlds; the difference in time gives the cost of a world


def per_decision(recipe_name: str, updates: int, folder: Path) -> float:
    """Return the processor seconds per decision of a training, including the learning."""
    recipe = load_recipe(recipe_name)
    once = recipe.n_envs * recipe.rounds
    times: dict[int, float] = {}

    def note(progress: object) -> None:
        times.setdefault(progress.done, time.process_time())  # type: ignore[attr-defined]

    steps = updates * once
    train(recipe, SCENARIO, folder / recipe_name, steps=steps, measure=None, on_progress=note)
    first = min(done for done in times if done > 0)
    return (times[steps] - times[first]) / (steps - first)


def per_world(name: str, worlds: int) -> float:
    """Return the processor seconds per world with the agent ``name``."""
    scenario = load_scenario(SCENARIO)
    spent = []
    for n in (20, worlds, LARGER * worlds):
        sample = scenario.sample(n, 7)
        started = time.process_time()
        evaluate(sample, {name: make_agent(name, scenario=scenario)}, scenario=scenario, aftermath=False)
        spent.append(time.process_time() - started)
    return (spent[2] - spent[1]) / ((LARGER - 1) * worlds)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=400, help="worlds for the slowest agent")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="ethbrake-") as name:
        for recipe, updates in UPDATES.items():
            print(
                f"{recipe}: {1e6 * per_decision(recipe, updates, Path(name)):.1f} s per million decisions", flush=True
            )
        for agent, times in AGENTS.items():
            each = per_world(agent, times * options.worlds)
            print(f"{agent}: {1e6 * each:.0f} s per million worlds", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
