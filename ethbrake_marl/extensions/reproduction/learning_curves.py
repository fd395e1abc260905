"""Learning curves: train several recipes with several seeds on one scenario, and draw them in one figure."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.report.seed_curves import SeedCurve, seed_curves
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.extensions.studies.trainings import TrainingJob, train_all
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import write_output
from ethbrake_marl.first_edition.evaluation.identity import result_identity, worlds_sha256
from ethbrake_marl.first_edition.evaluation.seeds import interquartile_mean
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.training import Training
from ethbrake_marl.progress import OnProgress

_RETURNED = "return"  # name of the metric here

_LABELS = {
    "first_impact_harm": "First-impact harm on the fixed list (m²/s²)",
    "total_harm": "Total harm on the fixed list (m²/s²)",
    "return": "Mean return of training episodes",
}

Against = Literal["steps", "cpu"]  # training steps, or processor seconds of learning

AXES: dict[Against, tuple[str, str, type]] = {  # column, label of the axis, type of its numbers
    "steps": ("steps", "Training steps", int),
    "cpu": ("cpu_s", "Processor time of learning (s)", float),
}


class LearningCurves(NamedTuple):
    """Training runs of several recipes with several seeds on one scenario.

    The folder of a training run is ``folder/RECIPE-seedK``.
    """

    scenario: Scenario  # scenario of all trainings
    plan: Sequence[tuple[TrainingRecipe, int]]  # each recipe with its number of seeds; the seeds are 0, 1, ...
    folder: Path  # folder of the trainings, the figure and the tables
    against: Against = "steps"  # quantity on the x axis: ``steps`` (of training) or ``cpu`` (processor time)

    def train(
        self, *, steps: int | None = None, settings: Sequence[str] = (), jobs: int = 1, tell: OnProgress | None = None
    ) -> bool:
        """Train every recipe with every seed. Finished training runs are not repeated; unfinished runs continue.

        ``steps`` is the number of steps of each training run; None: the number in the recipe. ``settings`` (texts
        ``KEY=VALUE``) are changes that the scenario and the recipes already contain; they are only noted in the file
        ``config.json`` of each run. Returns False if Ctrl-C stopped a training run. Raises the exceptions of
        ``train_all``, for instance ``InvalidInput`` (before any run begins) if a folder contains a training run with
        other settings.
        """
        trainings = [
            TrainingJob(
                Training.of(
                    recipe, self.scenario, seed=seed, total_steps=recipe.total_steps if steps is None else steps
                ),
                self._run(recipe, seed),
                tuple(settings),
            )
            for recipe, seeds in self.plan
            for seed in range(seeds)
        ]
        written = [f"learning_curves.{ending}" for ending in ("png", "csv", "json")]
        with StudyFolder(self.folder, "learning curves", writes=written).work():
            return train_all(trainings, jobs, tell)

    def write(self) -> dict[str, Any]:
        """Write the figure of the curves, the table and the summary to the folder, and return the summary.

        For each recipe, the summary has the harm of the best and of the last policy of a run, as interquartile means
        over the seeds with bootstrap intervals. It also has hashes of the best policies and of the worlds of their
        evaluation.

        Raises ``InvalidInput`` if the runs of a recipe have no step in common at which each of them was evaluated.
        """
        scenario, curves, lists = self.scenario, self.curves(), set()
        summary: dict[str, Any] = {
            **result_identity("learning-curves", scenario, None),
            "scenario": scenario.name,
            "recipes": {},
        }
        for recipe, seeds in self.plan:
            values = curves[RunDirectory.HARM[recipe.reward.harm_count]][recipe.name].values
            fixed = scenario.sample(recipe.evaluation.worlds, recipe.evaluation.seed)
            lists.add((recipe.evaluation.worlds, recipe.evaluation.seed))
            reached = {}
            for name, harms in {"kept": values.min(axis=1), "last": values[:, -1]}.items():
                mean, each = interquartile_mean([harms]).to_json(), harms.tolist()
                reached[name] = {"interquartile_mean": mean["value"], "interval": mean["interval"], "each": each}
            summary["recipes"][recipe.name] = {
                "worlds_sha256": worlds_sha256(fixed.worlds, fixed.index),
                "policy_sha256": [
                    load_policy(self._run(recipe, seed)).manifest.manifest_sha256 for seed in range(seeds)
                ],
                "seeds": seeds,
                **reached,
            }
        fixed_lists = "; ".join(f"{count_of(worlds, 'world')} of seed {seed}" for worlds, seed in sorted(lists))
        caption = f"{scenario.name}: mean over seeds, bands: one standard deviation. Fixed list: {fixed_lists}."
        panels = {_LABELS[metric]: lines for metric, lines in curves.items()}
        column, axis, number = AXES[self.against]
        harms = [_LABELS[metric] for metric in curves if metric != _RETURNED]
        figure = seed_curves(panels, logarithmic=harms, caption=caption, x_label=axis)
        write_picture(self.folder / "learning_curves.png", figure, force=True)
        rows = [
            {"figure": metric, "recipe": recipe, "seed": seed, column: number(step), "value": float(value)}
            for metric, lines in curves.items()
            for recipe, curve in lines.items()
            for seed, values in enumerate(curve.values)
            for step, value in zip(curve.steps, values, strict=True)
        ]
        texts = {"csv": csv_text(rows), "json": json.dumps(summary, indent=2, allow_nan=False) + "\n"}
        for ending, text in texts.items():
            write_output(self.folder / f"learning_curves.{ending}", text.encode(), force=True)
        return summary

    def _run(self, recipe: TrainingRecipe, seed: int) -> Path:
        return self.folder / f"{recipe.name}-seed{seed}"

    def curves(self) -> dict[str, dict[str, SeedCurve]]:
        """Return the learning curves: metric -> name of the recipe -> curve with all seeds of the recipe.

        A metric is the return, or a count of harm that the reward of at least one recipe uses. A metric without values
        is omitted. If ``self.against`` is ``cpu``, the x values of a curve are processor times (s), averaged over the
        seeds, instead of training steps.
        """
        counts = {recipe.reward.harm_count for recipe, _ in self.plan}
        metrics = [RunDirectory.HARM[count] for count in HARM_COUNTS if count in counts]
        curves: dict[str, dict[str, SeedCurve]] = {metric: {} for metric in (*metrics, _RETURNED)}
        for recipe, seeds in self.plan:
            runs = [RunDirectory(self._run(recipe, seed)) for seed in range(seeds)]
            spent = [run.cpu_s() for run in runs] if self.against == "cpu" else []
            for metric in curves:
                values = [run.column(RunDirectory.RETURN if metric == _RETURNED else f"eval/{metric}") for run in runs]
                if metric != _RETURNED or all(values):  # a very short training may end before its first episode does
                    curve = SeedCurve.of(values)
                    each = [np.interp(curve.steps, [*seconds], [*seconds.values()]) for seconds in spent]
                    curves[metric][recipe.name] = replace(curve, steps=np.mean(each, axis=0)) if each else curve
        return {metric: lines for metric, lines in curves.items() if lines}
