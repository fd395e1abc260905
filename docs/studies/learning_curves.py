"""Train recipes with several seeds on one scenario, and draw their learning curves in one figure.

``python docs/studies/learning_curves.py --scenario paper-delay-low --recipes ppo:5,sac:3 --output runs/low-delay``.
The same command continues after an interruption.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from ethbrake_marl.evaluation.trial import load_runnable
from ethbrake_marl.extensions.reproduction.learning_curves import AXES, LearningCurves
from ethbrake_marl.progress import Progress
from ethbrake_marl.training.settings import read_settings


def main(words: list[str]) -> int:
    """Train, draw, and print the summary. Return the exit status: 0, or 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="paper-random")
    parser.add_argument("--recipes", default="ppo:5,sac:3", help="recipes, each with its number of seeds (0, 1, ...)")
    parser.add_argument("--output", type=Path, required=True, help="folder of the trainings, the figure and the table")
    parser.add_argument("--steps", type=int, help="training steps (decisions)")
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel trainings")
    parser.add_argument("--against", choices=[*AXES], default="steps", help="quantity on the horizontal axis")
    parser.add_argument("--set", action="append", metavar="KEY=VALUE", help="a changed value; repeatable")
    given = parser.parse_args(words)
    plan = LearningCurves.parse(given.recipes)
    settings = read_settings(given.set, [recipe for recipe, _ in plan])
    scenario = load_runnable(given.scenario, settings.scenario, drives="one")
    changed = [(settings.change(recipe), seeds) for recipe, seeds in plan]
    curves = LearningCurves(scenario, changed, given.output, given.against)
    if not curves.train(steps=given.steps, jobs=given.jobs, settings=settings.texts, tell=_tell):
        print("interrupted; the same command continues the trainings in the folder", file=sys.stderr)
        return 130
    print(json.dumps(curves.write(), indent=2))
    print(f"figure: {given.output / 'learning_curves.png'}", file=sys.stderr)
    return 0


def _tell(progress: Progress) -> None:
    print(f"{progress.name}: {progress.done:,} of {progress.total:,}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
