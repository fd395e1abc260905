"""The table of a tuning, one row per trial, and the recipe of the best one.

No time and no place stands in the table: with one worker it is the same, byte for byte, however often it was stopped.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from ethbrake_marl.files.durable import write_file
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.learning.recipe_text import recipe_text
from ethbrake_marl.scenario.catalogue import check_file_name
from ethbrake_marl.studies.sweep.job import RESULTS
from ethbrake_marl.studies.tuning.plan import TuningPlan, Values, texts_of
from ethbrake_marl.studies.tuning.study import TrialRecord

TABLE = "trials.csv"


def write_table(folder: Path, plan: TuningPlan, trials: Sequence[TrialRecord]) -> Path:
    """Write the table and give its path.

    The values of ``RESULTS`` are those of the kept policy on the tuning's list, of a pruned trial of the best until
    then.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    keys = [*plan.file.search]
    writer.writerow(["trial", "state", "hash", *keys, *RESULTS, "reason"])
    for trial in trials:
        if trial.state == "waiting":
            continue
        values = trial.values or {}
        shown = [flow_text(values[key]) if key in values else "" for key in keys]
        found = trial.results or ("",) * len(RESULTS)
        writer.writerow([trial.number, trial.state, trial.identity, *shown, *found, trial.reason])
    path = folder / TABLE
    write_file(path, text.getvalue().encode())
    return path


def best_recipe(plan: TuningPlan, values: Values, file: Path, source: str) -> str:
    """The text of a recipe that trains what the trial with these values trained, named as its file.

    Raises ``InvalidInput`` for a file whose name cannot be a recipe's.
    """
    check_file_name("recipe", file.stem)
    described = f"Settings of {plan.file.recipe} that `ethbrake tune` found."
    recipe = plan.training(values).recipe.replace(
        name=file.stem, title=plan.file.title, description=described, source=source
    )
    return recipe_text(recipe, export_head(plan, file))


def export_head(plan: TuningPlan, file: Path) -> str:
    """The first line of an exported recipe."""
    settings = "".join(f" --set {text}" for text in scenario_texts(plan))
    command = f"ethbrake train --scenario {plan.file.scenario}{settings} --recipe {file.name}"
    return f"# The best trial of a tuning, trained again: {command}\n"


def scenario_texts(plan: TuningPlan) -> tuple[str, ...]:
    """Those settings of the file that are the scenario's, which no recipe can hold."""
    fields = type(plan.recipe).model_fields
    return texts_of(
        {
            key: value
            for key, value in plan.file.settings.items()
            if key.startswith("scenario.") or key.partition(".")[0] not in {*fields, "recipe"}
        }
    )
