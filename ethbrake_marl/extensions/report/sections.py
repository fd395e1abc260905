"""The sections of a page about compared agents: tables, episodes, worst worlds, what was avoidable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from markupsafe import Markup

from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.captions import caption
from ethbrake_marl.evaluation.compared import Compared
from ethbrake_marl.evaluation.record import record_episodes
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.evaluation.summary import SummaryTable
from ethbrake_marl.extensions.report.best_known import HARM, BestKnown
from ethbrake_marl.extensions.report.harm_figures import harm_above
from ethbrake_marl.extensions.report.page import Part, Section
from ethbrake_marl.extensions.report.player import SAMPLE_S, Played, player
from ethbrake_marl.extensions.report.shown_worlds import choose_shown, worst_rows
from ethbrake_marl.files.sheet import Column, Row, Sheet, Shown
from ethbrake_marl.motion.layout import Bools
from ethbrake_marl.names import open_game

SHORT = ("collision_rate", "first_impact_harm", "total_harm")  # columns of the first table
PERCENT: dict[str, Any] = {"digits": 1, "scale": 100.0, "unit": " %"}


def short_table(table: SummaryTable) -> Part:
    """Return each agent's collision rate and harms."""
    sheet = table.sheet()
    some = sheet.only(k for k, name in enumerate(sheet.names) if k == 0 or name in SHORT)
    return Part.table(replace(some, title="Means with 95 % intervals, m²/s²"))


def measured(table: SummaryTable, beside: Sequence[Row] = (), notes: Sequence[str] = ()) -> list[Part]:
    """Return the conditions, and folded tables of all measures; ``beside`` and ``notes`` stand below the agents."""
    sheet = table.sheet()
    whole = replace(sheet.only(sheet.filled()), title="All measures with a column")
    whole = replace(whole, rows=[*whole.rows, *beside])
    more = [] if (asked := table.measures()) is None else [Part.table(asked)]
    title = "Every measure" + (", and the paper's rows" if beside else "")
    line = Part.paragraph(f"{caption(table.parameters)}. Harm in m²/s².", "quiet")
    return [line, Part.opened(title, [Part.table(whole), *(Part.paragraph(text, "quiet") for text in notes), *more])]


def drive_shown(compared: Compared, focus: str) -> dict[int, Played]:
    """Let every team drive some worlds once more: row -> world, with the episode under every agent."""
    chosen = choose_shown(compared.result, focus)
    worlds, (_, game) = compared.worlds(chosen), open_game(compared.scenario)
    for name, team in compared.teams.items():
        records = record_episodes(worlds, team, game, SAMPLE_S)
        for one, record in zip(chosen.values(), records, strict=True):
            one.records[name] = record
    return chosen


def episodes_section(compared: Compared, played: Mapping[int, Played], focus: str) -> Section:
    """Return the player; a note names each agent that drove differently in these episodes than in the evaluation."""
    body: list[str | Part] = []
    moving = sum(not all(record.at_rest for record in world.records.values()) for world in played.values())
    until = "from the alert until all vehicles are at rest"
    if moving:
        until += (
            f", or until the horizon of {compared.scenario.horizon_s:g} s. In {count_of(moving, 'world')}, vehicles"
            " still moved at the horizon under some agent; the player names this agent"
        )
    n = compared.result.n
    body.append(f"{f'{len(played)} of the {n:,}' if len(played) < n else f'All {n}'} worlds, {until}.")
    for agent in compared.teams:
        columns, other = compared.result[agent], 0
        for row, world in played.items():
            last = world.records[agent].last
            other += any(last.harm(count)[0] != columns[harm][row] for count, harm in HARM.items())
        if other:
            text = f"In {count_of(other, 'world')} of these, {agent} drove differently the second time: the player"
            body.append(Part.paragraph(f"{text} shows another episode than the tables.", "note"))
    return Section("Episodes", [*body, player(list(played.values()), focus=focus)])


def worst_section(compared: Compared, focus: str, watched: Mapping[int, Played]) -> Section:
    """Return the ten worlds in which an agent did worst; those that the player shows have a button."""
    result, known = compared.result, BestKnown.of(compared.result)
    columns = {"First-impact harm": result[focus][HARM["first"]], "Total harm": result[focus][HARM["total"]]}
    if known is not None:
        columns |= {"Best known, first": known.harm["first"], "Best known, total": known.harm["total"]}
        if known.avoidable is not None:
            columns["Contact"] = np.where(known.avoidable, "avoidable", "unavoidable")
    columns["Impacts"] = result[focus]["impacts"]
    rows = []
    for k in worst_rows(result, focus).tolist():
        number = int(result.worlds["world"][k])
        button = Markup('{} <button type="button" data-watch="{}">Watch</button>').format(number, number)
        rows.append([Shown(button) if k in watched else number, *(each[k].item() for each in columns.values())])
    by = "total harm" if known is None else "total harm minus best known total harm"
    if not rows:
        return Section("Worst ten worlds", [f"{focus} did no harm in any world that could be avoided."])
    table = Part.table(Sheet(f"Worlds of {focus}", list(map(Column, ("World", *columns))), rows))
    return Section("Worst ten worlds", [f"The worlds in which {focus} did worst, by {by}. Harm in m²/s².", table])


def avoidable_section(compared: Compared) -> Section:
    """Return how harm is distributed over the worlds and, if it is proven, what was avoidable."""
    result, known = compared.result, BestKnown.of(compared.result)
    body: list[str | Part] = []
    if known is not None and known.avoidable is not None:
        share = rate(known.avoidable, result.clusters).in_words(digits=1, scale=100.0, unit=" %")
        body.append(
            f"Contact can be avoided in {share} of the worlds. In the other worlds, no command can avoid it (both"
            " proven for each world)."
        )
        for where, among in (("Contact avoidable", known.avoidable), ("Contact unavoidable", ~known.avoidable)):
            if among.any():
                body.append(_split(compared, known, where, among))
    title, words = "Harm", "For each harm x: share of the worlds in which an agent did more harm than x."
    if known is not None:
        title = "Regret"
        words = "For each value x: share of the worlds in which an agent's harm minus the best known harm is above x."
    return Section(
        "World by world" if known is None else "What was avoidable",
        [*body, Part.drawing(harm_above(result), title, words)],
    )


def _split(compared: Compared, known: BestKnown, where: str, among: Bools) -> Part:
    part = compared.result.take(among)
    by, rows = part.clusters, []
    for agent, own in part.columns.items():
        regrets = (mean(known.regret(compared.result, agent, count)[among], by) for count in HARM)
        rows.append((agent, rate(own["collided"], by), *(mean(own[harm], by) for harm in HARM.values()), *regrets))
    columns = ("First-impact harm", "Total harm", "Regret, first-impact", "Regret, total")
    heads: list[Column | str] = ["Agent", Column("Collided", **PERCENT), *map(Column, columns)]
    return Part.table(Sheet(f"{where}: {count_of(part.n, 'world')}", heads, rows))
