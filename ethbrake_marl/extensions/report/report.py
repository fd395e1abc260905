"""The page about compared agents: what they did in the same worlds, in tables, figures and episodes to watch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ethbrake_marl.evaluation.compared import Compared
from ethbrake_marl.evaluation.summary import IDENTITY
from ethbrake_marl.extensions.report.best_known import BestKnown
from ethbrake_marl.extensions.report.first_sentence import first_sentence
from ethbrake_marl.extensions.report.harm_figures import harm_by_agent
from ethbrake_marl.extensions.report.page import Page, Part, Section
from ethbrake_marl.extensions.report.sections import (
    avoidable_section,
    drive_shown,
    episodes_section,
    measured,
    short_table,
    worst_section,
)
from ethbrake_marl.files.sheet import Row
from ethbrake_marl.files.store import write_output

WORDS = {
    "Contact": "Two vehicles, or Vehicle 1 and an obstacle, touch: the gap between them is 0.",
    "Impact": "A contact with a closing speed above 0. The square of that speed is its harm.",
    "Collision": "A world with at least one impact.",
}


@dataclass(frozen=True)
class Test:
    """Another test of the same agents."""

    about: str  # how it differs
    compared: Compared


@dataclass(frozen=True)
class Report:
    """Content of the page. Its agents drive some worlds again when the page is made."""

    title: str
    compared: Compared
    focus: str = ""  # agent that the page is mainly about; "": the last one with a policy, or the last one
    summary: str = ""  # one or two sentences about the agents
    sections: Sequence[Section] = ()  # below the results
    figures: Sequence[Part] = ()
    tests: Mapping[str, Test] = field(default_factory=dict)  # by title
    beside: Sequence[Row] = ()  # rows below those of the agents: what somebody else printed
    notes: Sequence[str] = ()  # about these rows
    remarks: Sequence[str] = ()  # below the first sentence
    settings: Mapping[str, object] = field(default_factory=dict)  # by name

    @property
    def about(self) -> str:
        """Name of the agent that the page is mainly about."""
        table = self.compared.table
        return self.focus or [row.agent for row in table if row.policies or row is table[-1]][-1]

    @property
    def page(self) -> Page:
        """The whole page."""
        compared, focus = self.compared, self.about
        played = drive_shown(compared, focus)
        others = {title: test.compared for title, test in self.tests.items()}
        parameters = compared.table.parameters
        results = [Part.box("Three words", WORDS), *measured(compared.table, self.beside, self.notes)]
        sections = [
            Section("Results", [self.summary, *results] if self.summary else results),
            *self.sections,
            episodes_section(compared, played, focus),
            worst_section(compared, focus, played),
            avoidable_section(compared),
            Section("Figures", self.figures),
            *(self._test(title, test) for title, test in self.tests.items()),
            Section("How to read the tables", [Part.facts(compared.table.meanings())]),
            Section("Settings and seeds", [Part.facts(self.settings)] if self.settings else ()),
            Section(
                "Versions", [Part.facts({**parameters["versions"], **{key: parameters[key] for key in IDENTITY[:3]}})]
            ),
        ]
        which = "First-impact" if compared.harm_count == "first" else "Total"
        tables = {title: other.table for title, other in others.items()}
        bars = harm_by_agent(compared.table, compared.harm_count, BestKnown.of(compared.result), tables)
        marks = "; marks: the other tests" if others else ""
        drawing = Part.drawing(bars, f"{which} harm of each agent", f"Mean and 95 % interval{marks}.")
        opening = [
            Part.remarks([*self.remarks, *compared.table.notes()]),
            Part.beside([drawing, short_table(compared.table)]),
        ]
        lead = first_sentence(compared, focus, others)
        return Page(self.title, [section for section in sections if section.body], lead, opening=opening)

    @staticmethod
    def _test(title: str, test: Test) -> Section:
        table = test.compared.table
        notes = [Part.paragraph(text, "note") for text in table.notes()]
        return Section(title, [test.about, short_table(table), *notes, *measured(table)])

    def write(self, path: Path, *, force: bool = False) -> None:
        """Write the page. Raises the errors of ``write_output``."""
        write_output(path, self.page.html.encode("utf-8"), force=force)


def write_evaluation(path: Path, compared: Compared, command: str, *, force: bool = False) -> None:
    """Write the page of ``ethbrake evaluate --report``. Raises the errors of ``write_output``."""
    scenario, table = compared.scenario, compared.table
    names = ", ".join(row.agent for row in table)
    scripts = ", ".join(f"{vehicle} by {role}" for vehicle, role in scenario.roles.items() if role != "learner")
    Report(
        f"{scenario.name}: {names}" if len(names) <= 60 else f"{scenario.name}: {len(table)} agents compared",
        compared,
        summary=scenario.title or "Agents on the same worlds.",
        settings={
            "Command": command,
            "Agents": names,
            "Harm that agents minimise": "first impacts only" if compared.harm_count == "first" else "every impact",
            "Controlled by the agents": ", ".join(scenario.vehicle_names[body - 1] for body in scenario.learners),
            "Controlled by scripts": scripts or "none",
            "Time step, horizon": f"{scenario.time_step_s:g} s, {scenario.horizon_s:g} s",
        },
    ).write(path, force=force)
