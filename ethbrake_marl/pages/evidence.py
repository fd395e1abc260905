"""Sections of a report: the worst worlds, what was avoidable, and what the shield was good for."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from ethbrake_marl.agents.team import Driver
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.conditions import parameter_line, parameters
from ethbrake_marl.evaluation.outcome import Evaluation, Outcome
from ethbrake_marl.evaluation.regret import Regrets, assess
from ethbrake_marl.evaluation.shield_modes import ModeRow, are_teams, compare_behind_shields
from ethbrake_marl.evaluation.statistics import Estimate, mean, rate
from ethbrake_marl.figures.report import harm_in_parts, regret_distribution
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.limits.limits import Unproven
from ethbrake_marl.pages.chosen import worst_rows
from ethbrake_marl.pages.frame import Part, Section, paragraph
from ethbrake_marl.pages.parts import Cell, Row, table
from ethbrake_marl.pages.vector import drawing
from ethbrake_marl.physics import Bools
from ethbrake_marl.scenario import Task
from ethbrake_marl.shield.review import VERDICTS

SHIELD_WORLDS = 200  # in which what a shield replaced is simulated again
_NONE = "–"


def worst_section(evaluation: Evaluation, focus: str, watched: Collection[int]) -> Section:
    """The ten worlds in which an agent did worst; those that the page plays have a button."""
    regrets, outcome = assess(evaluation), evaluation.outcome(focus)
    known = [] if regrets is None else ["Best known, first", "Best known, total", "Contact"]
    head = ["World", "First-impact harm", "Total harm", *known, "Impacts"]
    rows: list[Row] = []
    for k in worst_rows(evaluation, focus).tolist():
        number = int(evaluation.index[k])
        best: list[str] = []
        if regrets is not None:
            best += [f"{regrets.best(count)[k]:.2f}" for count in HARM_COUNTS]
            best.append("avoidable" if regrets.limits.proof.avoidable[k] else "unavoidable")
        button = Markup('{} <button type="button" data-watch="{}">Watch</button>').format(number, number)
        harms = (f"{outcome.first_impact_harm[k]:.2f}", f"{outcome.total_harm[k]:.2f}")
        world = button if number in watched else number
        rows.append([world, *harms, *best, int(outcome.impacts[k])])
    why = (
        "by total harm, as nothing is proven of these worlds"
        if regrets is None
        else "by total harm above the best known"
    )
    if not rows:
        return Section("Worst ten worlds", [f"{focus} did no harm above the best known in any of these worlds."])
    return Section(
        "Worst ten worlds", [f"Of {focus}, {why}. Harm in m²/s².", table(head, rows, caption=f"Worlds of {focus}")]
    )


def avoidable_section(evaluation: Evaluation) -> Section:
    """Collisions and harm where contact could be avoided, and where nobody could; and the regret of each agent."""
    regrets = assess(evaluation)
    body: list[str | Part] = []
    if regrets is None:
        told = "Nothing is proven of these worlds, so what was avoidable is not told apart."
        body.append(f"{told} Reason: {evaluation.limits.because}." if isinstance(evaluation.limits, Unproven) else told)
        title, words = "Harm world by world", "For each harm x, the share of the worlds in which an agent did more."
    else:
        avoidable = regrets.limits.proof.avoidable
        share = rate(int(avoidable.sum()), len(avoidable)).in_words(digits=1, scale=100.0, unit=" %")
        body.append(
            f"Contact can be avoided in {share} of these worlds (proven, world by world); in the others no command can."
        )
        for where, among in (("Contact avoidable", avoidable), ("Contact unavoidable", ~avoidable)):
            if among.any():
                body.append(_split_table(evaluation, regrets, where, among))
        body.append(
            drawing(
                harm_in_parts(evaluation),
                "What the harm is made of",
                "Mean harm per world as the least that is known, and what each agent did above it.",
            )
        )
        title = "Regret world by world"
        words = "For each regret x, the share of the worlds in which an agent did more than x above the best known."
    body.append(drawing(regret_distribution(evaluation), title, words))
    return Section("What was avoidable", body)


def _split_table(evaluation: Evaluation, regrets: Regrets, where: str, among: Bools) -> Part:
    head = ["Agent", "Collided", "First-impact harm", "Total harm", "Regret, first-impact", "Regret, total"]
    rows = [[agent, *_split_cells(outcome, regrets, among)] for agent, outcome in evaluation.outcomes.items()]
    return table(head, rows, caption=f"{where}: {count_of(int(among.sum()), 'world')}")


def _split_cells(outcome: Outcome, regrets: Regrets, among: Bools) -> list[Cell]:
    means = [
        mean(values[among])
        for values in (
            outcome.first_impact_harm, outcome.total_harm,
            regrets.regret(outcome, "first"), regrets.regret(outcome, "total"),
        )
    ]  # fmt: skip
    collided = rate(int((outcome.collided & among).sum()), int(among.sum()))
    return [_cell(collided, 100.0, 1, " %"), *(_cell(each) for each in means)]


class ShieldEvidence(NamedTuple):
    """The modes of the shield around some agents, measured."""

    rows: Sequence[ModeRow]
    conditions: str  # of the measurement


def shield_evidence(
    agents: Mapping[str, Driver], evaluation: Evaluation, harm_count: HarmCount = "first"
) -> ShieldEvidence | None:
    """What is behind a shield among these agents, alone and behind every mode, in the first worlds of an evaluation.

    None where nobody has a shield.
    """
    worlds = evaluation.worlds.take(np.arange(min(evaluation.worlds.n, SHIELD_WORLDS)))
    rows = compare_behind_shields(agents, worlds, Task(evaluation.scenario, evaluation.vehicles, harm_count))
    if not rows:
        return None
    count = "first-impact" if harm_count == "first" else "total"
    line = parameter_line({**parameters(evaluation), "count": worlds.n})
    return ShieldEvidence(rows, f"{count.capitalize()} harm, which the shield bounds, in m²/s². {line}.")


def shield_section(evidence: ShieldEvidence) -> Section:
    """The modes of the shield on the same worlds, and what each intervention of step mode was good for."""
    rows, teams = evidence.rows, are_teams(evidence.rows)
    head = ["Agent, mode", "Harm", "Minus no shield" if teams else "Minus episode mode", "Decisions replaced"]
    head += [*VERDICTS, "Worlds above the bound"]
    lines: list[Row] = []
    for row in rows:
        shares = (None,) * len(VERDICTS) if row.verdicts is None else row.verdicts
        replaced = [_NONE if share is None else f"{100.0 * share:.1f} %" for share in (row.replaced, *shares)]
        above = _NONE if row.above_bound is None else row.above_bound
        against = row.against_none if teams else row.against_episode
        told_against = _NONE if against is None else _cell(against)
        lines.append([f"{row.agent}, {row.mode}", _cell(row.harm), told_against, *replaced, above])
    told = (
        "Each agent alone and behind every mode of the shield. Each decision that step mode replaced was simulated"
        " again without it: needed (harm would have been higher), harmless (the same), costly (lower)."
    )
    left_out = rows[0].left_out
    notes = [paragraph(evidence.conditions, "quiet")]
    if left_out:
        told_of = count_of(len(left_out), "world")
        notes.append(paragraph(f"Left out: {told_of}, which the physics could not advance.", "note"))
    borne = [_shares(rows)] if teams else []
    return Section("Shield", [told, table(head, lines, caption="Modes of the shield"), *borne, *notes])


def _shares(rows: Sequence[ModeRow]) -> Part:
    """What each vehicle bears behind the shield of a team."""
    head = ["Agent, mode, vehicle", "Decisions replaced", "Bears", "Under the baseline plan", "Worlds with more"]
    lines: list[Row] = [
        [
            f"{row.agent}, {row.mode}, {each.vehicle}",
            _NONE if each.replaced is None else f"{100.0 * each.replaced:.1f} %",
            f"{each.harm:.2f}",
            f"{each.baseline:.2f}",
            f"{100.0 * each.above_baseline:.1f} %",
        ]
        for row in rows
        for each in row.vehicles
    ]
    return table(head, lines, caption="What each vehicle bears")


def _cell(estimate: Estimate, scale: float = 1.0, digits: int = 2, unit: str = "") -> Cell:
    value = f"{scale * estimate.value:.{digits}f}{unit}".replace("-", "−")
    if estimate.interval is None:
        return Cell(value)
    low, high = (f"{scale * end:.{digits}f}".replace("-", "−") for end in estimate.interval)
    return Cell(value, f"{low}, {high}")
