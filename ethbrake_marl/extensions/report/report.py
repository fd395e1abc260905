"""The HTML report of an evaluation: results, episodes, worst worlds, avoidable harm, and the effect of the shield."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from ethbrake_marl.errors import count_of
from ethbrake_marl.extensions.report.harm_figures import harm_by_agent, harm_in_parts, regret_distribution
from ethbrake_marl.extensions.report.page import Page, Part, Section
from ethbrake_marl.extensions.report.player import Played
from ethbrake_marl.extensions.report.shown_worlds import BASELINE, NAMES, ROUNDING, WORDS, choose_shown, worst_rows
from ethbrake_marl.extensions.search.limit_measures import best_known_words
from ethbrake_marl.extensions.search.limits import Unproven
from ethbrake_marl.extensions.search.regret import limits_of, regrets_of
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, Shown
from ethbrake_marl.files.store import write_output
from ethbrake_marl.first_edition.agents.learned import TRAINED_POLICY, TRAINED_TEAM
from ethbrake_marl.first_edition.agents.protocol import Driver
from ethbrake_marl.first_edition.agents.spec import split_specs
from ethbrake_marl.first_edition.evaluation.chunks import Lineup, evaluate_held
from ethbrake_marl.first_edition.evaluation.conditions import Conditions
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.notes import identity_line
from ethbrake_marl.first_edition.evaluation.shield_modes import ShieldModes, compare_modes
from ethbrake_marl.first_edition.evaluation.statistics import mean, share_of
from ethbrake_marl.first_edition.evaluation.summary import SummaryTable, summarise
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow
from ethbrake_marl.first_edition.evaluation.trial import load_runnable
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.training.settings import read_settings

SHIELD_WORLDS = 200  # number of worlds in which each replacement by a shield is simulated again


def worst_section(evaluation: Evaluation, focus: str, watched: Sequence[int]) -> Section:
    """Return the section that lists the ten worlds in which the agent ``focus`` did worst.

    ``watched`` are the numbers of the worlds that the episode player on the page can show; these worlds get a button
    that starts the player.
    """
    regrets, outcome = regrets_of(evaluation), evaluation.outcome(focus)
    avoidable = None if regrets is None else regrets.limits.proof.avoidable
    columns: dict[str, NDArray[Any] | None] = {
        "First-impact harm": outcome.first_impact_harm,
        "Total harm": outcome.total_harm,
        "Best known, first": None if regrets is None else regrets.first_impact_harm,
        "Best known, total": None if regrets is None else regrets.total_harm,
        "Contact": None if avoidable is None else np.where(avoidable, "avoidable", "unavoidable"),
        "Impacts": outcome.impacts,
    }
    filled = {name: column.tolist() for name, column in columns.items() if column is not None}
    rows = []
    for k in worst_rows(evaluation, focus).tolist():
        number = int(evaluation.index[k])
        button = Markup('{} <button type="button" data-watch="{}">Watch</button>').format(number, number)
        rows.append([Shown(button) if number in watched else number, *(column[k] for column in filled.values())])
    by = "total harm" if regrets is None else "total harm minus best known total harm"
    body: list[str | Part] = [f"In all worlds, {focus} did no more harm than the best known harm."]
    if rows:
        table = Part.table(Sheet(f"Worlds of {focus}", list(map(Column, ("World", *filled))), rows))
        body = [f"The worlds in which {focus} did worst, by {by}. Harm in m²/s².", table]
    return Section("Worst ten worlds", body)


def avoidable_section(evaluation: Evaluation) -> Section:
    """Return the section that compares harm in worlds with avoidable contact and with unavoidable contact."""
    regrets, limits = regrets_of(evaluation), limits_of(evaluation)
    body: list[str | Part] = []
    avoidable = None if regrets is None else regrets.limits.proof.avoidable
    if isinstance(limits, Unproven):
        text = "The proofs do not cover these worlds, so avoidable and unavoidable contacts are not separated."
        body.append(f"{text} Reason: {limits.because}.")
    elif regrets is None or avoidable is None:
        body.append(
            "It is not proven in which worlds these vehicles can avoid contact, so avoidable and unavoidable contacts"
            " are not separated."
        )
    else:
        share = share_of(avoidable, evaluation.clusters).in_words(digits=1, scale=100.0, unit=" %")
        body.append(
            f"Contact can be avoided in {share} of the worlds. In the other worlds, no command can avoid it (both"
            " proven for each world)."
        )
        for where, among in (("Contact avoidable", avoidable), ("Contact unavoidable", ~avoidable)):
            if among.any():
                part = evaluation.take(among)
                by = part.clusters
                caption = f"{where}: {count_of(part.worlds.n, 'world')}{part.conditions.by_recording}"
                rows = [
                    (
                        agent,
                        share_of(each.collided, by),
                        *(mean(each.world_harm(count), by) for count in HARM_COUNTS),
                        *(mean(regrets.regret(evaluation.outcomes[agent], count)[among], by) for count in HARM_COUNTS),
                    )
                    for agent, each in part.outcomes.items()
                ]
                body.append(Part.table(Sheet(caption, _SPLIT, rows)))
        about = "Mean harm per world, divided into the best known harm and the regret of each agent."
        body.append(Part.drawing(harm_in_parts(evaluation), "Avoidable and unavoidable harm", about))
    title, words = "Harm world by world", "For each harm x: share of the worlds in which an agent did more harm than x."
    if regrets is not None:
        title = "Regret world by world"
        words = "For each value x: share of the worlds in which an agent's harm minus the best known harm is above x."
    body.append(Part.drawing(regret_distribution(evaluation), title, words))
    return Section("What was avoidable", body)


_SPLIT: tuple[Column | str, ...] = (
    "Agent", Column("Collided", digits=1, scale=100.0, unit=" %"),
    *map(Column, ("First-impact harm", "Total harm", "Regret, first-impact", "Regret, total")),
)  # fmt: skip


def shield_section(rows: ShieldModes, conditions: str) -> Section:
    """Return the section that compares the modes of the shield; the section is empty if ``rows`` is empty.

    The section also counts the needed, harmless and costly interventions of the mode ``step``. Without an intervention,
    the harm is higher (needed), equal (harmless) or lower (costly). ``conditions`` is a sentence about the worlds and
    the harm count.
    """
    if not rows:
        return Section("Shield", ())
    text = (
        "Each agent without its shield, and with every mode of the shield. The mode step-alert simulates the policy at"
        " the alert only. With several vehicles, the mode step-cap lets no vehicle bear more harm than under the first"
        " plan of the shield (the baseline plan). Each decision that the mode step replaced was simulated again without"
        " the replacement. The replacement was needed if the harm is then higher, harmless if it is equal, and costly"
        " if it is lower."
    )
    body: list[str | Part] = [text, *map(Part.table, rows.sheets()), Part.paragraph(conditions, "quiet")]
    if left_out := rows[0].left_out:
        count = count_of(len(left_out), "world")
        body.append(Part.paragraph(f"{count} left out, because the physics could not simulate the motion.", "note"))
    return Section("Shield", body)


_SHORT = {"collision_rate", "first_impact_harm", "total_harm"}  # columns of the first table on the page

_CAPTION = "Means with 95 % intervals, m²/s²"

_OTHERS = {"Knows", "sampled_harm", "vehicle_1_shoved_m", "vehicle_1_shoved_far_rate", "predicted_harm"}


@dataclass(frozen=True, slots=True)
class Report:
    """Content of the HTML report of an evaluation."""

    title: str  # title of the page
    rows: Sequence[SummaryRow]  # summary of each agent
    evaluation: Evaluation  # evaluation that the rows summarise
    played: Sequence[Played] = ()  # episodes to watch
    shield: Section | None = None  # section about shields; None: no shield was measured
    focus: str = ""  # agent whose worst worlds are shown; empty: no section with worst worlds
    sections: Sequence[Section] = ()  # further sections, below the results
    figures: Sequence[Part] = ()  # figures to show, as parts of a page
    # other tests: title, how the test differs, summary of each agent
    tests: Sequence[tuple[str, str, Sequence[SummaryRow]]] = ()
    harm_count: HarmCount = "first"  # harm count that the agents minimised
    remarks: Sequence[str] = ()  # important remarks, below the first sentence
    summary: str = ""  # one or two sentences about the compared agents
    # command, seeds and settings of the training, by name; printed unchanged
    settings: Mapping[str, object] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)  # versions of software, by name; printed unchanged

    def driven(self, agents: Mapping[str, Driver], *, on_agent: Callable[[str], None] | None = None) -> Report:
        """Return a new report that also has episodes to watch and the section about shields.

        For the episodes to watch, every agent drives some worlds again (see ``choose_shown``); the agents are not
        changed. ``on_agent`` is called with the name of each agent that has finished. The section about shields
        compares the modes of each shield in the first ``SHIELD_WORLDS`` worlds.
        """
        evaluation, focus, harm_count = self.evaluation, self.about, self.harm_count
        chosen = choose_shown(evaluation, focus)
        worlds, played = evaluation.worlds.take(np.array(list(chosen), np.int64)), list(chosen.values())
        scenario = evaluation.scenario
        if evaluation.vehicles != scenario.learners:
            scenario = scenario.with_learners(evaluation.vehicles)
        for name, agent in agents.items():
            Played.drive(played, worlds, name, agent, scenario)
            if on_agent is not None:
                on_agent(name)
        some = evaluation.take(np.arange(min(evaluation.worlds.n, SHIELD_WORLDS)))
        task = Task(evaluation.scenario, evaluation.vehicles, harm_count)
        modes = compare_modes(agents, some.worlds, task, behind=True, clusters=some.clusters)
        changed = {"count": some.worlds.n, "recordings": some.recordings}
        line = Conditions({**evaluation.conditions, **changed}).line
        count = "First-impact" if harm_count == "first" else "Total"
        shield = shield_section(modes, f"{count} harm in m²/s²; the shield bounds this harm. {line}.")
        return replace(self, played=played, shield=shield, focus=focus)

    @property
    def about(self) -> str:
        """Name of the agent that the page is mainly about.

        This is ``focus``. If ``focus`` is empty, it is the last agent with a trained policy, or the last agent of all
        if no agent has a trained policy.
        """
        learned = [row.agent for row in self.rows if row.policy_sha256]
        return self.focus or (learned or [row.agent for row in self.rows] or [""])[-1]

    @property
    def html(self) -> str:
        """HTML text of the whole page."""
        sections: list[Section | None] = [self._results(), *self.sections, self._episodes()]
        if self.focus:
            sections.append(worst_section(self.evaluation, self.focus, [one.number for one in self.played]))
        sections += [avoidable_section(self.evaluation), self.shield, Section("Figures", self.figures)]
        all_rows = _table_of(self.rows)
        sheet, nowhere = all_rows.sheet(), set(_empty(all_rows))
        for title, about, test_rows in self.tests:
            rows = _table_of(test_rows)
            notes = [Part.paragraph(text, "note") for text in _remarks(rows)]
            parts = [_short_table(rows), *notes, *_measured(rows), Part.paragraph(identity_line(rows), "quiet")]
            sections.append(Section(title, [about, *parts]))
            nowhere.intersection_update(_empty(rows))
        unseen = tuple(name for name in sheet.headings[2:] if name in nowhere)
        seen = tuple(name for name in sheet.headings[2:] if name not in nowhere)
        meanings = {
            name: meaning
            for name, meaning in all_rows.meanings().items()
            if any(each.startswith(name) for each in seen) or not any(each.startswith(name) for each in unseen)
        }
        versions = [Part.facts(self.versions)] if self.versions else []
        versions += [Part.paragraph(identity_line(all_rows), "quiet")] if all_rows else []
        sections += [
            Section("How to read the tables", [Part.facts(meanings)]),
            Section("Settings and seeds", [Part.facts(self.settings)] if self.settings else ()),
            Section("Versions", versions),
        ]
        shown = [section for section in sections if section is not None and section.body]
        return Page(self.title, shown, self.first_sentence, opening=self._opening(all_rows)).html

    def write(self, path: str | Path, *, force: bool = False) -> None:
        """Write the page to the file ``path``.

        Raises ``AlreadyExists`` if the file exists and ``force`` is false, and ``InvalidInput`` if the folder does not
        exist.
        """
        write_output(path, self.html.encode("utf-8"), force=force)

    @property
    def first_sentence(self) -> str:
        """First sentence of the page, which compares the agent ``about`` with full braking and the best known harm.

        The sentence names the tests in ``tests`` in which this agent does about as much harm as full braking, or more.
        If the agent does clearly less harm than full braking in all of ``tests``, the sentence says in how many worlds
        of the evaluation the agent does more harm than full braking.
        """
        rows, harm = {row.agent: row for row in self.rows}, NAMES[self.harm_count]
        if self.about not in rows:
            return ""
        row, before = rows[self.about], rows.get(BASELINE)
        name = "Full braking" if self.about == BASELINE else self.about
        name = f"The {name}" if name in (TRAINED_POLICY, TRAINED_TEAM) else name
        value, best = row[harm], row[f"best_known_{harm}"]
        known = "" if best is None else f"; {best_known_words(row)} {_words(best)}"
        impacts = "first impacts" if self.harm_count == "first" else "all impacts"
        if before is None or row is before:
            return f"{name} does {_words(value)} m²/s² of harm per emergency ({impacts}{known})."
        change, decrease = _change(row, harm), row[f"harm_decrease_{self.harm_count}"]
        much = "" if decrease is None else f"{abs(100.0 * decrease.value):.0f} % "  # None: full braking does none
        words = "about as much harm as" if change == "as much" else f"{much}{change} harm than"
        numbers = f"{impacts}: {_words(value)} m²/s² per emergency instead of {_words(before[harm])}{known}"
        fails = self._fails(harm)
        joined = ", but " if fails and change == "less" else ", and "
        return f"{name} does {words} full braking ({numbers}){joined}{fails or 'in no world more'}."

    def _fails(self, harm: str) -> str:
        """Return the end of ``first_sentence``, which names tests or worlds in which the agent does badly.

        ``harm`` is the name of the compared measure, for instance ``total_harm``.
        """
        reasons = []
        for title, _, others in self.tests:
            rows = {row.agent: row for row in others}
            if self.about in rows and BASELINE in rows and (change := _change(rows[self.about], harm)) != "less":
                numbers = f"{_words(rows[self.about][harm])} instead of {_words(rows[BASELINE][harm])}"
                reasons.append(f"{change} in the {title.lower()} ({numbers})")
        if reasons:
            return " and ".join(reasons)
        outcomes = (self.evaluation.outcome(agent) for agent in (self.about, BASELINE))
        after, before = (outcome.world_harm(self.harm_count) for outcome in outcomes)
        share = float((after > before + ROUNDING).mean())
        most = float((after - before).max())
        often, much = f"{100.0 * share:.1f}" if share >= 0.0005 else "less than 0.1", max(most, 0.01)
        return f"more in {often} % of the worlds, by {much:.2f} at most" if share else ""

    def _opening(self, rows: SummaryTable) -> list[Part]:
        """Return the parts at the top of the page: important remarks, a figure and a table."""
        if not rows:
            return []
        which = "First-impact" if self.harm_count == "first" else "Total"
        elsewhere = {title: text for title, _, text in self.tests}
        marks = "; marks: the other tests" if elsewhere else ""
        figure = harm_by_agent(rows, self.harm_count, elsewhere)
        about = f"Mean and 95 % interval{marks}{self.evaluation.conditions.by_recording}."
        drawing = Part.drawing(figure, f"{which} harm of each agent", about)
        return [Part.remarks([*self.remarks, *_remarks(rows)]), Part.beside([drawing, _short_table(rows)])]

    def _results(self) -> Section:
        rows, limits = _table_of(self.rows), limits_of(self.evaluation)
        because = f" The proofs do not cover these worlds: {limits.because}." if isinstance(limits, Unproven) else ""
        parts: list[str | Part] = [self.summary] if self.summary else []
        return Section("Results", [*parts, Part.box("Three words", WORDS), *_measured(rows, because)])

    def _episodes(self) -> Section:
        """Return the section with episodes to watch.

        A note names each agent that drove differently in these episodes than in the evaluation.
        """
        evaluation, played = self.evaluation, self.played
        if not played:
            return Section("Episodes", ())
        rows = {int(number): row for row, number in enumerate(evaluation.index)}
        unrepeated: dict[str, int] = {}
        for world in played:
            for agent, motion in world.motions.items():
                outcome, row = evaluation.outcome(agent), rows[world.number]
                counted = (float(outcome.first_impact_harm[row]), float(outcome.total_harm[row]))
                unrepeated[agent] = unrepeated.get(agent, 0) + (motion.harm != counted)
        notes = [
            f"In {count_of(count, 'world')} of these, {agent} drove differently the second time: the player shows"
            " another episode than the tables."
            for agent, count in unrepeated.items()
            if count
        ]
        moving = sum(not all(motion.at_rest for motion in world.motions.values()) for world in played)
        until = (
            f"from the alert until all vehicles are at rest, or until the horizon of"
            f" {evaluation.scenario.horizon_s:g} s. In {count_of(moving, 'world')}, vehicles still moved at the horizon"
            " under some agent; the player names this agent"
        )
        until = until if moving else "from the alert until all vehicles are at rest"
        shown, every = len(played), evaluation.worlds.n
        how_many = f"{shown} of the {every:,} worlds" if shown < every else f"All {shown} worlds"
        player = Part.player(played, evaluation.vehicles, focus=self.focus)
        body: list[str | Part] = [f"{how_many}, {until}.", *(Part.paragraph(text, "note") for text in notes), player]
        return Section("Episodes", body)


def _words(estimate: Estimate | None) -> str:
    """Return the value of ``estimate`` as text, without its interval; a dash if ``estimate`` is None."""
    return Column("").show(estimate).value


def _change(row: SummaryRow, harm: str) -> Literal["less", "more", "as much"]:
    """Compare an agent's harm with full braking in the same worlds: "less", "more" or "as much".

    The result is "as much" if the 95 % interval of the difference contains 0, or if no interval is known although there
    are several worlds. ``harm`` is the name of the compared measure, for instance ``total_harm``.
    """
    difference = row[f"{harm}_difference"]
    unknown = difference is None or (difference.interval is None and row.episodes > 1)
    low, high = (0.0, 0.0) if difference is None or unknown else difference.ends
    return "less" if high < 0.0 else "more" if low > 0.0 else "as much"


def _table_of(rows: Sequence[SummaryRow]) -> SummaryTable:
    """Return ``rows`` as a summary table."""
    return rows if isinstance(rows, SummaryTable) else SummaryTable(rows)


def _short_table(rows: SummaryTable) -> Part:
    """Return a table of each agent's collision rate, first-impact harm and total harm."""
    caption = _CAPTION + (rows[0].parameters.by_recording if rows else "")
    return _table(SummaryTable(rows).sheet(), caption, _SHORT)


def _remarks(rows: SummaryTable) -> list[str]:
    """Return the important notes about ``rows``, without the notes in small print."""
    return [text for kind, text in SummaryTable(rows).notes() if kind == "note"]


def _measured(rows: SummaryTable, because: str = "") -> list[Part]:
    """Return the conditions under which ``rows`` were measured, and (folded) tables of all measures.

    If ``rows`` also contains results that the paper prints, the first table shows these results. ``because`` is a
    sentence that says why some columns are empty.
    """
    ours = SummaryTable(rows)
    whole, notes, empty = rows.sheet(), ours.notes(), _empty(rows)
    folded = [
        _table(whole, "All measures of harm", set(whole.names) - _OTHERS),
        _table(ours.sheet(), "Other measures in the same worlds", _OTHERS),
    ]
    left_out = f"Columns without values are left out: {'; '.join(empty)}.{because}"
    lines = [*([("quiet", left_out)] if empty else []), *(note for note in rows.notes() if note not in notes)]
    folded += [Part.paragraph(text, kind) for kind, text in lines]
    quiet = [
        *(f"{row.parameters.line}. Harm in m²/s²." for row in rows[:1]),
        *(t for kind, t in notes if kind == "quiet"),
    ]
    title = "Every measure" + (", and the paper's rows" if len(whole.rows) > len(rows) else "")
    return [*(Part.paragraph(text, "quiet") for text in quiet), Part.opened(title, folded)]


def _empty(rows: SummaryTable) -> list[str]:
    """Return the headings of those columns of the table ``rows`` in which every cell is empty."""
    sheet = rows.sheet()
    filled = sheet.filled()
    return [name for k, name in enumerate(sheet.headings) if k not in filled]


def _table(sheet: Sheet, caption: str, names: set[str]) -> Part:
    """Return a table of those columns of ``sheet`` that have values and whose name is in ``names``."""
    filled = set(sheet.filled())
    some = sheet.only(k for k, name in enumerate(sheet.names) if k == 0 or (name in names and k in filled))
    rows = [
        f"The paper's {row.removeprefix('paper, ')}, as printed" if isinstance(row, str) else row for row in some.rows
    ]
    return Part.table(replace(some, title=caption, rows=rows))


def write_evaluation(
    path: Path,
    scenario_name: str,
    *,
    agents: str,
    episodes: int,
    seed: int,
    settings: Sequence[str],
    force: bool = False,
    tell: Callable[[int, int], None] | None = None,
) -> None:
    """Write the page of ``ethbrake evaluate --report`` to the file ``path``.

    The first edition evaluates the agents once more; they drive some worlds again for the episode player. ``tell`` is
    called with the number of agents that have done so, and the number of all agents. Raises the exceptions of
    ``Report.write``.
    """
    chosen = read_settings(settings, of_agents=("harm_count", "measures"))
    loaded, harm_count = load_runnable(scenario_name, chosen.scenario, drives="some"), chosen.harm_count
    lineup = Lineup.of(split_specs(agents), loaded, harm_count=harm_count, measures=chosen.measures)
    evaluation = evaluate_held(lineup, loaded.sample(episodes, seed), seed)
    rows, drivers = summarise(evaluation), lineup.make()
    done: list[str] = []

    def on_agent(agent: str) -> None:
        done.append(agent)
        if tell is not None:
            tell(len(done), len(drivers))

    scenario, names, asked = evaluation.scenario, ", ".join(row.agent for row in rows), rows[0].parameters
    scripts = ", ".join(f"{vehicle} by {script}" for vehicle, script in asked["scripts"].items())
    report = Report(
        f"{scenario.name}: {names}" if len(names) <= 60 else f"{scenario.name}: {len(rows)} agents compared",
        rows,
        evaluation,
        harm_count=harm_count,
        summary=scenario.title or "Agents on the same worlds.",
        settings={
            "Command": "ethbrake " + " ".join(sys.argv[1:]),
            "Agents": names,
            "Harm that agents minimise": "first impacts only" if harm_count == "first" else "every impact",
            "Worlds": asked.line,
            "Controlled by the agents": asked.get("controlled_vehicle") or ", ".join(asked["controlled_vehicles"]),
            "Controlled by scripts": scripts or "none",
            "Time step, horizon": f"{asked['time_step_s']:g} s, {asked['horizon_s']:g} s",
        },
        versions=rows[0].versions,
    )
    report.driven(drivers, on_agent=on_agent).write(path, force=force)
