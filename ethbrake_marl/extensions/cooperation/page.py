"""Output files of an ablation: an HTML page, and its tables as Markdown, CSV and JSON.

``results`` is the content of ``ablation.json``. ``conditions`` is a text that describes the worlds, the seeds and the
machine.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.conditions import message_words
from ethbrake_marl.extensions.cooperation.comparison import compare
from ethbrake_marl.extensions.cooperation.curves import swept_axis
from ethbrake_marl.extensions.cooperation.figures import ablation_figures
from ethbrake_marl.extensions.cooperation.joint_optimum import Measured
from ethbrake_marl.extensions.cooperation.levels import FIGURES, HARM, SWEEP_FIGURES, Json, Plan, algorithm
from ethbrake_marl.extensions.report.page import Page, Part, Section
from ethbrake_marl.extensions.report.player import Played
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, csv_text
from ethbrake_marl.files.store import write_output
from ethbrake_marl.game.harm import HARM_COUNTS
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.team import load_team

_MOST, _USUAL, _LEAST = 3, 2, 2  # number of example worlds with the largest, a median and the least reduction of harm


def choose_worlds(measured: Sequence[Measured]) -> list[Played]:
    """Choose worlds for the page by the decrease of total harm from the first to the last level.

    In some of these worlds the harm decreases most, in some by about the median, and in some least. The decrease is
    computed with the policies of the first seed. Levels that differ from an earlier level only by a worse V2X channel
    are not used.
    """
    ladder = [one for one in measured if one.level.clear is None]
    first, last = ladder[0], ladder[-1]
    before, after = (one.reached.world["total"][0] for one in (first, last))
    order = np.argsort(after - before, kind="stable")
    middle = max((len(order) - _USUAL) // 2, 0)
    kinds = (
        (f"Where {last.level.name} saves most against {first.level.name}", order[:_MOST]),
        ("As usual", order[middle : middle + _USUAL]),
        ("Where it saves least, or harms", order[::-1][:_LEAST]),
    )
    chosen: dict[int, Played] = {}
    for kind, rows in kinds:
        for row in map(int, rows):
            chosen.setdefault(row, Played(row, kind, f"total harm {before[row]:.2f} to {after[row]:.2f}"))
    return list(chosen.values())


def episodes_section(plan: Plan, measured: Sequence[Measured]) -> Section:
    """Return the section of the page that shows the episodes of all levels side by side.

    The worlds come from ``choose_worlds``. Learners drive with the policies of the first seed.
    """
    played = choose_worlds(measured)
    rows = np.array([each.number for each in played], np.int64)
    controlled: dict[str, tuple[int, ...]] = {}
    for level in plan.levels:
        worlds = level.scenario.sample(plan.episodes, plan.list_seed).worlds.take(rows)
        drivers = {level.name: Team({}, level.name)}  # an empty team: scripts drive all vehicles
        if level.scenario.learners:
            drivers = {}
            for recipe in plan.recipes:
                folder = plan.training(level, recipe, 0).folder
                name = level.name if len(plan.recipes) == 1 else f"{level.name}, {algorithm(recipe)}"
                drivers[name] = load_team(folder, level.scenario, name)
        for name, team in drivers.items():
            Played.drive(played, worlds, name, team, level.scenario)
            controlled[name] = level.scenario.learners
    first = plan.levels[0]
    same = "the same line" if first.same_lines else "drawn with the same random numbers"
    other = "" if first.swept is None or first.same_lines else f" {first.swept.key},"
    text = (
        f"{count_of(len(played), 'world')}, {same} at every level; of several seeds the first drives."
        f" The conditions are those of {first.name}:{other} delays of messages and an obstacle ahead are each"
        " level's own."
    )
    return Section("Episodes", [text, Part.player(played, controlled)])


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


_ALGORITHM = "Algorithm"


def markdown(results: Json, conditions: str) -> str:
    """Return all tables of an ablation as Markdown."""
    blocks = [f"**{line}**" for line in results["undertrained"]]
    blocks += [text for title, sheets in _blocks(results) for text in (f"## {title}", *(s.markdown() for s in sheets))]
    return "\n\n".join([*blocks, conditions]) + "\n"


def ablation_page(
    results: Json, conditions: str, figures: Mapping[str, Figure], episodes: Sequence[Section] = ()
) -> str:
    """Return the HTML page of an ablation.

    ``figures`` are figures by file name. ``episodes`` are sections that show single episodes.
    """
    titles = FIGURES if swept_axis(results) is None else SWEEP_FIGURES
    drawn = [
        Part.drawing(figure, *titles[name], alone=name == "ablation-who-pays.png", known=conditions)
        for name, figure in figures.items()
    ]
    sections = [Section("Conditions", [conditions]), *([Section("Figures", drawn)] if drawn else []), *episodes]
    for title, sheets in _blocks(results):
        parts = []
        for sheet in sheets:
            rows = [
                [cell.in_words.replace("`", "") for cell in row] for row in sheet.shown() if not isinstance(row, str)
            ]
            parts.append(Part.table(Sheet("", [Column(heading) for heading in sheet.headings], rows)))
        sections.append(Section(title, parts))
    settings = {name: value for name, value in results["settings"].items() if name != "recipes"}
    sections.append(Section("Settings", [Part.facts(settings)]))
    lead, swept = "Who learns, who knows, whose harm counts: step by step.", swept_axis(results)
    if swept is not None:
        lead = f"One level with several numbers of {swept}."
    alarms = [Part.paragraph(line, "alarm") for line in results["undertrained"]]
    return Page("What cooperation is worth", sections, lead, opening=alarms).html


def _blocks(results: Json) -> list[tuple[str, list[Sheet]]]:
    """Return the tables of an ablation in groups, each as (title of the group, tables)."""
    swept = swept_axis(results)
    shown = {
        level["level"]: f"`{level['level']}`" if swept is None else f"{level['swept_number']:g}"
        for level in results["levels"]
    }
    levels = [{**level, "level": f"`{level['level']}`", "number": shown[level["level"]]} for level in results["levels"]]
    steps, channels = (
        [{**change, "from": shown[change["from"]], "to": shown[change["to"]]} for change in results[key]]
        for key in ("steps", "channels")
    )
    both = [{**change, "change": f"{change['from']} to {change['to']}"} for change in steps + channels]
    vehicles = range(len(both[0]["first"]["vehicles"]) if both else 0)
    worlds = levels[0]["first"]["searched"]["worlds"]
    braking = Column("All brake fully")
    about: _Columns = [("Level", "level"), (_ALGORITHM, "algorithm")]
    changed: _Columns = [("From", "from"), ("To", "to"), (_ALGORITHM, "algorithm")]
    if swept is not None:
        about.insert(1, (swept, "number"))
        changed[:2] = [(f"{swept}, from", "from"), ("To", "to")]
    for count in HARM_COUNTS:
        changed += [
            (Column(f"Change of {HARM[count]}", sign="+"), f"{count} difference"),
            (_share(f"Somebody worse off, {HARM[count]}"), f"{count} worse_off"),
        ]
    blocks = {
        "Levels": [
            _sheet(levels, [
                *about,
                (_share("Collisions"), "collision_rate"),
                (braking, f"{count} full_brake value"),
                (Column(f"Reached, {HARM[count]}"), f"{count} harm"),
            ])
            for count in HARM_COUNTS
        ],
        f"How near the joint optimum, in the first {count_of(worlds, 'world')}": [
            _sheet([level for level in levels if level[count]["searched"]["best_known"] is not None], [
                *about,
                (braking, f"{count} searched full_brake value"),
                (Column(f"Reached, {HARM[count]}"), f"{count} searched harm"),
                (Column("Joint optimum"), f"{count} searched best_known value"),
                (_share("Share of its reduction"), f"{count} searched share_of_possible_reduction"),
            ])
            for count in HARM_COUNTS
        ],
        "Behind the step shield that guards the count of the table": [
            _sheet([level for level in levels if level[count]["shielded"]], [
                *about,
                (Column(f"Without, {HARM[count]}"), f"{count} harm value"),
                (Column("With"), f"{count} shielded harm value"),
                (Column("Change", sign="+"), f"{count} shielded difference"),
                (Column("Bound"), f"{count} shielded bound value"),
                (_share("Replaced"), f"{count} shielded replaced"),
                (_share("Stepped in"), f"{count} shielded stepped_in"),
                (_share("Somebody worse off"), f"{count} shielded worse_off"),
                (_share("Above the baseline plan"), f"{count} shielded above_baseline"),
                (Column("Above the bound"), f"{count} shielded above_bound"),
            ])
            for count in HARM_COUNTS
        ],
        "What each step is worth": [_sheet(steps, changed)],
        "Price of messages that are lost or tell less": [_sheet(channels, changed)],
        "Who pays": [
            _sheet(both, [
                (f"Change of {HARM[count]}", "change"),
                (_ALGORITHM, "algorithm"),
                *((Column(f"Vehicle {i + 1}", sign="+"), f"{count} vehicles {i}") for i in vehicles),
                *((_share(f"Vehicle {i + 1} worse off"), f"{count} worse_off_vehicles {i}") for i in vehicles),
            ])
            for count in HARM_COUNTS
        ],
    }  # fmt: skip
    always = [*blocks][:2]
    return [(title, sheets) for title, sheets in blocks.items() if title in always or any(s.rows for s in sheets)]


_Columns = list[tuple[Column | str, str]]


def _sheet(rows: Sequence[Json], columns: _Columns) -> Sheet:
    """Return a table with values from ``ablation.json``.

    ``columns`` are headings, each with the path of its values in ``rows``: ``first harm`` means
    ``row["first"]["harm"]``. If all rows are results of the same algorithm, the table has no column for the algorithm.
    """
    if len({row["algorithm"] for row in rows} - {None}) == 1:
        columns = [(column, path) for column, path in columns if column != _ALGORITHM]
    cells: list[list[Any]] = []
    for row in rows:
        cells.append([])
        for _, path in columns:
            value: Any = row
            for key in path.split():
                value = value[int(key) if isinstance(value, list) else key]
            cells[-1].append(Estimate(**value) if isinstance(value, dict) else value)
    return Sheet("", [column for column, _ in columns], cells)


def interval_words(seeds: int) -> str:
    """Return a phrase for captions: whether the 95 % intervals allow for other worlds only, or also for other seeds."""
    if seeds == 1:
        return "95 % intervals for other worlds only: one seed says nothing about others"
    rough = f" (rough: {seeds} seeds)" if seeds < 3 else ""
    return f"95 % intervals for other seeds and other worlds{rough}"


def _share(heading: str) -> Column:
    return Column(heading, digits=1, scale=100.0, unit=" %")


def write_ablation(plan: Plan, measured: Sequence[Measured], machine: str) -> tuple[Json, list[Path]]:
    """Write the HTML page, the Markdown, CSV and JSON files and the figures of an ablation; replace existing files.

    ``machine`` describes the computer on which the ablation ran. Returns the content of ``ablation.json``, and the
    paths of the page, the Markdown file and the figures.
    """
    settings = {
        **plan.settings(),
        "levels": [level.name for level in plan.levels],
        **({} if plan.sweep is None else {"sweep": plan.sweep}),
        "recipes": {name: r.model_dump(mode="json") for name, r in zip(plan.algorithms, plan.recipes, strict=True)},
        "machine": machine,
        "date": datetime.now(UTC).date().isoformat(),
    }
    results = {"settings": settings, **compare(measured, plan.search_episodes)}
    recipes = ", ".join(
        f"{name} (rewarded for {'first-impact' if recipe.reward.harm_count == 'first' else 'total'} harm)"
        for name, recipe in zip(plan.algorithms, plan.recipes, strict=True)
    )
    worlds, first = f"{count_of(plan.episodes, 'world')} of seed {plan.list_seed}", plan.levels[0]
    same = f"the same {worlds}" if first.same_lines else f"{worlds}, drawn with the same random numbers"
    swept = "" if plan.sweep is None else f"{first.scenario.name} with {plan.sweep}; "
    lines = [
        f"{level.name}: {message_words(level.scenario)}. " for level in plan.levels if message_words(level.scenario)
    ]
    conditions = (
        f"{swept}{recipes}; {plan.seeds} {'seeds' if plan.seeds > 1 else 'seed'}, {plan.steps_per_learner:,} decisions"
        f" of each learner, rounded up to whole updates. Harms are means per world in m²/s² on {same} at every level;"
        f" {interval_words(plan.seeds)}. Joint optimum: the least harm known that the level's learners can do, and"
        f" everything beside it, in the first {plan.search_episodes:,} of these worlds, {plan.budget:,} candidates per"
        f" world and count. {''.join(lines)}{machine}."
    )
    drawn = results["steps"] or results["channels"]
    titles = FIGURES if plan.sweep is None else SWEEP_FIGURES
    figures = dict(zip(titles, ablation_figures(results, conditions), strict=True)) if drawn else {}
    for name, figure in figures.items():
        write_picture(plan.folder / name, figure, force=True)
    texts = {
        "ablation.html": ablation_page(results, conditions, figures, [episodes_section(plan, measured)]),
        "ablation.md": markdown(results, conditions),
        "ablation.csv": levels_csv(measured, plan.search_episodes),
        "ablation.json": json.dumps(results, indent=2, allow_nan=False) + "\n",
    }
    for name, text in texts.items():
        write_output(plan.folder / name, text.encode(), force=True)
    return results, [plan.folder / name for name in ("ablation.html", "ablation.md", *figures)]
