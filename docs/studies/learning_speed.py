"""How long each recipe takes to a given harm, on one thread of one process: ``docs/studies/learning_speed.py``.

Every row learns on ``--scenario`` from the same seed and is measured on the recipe's own list of worlds; what measuring
costs is not counted, compiling neither. A row ``NAME --set KEY=VALUE`` is the recipe with other values; ``sb3`` is
Stable-Baselines3's PPO with its own defaults but for the size of a rollout, which is that of ``ppo``, and the reward
``harm``. Times are processor time of this process.
"""

from __future__ import annotations

import argparse
import shlex
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO

from ethbrake_marl.agents.policy import policy_agent
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.evaluation import evaluate, summarise
from ethbrake_marl.learning.runs import measure_on_list, train
from ethbrake_marl.learning.training import Training, load_recipe, read_settings
from ethbrake_marl.scenario import Scenario, load_scenario

OWN_LOOP = "sb3"
ROWS = (OWN_LOOP, "ppo --set horizon_is_end=false", "ppo", "quick")
LEVELS = (10.0, 8.0, 7.5, 7.08)  # m2/s2; the last one is 1.10 times the best known of paper-random
LIST = (4000, 1007)  # worlds, seed
STEPS, PARTS = 400_000, 10  # of Stable-Baselines3's own loop: decisions, and how often it is measured on the way
N_ENVS, N_STEPS = 128, 64  # as in recipe ppo: with its own 2,048 steps of each world it would learn once

Course = list[tuple[float, float]]  # processor time (s) and first-impact harm (m2/s2), as it went


class Stopwatch:
    """Runs while something learns, and stands still while it is measured."""

    def __init__(self) -> None:
        self.course: Course = []
        self._begun, self._measured = time.process_time(), 0.0

    def measure(self, harm: Callable[[], float]) -> float:
        """Note the time so far beside what ``harm`` finds."""
        now = time.process_time()
        found = harm()
        self.course.append((now - self._begun - self._measured, found))
        self._measured += time.process_time() - now
        return found


def learn_recipe(row: str, scenario: Scenario, seed: int, folder: Path) -> Course:
    """The course of a recipe, measured when its plan says so."""
    name, *settings = shlex.split(row)
    recipe = load_recipe(name)
    recipe = read_settings([each for each in settings if each != "--set"], [recipe]).change(recipe)
    recipe = recipe.replace(evaluation={**recipe.evaluation.model_dump(), "worlds": LIST[0], "seed": LIST[1]})
    watch = Stopwatch()

    def measure(training: Training) -> Callable[[Any], dict[str, float]]:
        found = measure_on_list(training)
        return lambda policy: {"first_impact_harm": watch.measure(lambda: found(policy)["first_impact_harm"])}

    train(recipe, scenario, folder, seed=seed, measure=measure, on_progress=None)
    return watch.course


def learn_by_its_own_loop(scenario: Scenario, seed: int, steps: int) -> Course:
    """The course of Stable-Baselines3's PPO as it comes."""
    worlds = scenario.sample(*LIST)

    def harm(model: PPO) -> float:
        agents = {OWN_LOOP: policy_agent(model, scenario=scenario, clip=True)}
        return summarise(evaluate(worlds, agents, scenario=scenario, aftermath=False))[0].first_impact_harm.value

    watch = Stopwatch()
    environment = make_sb3_vec_env(scenario, N_ENVS, seed, reward="harm", horizon_is_end=False)
    model = PPO("MlpPolicy", environment, n_steps=N_STEPS, seed=seed, device="cpu")
    for _ in range(PARTS):
        model.learn(steps // PARTS, reset_num_timesteps=False)
        watch.measure(lambda: harm(model))
    return watch.course


def table(courses: dict[str, Course], levels: Sequence[float]) -> list[str]:
    """Markdown: seconds until the harm was at most each level, and what it was at the end."""
    head = ["what learns", *(f"{level:g}" for level in levels), "least", "at the end", "in all"]
    lines = [" | ".join(head), " | ".join("---" for _ in head)]
    for row, course in courses.items():
        firsts = [next((seconds for seconds, harm in course if harm <= level), None) for level in levels]
        cells = ["–" if first is None else f"{first:.0f} s" for first in firsts]
        ends = [f"{min(harm for _, harm in course):.2f}", f"{course[-1][1]:.2f}", f"{course[-1][0]:.0f} s"]
        lines.append(" | ".join([f"`{row}`", *cells, *ends]))
    return [f"| {line} |" for line in lines]


def main() -> None:
    """Learn every row, one after the other, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", default=list(ROWS))
    parser.add_argument("--scenario", default="paper-random")
    parser.add_argument("--levels", nargs="+", type=float, default=list(LEVELS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=STEPS, help=f"decisions of {OWN_LOOP}")
    given = parser.parse_args()
    torch.set_num_threads(1)
    scenario = load_scenario(given.scenario)
    courses: dict[str, Course] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("ppo", "quick"):  # compiles
            train(load_recipe(name).replace(total_steps=1), scenario, Path(folder) / name, on_progress=None)
        for k, row in enumerate(given.rows):
            own = row == OWN_LOOP
            courses[row] = (
                learn_by_its_own_loop(scenario, given.seed, given.steps)
                if own
                else learn_recipe(row, scenario, given.seed, Path(folder) / f"{k}")
            )
            print(f"{row}: {', '.join(f'{s:.0f} s {h:.2f}' for s, h in courses[row])}", flush=True)
    print("\n".join(table(courses, given.levels)))


if __name__ == "__main__":
    main()
