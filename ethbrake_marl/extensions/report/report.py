"""Report of an evaluation: first sentence, tables, figures and worst worlds."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from markupsafe import Markup

from ethbrake_marl.agent_names import AGENTS, WRAPPERS
from ethbrake_marl.episode.counts import ALL_IMPACTS, BUILT_IN_COUNTS, FIRST_IMPACTS, IMPACT_COUNTS, HarmCount
from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.evaluation.summary import BASELINE, IDENTITY, SummaryRow, SummaryTable, caption
from ethbrake_marl.extensions.report.best_known import BestKnown, shown_counts
from ethbrake_marl.extensions.report.episodes import episodes_section, shown_worlds, worst_rows
from ethbrake_marl.extensions.report.figures import harm_above, harm_by_agent
from ethbrake_marl.extensions.report.page import Section, drawing, page_part, table, whole_page
from ethbrake_marl.files.sheet import CellText, Column, Sheet
from ethbrake_marl.files.store import write_output
from ethbrake_marl.motion.layout import Bools

SHORT_TABLE = (
    "collision_rate",
    *(count.column for count in BUILT_IN_COUNTS),
    "pushed_mps",
)  # columns of a short table, if they are shown
LEARNED_AGENTS = ("trained policy", "trained team")  # names that get an article
COUNTED_WORDS = {  # count -> verb, noun, and what is counted
    FIRST_IMPACTS: ("does", " harm", "first impacts"),
    ALL_IMPACTS: ("does", " harm", "all impacts"),
}


def first_sentence(compared: Comparison, focus: str, tests: Mapping[str, Comparison]) -> str:
    """First sentence of the page: ``focus`` against full braking; also the ``tests`` in which it is not better."""
    count, harm = compared.harm_count, compared.harm_count.column
    rows, best_known = {row.agent: row for row in compared.table}, BestKnown.of(compared.result)
    row, before = rows[focus], rows.get(BASELINE)
    name = "Full braking" if focus == BASELINE else f"The {focus}" if focus in LEARNED_AGENTS else focus
    best = (
        ""
        if best_known is None or count not in best_known.harm
        else f"; best known {best_known.harm[count].mean():.2f}"
    )
    does, of_harm, what = COUNTED_WORDS.get(count, ("costs", "", count.words))
    if before is None or row is before:
        total = f"; total harm: {value(row, ALL_IMPACTS.column)}" if count not in IMPACT_COUNTS else ""
        return (
            f"{name} {does} {value(row, harm)} m²/s²{of_harm and ' of'}{of_harm} per emergency ({what}{total}{best})."
        )
    change, decrease = change_of(row, harm), row[f"harm_decrease_{count.name}"]
    much = "" if decrease is None else f"{abs(100.0 * decrease.value):.0f} % "  # None: full braking does none
    words = f"about as much{of_harm} as" if change == "as much" else f"{much}{change}{of_harm} than"
    numbers = f"{what}: {value(row, harm)} m²/s² per emergency instead of {value(before, harm)}{best}"
    if count not in IMPACT_COUNTS:
        numbers += f"; total harm: {value(row, ALL_IMPACTS.column)} instead of {value(before, ALL_IMPACTS.column)}"
    fails = []
    for title, comparison in tests.items():
        there = {test_row.agent: test_row for test_row in comparison.table}
        if {focus, BASELINE} <= there.keys() and (worse := change_of(there[focus], harm)) != "less":
            instead = f"{value(there[focus], harm)} instead of {value(there[BASELINE], harm)}"
            fails.append(f"{worse} in the {title.lower()} ({instead})")
    conjunction = ", but " if change == "less" else ", and "
    return f"{name} {does} {words} full braking ({numbers}){conjunction * bool(fails)}{' and '.join(fails)}."


def change_of(row: SummaryRow, harm: str) -> Literal["less", "more", "as much"]:
    """Whether an agent does less harm than full braking; "as much": the interval contains 0, or is unknown."""
    difference = row[f"{harm}_difference"]
    if difference is None or (difference.interval is None and row.episodes > 1):
        return "as much"
    low, high = difference.ends
    return "less" if high < 0.0 else "more" if low > 0.0 else "as much"


def value(row: SummaryRow, key: str) -> str:
    return Column("").show(row[key]).value


HONEST_COST = {
    "Honest cost": "Total harm, plus penalties for pushing a vehicle, for impacts passed on through touching vehicles,"
    " for speeding up, and for motion at the end. Unlike harm alone, it cannot be lowered by pushing."
}
LEARNED = {  # names that this package gives to what a run has learned
    "trained policy": "the policy that this run trained",
    "hybrid": "the paper's hybrid: the trained policy or E-V2X-BM drives the whole episode",
    "trained team": "the policies that this run trained, one for each learner",
    "shielded team": "the trained team with a shield, which replaces actions that could do more harm",
}
PAIRWISE = "the paper's E-V2X-BM: the constant deceleration of its closed form, which treats pairs as independent"
GLOSSARY = {
    "Contact": "Two vehicles, or Vehicle 1 and an obstacle, touch: the gap between them is 0.",
    "Impact": "A contact with a closing speed above 0. The square of that speed is its harm.",
    "Collision": "A world with at least one impact.",
}


class Test(NamedTuple):
    about: str  # how it differs
    compared: Comparison


@dataclass(frozen=True)
class ReportPage:
    """Content of a report. When the page is made, its agents drive the worlds that it shows once more."""

    title: str
    compared: Comparison
    summary: str  # one or two sentences about the agents
    settings: Mapping[str, object]  # by name
    focus: str = ""  # agent that the page is mainly about; "": the last one with a policy, or the last one
    sections: Sequence[Section] = ()  # below the results
    figures: Sequence[Markup] = ()
    tests: Mapping[str, Test] = field(default_factory=dict)  # by title
    remarks: Sequence[str] = ()  # below the first sentence

    @property
    def html(self) -> str:
        """The page as HTML. The agents drive the worlds that it shows once more."""
        compared, rows = self.compared, self.compared.table
        focus = self.focus or [row.agent for row in rows if row.policies or row is rows[-1]][-1]
        kinds = shown_worlds(compared, focus)
        test_results = {title: test.compared for title, test in self.tests.items()}
        about = rows.parameters
        versions = {**about["versions"], **{key: about[key] for key in IDENTITY[:3]}}
        sections = [
            *(Section(title, _test_body(test)) for title, test in self.tests.items()),
            Section("Learning curve", self.figures[:1]),
            *self.sections,
            worst_section(compared, focus, kinds),
            Section("Agents and measures", [self.summary, *measure_parts(rows)], folded=True),
            avoidable_section(compared)._replace(folded=True),
            Section("Figures", self.figures[1:], folded=True),
            Section("How to read the tables", [page_part("facts", GLOSSARY | rows.meanings())], folded=True),
            Section("Settings and seeds", [page_part("facts", self.settings)], folded=True),
            Section("Versions", [page_part("facts", versions)], folded=True),
        ]
        marks = "; marks: the other tests" if test_results else ""
        bars = harm_by_agent(compared, test_results)
        words = compared.harm_count.words.capitalize()
        harm = drawing(bars, f"{words} of each agent", f"Mean and 95 % interval{marks}.")
        opening = [
            page_part("remarks", [*self.remarks, *rows.notes()]),
            page_part("beside", short_table(rows, compared.harm_count), harm),
            page_part("box", "What is compared", HONEST_COST | agents_in_words(compared.teams)),
            *episodes_section(compared, focus, kinds).body,
        ]
        lead = first_sentence(compared, focus, test_results)
        sections.sort(key=lambda section: section.folded)
        return whole_page(self.title, lead, opening, [section for section in sections if section.body])

    def write(self, path: Path, *, force: bool = False) -> None:
        write_output(path, self.html.encode("utf-8"), force=force)


def agents_in_words(teams: Iterable[str]) -> dict[str, str]:
    """What each agent does, in one line; without agents of the user, about whom nothing is known."""
    words = {}
    for team in teams:
        core, *wrappers = team.split("+")
        name, _, argument = core.partition("@")[0].partition(":")
        if team in LEARNED:
            words[team] = LEARNED[team]
        elif name in AGENTS and "/" not in core.partition("@")[0]:
            about = PAIRWISE if (name, argument) == ("e_v2x_bm", "pairwise") else AGENTS[name].about
            guards = (WRAPPERS[wrapper.partition(":")[0]].about for wrapper in wrappers)
            words[team] = "; ".join([about, *guards])
    return words


def short_table(agents: SummaryTable, count: HarmCount) -> Markup:
    """Table of the most important columns. The count that agents minimise comes first, so that a phone shows it."""
    sheet = agents.sheet()
    chosen = [k for k, name in enumerate(sheet.names) if name in (*SHORT_TABLE, count.column)]
    chosen.sort(key=lambda k: sheet.names[k] != count.column)
    return table(replace(sheet.only([0, *chosen]), title=f"{agents.heading}; means with 95 % intervals, m²/s²"))


def measure_parts(agents: SummaryTable) -> list[Markup]:
    sheet, measures_sheet = agents.sheet(), agents.measures()
    full_sheet = replace(sheet.only(sheet.filled()), title="All measures with a column")
    tables = [table(chosen_sheet) for chosen_sheet in (full_sheet, measures_sheet) if chosen_sheet is not None]
    line = page_part("paragraph", f"{caption(agents.parameters)}. Harm in m²/s².", "quiet")
    return [line, page_part("folded", "Every measure", tables)]


def worst_section(compared: Comparison, focus: str, watched: Collection[int]) -> Section:
    """Worlds in which ``focus`` did worst. The rows ``watched`` get a button that starts the player."""
    result, known_best, minimised = compared.result, BestKnown.of(compared.result), compared.harm_count
    counts = dict.fromkeys([*IMPACT_COUNTS, minimised])
    columns = {count.words.capitalize(): result[focus][count.column] for count in counts}
    if known_best is not None:
        columns |= {f"Best known, {count.name}": known_best.harm[count] for count in counts if count in known_best.harm}
        if known_best.impact_unavoidable is not None:
            columns["An impact is"] = np.where(known_best.impact_unavoidable, "unavoidable", "perhaps avoidable")
    columns["Impacts"] = result[focus]["impacts"]
    rows = []
    for k in worst_rows(compared, focus):
        number = int(result.worlds["world"][k])
        name = CellText(page_part("watch", number)) if k in watched else number
        rows.append([name, *(values[k].item() for values in columns.values())])
    by = minimised.words
    if known_best is not None and minimised in known_best.harm:
        by = f"{by} minus the best known {by}"
    sheet = Sheet(f"Worlds of {focus}", list(map(Column, ("World", *columns))), rows)
    return Section(
        "Worst ten worlds", [f"The worlds in which {focus} did worst, by {by}. Harm in m²/s².", table(sheet)]
    )


def avoidable_section(compared: Comparison) -> Section:
    """Section on regret, or on harm if no best harm is known; by whether an impact is proven unavoidable."""
    result, best_known, figure = compared.result, BestKnown.of(compared.result), harm_above(compared)
    if best_known is None:
        words = "For each harm x: share of the worlds in which an agent did more harm than x."
        return Section("World by world", [drawing(figure, "Harm", words)])
    body: list[str] = []
    certain = best_known.impact_unavoidable
    if certain is not None:
        share = rate(certain, result.clusters).in_words(digits=1, scale=100.0, unit=" %")
        body.append(
            f"An impact is unavoidable in {share} of the worlds: it is proven for each of them that no command avoids"
            " an impact."
        )
        for where, among in (("Impact unavoidable", certain), ("Other worlds", ~certain)):
            if among.any():
                body.append(table(_harm_among(compared, best_known, where, among)))
    words = "For each value x: share of the worlds in which an agent's harm minus the best known harm is above x."
    return Section("What was avoidable", [*body, drawing(figure, "Regret", words)])


def _harm_among(compared: Comparison, best_known: BestKnown, where: str, among: Bools) -> Sheet:
    """Table of each agent's collision rate, harm and regret in the worlds of the mask ``among`` [n]."""
    result, counts = compared.result, shown_counts(compared)
    some, rows = result.take(among), []
    for agent, harm_columns in some.columns.items():
        regrets = (best_known.regret(result, agent, count)[among] for count in counts)
        harms = (harm_columns[count.column] for count in counts)
        rows.append(
            (
                agent,
                rate(harm_columns["collided"], some.clusters),
                *(mean(x, some.clusters) for x in (*harms, *regrets)),
            )
        )
    headings = [count.words for count in counts]
    columns: list[Column | str] = [
        "Agent",
        Column("Collided", digits=1, scale=100.0, unit=" %"),
        *(Column(heading.capitalize()) for heading in headings),
        *(Column(f"Regret, {heading}") for heading in headings),
    ]
    return Sheet(f"{where}: {count_of(some.n, 'world')}", columns, rows)


def _test_body(test: Test) -> list[str]:
    rows = test.compared.table
    notes = [page_part("paragraph", text, "note") for text in rows.notes()]
    return [test.about, short_table(rows, test.compared.harm_count), *notes, *measure_parts(rows)]


def write_evaluation(path: Path, compared: Comparison, command: str, *, force: bool = False) -> None:
    scenario, agents = compared.scenario, [row.agent for row in compared.table]
    names = ", ".join(agents)
    scripts = ", ".join(f"{vehicle} by {role}" for vehicle, role in scenario.roles.items() if role != "learner")
    ReportPage(
        f"{scenario.name}: {names}" if len(names) <= 60 else f"{scenario.name}: {len(agents)} agents compared",
        compared,
        scenario.title or "Agents on the same worlds.",
        {
            "Command": command,
            "Agents": names,
            "Agents minimise": compared.harm_count.words,
            "Controlled by the agents": ", ".join(scenario.vehicle_names[body - 1] for body in scenario.learners),
            "Controlled by scripts": scripts or "none",
            "Time step, horizon": f"{scenario.time_step_s:g} s, {scenario.horizon_s:g} s",
        },
    ).write(path, force=force)
