"""Output of an ablation: ``ablation.json``, ``ablation.csv``, the figure, and tables for the terminal."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ethbrake_marl.episode.counts import COLUMN, IN_WORDS
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.door import SEED
from ethbrake_marl.extensions.cooperation.ablation import CSV, FIGURE, FULL, JSON, Ablation, Measured
from ethbrake_marl.extensions.cooperation.comparison import Json, compare, place_of
from ethbrake_marl.extensions.cooperation.figures import ablation_figure
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, csv_text
from ethbrake_marl.files.store import write_output


def write_ablation(plan: Ablation, measured: Sequence[Measured]) -> tuple[Json, list[Path]]:
    recipes = zip(plan.algorithms, plan.recipes, strict=True)
    swept, machine = plan.levels[0].swept, this_machine()
    results = {
        "settings": {
            **{name: getattr(plan, name) for name in FULL},
            "recipes": {name: recipe.model_dump(mode="json") for name, recipe in recipes},
            "swept": None if swept is None else swept.axis,
            "list_seed": SEED,
            "machine": machine,
            "date": datetime.now(UTC).date().isoformat(),
        },
        "conditions": f"{conditions(plan, plan.episodes)} {machine}.",
        **compare(measured, plan.search_episodes),
    }
    json_file, csv_file, picture = (plan.folder / name for name in (JSON, CSV, FIGURE))
    write_output(json_file, f"{json.dumps(results, indent=2, allow_nan=False)}\n".encode(), force=True)
    write_output(csv_file, levels_csv(measured, plan.search_episodes).encode(), force=True)
    write_picture(picture, ablation_figure(results, conditions(plan, plan.search_episodes)), force=True)
    return results, [json_file, csv_file, picture]


def conditions(plan: Ablation, number: int) -> str:
    recipes = ", ".join(
        f"{name} (rewarded for {IN_WORDS[recipe.reward.harm_count]})"
        for name, recipe in zip(plan.algorithms, plan.recipes, strict=True)
    )
    alike = plan.levels[0].same_vehicles
    same, drawn = ("the same ", "") if alike else ("", ", drawn with the same random numbers")
    first = "" if number == plan.episodes else "first "
    others = "other seeds and other worlds" if plan.seeds > 1 else "other worlds only: one seed says nothing of others"
    optimum = f"{count_of(plan.search_episodes, 'world')}, {plan.budget:,} candidates per world and count."
    return (
        f"{recipes}; {count_of(plan.seeds, 'seed')}, {plan.steps_per_learner:,} decisions of each learner, rounded up"
        " to whole updates. Harm and honest cost are means per world in m²/s² on"
        f" {same}{first}{count_of(number, 'world')} of seed {SEED}{drawn}; 95 % intervals for {others}. Joint optimum:"
        f" the least harm or cost known that the learners can cause, in the first {optimum}"
    )


def levels_csv(measured: Sequence[Measured], searched: int) -> str:
    """Return CSV text with one row per level, algorithm and seed: the mean over worlds of each column of an evaluation.

    The columns ``searched_*`` are means over the first ``searched`` worlds.
    """
    rows: list[Json] = []
    for one in measured:
        for seed in range(len(one.reached["collided"])):
            row: Json = {**place_of(one), "algorithm": one.algorithm, "seed": seed if one.algorithm else None}
            row |= {name: float(values[seed].mean()) for name, values in one.reached.items()}
            for count, name in COLUMN.items():
                row |= {
                    f"full_brake_{name}": float(one.braking[name].mean()),
                    f"searched_{name}": float(one.reached[name][seed, :searched].mean()),
                    f"searched_full_brake_{name}": float(one.braking[name][:, :searched].mean()),
                    f"searched_best_known_{name}": None if one.best is None else float(one.best[count].mean()),
                }
            rows.append(row)
    return csv_text(rows)


Columns = list[tuple[Column, str]]


def tables(results: Json) -> list[Sheet]:
    swept, levels = results["settings"]["swept"], results["levels"]
    several = len(results["settings"]["recipes"]) > 1
    algorithm: Columns = [(Column("Algorithm", text=True), "algorithm")] if several else []
    about: Columns = [(Column("Level", text=True), "level") if swept is None else (Column(swept), "swept_number")]
    from_to: Columns = [(Column(name, text=True), name.lower()) for name in ("From", "To")]
    if swept is not None:
        from_to = [(Column(f"{swept}, from"), "from_swept_number"), (Column("To"), "to_swept_number")]
    worlds = count_of(levels[0]["first"]["searched"]["worlds"], "world")
    known = [level for level in levels if level["first"]["searched"]["best_known"] is not None]
    sheets = []
    for count, harm in ((count, IN_WORDS[count]) for count in COLUMN):
        sheets += [
            sheet(f"Levels, {harm}", levels, [
                *about, *algorithm, (share("Collisions"), "collision_rate"),
                (Column("Full braking"), f"{count} full_brake value"), (Column("Reached"), f"{count} harm"),
            ]),
            sheet(f"How near the joint optimum, {harm} in the first {worlds}", known, [
                *about, *algorithm, (Column("Full braking"), f"{count} searched full_brake value"),
                (Column("Reached"), f"{count} searched harm value"),
                (Column("Joint optimum"), f"{count} searched best_known value"),
                (share("Share of its reduction"), f"{count} searched share_of_possible_reduction"),
            ]),
            sheet(f"What each step is worth, {harm}", results["steps"], [
                *from_to, *algorithm, (Column("Change", sign="+"), f"{count} difference"),
                (share("Somebody worse off"), f"{count} worse_off"),
            ]),
        ]  # fmt: skip
    return sheets


def sheet(title: str, rows: Sequence[Json], columns: Columns) -> Sheet:
    """Return a table. A column's path says where its values are: ``first harm`` means ``row["first"]["harm"]``."""
    cells: list[list[Any]] = []
    for row in rows:
        cells.append([])
        for _, path in columns:
            value: Any = row
            for key in path.split():
                value = value[key]
            cells[-1].append(Estimate(**value) if isinstance(value, dict) else value)
    return Sheet(title, [column for column, _ in columns], cells)


def share(heading: str) -> Column:
    return Column(heading, digits=1, scale=100.0, unit=" %")
