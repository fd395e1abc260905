"""The findings of an ablation: Markdown tables, and a page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.per_world import write_output
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.figures.ablation import change_figure, harm_curve, who_pays
from ethbrake_marl.figures.style import Figure, write_picture
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.pages.frame import Section, page
from ethbrake_marl.pages.parts import facts, table
from ethbrake_marl.pages.vector import drawing
from ethbrake_marl.studies.ablation.comparison import compare
from ethbrake_marl.studies.ablation.episodes import episodes_section
from ethbrake_marl.studies.ablation.levels_csv import levels_csv
from ethbrake_marl.studies.ablation.longer_lines import LineQuestion, LineResult
from ethbrake_marl.studies.ablation.plan import Plan
from ethbrake_marl.studies.ablation.run import Measured

NONE = "–"
_ALGORITHM = "Algorithm"
_HARM = {"first": "first-impact harm", "total": "total harm"}

Json = dict[str, Any]


class _Table(NamedTuple):
    """A table whose first ``left`` columns are texts."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    left: int


def markdown(found: Json, conditions: str) -> str:
    """All tables, with their conditions below."""
    blocks = [each for title, tables in _blocks(found) for each in (f"## {title}", *map(_write_table, tables))]
    return "\n\n".join([*blocks, conditions]) + "\n"


def ablation_page(found: Json, conditions: str, figures: Mapping[str, Figure], episodes: Sequence[Section] = ()) -> str:
    """The figures by name, sections of episodes to watch and all tables as one HTML page, with their conditions."""
    drawn = [
        drawing(figure, *FIGURE_TEXTS[name], alone=name == "ablation-who-pays.png", known=conditions)
        for name, figure in figures.items()
    ]
    sections = [Section("Conditions", [conditions])]
    sections += [Section("Figures", drawn)] if drawn else []
    sections += episodes
    for title, tables in _blocks(found):
        parts = [
            table(t.head, [[cell.replace("`", "") for cell in row] for row in t.rows]) for t in map(_alone, tables)
        ]
        sections.append(Section(title, parts))
    settings = {name: value for name, value in found["settings"].items() if name != "recipes"}
    sections.append(Section("Settings", [facts(settings)]))
    return page("What cooperation is worth", sections, lead="Who learns, who knows, whose harm counts: step by step.")


def _blocks(found: Json) -> list[tuple[str, list[_Table]]]:
    """The tables below their titles."""
    worlds = found["levels"][0]["first"]["searched"]["worlds"]
    blocks = [("Levels", [_levels(found["levels"], harm_count) for harm_count in HARM_COUNTS])]
    optima = [_optima(found["levels"], harm_count) for harm_count in HARM_COUNTS]
    blocks.append((f"How near the joint optimum, in the first {count_of(worlds, 'world')}", optima))
    if any(level["first"]["shielded"] for level in found["levels"]):
        behind = [_shielded(found["levels"], harm_count) for harm_count in HARM_COUNTS]
        blocks.append(("Behind the step shield that guards the count of the table", behind))
    for title, key in (("What each step is worth", "steps"), ("Price of lost messages", "channels")):
        if found[key]:
            blocks.append((title, [_changes(found[key])]))
    if found["steps"] or found["channels"]:
        changes = found["steps"] + found["channels"]
        blocks.append(("Who pays", [_who_pays(changes, harm_count) for harm_count in HARM_COUNTS]))
    return blocks


def interval_words(seeds: int) -> str:
    """What the intervals of figures over so many seeds hold for."""
    if seeds == 1:
        return "95 % intervals for other worlds only: one seed says nothing about others"
    rough = f" (rough: {seeds} seeds)" if seeds < 3 else ""
    return f"95 % intervals for other seeds and other worlds{rough}"


def lines_markdown(found: Sequence[LineResult], question: LineQuestion, runs: int) -> str:
    """One row per length of the line."""
    head = ["Vehicles", "All brake fully", "Reached", "Decrease", "Somebody worse off"]
    head += ["Best known", "Share of the joint optimum"] if question.search_episodes else []
    rows = []
    for one in found:
        row = [str(one.vehicles), _of(one.full_brake), _of(one.reached), _of(one.decrease, 100.0, 1, " %")]
        row.append(_of(one.worse_off, 100.0, 1, " %"))
        rows.append(row + ([_of(one.best_known), _of(one.share, 100.0, 1, " %")] if question.search_episodes else []))
    name = question.scenario.name
    conditions = (
        f"{_HARM[question.harm_count].capitalize()} (m²/s², means per world) of the line of {name} made longer:"
        f" {runs} {'policies' if runs > 1 else 'policy'}, {count_of(question.episodes, 'world')} of seed"
        f" {question.list_seed} for each length; {interval_words(runs)}."
    )
    if question.search_episodes:
        conditions += (
            f" Best known and share: the first {count_of(question.search_episodes, 'world')},"
            f" {question.budget:,} candidates each."
        )
    return f"{_write_table(_Table(head, rows, left=1))}\n\n{conditions}\n"


def _of(estimate: Estimate | None, scale: float = 1.0, digits: int = 2, unit: str = "") -> str:
    return _cell(None if estimate is None else estimate.to_json(), scale, digits, unit)


def _levels(levels: Sequence[Json], harm_count: HarmCount) -> _Table:
    head = ["Level", _ALGORITHM, "Collisions", "All brake fully", f"Reached, {_HARM[harm_count]}"]
    rows = []
    for level in levels:
        own = level[harm_count]
        row = [f"`{level['level']}`", level["algorithm"] or NONE, _cell(level["collision_rate"], 100.0, 1, " %")]
        rows.append([*row, _value(own["full_brake"]), _cell(own["harm"])])
    return _Table(head, rows, left=2)


def _optima(levels: Sequence[Json], harm_count: HarmCount) -> _Table:
    head = ["Level", _ALGORITHM, "All brake fully", f"Reached, {_HARM[harm_count]}"]
    head += ["Joint optimum", "Share of its reduction"]
    rows = []
    for level in levels:
        own = level[harm_count]["searched"]
        if own["best_known"] is not None:
            row = [f"`{level['level']}`", level["algorithm"], _value(own["full_brake"]), _cell(own["harm"])]
            rows.append([*row, _value(own["best_known"]), _cell(own["realised_share"], 100.0, 1, " %")])
    return _Table(head, rows, left=2)


def _shielded(levels: Sequence[Json], harm_count: HarmCount) -> _Table:
    head = ["Level", _ALGORITHM, f"Without, {_HARM[harm_count]}", "With", "Change", "Bound", "Replaced", "Stepped in"]
    rows = []
    for level in levels:
        own, behind = level[harm_count], level[harm_count]["shielded"]
        if behind is not None:
            row = [f"`{level['level']}`", level["algorithm"], _value(own["harm"]), _value(behind["harm"])]
            row += [
                _cell(behind["difference"], sign=True),
                _value(behind["bound"]),
                f"{100.0 * behind['replaced']:.1f} %",
            ]
            row += [_cell(behind[key], 100.0, 1, " %") for key in ("stepped_in", "worse_off", "above_baseline")]
            rows.append([*row, str(behind["above_bound"])])
    return _Table([*head, "Somebody worse off", "Above the baseline plan", "Above the bound"], rows, left=2)


def _changes(changes: Sequence[Json]) -> _Table:
    head = ["From", "To", _ALGORITHM]
    for harm_count in HARM_COUNTS:
        head += [f"Change of {_HARM[harm_count]}", f"Somebody worse off, {_HARM[harm_count]}"]
    rows = []
    for change in changes:
        row = [f"`{change['from']}`", f"`{change['to']}`", change["algorithm"]]
        for harm_count in HARM_COUNTS:
            row += [
                _cell(change[harm_count]["difference"], sign=True),
                _cell(change[harm_count]["worse_off"], 100.0, 1, " %"),
            ]
        rows.append(row)
    return _Table(head, rows, left=3)


def _who_pays(changes: Sequence[Json], harm_count: HarmCount) -> _Table:
    vehicles = len(changes[0][harm_count]["vehicles"])
    head = [f"Change of {_HARM[harm_count]}", _ALGORITHM, *(f"Vehicle {i + 1}" for i in range(vehicles))]
    head += [f"Vehicle {i + 1} worse off" for i in range(vehicles)]
    rows = []
    for change in changes:
        own = change[harm_count]
        row = [f"`{change['from']}` to `{change['to']}`", change["algorithm"]]
        row += [_cell(estimate, sign=True) for estimate in own["vehicles"]]
        rows.append(row + [f"{100.0 * share:.1f} %" for share in own["worse_off_vehicles"]])
    return _Table(head, rows, left=2)


def _alone(given: _Table) -> _Table:
    """The table without the algorithm's column where there is only one."""
    head, rows, left = given
    if _ALGORITHM not in head:
        return given
    column = head.index(_ALGORITHM)
    if len({row[column] for row in rows} - {NONE}) != 1:
        return given
    head, *rows = ([*row[:column], *row[column + 1 :]] for row in (head, *rows))
    return _Table(head, rows, left - 1)


def _write_table(given: _Table) -> str:
    """A table in Markdown."""
    head, rows, left = _alone(given)
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * left + " ---: |" * (len(head) - left)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _cell(estimate: Json | None, scale: float = 1.0, digits: int = 2, unit: str = "", *, sign: bool = False) -> str:
    """``12.34 [12.00, 12.70]``."""
    if estimate is None:
        return NONE
    plus = "+" if sign else ""
    value = f"{scale * estimate['value']:{plus}.{digits}f}{unit}"
    if estimate["interval"] is None:
        return value
    low, high = (f"{scale * end:{plus}.{digits}f}" for end in estimate["interval"])
    return f"{value} [{low}, {high}]"


def _value(estimate: Json | None) -> str:
    return NONE if estimate is None else f"{estimate['value']:.2f}"


SUMMARY, TABLE, TEXT, PAGE = "ablation.json", "ablation.csv", "ablation.md", "ablation.html"
FIGURES = {"ablation.png": harm_curve, "ablation-changes.png": change_figure, "ablation-who-pays.png": who_pays}

FIGURE_TEXTS = {
    "ablation.png": (
        "Harm against cooperation",
        "Both harms at each level, between full braking and the joint optimum.",
    ),
    "ablation-changes.png": ("What each step is worth", "Change of both harms from one level to the next."),
    "ablation-who-pays.png": ("Who pays", "Change of the harm of each vehicle, under both counts."),
}


def write_ablation(plan: Plan, measured: Sequence[Measured], machine: str) -> dict[str, Any]:
    """Write all files, replacing earlier ones, and give what ``ablation.json`` holds."""
    found = {"settings": _settings(plan, machine), **compare(measured, plan.search_episodes)}
    conditions = _conditions(plan, machine)
    write_output(plan.folder / SUMMARY, (json.dumps(found, indent=2, allow_nan=False) + "\n").encode(), force=True)
    write_output(plan.folder / TABLE, levels_csv(measured, plan.search_episodes).encode(), force=True)
    write_output(plan.folder / TEXT, markdown(found, conditions).encode(), force=True)
    drawn = found["steps"] or found["channels"]
    figures = {name: draw(found, conditions) for name, draw in FIGURES.items() if drawn}
    for name, figure in figures.items():
        write_picture(plan.folder / name, figure, force=True)
    page_text = ablation_page(found, conditions, figures, [episodes_section(plan, measured)])
    write_output(plan.folder / PAGE, page_text.encode(), force=True)
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
        f" learner. Harms are means per world in m²/s² on the same {count_of(plan.episodes, 'world')} of seed"
        f" {plan.list_seed} at every level; {interval_words(plan.seeds)}. Joint optimum: the least harm known that"
        f" the level's learners can do, and everything beside it, in the first {plan.search_episodes:,} of these"
        f" worlds, {plan.budget:,} candidates per world and count. {machine}."
    )
