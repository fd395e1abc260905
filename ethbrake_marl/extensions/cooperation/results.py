"""Results of an ablation: a comparison of its levels, ``ablation.json``, ``ablation.csv``, the figure, and tables."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ethbrake_marl.episode.counts import BUILT_IN_COUNTS, HarmCount
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.evaluate import SEED
from ethbrake_marl.evaluation.summary import on_what_intervals_rest
from ethbrake_marl.extensions.cooperation.ablation import CSV, FIGURE, FULL, JSON, Ablation, LevelResult
from ethbrake_marl.extensions.cooperation.seeds import mean_over_seeds, share_over_seeds
from ethbrake_marl.extensions.report.style import (
    GREY,
    axis_title,
    finish,
    in_our_style,
    new_panels,
    series_style,
    write_picture,
)
from ethbrake_marl.extensions.studies.machine import this_machine
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, csv_text
from ethbrake_marl.files.store import write_output
from ethbrake_marl.motion.layout import Floats

HARM_TOLERANCE = 1e-6  # m2/s2; a vehicle counts as worse off if its harm rises by more than this
LEVEL_IN, NARROWEST_IN, WIDEST_IN = 1.05, 5.0, 10.5  # width of a level, and of the figure
PANEL_IN = 3.2  # height of a panel
MOST_SHOWN = 1.6  # end of the axis, as a multiple of the median of full braking

Json = dict[str, Any]


def comparison(measured: Sequence[LevelResult], searched: int) -> Json:
    """Comparison of the levels as plain data; with the joint optimum, only in the first ``searched`` worlds.

    - ``levels``: results of each level and algorithm;
    - ``steps``: for each algorithm, the change of harm from each level's ``before`` to the level;
    - ``undertrained``: a sentence that names the levels whose trained policies do worse than full braking, if any.
    """
    steps = []
    for algorithm in dict.fromkeys(result.algorithm for result in measured if result.algorithm is not None):
        results_by_level = {result.level.name: result for result in measured if result.algorithm in (None, algorithm)}
        steps += [
            _change(results_by_level[result.level.before], result, algorithm)
            for result in results_by_level.values()
            if result.level.before
        ]
    goals = [
        (result, *(columns["goal"].mean() for columns in (result.reached, result.braking)))
        for result in measured
        if result.algorithm
    ]
    named = [
        f"{result.level.name} ({result.algorithm}) with {reached:.2f} ({braking:.2f} with full braking)"
        for result, reached, braking in goals
        if reached > braking + HARM_TOLERANCE
    ]
    return {
        "kind": "ablate",
        "levels": [_level(result, searched) for result in measured],
        "steps": steps,
        "undertrained": [f"Not trained enough to say anything: {'; '.join(named)}."] if named else [],
    }


def level_key(result: LevelResult) -> Json:
    swept = result.level.swept
    return {"level": result.level.name} | ({} if swept is None else {"swept_number": swept.number})


def _level(result: LevelResult, searched: int) -> Json:
    scenario = result.level.scenario
    mean = partial(mean_over_seeds, clusters=result.clusters)
    entry: Json = {
        **result.about,
        **level_key(result),
        "title": scenario.title,
        "algorithm": result.algorithm,
        "before": result.level.before,
        "learners": [scenario.vehicle_names[body - 1] for body in scenario.learners],
        "seeds": len(result.reached["collided"]),
        "worlds": result.reached["collided"].shape[1],
        "collision_rate": mean(result.reached["collided"]).to_json(),
    }
    for count in BUILT_IN_COUNTS:
        column = count.column
        reached, braking = result.reached[column], result.braking[column]
        entry[count.name] = {
            "full_brake": mean(braking).to_json(),
            "harm": mean(reached).to_json(),
            "each_seed": reached.mean(axis=1).tolist(),
            "vehicles": [mean(harm).to_json() for harm in _borne_columns(result, column)],
            "searched": _beside_optimum(result, count, searched),
        }
    return entry


def _beside_optimum(result: LevelResult, count: HarmCount, searched: int) -> Json:
    first = None if result.clusters is None else result.clusters[:searched]
    reached, braking = result.reached[count.column][:, :searched], result.braking[count.column][:, :searched]
    best = None if result.best is None else result.best[count.name]
    mean = partial(mean_over_seeds, clusters=first)
    share = None if best is None else share_over_seeds(reached, braking, best, first)
    return {
        "worlds": reached.shape[1],
        "full_brake": mean(braking).to_json(),
        "harm": mean(reached).to_json(),
        "each_seed": reached.mean(axis=1).tolist(),
        "best_known": None if best is None else mean(best).to_json(),
        "share_of_possible_reduction": None if share is None else share.to_json(),
    }


def _change(before: LevelResult, after: LevelResult, algorithm: str) -> Json:
    """Difference in harm between two levels, as plain data.

    Seed k is compared with seed k; a level with a single seed is compared with every seed of the other level.
    """
    entry: Json = {"algorithm": algorithm}
    for word, result in (("from", before), ("to", after)):
        entry |= {f"{word}_{key}" if key != "level" else word: value for key, value in level_key(result).items()}
    mean = partial(mean_over_seeds, clusters=after.clusters)
    for count in BUILT_IN_COUNTS:
        column = count.column
        new, old = (np.stack(_borne_columns(measured, column), axis=2) for measured in (after, before))
        worse = new > old + HARM_TOLERANCE
        entry[count.name] = {
            "difference": mean(after.reached[column], before.reached[column]).to_json(),
            "vehicles": [mean(new[:, :, i], old[:, :, i]).to_json() for i in range(new.shape[2])],
            "worse_off": mean(worse.any(axis=2)).to_json(),
            "worse_off_vehicles": worse.mean(axis=(0, 1)).tolist(),
        }
    return entry


def _borne_columns(result: LevelResult, column: str) -> list[Floats]:
    return [result.reached[f"{column}_{i}"] for i in range(1, result.level.scenario.vehicles + 1)]


def ablation_results(plan: Ablation, measured: Sequence[LevelResult]) -> Json:
    recipes = zip(plan.algorithms, plan.recipes, strict=True)
    swept, machine = plan.levels[0].swept, this_machine()
    return {
        "settings": {
            **{name: getattr(plan, name) for name in FULL},
            "recipes": {name: recipe.model_dump(mode="json") for name, recipe in recipes},
            "swept": None if swept is None else swept.axis,
            "list_seed": SEED,
            "machine": machine,
            "date": datetime.now(UTC).date().isoformat(),
        },
        "conditions": f"{conditions(plan, measured)} {machine}.",
        **comparison(measured, plan.search_episodes),
    }


def write_ablation(plan: Ablation, measured: Sequence[LevelResult], results: Json) -> list[Path]:
    """Write ``ablation.json``, ``ablation.csv`` and the figure; return the paths of the files."""
    json_file, csv_file, picture = (plan.folder / name for name in (JSON, CSV, FIGURE))
    write_output(json_file, f"{json.dumps(results, indent=2, allow_nan=False)}\n".encode(), force=True)
    write_output(csv_file, levels_csv(measured, plan.search_episodes).encode(), force=True)
    caption = f"{conditions(plan, measured)} Its line is as far below a bar as in these worlds."
    figure = ablation_figure(results, caption)
    write_picture(picture, figure, force=True)
    return [json_file, csv_file, picture]


def conditions(plan: Ablation, measured: Sequence[LevelResult]) -> str:
    """Sentences that say how the results were made."""
    recipes = ", ".join(
        f"{name} (rewarded for {recipe.reward.harm_count.words})"
        for name, recipe in zip(plan.algorithms, plan.recipes, strict=True)
    )
    alike = plan.levels[0].same_vehicles
    same_words, draw_words = ("the same ", "") if alike else ("", ", drawn with the same random numbers")
    scope = "other seeds and other worlds" if plan.seeds > 1 else "other worlds only: one seed says nothing of others"
    optimum = f"{count_of(plan.search_episodes, 'world')}, {plan.budget:,} candidates per world and count."
    return (
        f"{recipes}; {count_of(plan.seeds, 'seed')}, {plan.steps_per_learner:,} decisions of each learner, rounded up"
        " to whole updates. Harm and honest cost are means per world in m²/s² on"
        f" {same_words}{count_of(plan.episodes, 'world')} of seed {SEED}{draw_words}"
        f"{on_what_intervals_rest(measured[0].about)}; 95 % intervals for {scope}. Joint"
        f" optimum: the least harm or cost known that the learners can cause, in the first {optimum}"
    )


def levels_csv(measured: Sequence[LevelResult], searched: int) -> str:
    """CSV text with one row for each level, algorithm and seed: means; ``searched_*`` over the first ``searched``
    worlds.
    """
    rows: list[Json] = []
    for result in measured:
        for seed in range(len(result.reached["collided"])):
            row: Json = {**level_key(result), "algorithm": result.algorithm, "seed": seed if result.algorithm else None}
            row |= {name: float(values[seed].mean()) for name, values in result.reached.items()}
            for count in BUILT_IN_COUNTS:
                name, best = count.column, None if result.best is None else result.best[count.name]
                row |= {
                    f"full_brake_{name}": float(result.braking[name].mean()),
                    f"searched_{name}": float(result.reached[name][seed, :searched].mean()),
                    f"searched_full_brake_{name}": float(result.braking[name][:, :searched].mean()),
                    f"searched_best_known_{name}": None if best is None else float(best.mean()),
                }
            rows.append(row)
    return csv_text(rows)


SheetColumns = list[tuple[Column, str]]


def tables(results: Json) -> list[Sheet]:
    swept, levels = results["settings"]["swept"], results["levels"]
    several = len(results["settings"]["recipes"]) > 1
    algorithm: SheetColumns = [(Column("Algorithm", text=True), "algorithm")] if several else []
    about: SheetColumns = [(Column("Level", text=True), "level") if swept is None else (Column(swept), "swept_number")]
    from_to: SheetColumns = [(Column(name, text=True), name.lower()) for name in ("From", "To")]
    if swept is not None:
        from_to = [(Column(f"{swept}, from"), "from_swept_number"), (Column("To"), "to_swept_number")]
    worlds = count_of(levels[0]["first"]["searched"]["worlds"], "world")
    searched_levels = [level for level in levels if level["first"]["searched"]["best_known"] is not None]
    sheets = []
    for count, harm in ((count.name, count.words) for count in BUILT_IN_COUNTS):
        sheets += [
            sheet(f"Levels, {harm}", levels, [
                *about, *algorithm, (share("Collisions"), "collision_rate"),
                (Column("Full braking"), f"{count} full_brake value"), (Column("Reached"), f"{count} harm"),
            ]),
            sheet(f"How near the joint optimum, {harm} in the first {worlds}", searched_levels, [
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


def sheet(title: str, rows: Sequence[Json], columns: SheetColumns) -> Sheet:
    """Table with one row for each mapping of ``rows``. The path ``first harm`` of a column means
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


def share(heading: str) -> Column:
    return Column(heading, digits=1, scale=100.0, unit=" %")


@in_our_style
def ablation_figure(results: Json, caption: str) -> Figure:
    """Bars of what is minimised at each level or swept value, with 95 % intervals; a panel for each count.

    A bar far above full braking at most levels is cut. Means are over all worlds; the line of the joint optimum is as
    far below the bar as in the worlds in which it is known.
    """
    levels, recipes = results["levels"], results["settings"]["recipes"]
    names = list(dict.fromkeys(level["level"] for level in levels))
    at = {level["level"]: level.get("swept_number", names.index(level["level"])) for level in levels}
    unit = (max(at.values()) - min(at.values())) / (len(at) - 1)  # mean distance between neighbours
    width = min(max(LEVEL_IN * len(at), NARROWEST_IN), WIDEST_IN)
    rewarded = {recipe["reward"]["harm_count"] for recipe in recipes.values()}
    counts = [count for count in BUILT_IN_COUNTS if count.name in rewarded]
    figure, panels = new_panels((width, PANEL_IN * len(counts)), rows=len(counts))
    bar = 0.7 * unit / len(recipes)
    for axes, count in zip(panels, counts, strict=True):
        for number, algorithm in enumerate(recipes):
            shown = [level for level in levels if level["algorithm"] in (None, algorithm)]
            harms = [Estimate(**level[count.name]["harm"]) for level in shown]
            ends = list(zip(*((h.value - h.ends[0], h.ends[1] - h.value) for h in harms), strict=True))
            places = [at[level["level"]] + bar * (number - (len(recipes) - 1) / 2) for level in shown]
            colour = series_style(1 if number == 0 else number + 3)["color"]
            axes.bar(places, [h.value for h in harms], bar, yerr=ends, capsize=3, label=algorithm, color=colour)
            for place, harm in zip(places, harms, strict=True):
                mean, at_top = f"{harm.value:.2f}", axes.get_xaxis_transform()
                axes.text(place, 0.94, mean, transform=at_top, ha="center", fontsize=8)
        _draw_bounds(axes, [(at[level["level"]], level[count.name]) for level in levels], 0.42 * unit)
        if results["settings"]["swept"] is None:
            words = [name.removeprefix("cooperation-").removeprefix("level-").replace("-", "\n", 1) for name in names]
            axes.set_xticks([at[name] for name in names], words, fontsize=8)
        braking = [level[count.name]["full_brake"]["value"] for level in levels]
        axes.set_ylim(0.0, min(1.1 * axes.get_ylim()[1], MOST_SHOWN * float(np.median(braking))))
        axes.set(title=axis_title(count), xlabel=results["settings"]["swept"] or "")
    return finish(figure, " ".join([*results["undertrained"], caption]), panels[0], columns=3, fontsize=8.5)


def _draw_bounds(axes: Axes, points: list[tuple[float, Json]], half: float) -> None:
    braking = [(x, entry["full_brake"]["value"]) for x, entry in points]
    optimum = [
        (x, entry["harm"]["value"] - (entry["searched"]["harm"]["value"] - entry["searched"]["best_known"]["value"]))
        for x, entry in points
        if entry["searched"]["best_known"] is not None
    ]
    for label, colour, lines in (("full braking", GREY, braking), ("joint optimum", series_style(3)["color"], optimum)):
        x, value = np.transpose(lines)
        axes.hlines(value, x - half, x + half, color=colour, linewidth=2.0, label=label)
