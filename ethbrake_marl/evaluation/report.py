"""One self-contained HTML page: our results and the paper's, figures, conditions, seeds, versions, how to read it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from ethbrake_marl.evaluation.cells import Line, our_lines, paper_blocks, table_columns, table_meanings
from ethbrake_marl.evaluation.conditions import parameter_line
from ethbrake_marl.evaluation.paper import PAPER_NOTE, PAPER_PARAMETERS
from ethbrake_marl.evaluation.per_world import write_output
from ethbrake_marl.evaluation.table import SummaryRow
from ethbrake_marl.evaluation.text import identity_lines, knowledge_lines, left_out_lines, limit_lines

_TEMPLATE = "report.html.j2"


@dataclass(frozen=True, slots=True)
class ReportFigure:
    """A figure of the report; ``description`` says in words what it shows (and is read to those who cannot see it)."""

    title: str
    description: str
    png: bytes

    @property
    def source(self) -> str:
        """The picture itself, as a data URI."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode("ascii")


@dataclass(frozen=True, slots=True)
class ReportTest:
    """Results on another test, to stand below the main table."""

    title: str
    description: str  # what differs from the main table's test
    rows: Sequence[SummaryRow]

    @property
    def lines(self) -> list[Line]:
        """The lines of its table."""
        return our_lines(self.rows)

    @property
    def conditions(self) -> list[str]:
        """Conditions and limits, as sentences."""
        if not self.rows:
            return []
        return [f"{parameter_line(self.rows[0].parameters)}.", *limit_lines(self.rows), *identity_lines(self.rows)]


@dataclass(frozen=True, slots=True)
class Report:
    """Everything on the page. ``settings`` and ``versions`` are printed as they are given, name and value."""

    title: str
    rows: Sequence[SummaryRow]
    figures: Sequence[ReportFigure] = ()
    tests: Sequence[ReportTest] = ()  # the same agents elsewhere
    summary: str = ""  # a sentence or two below the title
    settings: Mapping[str, object] = field(default_factory=dict)  # command, seeds, training set-up
    versions: Mapping[str, str] = field(default_factory=dict)


def render_report(report: Report) -> str:
    """The page as HTML; it loads nothing from anywhere."""
    environment = Environment(
        loader=PackageLoader("ethbrake_marl.evaluation", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    blocks = paper_blocks(report.rows)
    return environment.get_template(_TEMPLATE).render(
        report=report,
        columns=table_columns(report.rows),
        meanings=table_meanings(report.rows),
        ours=our_lines(report.rows),
        conditions=parameter_line(report.rows[0].parameters) if report.rows else "",
        left_out=left_out_lines(report.rows),
        limits=limit_lines(report.rows),
        identity=identity_lines(report.rows),
        knowledge=knowledge_lines(report.rows),
        paper=blocks,
        paper_conditions={name: PAPER_PARAMETERS[name] for name, _ in blocks},
        paper_note=PAPER_NOTE,
    )


def write_report(path: str | Path, report: Report, *, force: bool = False) -> None:
    """Write the page; raises ``AlreadyExists`` unless ``force``, ``InvalidInput`` without a folder."""
    write_output(path, render_report(report).encode("utf-8"), force=force)
