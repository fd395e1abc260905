"""Algorithms at equal processor time on the three tests, for docs/extensions/learners.md and docs/results.

    .venv/bin/python docs/studies/equal_processor.py SECONDS FOLDER docs/figures/learning-curves-equal.png

Each training gets SECONDS of one core; the time of evaluations does not count. FOLDER contains the trainings, and the
same command continues them after an interruption.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from ethbrake_marl.extensions.report.seed_curves import seed_curves
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.extensions.reproduction.learning_curves import AXES, LearningCurves
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory

TESTS: dict[str, HarmCount] = {
    "paper-random": "first",
    "paper-random-brake-only": "first",
    "paper-random-obstacle": "total",
}
STEPS = {  # recipe -> decisions in half a minute, measured in a short training
    "quick": 4_400_000,
    "ppo": 1_080_000,
    "sac": 225_000,
    "rollout-classification": 270_000,
}
POINTS, WORLDS, SEED, BUDGET = 12, 2000, 1007, 2000


def plan(count: HarmCount, seconds: int) -> list[tuple[TrainingRecipe, int]]:
    """Return the recipes, each with its number of seeds, for one count of harm."""
    recipes = []
    for name in STEPS:
        recipe, steps = load_recipe(name), STEPS[name] * seconds // 30
        updates = steps // (recipe.n_envs * recipe.rounds)
        reward = recipe.reward.model_dump() | {"harm_count": count}
        measured = {"every_updates": max(updates // POINTS, 1), "worlds": WORLDS, "seed": SEED}
        recipes.append((recipe.replace(total_steps=steps, reward=reward, evaluation=measured), 1))
    return recipes


if __name__ == "__main__":
    seconds, folder, picture = int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3])
    panels, known = {}, {}
    for test, count in TESTS.items():
        curves = LearningCurves(load_scenario(test), plan(count, seconds), folder / test, "cpu")
        if not curves.train():
            raise SystemExit(1)
        curves.write()
        label = f"{test}: {'first-impact' if count == 'first' else 'total'} harm (m²/s²)"
        panels[label] = curves.curves()[RunDirectory.HARM[count]]
        worlds = load_scenario(test).sample(WORLDS, SEED).worlds
        least = best_harm(load_scenario(test), worlds, counts=[count], budget=BUDGET, threads=1).best[count].harm
        known[label] = float(np.mean(least))
        for name, curve in panels[label].items():
            harm = curve.values[0]
            cells = [f"{each:.3f}" for each in (harm[-1], harm.min(), harm.min() / known[label])]
            print(f"| `{test}` | {count} | `{name}` | {curve.steps[-1]:.0f} s | {' | '.join(cells)} |")
        print(f"best known: {known[label]:.3f}", flush=True)
    caption = f"One training per recipe; harm on the fixed list of the trainings, {WORLDS:,} worlds of seed {SEED}."
    axis = AXES["cpu"][1]
    figure = seed_curves(panels, logarithmic=[*panels], caption=caption, x_label=axis, known=known)
    write_picture(picture, figure, force=True)
