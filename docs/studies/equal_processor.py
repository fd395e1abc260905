"""Algorithms at equal processor time on the three tests, for docs/extensions/learners.md and docs/results.

    .venv/bin/python docs/studies/equal_processor.py SECONDS FOLDER docs/figures/learning-curves-equal.png

Each training gets SECONDS of one core; the time of evaluations does not count. FOLDER contains the trainings, and the
same command continues them after an interruption.
"""

from __future__ import annotations

import sys
from pathlib import Path

import ethbrake_marl as eb
from ethbrake_marl.extensions.report.seed_curves import SeedCurve, seed_curves
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.training.job import Job
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.training.training import Training

TESTS = {"paper-random": "first", "paper-random-brake-only": "first", "paper-random-obstacle": "total"}
HARM = {"first": "first_impact_harm", "total": "total_harm"}
STEPS = {  # recipe -> decisions in half a minute, measured in a short training
    "quick": 4_400_000,
    "ppo": 1_080_000,
    "sac": 225_000,
    "rollout-classification": 270_000,
}
POINTS, WORLDS, SEED, BUDGET = 12, 2000, 1007, 2000


def job(test: str, count: str, name: str, seconds: int, folder: Path) -> Job:
    """Return the training of a recipe on a test, with one count of harm."""
    recipe, steps = eb.load_recipe(name), STEPS[name] * seconds // 30
    reward = recipe.reward.model_dump() | {"harm_count": count}
    updates = steps // (recipe.n_envs * recipe.rounds)
    measured = {"every_updates": max(updates // POINTS, 1), "worlds": WORLDS, "seed": SEED}
    recipe = recipe.replace(total_steps=steps, reward=reward, evaluation=measured)
    return Job(Training.of(recipe, test), folder / test / name)


def curve(run: Path, count: str, seconds: int) -> SeedCurve:
    """Return the harm on the fixed list by processor seconds, which every training spends evenly over its steps."""
    rows = [row for row in RunFolder(run).rows() if row.get("eval/total_harm")]
    last = int(rows[-1]["steps"])
    points = {round(int(row["steps"]) / last * seconds): float(row[f"eval/{HARM[count]}"]) for row in rows}
    return SeedCurve.of([points])


def main(seconds: int, folder: Path, picture: Path) -> None:
    """Train what is missing, print the rows of the table and write the figure."""
    panels: dict[str, dict[str, SeedCurve]] = {}
    known: dict[str, float] = {}
    for test, count in TESTS.items():
        label = f"{test}: {'first-impact' if count == 'first' else 'total'} harm (m²/s²)"
        scenario, game = eb.open_game(test)
        least = best_harm(game, scenario.sample(WORLDS, SEED), counts=[count], budget=BUDGET, threads=1)
        panels[label], known[label] = {}, float(least.harm[count].mean())
        for name in STEPS:
            training = job(test, count, name, seconds, folder)
            if not training.finish():
                raise SystemExit(1)
            panels[label][name] = here = curve(training.folder, count, seconds)
            harm = here.values[0]
            cells = [f"{each:.3f}" for each in (harm[-1], harm.min(), harm.min() / known[label])]
            print(f"| `{test}` | {count} | `{name}` | {here.steps[-1]:.0f} s | {' | '.join(cells)} |")
        print(f"best known: {known[label]:.3f}", flush=True)
    caption = f"One training per recipe; harm on the fixed list of the trainings, {WORLDS:,} worlds of seed {SEED}."
    figure = seed_curves(
        panels, logarithmic=[*panels], caption=caption, x_label="Processor time of the training (s)", known=known
    )
    write_picture(picture, figure, force=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]))
