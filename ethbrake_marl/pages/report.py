"""The report of an evaluation as one page: results, episodes to watch, what was avoidable, shield, figures."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from ethbrake_marl.agents.protocol import Driver, team_of
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.episodes import follow_episodes, issue_passport
from ethbrake_marl.evaluation.inputs import policy_sha256
from ethbrake_marl.evaluation.measures import BASELINE, Regrets, assess
from ethbrake_marl.evaluation.outcome import (
    Evaluation,
    Outcome,
    parameter_line,
    parameters,
)
from ethbrake_marl.evaluation.results import write_output
from ethbrake_marl.evaluation.shield_modes import ModeRow, are_teams, compare_behind_shields
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.evaluation.summary import (
    SummaryRow,
    identity_lines,
    knowledge_lines,
    left_out_lines,
    limit_lines,
    paper_lines,
    summary_sheet,
    table_meanings,
    warning_lines,
)
from ethbrake_marl.figures.evaluation import harm_by_agent, harm_in_parts, regret_distribution
from ethbrake_marl.figures.style import Figure
from ethbrake_marl.files.sheet import Estimate, Sheet
from ethbrake_marl.limits.limits import Unproven
from ethbrake_marl.pages.frame import Block, Cell, Part, Row, Section, facts, page, paragraph, table
from ethbrake_marl.pages.player import Played, player
from ethbrake_marl.pages.vector import drawing
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.shield.review import VERDICTS

# The worlds that a report shows: the worst, the typical, and some drawn at random; and every agent in each.

MOST_WORLDS = 50
WORST = 10
_EACH = 5  # of the other kinds
_RANDOM_SEED = 0


class Chosen(NamedTuple):
    """A world of an evaluation, and why it is shown."""

    row: int
    kind: str
    why: str


def choose_shown(evaluation: Evaluation, focus: str, *, most: int = MOST_WORLDS) -> list[Chosen]:
    """Up to ``most`` worlds to look at, each once: where ``focus`` did worst, best against full braking, as usual."""
    outcome = evaluation.outcome(focus)
    found: dict[int, Chosen] = {}
    total, first = outcome.total_harm, outcome.first_impact_harm

    def add(kind: str, rows: Sequence[int] | Ints, most_of_kind: int) -> None:
        fresh = [int(row) for row in rows if int(row) not in found][: min(most_of_kind, most - len(found))]
        for row in fresh:
            found[row] = Chosen(row, kind, f"{focus}: harm {first[row]:.2f} first-impact, {total[row]:.2f} total")

    add(f"Where {focus} did worst", worst_rows(evaluation, focus), WORST)
    regrets = assess(evaluation)
    avoidable = None if regrets is None else regrets.limits.proof.avoidable
    if avoidable is not None:
        add(
            f"Avoidable, and {focus} collided",
            _largest(total, outcome.collided & avoidable),
            _EACH,
        )
    if BASELINE in evaluation.outcomes and focus != BASELINE:
        saved = evaluation.outcome(BASELINE).total_harm - total
        add(f"Where {focus} saved most against {BASELINE}", _largest(saved, saved > 0.0), _EACH)
        add(f"Where {focus} did more harm than {BASELINE}", _largest(-saved, saved < 0.0), _EACH)
    order = np.argsort(total, kind="stable")
    add(f"Typical of {focus}", [order[int(q * (len(order) - 1))] for q in (0.5, 0.6, 0.7, 0.8, 0.9)], _EACH)
    add("Drawn at random", np.random.default_rng(_RANDOM_SEED).permutation(len(total))[: 2 * most], most)
    return list(found.values())


def worst_rows(evaluation: Evaluation, focus: str) -> Ints:
    """The ten worlds of the largest regret in total harm, or of the largest total harm where no best is known."""
    outcome, regrets = evaluation.outcome(focus), assess(evaluation)
    value = outcome.total_harm if regrets is None else regrets.regret(outcome, "total")
    return _largest(value, value > 0.0)[:WORST]


def _largest(value: Floats, among: Bools) -> Ints:
    order = np.argsort(-value, kind="stable")
    return order[among[order]]


def drive_played(
    played: Sequence[Played],
    worlds: Worlds,
    name: str,
    agent: Driver,
    scenario: Scenario,
    spelling: str,
    *,
    seed: int | None,
    harm_count: HarmCount = "first",
) -> None:
    """Let one agent drive the worlds of ``played`` and keep each motion and passport there, by the agent's name.

    Args:
        played: one for each world.
        worlds: at the alert, in the same order.
        name: of the agent on the page.
        agent: is left as it is.
        scenario: of the worlds, with the vehicles that are driven as its learners.
        spelling: how the agent is written on a command line.
        seed: of the list of worlds; None: they came from a file.
        harm_count: that the agent minimised.

    """
    drivers = team_of(agent, scenario.learners).drivers
    policies = {i: sha for i, driver in drivers.items() if (sha := policy_sha256(driver)) is not None}
    for one, motion in zip(played, follow_episodes(worlds, agent, scenario), strict=True):
        passport = issue_passport(
            motion, scenario, spelling, seed=seed, number=one.number, harm_count=harm_count, policies=policies
        )
        one.motions[name] = motion
        one.passports[name] = str(passport)


# Sections of a report: the worst worlds, what was avoidable, and what the shield was good for.

SHIELD_WORLDS = 200  # in which what a shield replaced is simulated again
_NONE = "–"


def worst_section(evaluation: Evaluation, focus: str, watched: Collection[int]) -> Section:
    """The ten worlds in which an agent did worst; those that the page plays have a button."""
    regrets, outcome = assess(evaluation), evaluation.outcome(focus)
    avoidable = None if regrets is None else regrets.limits.proof.avoidable
    known = [] if regrets is None else ["Best known, first", "Best known, total"]
    known += [] if avoidable is None else ["Contact"]
    head = ["World", "First-impact harm", "Total harm", *known, "Impacts"]
    columns = [outcome.first_impact_harm, outcome.total_harm]
    columns += [] if regrets is None else [regrets.best(count) for count in HARM_COUNTS]
    rows: list[Row] = []
    for k in worst_rows(evaluation, focus).tolist():
        number = int(evaluation.index[k])
        button = Markup('{} <button type="button" data-watch="{}">Watch</button>').format(number, number)
        contact = [] if avoidable is None else ["avoidable" if avoidable[k] else "unavoidable"]
        harms = (f"{column[k]:.2f}" for column in columns)
        rows.append([button if number in watched else number, *harms, *contact, int(outcome.impacts[k])])
    why = "as nothing is proven of these worlds" if regrets is None else "above the best known"
    told = f"Of {focus}, by total harm{',' * (regrets is None)} {why}. Harm in m²/s²."
    if not rows:
        return Section("Worst ten worlds", [f"{focus} did no harm above the best known in any of these worlds."])
    return Section("Worst ten worlds", [told, table(head, rows, caption=f"Worlds of {focus}")])


def avoidable_section(evaluation: Evaluation) -> Section:
    """Collisions and harm where contact could be avoided, and where nobody could; and the regret of each agent."""
    regrets = assess(evaluation)
    body: list[str | Part] = []
    avoidable = None if regrets is None else regrets.limits.proof.avoidable
    if regrets is None or avoidable is None:
        told = "Nothing is proven of these worlds, so what was avoidable is not told apart."
        if regrets is not None:
            told = "Where contact can be avoided is not decided for these vehicles, so that is not told apart."
        body.append(f"{told} Reason: {evaluation.limits.because}." if isinstance(evaluation.limits, Unproven) else told)
    else:
        share = rate(int(avoidable.sum()), len(avoidable)).in_words(digits=1, scale=100.0, unit=" %")
        body.append(
            f"Contact can be avoided in {share} of these worlds (proven, world by world); in the others no command can."
        )
        for where, among in (("Contact avoidable", avoidable), ("Contact unavoidable", ~avoidable)):
            if among.any():
                rows = [[agent, *_split_cells(each, regrets, among)] for agent, each in evaluation.outcomes.items()]
                body.append(table(_SPLIT, rows, caption=f"{where}: {count_of(int(among.sum()), 'world')}"))
        body.append(
            drawing(
                harm_in_parts(evaluation),
                "What the harm is made of",
                "Mean harm per world as the least that is known, and what each agent did above it.",
            )
        )
    title, words = "Harm world by world", "For each harm x, the share of the worlds in which an agent did more."
    if regrets is not None:
        title = "Regret world by world"
        words = "For each regret x, the share of the worlds in which an agent did more than x above the best known."
    body.append(drawing(regret_distribution(evaluation), title, words))
    return Section("What was avoidable", body)


_SPLIT = ("Agent", "Collided", "First-impact harm", "Total harm", "Regret, first-impact", "Regret, total")


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
        shares = map(_share, (row.replaced, *(row.verdicts or [None] * len(VERDICTS))))
        above = _NONE if row.above_bound is None else row.above_bound
        against = row.against_none if teams else row.against_episode
        told_against = _NONE if against is None else _cell(against)
        lines.append([f"{row.agent}, {row.mode}", _cell(row.harm), told_against, *shares, above])
    told = (
        "Each agent alone and behind every mode of the shield. Each decision that step mode replaced was simulated"
        " again without it: needed (harm would have been higher), harmless (the same), costly (lower)."
    )
    body: list[str | Part] = [told, table(head, lines, caption="Modes of the shield")]
    if teams:
        head = ["Agent, mode, vehicle", "Decisions replaced", "Bears", "Under the baseline plan", "Worlds with more"]
        lines = [
            [f"{row.agent}, {row.mode}, {each.vehicle}", _share(each.replaced), f"{each.harm:.2f}",
             f"{each.baseline:.2f}", _share(each.above_baseline)]
            for row in rows
            for each in row.vehicles
        ]  # fmt: skip
        body.append(table(head, lines, caption="What each vehicle bears"))
    body.append(paragraph(evidence.conditions, "quiet"))
    if left_out := rows[0].left_out:
        told_of = count_of(len(left_out), "world")
        body.append(paragraph(f"Left out: {told_of}, which the physics could not advance.", "note"))
    return Section("Shield", body)


def _share(share: float | None) -> str:
    return _NONE if share is None else f"{100.0 * share:.1f} %"


def _cell(estimate: Estimate, scale: float = 1.0, digits: int = 2, unit: str = "") -> Cell:
    value, *ends = (f"{scale * each:.{digits}f}" for each in (estimate.value, *(estimate.interval or ())))
    return Cell(f"{value}{unit}".replace("-", "−"), ", ".join(ends).replace("-", "−"))


_OTHERS = ("sampled_harm", "vehicle_1_shoved_m", "vehicle_1_shoved_far_rate", "predicted_harm")


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """A figure of the report; ``description`` says in words what it shows (and is read to those who cannot see it)."""

    title: str
    description: str
    figure: Figure


@dataclass(frozen=True, slots=True)
class ReportTest:
    """Results on another test, to stand below the main table."""

    title: str
    description: str  # what differs from the main table's test
    rows: Sequence[SummaryRow]


@dataclass(frozen=True, slots=True)
class Report:
    """Everything on the page. ``settings`` and ``versions`` are printed as they are given, name and value."""

    title: str
    rows: Sequence[SummaryRow]
    evaluation: Evaluation | None = None  # that the rows sum up
    played: Sequence[Played] = ()  # episodes to watch
    shield: ShieldEvidence | None = None  # of what is behind a shield
    focus: str = ""  # the agent whose worst worlds are shown
    figures: Sequence[ReportFigure] = ()
    tests: Sequence[ReportTest] = ()  # the same agents elsewhere
    summary: str = ""  # a sentence or two below the title
    settings: Mapping[str, object] = field(default_factory=dict)  # command, seeds, training set-up
    versions: Mapping[str, str] = field(default_factory=dict)


def focus_of(rows: Sequence[SummaryRow]) -> str:
    """The agent whose worst worlds a report shows: the last that drives by a trained policy, or the last."""
    learned = [row.agent for row in rows if row.policy_sha256]
    return learned[-1] if learned else rows[-1].agent


def play_for_report(
    evaluation: Evaluation,
    agents: Mapping[str, Driver],
    focus: str,
    *,
    spellings: Mapping[str, str] | None = None,
    harm_count: HarmCount = "first",
    on_agent: Callable[[str], None] | None = None,
) -> list[Played]:
    """Let every agent drive the worlds of a report once more: the motion and a passport of each episode.

    Args:
        evaluation: whose worlds they are.
        agents: that were evaluated, by name; they are left as they are.
        focus: the agent whose worst worlds are shown: see ``choose_shown``.
        spellings: how an agent is written on a command line, where that is not its name.
        harm_count: that agents minimised.
        on_agent: is told each agent that is done.

    """
    chosen = choose_shown(evaluation, focus)
    rows = np.array([each.row for each in chosen], np.int64)
    worlds, numbers = evaluation.worlds.take(rows), evaluation.index[rows]
    scenario = evaluation.scenario
    if evaluation.vehicles != scenario.learners:
        scenario = scenario.with_learners(evaluation.vehicles)
    played = [Played(int(n), each.kind, each.why, {}, {}) for n, each in zip(numbers, chosen, strict=True)]
    for name, agent in agents.items():
        spelling = (spellings or {}).get(name, name)
        drive_played(played, worlds, name, agent, scenario, spelling, seed=evaluation.seed, harm_count=harm_count)
        if on_agent is not None:
            on_agent(name)
    return played


def render_report(report: Report) -> str:
    """The page as HTML; it loads nothing from anywhere."""
    sections = [_results(report), *_episodes(report)]
    if report.evaluation is not None and report.focus:
        sections.append(worst_section(report.evaluation, report.focus, {one.number for one in report.played}))
    if report.evaluation is not None:
        sections.append(avoidable_section(report.evaluation))
    if report.shield is not None:
        sections.append(shield_section(report.shield))
    if report.figures:
        drawn = [drawing(each.figure, each.title, each.description) for each in report.figures]
        sections.append(Section("Figures", drawn))
    sections += [_other_test(test) for test in report.tests]
    sections += [_measures(report), _reading(report), *_settings(report)]
    return page(report.title, sections, lead=report.summary)


def write_report(path: str | Path, report: Report, *, force: bool = False) -> None:
    """Write the page; raises ``AlreadyExists`` unless ``force``, ``InvalidInput`` without a folder."""
    write_output(path, render_report(report).encode("utf-8"), force=force)


def _results(report: Report) -> Section:
    rows = report.rows
    body: list[str | Part] = []
    if rows:
        body.append(
            drawing(
                harm_by_agent(rows),
                "Harm of each agent",
                "Mean per world of the squared closing speed of impacts: each pair's first one, and every one.",
            )
        )
    sheet = summary_sheet(rows)
    names = [name for name in sheet.names if name not in ("Knows", *_OTHERS)]
    body.append(_table(sheet, names, "Means with 95 % intervals"))
    if rows:
        body.append(paragraph(f"{parameter_line(rows[0].parameters)}. Harm in m²/s².", "quiet"))
    body += [paragraph(text, "quiet") for text in _empty_lines(report)]
    body += [paragraph(text, "note") for text in (*left_out_lines(rows), *warning_lines(rows))]
    body += [paragraph(f"The limit: {text}", "quiet") for text in limit_lines(rows)]
    body += [paragraph(f"Who knows what: {text}", "note") for text in knowledge_lines(rows)]
    *paper, note = paper_lines(rows) or [""]
    body += [paragraph(f"The paper's {line}", "quiet") for line in paper]
    body += [paragraph(note, "note")] if note else []
    return Section("Results", body)


def _empty_lines(report: Report) -> list[str]:
    """Which columns of the tables hold nothing, and why where that is known, as a sentence; none where all do."""
    names = _empty(report.rows)
    if not names:
        return []
    limits = report.evaluation.limits if report.evaluation is not None else None
    because = f" Nothing is proven of these worlds: {limits.because}." if isinstance(limits, Unproven) else ""
    return [f"Columns without a value in any row are left out: {'; '.join(names)}.{because}"]


def _empty(rows: Sequence[SummaryRow]) -> list[str]:
    """Columns of the table of these rows in which no line has a value."""
    sheet = summary_sheet(rows)
    filled = sheet.filled()
    return [name for k, name in enumerate(sheet.headings) if k not in filled]


def _table(sheet: Sheet, names: Sequence[str], caption: str) -> Part:
    """Columns of a table by name, below those of the agent; what is empty is left out."""
    filled = set(sheet.filled())
    kept = [k for k, name in enumerate(sheet.names) if k == 0 or (name in names and k in filled)]
    some = sheet.only(kept)
    words = [name == "Knows" for name in some.names[1:]]
    lines: list[Row] = []
    for row in some.shown():
        if isinstance(row, str):
            lines.append(Block(f"The paper's {row.removeprefix('paper, ')}, as printed"))
        else:
            cells = (Cell(value, below, text) for (value, below), text in zip(row[1:], words, strict=True))
            lines.append([row[0].value, *cells])
    return table(some.headings, lines, caption=caption)


def _episodes(report: Report) -> list[Section]:
    if not report.played or report.evaluation is None:
        return []
    shown, every = len(report.played), report.evaluation.worlds.n
    told = f"{shown} of the {every:,} worlds" if shown < every else f"All {shown} worlds"
    notes = [paragraph(text, "note") for text in _unrepeated(report.played, report.evaluation)]
    played = player(report.played, report.evaluation.vehicles, focus=report.focus)
    return [Section("Episodes", [f"{told}, {_until(report.played, report.evaluation)}", *notes, played])]


def _until(played: Sequence[Played], evaluation: Evaluation) -> str:
    """Where the episodes end, as the end of a sentence."""
    moving = sum(not all(motion.at_rest for motion in world.motions.values()) for world in played)
    if not moving:
        return "from the alert to rest."
    return (
        f"from the alert to rest, or to the horizon of {evaluation.scenario.horizon_s:g} s: in"
        f" {count_of(moving, 'world')} the line of some agent was not at rest then, and the player says whose."
    )


def _unrepeated(played: Sequence[Played], evaluation: Evaluation) -> list[str]:
    """Which agents drove otherwise when they drove once more, as sentences; none where all did the same to the bit."""
    rows = {int(number): row for row, number in enumerate(evaluation.index)}
    found: dict[str, int] = {}
    for world in played:
        for agent, motion in world.motions.items():
            outcome, row = evaluation.outcome(agent), rows[world.number]
            counted = (float(outcome.first_impact_harm[row]), float(outcome.total_harm[row]))
            found[agent] = found.get(agent, 0) + (motion.harm != counted)
    return [
        f"{agent} did not repeat itself in {count_of(count, 'world')} of these: what is played there is another episode"
        " than the one that the tables count."
        for agent, count in found.items()
        if count
    ]


def _other_test(test: ReportTest) -> Section:
    sheet = summary_sheet(test.rows)
    names = [name for name in sheet.names if name != "Knows"]
    body: list[str | Part] = [test.description, _table(sheet, names, test.title)]
    if empty := _empty(test.rows):
        body.append(paragraph(f"Columns without a value in any row are left out: {'; '.join(empty)}.", "quiet"))
    if test.rows:
        told = [f"{parameter_line(test.rows[0].parameters)}.", *limit_lines(test.rows), *identity_lines(test.rows)]
        body += [paragraph(text, "note") for text in warning_lines(test.rows)]
        body += [paragraph(text, "quiet") for text in told]
    return Section(test.title, body)


def _measures(report: Report) -> Section:
    sheet = summary_sheet(report.rows)
    ours = replace(sheet, rows=sheet.rows[: len(report.rows)])
    return Section("Other measures", [_table(ours, ("Knows", *_OTHERS), "In the same worlds")])


def _reading(report: Report) -> Section:
    empty = set(_empty(report.rows))
    empty = empty.intersection(*(_empty(test.rows) for test in report.tests))
    columns = summary_sheet(report.rows).headings[2:]
    told = {}
    for name, meaning in table_meanings(report.rows).items():
        about = {column for column in columns if column.startswith(name)}
        if not about or about - empty:
            told[name] = meaning
    return Section("How to read the tables", [facts(told)])


def _settings(report: Report) -> list[Section]:
    found = []
    if report.settings:
        found.append(Section("Settings and seeds", [facts(report.settings)]))
    identity = [paragraph(text, "quiet") for text in identity_lines(report.rows)]
    if report.versions or identity:
        found.append(Section("Versions", [*([facts(report.versions)] if report.versions else []), *identity]))
    return found
