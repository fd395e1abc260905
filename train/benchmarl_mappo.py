"""BenchMARL's MAPPO on a level of cooperation. Needs the extra `marl` (`.venv/bin/pip install '.[marl]'`).

    python train/benchmarl_mappo.py --scenario cooperation-3-pair --steps 200000 --output runs/mappo
    ethbrake evaluate --scenario cooperation-3-pair --agents full_brake,team@runs/mappo

`ethbrake train --scheme centralised` trains the same kind of team (one actor for all, a critic on the state of the
line) without the extra, with checkpoints and measuring on the way; this file is for those who use BenchMARL.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import ethbrake_marl as eb
from ethbrake_marl.errors import EthBrakeError, InvalidInput, naming_extras
from ethbrake_marl.learning.recipe import PpoRecipe, load_recipe


def train(scenario: str, recipe: str, steps: int, seed: int, output: Path) -> None:
    """Train with the numbers of a recipe, into the new folder `output`."""
    line, plan = eb.load_scenario(scenario), load_recipe(recipe).replace(total_steps=steps, seed=seed)
    if not isinstance(plan, PpoRecipe):
        raise InvalidInput(f"recipe {plan.name!r}: is for {plan.algorithm.upper()}; MAPPO needs one for PPO")
    with naming_extras():
        from ethbrake_marl.learning.benchmarl import train_mappo  # only here: an extra
    train_mappo(plan, line, output)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="cooperation-3-pair", help="a shipped scenario, or a YAML file")
    parser.add_argument("--recipe", default="cooperation-ppo", help="a shipped PPO recipe, or a YAML file")
    parser.add_argument("--steps", type=int, default=200_000, help="decisions of learners")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/mappo"), help="new folder")
    given = parser.parse_args()
    try:
        train(given.scenario, given.recipe, given.steps, given.seed, given.output)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    print(f"trained: ethbrake evaluate --scenario {given.scenario} --agents full_brake,team@{given.output}")
