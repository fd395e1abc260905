"""What an ablation writes into its folder: JSON, CSV, Markdown and three figures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from ethbrake_marl.ablation.comparison import compare
from ethbrake_marl.ablation.figures import change_figure, harm_curve, who_pays
from ethbrake_marl.ablation.measurement import Measured
from ethbrake_marl.ablation.plan import Plan
from ethbrake_marl.ablation.tables import interval_words, levels_csv, markdown
from ethbrake_marl.evaluation.figure_style import png_bytes
from ethbrake_marl.evaluation.output_files import write_output

SUMMARY, TABLE, PAGE = "ablation.json", "ablation.csv", "ablation.md"
FIGURES = {"ablation.png": harm_curve, "ablation-changes.png": change_figure, "ablation-who-pays.png": who_pays}


def write_ablation(plan: Plan, measured: Sequence[Measured], machine: str) -> dict[str, Any]:
    """Write all files, replacing earlier ones, and give what ``ablation.json`` holds."""
    found = {"settings": _settings(plan, machine), **compare(measured, plan.search_episodes)}
    conditions = _conditions(plan, machine)
    write_output(plan.folder / SUMMARY, (json.dumps(found, indent=2, allow_nan=False) + "\n").encode(), force=True)
    write_output(plan.folder / TABLE, levels_csv(measured, plan.search_episodes).encode(), force=True)
    write_output(plan.folder / PAGE, markdown(found, conditions).encode(), force=True)
    for name, draw in FIGURES.items():
        if found["steps"] or found["channels"]:
            write_output(plan.folder / name, png_bytes(draw(found, conditions)), force=True)
    return found


def _settings(plan: Plan, machine: str) -> dict[str, Any]:
    return {
        **plan.settings(),
        "levels": [level.name for level in plan.levels],
        "recipes": {name: r.model_dump(mode="json") for name, r in zip(plan.algorithms, plan.recipes, strict=True)},
        "machine": machine,
        "date": datetime.now(UTC).date().isoformat(),
    }


def _conditions(plan: Plan, machine: str) -> str:
    recipes = ", ".join(
        f"{name} (rewarded for {'first-impact' if recipe.reward.harm_count == 'first' else 'total'} harm)"
        for name, recipe in zip(plan.algorithms, plan.recipes, strict=True)
    )
    return (
        f"{recipes}; {plan.seeds} {'seeds' if plan.seeds > 1 else 'seed'}, {plan.steps_per_learner:,} decisions of each"
        f" learner. Harms are means per world in m²/s² on the same {plan.episodes:,} worlds of seed {plan.list_seed} at"
        f" every level; {interval_words(plan.seeds)}. Joint optimum: the least harm known that the level's learners can"
        f" do, and everything beside it, in the first {plan.search_episodes:,} of these worlds, {plan.budget:,}"
        f" candidates per world and count. {machine}."
    )
