"""Output of an ablation: a JSON file, a CSV file and a figure, and tables for the terminal.

``results`` is the content of ``ablation.json``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.cooperation.comparison import compare
from ethbrake_marl.extensions.cooperation.figures import ablation_figure, swept_axis
from ethbrake_marl.extensions.cooperation.joint_optimum import Measured
from ethbrake_marl.extensions.cooperation.levels import CSV, FIGURE, HARM, JSON, Json, Plan
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, csv_text
from ethbrake_marl.files.store import write_output
from ethbrake_marl.first_edition.evaluation.conditions import message_words
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.training.run_folder import RunDirectory


def write_ablation(plan: Plan, measured: Sequence[Measured], machine: str) -> tuple[Json, list[Path]]:
    """Write the results of an ablation, and replace existing files.

    ``machine`` describes the computer on which the ablation ran. Returns the content of ``ablation.json``, and the
    paths of the three files.
    """
    results = {
        "settings": {
            **plan.settings(),
            "levels": [level.name for level in plan.levels],
            **({} if plan.sweep is None else {"sweep": plan.sweep}),
            "recipes": {name: r.model_dump(mode="json") for name, r in zip(plan.algorithms, plan.recipes, strict=True)},
            "machine": machine,
            "date": datetime.now(UTC).date().isoformat(),
        },
        "conditions": _conditions(plan, machine),
        **compare(measured, plan.search_episodes),
    }
    paths = [plan.folder / name for name in (JSON, CSV, FIGURE)]
    write_output(paths[0], (json.dumps(results, indent=2, allow_nan=False) + "\n").encode(), force=True)
    write_output(paths[1], levels_csv(measured, plan.search_episodes).encode(), force=True)
    write_picture(paths[2], ablation_figure(results, results["conditions"]), force=True)
    return results, paths


def _conditions(plan: Plan, machine: str) -> str:
    """Return the conditions of an ablation in words: worlds, trainings, intervals, messages and machine."""
    recipes = ", ".join(
        f"{name} (rewarded for {'first-impact' if recipe.reward.harm_count == 'first' else 'total'} harm)"
        for name, recipe in zip(plan.algorithms, plan.recipes, strict=True)
    )
    worlds, first = f"{count_of(plan.episodes, 'world')} of seed {plan.list_seed}", plan.levels[0]
    same = f"the same {worlds}" if first.same_lines else f"{worlds}, drawn with the same random numbers"
    swept = "" if plan.sweep is None else f"{first.scenario.name} with {plan.sweep}; "
    words = {level.name: message_words(level.scenario) for level in plan.levels}
    messages = "".join(f"{name}: {each}. " for name, each in words.items() if each)
    intervals = (
        "other seeds and other worlds" if plan.seeds > 1 else "other worlds only: one seed says nothing about others"
    )
    return (
        f"{swept}{recipes}; {count_of(plan.seeds, 'seed')}, {plan.steps_per_learner:,} decisions of each learner,"
        f" rounded up to whole updates. Harms are means per world in m²/s² on {same} at every level; 95 % intervals for"
        f" {intervals}. Joint optimum: the least harm known that the level's learners can do, in the first"
        f" {plan.search_episodes:,} of these worlds, {plan.budget:,} candidates per world and count."
        f" {messages}{machine}."
    )


def levels_csv(measured: Sequence[Measured], searched: int) -> str:
    """Return CSV text with one row per level, algorithm and seed. Harms are means over all worlds (m2/s2).

    The columns ``searched_*`` are means over the first ``searched`` worlds, in which the joint optimum was searched.
    The columns of the shield are empty if no team was evaluated with a shield.
    """
    return csv_text(_seed_row(one, seed, searched) for one in measured for seed in range(len(one.reached.collided)))


def _seed_row(one: Measured, seed: int, searched: int) -> Json:
    collided = one.reached.collided[seed]
    about: Json = {
        "level": one.level.name,
        **one.level.columns,
        "algorithm": one.algorithm,
        "seed": seed if one.algorithm else None,
        "worlds": len(collided),
        "collision_rate": float(collided.mean()),
    }
    vehicles: Json = {}
    shield: Json = {}
    for harm_count in HARM_COUNTS:
        name = RunDirectory.HARM[harm_count]
        reached, braking = one.reached.world[harm_count][seed], one.full_brake.world[harm_count]
        about |= {
            name: float(reached.mean()),
            f"full_brake_{name}": float(braking.mean()),
            f"searched_{name}": float(reached[:searched].mean()),
            f"searched_full_brake_{name}": float(braking[:, :searched].mean()),
            f"searched_best_known_{name}": None if one.best is None else float(one.best[harm_count].mean()),
        }
        each = one.reached.vehicle[harm_count][seed].mean(axis=0)
        vehicles |= {f"{name}_{i + 1}": float(harm) for i, harm in enumerate(each)}
        behind = None if one.shielded is None else one.shielded[harm_count]
        actions = 1 if behind is None else behind.decisions[seed].sum() * behind.replaced.shape[2]
        shield |= {
            f"shielded_{name}": None if behind is None else float(behind.harm[seed].mean()),
            f"bound_{name}": None if behind is None else float(behind.bound[seed].mean()),
            f"actions_replaced_{name}": None if behind is None else float(behind.replaced[seed].sum() / actions),
        }
    return {**about, **vehicles, **shield}


def tables(results: Json) -> list[Sheet]:
    """Return the tables of an ablation for the terminal, for each count of harm; a table without rows is left out."""
    swept, levels = swept_axis(results), results["levels"]
    several = len({level["algorithm"] for level in levels} - {None}) > 1
    algorithm: _Columns = [(Column("Algorithm", text=True), "algorithm")] if several else []
    about: _Columns = [(Column("Level", text=True), "level") if swept is None else (Column(swept), "swept_number")]
    from_to: _Columns = [(Column(name, text=True), name.lower()) for name in ("From", "To")]
    if swept is not None:
        from_to = [(Column(f"{swept}, from"), "from_number"), (Column("To"), "to_number")]
    worlds = count_of(levels[0]["first"]["searched"]["worlds"], "world")
    known = [level for level in levels if level["first"]["searched"]["best_known"] is not None]
    sheets = []
    for count in HARM_COUNTS:
        harm = HARM[count]
        changes = [
            *from_to, *algorithm, (Column("Change", sign="+"), f"{count} difference"),
            (_share("Somebody worse off"), f"{count} worse_off"),
        ]  # fmt: skip
        sheets += [
            _sheet(f"Levels, {harm}", levels, [
                *about, *algorithm, (_share("Collisions"), "collision_rate"),
                (Column("All brake fully"), f"{count} full_brake value"), (Column("Reached"), f"{count} harm"),
            ]),
            _sheet(f"How near the joint optimum, {harm} in the first {worlds}", known, [
                *about, *algorithm, (Column("All brake fully"), f"{count} searched full_brake value"),
                (Column("Reached"), f"{count} searched harm value"),
                (Column("Joint optimum"), f"{count} searched best_known value"),
                (_share("Share of its reduction"), f"{count} searched share_of_possible_reduction"),
            ]),
            _sheet(f"What each step is worth, {harm}", results["steps"], changes),
            _sheet(f"Price of messages that are lost or tell less, {harm}", results["channels"], changes),
            _sheet(f"Behind the step shield, {harm}", [level for level in levels if level["first"]["shielded"]], [
                *about, *algorithm, (Column("Without"), f"{count} harm value"),
                (Column("With"), f"{count} shielded harm value"), (Column("Bound"), f"{count} shielded bound value"),
                (_share("Replaced"), f"{count} shielded replaced"),
            ]),
        ]  # fmt: skip
    return [sheet for sheet in sheets if sheet.rows]


_Columns = list[tuple[Column, str]]


def _sheet(title: str, rows: Sequence[Json], columns: _Columns) -> Sheet:
    """Return a table with values from ``ablation.json``.

    ``columns`` are headings, each with the path of its values in ``rows``: ``first harm`` means
    ``row["first"]["harm"]``.
    """
    cells: list[list[Any]] = []
    for row in rows:
        cells.append([])
        for _, path in columns:
            value: Any = row
            for key in path.split():
                value = value[key]
            cells[-1].append(Estimate(**value) if isinstance(value, dict) else value)
    return Sheet(title, [column for column, _ in columns], cells)


def _share(heading: str) -> Column:
    return Column(heading, digits=1, scale=100.0, unit=" %")
