"""Output of an ablation: ``ablation.json``, ``ablation.csv``, the figure, and tables for the terminal."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.cooperation.comparison import Json, columns_of, compare
from ethbrake_marl.extensions.cooperation.figures import ablation_figure, swept_axis
from ethbrake_marl.extensions.cooperation.levels import CSV, FIGURE, FULL, JSON, Plan
from ethbrake_marl.extensions.cooperation.measured import HARM, Measured
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, csv_text
from ethbrake_marl.files.store import write_output

WORDS = {"first": "first-impact harm", "total": "total harm"}


def write_ablation(plan: Plan, measured: Sequence[Measured], machine: str) -> tuple[Json, list[Path]]:
    """Write the results, and replace those of an earlier run; return the content of the JSON file, and the paths.

    ``machine`` describes the computer.
    """
    recipes = zip(plan.algorithms, plan.recipes, strict=True)
    results = {
        "settings": {
            **{name: getattr(plan, name) for name in (*FULL, "list_seed", "shield", "sweep")},
            "levels": [level.name for level in plan.levels],
            "recipes": {name: recipe.model_dump(mode="json") for name, recipe in recipes},
            "machine": machine,
            "date": datetime.now(UTC).date().isoformat(),
        },
        "conditions": f"{trained(plan)} {worlds_in_words(plan, plan.episodes)} {optimum_in_words(plan)} {machine}.",
        **compare(measured, plan.search_episodes),
    }
    caption = f"{trained(plan)} {worlds_in_words(plan, plan.search_episodes)} {optimum_in_words(plan)}"
    json_file, csv_file, picture = (plan.folder / name for name in (JSON, CSV, FIGURE))
    write_output(json_file, f"{json.dumps(results, indent=2, allow_nan=False)}\n".encode(), force=True)
    write_output(csv_file, levels_csv(measured, plan.search_episodes).encode(), force=True)
    write_picture(picture, ablation_figure(results, caption), force=True)
    return results, [json_file, csv_file, picture]


def trained(plan: Plan) -> str:
    """Return how the policies were trained."""
    recipes = ", ".join(
        f"{name} (rewarded for {WORDS[recipe.reward.harm_count]})"
        for name, recipe in zip(plan.algorithms, plan.recipes, strict=True)
    )
    swept = "" if plan.sweep is None else f"{plan.levels[0].scenario.name} with {plan.sweep}; "
    return (
        f"{swept}{recipes}; {count_of(plan.seeds, 'seed')}, {plan.steps_per_learner:,} decisions of each learner,"
        " rounded up to whole updates."
    )


def worlds_in_words(plan: Plan, number: int) -> str:
    """Return in which worlds means are taken, if they are the first ``number`` ones."""
    worlds = f"{'' if number == plan.episodes else 'first '}{count_of(number, 'world')} of seed {plan.list_seed}"
    same = "the same " if plan.levels[0].same_vehicles else ""
    drawn = "" if same else ", drawn with the same random numbers"
    others = "other seeds and other worlds" if plan.seeds > 1 else "other worlds only: one seed says nothing of others"
    return f"Harms are means per world in m²/s² on {same}{worlds}{drawn} at every level; 95 % intervals for {others}."


def optimum_in_words(plan: Plan) -> str:
    """Return what the joint optimum is."""
    return (
        f"Joint optimum: the least harm known that the level's learners can do, in the first"
        f" {count_of(plan.search_episodes, 'world')}, {plan.budget:,} candidates per world and count."
    )


def levels_csv(measured: Sequence[Measured], searched: int) -> str:
    """Return CSV text with one row per level, algorithm and seed; harms are means over worlds (m2/s2).

    The columns ``searched_*`` are means over the first ``searched`` worlds. Those of a shield are empty without one.
    """
    return csv_text(_row(one, seed, searched) for one in measured for seed in range(len(one.reached["collided"])))


def _row(one: Measured, seed: int, searched: int) -> Json:
    collided = one.reached["collided"][seed]
    row: Json = {
        "level": one.level.name,
        **columns_of(one),
        "algorithm": one.algorithm,
        "seed": seed if one.algorithm else None,
        "worlds": len(collided),
        "collision_rate": float(collided.mean()),
    }
    for count, name in HARM.items():
        reached, braking, behind = one.reached[name][seed], one.braking[name], one.shielded.get(count)
        row |= {
            name: float(reached.mean()),
            f"full_brake_{name}": float(braking.mean()),
            f"searched_{name}": float(reached[:searched].mean()),
            f"searched_full_brake_{name}": float(braking[:, :searched].mean()),
            f"searched_best_known_{name}": None if one.best is None else float(one.best[count].mean()),
        }
        vehicles = range(1, one.level.scenario.vehicles + 1)
        row |= {f"{name}_{i}": float(one.reached[f"{name}_{i}"][seed].mean()) for i in vehicles}
        row |= {f"shielded_{name}": None if behind is None else float(behind[name][seed].mean())}
        row |= {f"bound_{name}": None if behind is None else float(behind["bound"][seed].mean())}
    return row


def tables(results: Json) -> list[Sheet]:
    """Return the tables for the terminal, for each count of harm; a table without rows is left out."""
    swept, levels = swept_axis(results), results["levels"]
    several = len({level["algorithm"] for level in levels} - {None}) > 1
    algorithm: Columns = [(Column("Algorithm", text=True), "algorithm")] if several else []
    about: Columns = [(Column("Level", text=True), "level") if swept is None else (Column(swept), "swept_number")]
    about += algorithm
    from_to: Columns = [(Column(name, text=True), name.lower()) for name in ("From", "To")]
    if swept is not None:
        from_to = [(Column(f"{swept}, from"), "from_number"), (Column("To"), "to_number")]
    worlds = count_of(levels[0]["first"]["searched"]["worlds"], "world")
    known = [level for level in levels if level["first"]["searched"]["best_known"] is not None]
    shielded = [level for level in levels if level["first"]["shielded"]]
    sheets = []
    for count, harm in WORDS.items():
        changes = [
            *from_to, *algorithm, (Column("Change", sign="+"), f"{count} difference"),
            (share("Somebody worse off"), f"{count} worse_off"),
        ]  # fmt: skip
        sheets += [
            sheet(f"Levels, {harm}", levels, [
                *about, (share("Collisions"), "collision_rate"),
                (Column("All brake fully"), f"{count} full_brake value"), (Column("Reached"), f"{count} harm"),
            ]),
            sheet(f"How near the joint optimum, {harm} in the first {worlds}", known, [
                *about, (Column("All brake fully"), f"{count} searched full_brake value"),
                (Column("Reached"), f"{count} searched harm value"),
                (Column("Joint optimum"), f"{count} searched best_known value"),
                (share("Share of its reduction"), f"{count} searched share_of_possible_reduction"),
            ]),
            sheet(f"What each step is worth, {harm}", results["steps"], changes),
            sheet(f"Price of messages that are lost or tell less, {harm}", results["channels"], changes),
            sheet(f"Behind the step shield, {harm}", shielded, [
                *about, (Column("Without"), f"{count} harm value"),
                (Column("With"), f"{count} shielded harm value"), (Column("Bound"), f"{count} shielded bound value"),
                (share("Replaced"), f"{count} shielded replaced"),
            ]),
        ]  # fmt: skip
    return [each for each in sheets if each.rows]


Columns = list[tuple[Column, str]]


def sheet(title: str, rows: Sequence[Json], columns: Columns) -> Sheet:
    """Return a table; each column has the path of its values: ``first harm`` means ``row["first"]["harm"]``."""
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
    """Return a column of percentages."""
    return Column(heading, digits=1, scale=100.0, unit=" %")
