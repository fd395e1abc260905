"""Learning curves: several seeds of several recipes on one scenario, in one folder, with one figure."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput, OnProgress, count_of
from ethbrake_marl.evaluation.inputs import result_identity, worlds_sha256
from ethbrake_marl.evaluation.results import write_output
from ethbrake_marl.evaluation.seed_statistics import interquartile_mean
from ethbrake_marl.figures.studies import SeedCurve, at_common_steps, seed_curves
from ethbrake_marl.figures.style import Figure, write_picture
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.learning.progress import HARM_METRIC
from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.learning.training import RETURN, progress_column, progress_rows, resolve
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.studies.jobs import JobFolder
from ethbrake_marl.studies.trainings import TrainingJob, finish_trainings

FIGURE, TABLE, SUMMARY = "learning_curves.png", "learning_curves.csv", "learning_curves.json"

_RETURNED = "return"  # what it is called here
_LABELS = {
    "first_impact_harm": "First-impact harm on the fixed list (m²/s²)",
    "total_harm": "Total harm on the fixed list (m²/s²)",
    "return": "Mean return of training episodes",
}


@dataclass(frozen=True, slots=True)
class Trainings:
    """The seeds 0 to ``seeds - 1`` of one recipe."""

    recipe: TrainingRecipe
    seeds: int


def parse_trainings(text: str) -> list[Trainings]:
    """Read ``ppo:5,sac:3``: recipes (names, or paths) with their numbers of seeds; raises ``InvalidInput``."""
    found = []
    for part in text.split(","):
        match = re.fullmatch(r"(.+):([1-9][0-9]{0,3})", part)
        if match is None:
            raise InvalidInput(f"recipes {text!r}: {part!r} must be RECIPE:SEEDS, for instance ppo:5,sac:3")
        found.append(Trainings(load_recipe(match[1]), int(match[2])))
    names = [trainings.recipe.name for trainings in found]
    if len(set(names)) < len(names):
        raise InvalidInput(f"recipes {text!r}: two recipes have the same name")
    return found


def train_all(
    scenario: Scenario,
    plan: Sequence[Trainings],
    folder: Path,
    *,
    steps: int | None = None,
    settings: Sequence[str] = (),
    jobs: int = 1,
    tell: OnProgress | None = None,
) -> bool:
    """Train every seed of every recipe into ``folder/RECIPE-seedK``: finished ones are kept, begun ones go on.

    ``jobs`` of them at a time. Gives False when Ctrl-C stopped it. Raises ``InvalidInput`` for a folder that holds
    another training than this one would be (``learning.training``), before any is begun, besides what ``train`` raises.
    """
    trainings = [
        TrainingJob(
            resolve(each.recipe, scenario, seed=seed, total_steps=each.recipe.total_steps if steps is None else steps),
            folder / f"{each.recipe.name}-seed{seed}",
            tuple(settings),
        )
        for each in plan
        for seed in range(each.seeds)
    ]
    kept = JobFolder(folder, "learning curves")
    with kept.work():
        return finish_trainings(trainings, jobs, tell, run=kept.run)


def write_curves(scenario: Scenario, plan: Sequence[Trainings], folder: Path) -> dict[str, Any]:
    """Draw the finished trainings of ``folder``, write figure, table and summary, and give the summary.

    For each recipe: interquartile mean over seeds, with its stratified bootstrap interval, of the harm of the policy
    that each training kept, and of the last one. Raises ``InvalidInput`` when they have no evaluation in common.
    """
    curves = _read_curves(plan, folder)
    about = result_identity("learning-curves", scenario, None)
    summary: dict[str, Any] = {**about, "scenario": scenario.name, "recipes": {}}
    for trainings in plan:
        name = trainings.recipe.name
        values = curves[HARM_METRIC[trainings.recipe.reward.harm_count]][name].values
        kept, last = _estimate(values.min(axis=1)), _estimate(values[:, -1])
        summary["recipes"][name] = {
            **_identity(scenario, trainings, folder),
            "seeds": trainings.seeds,
            "kept": kept,
            "last": last,
        }
    write_picture(folder / FIGURE, curves_figure(scenario, plan, folder), force=True)
    rows = [
        {"figure": metric, "recipe": recipe, "seed": seed, "steps": int(step), "value": float(value)}
        for metric, lines in curves.items()
        for recipe, curve in lines.items()
        for seed, values in enumerate(curve.values)
        for step, value in zip(curve.steps, values, strict=True)
    ]
    write_output(folder / TABLE, csv_text(rows).encode(), force=True)
    write_output(folder / SUMMARY, (json.dumps(summary, indent=2, allow_nan=False) + "\n").encode(), force=True)
    return summary


def curves_figure(scenario: Scenario, plan: Sequence[Trainings], folder: Path) -> Figure:
    """The figure of the finished trainings of ``folder``: harm and return over steps, mean over seeds.

    Raises ``InvalidInput`` when they have no evaluation in common.
    """
    curves = _read_curves(plan, folder)
    caption = f"{scenario.name}: mean over seeds, bands: one standard deviation. {_conditions(plan)}"
    panels = {_LABELS[metric]: lines for metric, lines in curves.items()}
    return seed_curves(panels, logarithmic=[_LABELS[m] for m in curves if m != _RETURNED], caption=caption)


def _read_curves(plan: Sequence[Trainings], folder: Path) -> dict[str, dict[str, SeedCurve]]:
    """What the trainings of ``folder`` reached, by metric and recipe; without what no episode told."""
    counts = {trainings.recipe.reward.harm_count for trainings in plan}
    metrics = [HARM_METRIC[count] for count in ("first", "total") if count in counts]
    curves: dict[str, dict[str, SeedCurve]] = {metric: {} for metric in (*metrics, _RETURNED)}
    for trainings in plan:
        name = trainings.recipe.name
        tables = [progress_rows(folder / f"{name}-seed{seed}") for seed in range(trainings.seeds)]
        for metric in curves:
            values = [progress_column(table, RETURN if metric == _RETURNED else f"eval/{metric}") for table in tables]
            if metric != _RETURNED or all(values):  # no episode may have ended in a very short training
                curves[metric][name] = at_common_steps(values)
    return {metric: lines for metric, lines in curves.items() if lines}


def _estimate(harms: Any) -> dict[str, Any]:
    found = interquartile_mean([harms])
    told = found.to_json()
    return {"interquartile_mean": told["value"], "interval": told["interval"], "each": [float(harm) for harm in harms]}


def _identity(scenario: Scenario, trainings: Trainings, folder: Path) -> dict[str, Any]:
    """Hashes of the recipe's fixed list, and of the policy that each of its seeds kept."""
    fixed = scenario.sample(trainings.recipe.evaluation.worlds, trainings.recipe.evaluation.seed)
    runs = [folder / f"{trainings.recipe.name}-seed{seed}" for seed in range(trainings.seeds)]
    return {
        "worlds_sha256": worlds_sha256(fixed.worlds, fixed.index),
        "policy_sha256": [load_policy(run).manifest.manifest_sha256 for run in runs],
    }


def _conditions(plan: Sequence[Trainings]) -> str:
    """The fixed list of each recipe, in words."""
    lists = sorted({(t.recipe.evaluation.worlds, t.recipe.evaluation.seed) for t in plan})
    return "Fixed list: " + "; ".join(f"{count_of(worlds, 'world')} of seed {seed}" for worlds, seed in lists) + "."
