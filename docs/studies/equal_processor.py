"""Algorithms at equal processor time on the three tests, for docs/results/learning.md.

    .venv/bin/python docs/studies/equal_processor.py SECONDS FOLDER docs/figures/learning-curves-equal.png

Each training gets SECONDS of one core; the time of evaluations does not count. FOLDER contains the trainings, and the
same command continues them after an interruption.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.ticker import LogLocator, NullLocator

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import HARM
from ethbrake_marl.extensions.report.figures import EstimateCurve, curves_figure
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.training.job import Job
from ethbrake_marl.training.recipe import load_recipe
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.training.training import Training

TESTS = {"paper-random": "first", "paper-random-brake-only": "first", "paper-random-obstacle": "total"}
STEPS = {  # recipe -> decisions in half a minute, measured in a short training
    "quick": 2_300_000,
    "ppo": 1_080_000,
    "sac": 225_000,
    "rollout-classification": 270_000,
}
POINTS, WORLDS, SEED, BUDGET = 12, 2000, 1007, 2000


def job_of(test: str, count: str, name: str, seconds: int, folder: Path) -> Job:
    recipe, steps = load_recipe(name), STEPS[name] * seconds // 30
    measured = {"every_updates": max(steps // (recipe.n_envs * recipe.rounds) // POINTS, 1), "worlds": WORLDS}
    recipe = recipe.replace(
        total_steps=steps,
        reward=recipe.reward.model_dump() | {"harm_count": count},
        evaluation={**measured, "seed": SEED},
    )
    return Job(Training.of(recipe, test), folder / test / name)


def curve_of(run: RunFolder, count: str) -> EstimateCurve:
    """Harm against the processor time of the training, without evaluations (s)."""
    evaluations = read_object(run.status)["evaluations"]
    return {each["cpu_s"]: Estimate(float(each[HARM[count]]), None) for each in evaluations}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seconds", type=int, help="processor time of each training")
    parser.add_argument("folder", type=Path, help="folder of the trainings")
    parser.add_argument("picture", type=Path, help="file for the figure")
    given = parser.parse_args()
    seconds, folder, picture = given.seconds, given.folder, given.picture
    panels, known = {}, {}
    for test, count in TESTS.items():
        label = f"{test}: {'first-impact' if count == 'first' else 'total'} harm (m²/s²)"
        best = f"best_harm:{BUDGET}"
        result = eb.evaluate(test, best, episodes=WORLDS, seed=SEED, harm_count=count)
        known[label] = float(np.mean(result[best][HARM[count]]))
        panels[label] = {}
        for name in STEPS:
            job = job_of(test, count, name, seconds, folder)
            if not job.finish():
                raise SystemExit(1)
            curve = panels[label][name] = curve_of(RunFolder(job.folder), count)
            harm = [each.value for each in curve.values()]
            cells = [f"{each:.3f}" for each in (harm[-1], min(harm), min(harm) / known[label])]
            print(f"| `{test}` | {count} | `{name}` | {max(curve):.0f} s | {' | '.join(cells)} |", flush=True)
        print(f"best known: {known[label]:.3f}", flush=True)
    caption = f"One training per recipe; harm on the fixed list of the trainings, {WORLDS:,} worlds of seed {SEED}."
    axis = "Processor time of the training (s)"
    lines = {label: {"best known": harm} for label, harm in known.items()}
    figure = curves_figure(panels, axis, caption, lines=lines)
    for axes in figure.axes:
        axes.set_yscale("log")
        axes.autoscale(axis="y")
        axes.yaxis.set(major_locator=LogLocator(subs=(1, 2, 5)), major_formatter="{x:g}", minor_locator=NullLocator())
    write_picture(picture, figure, force=True)
