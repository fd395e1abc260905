"""The results of an experiment beside its policy: CSV and JSON, every world, three figures and one page."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.evaluation import Evaluation, SummaryRow, record_episode, write_per_world_csv
from ethbrake_marl.evaluation.paper import MAIN_TEST, TESTS
from ethbrake_marl.evaluation.per_world import PER_WORLD, write_output
from ethbrake_marl.evaluation.results_file import results_to_json
from ethbrake_marl.evaluation.table import BASELINE
from ethbrake_marl.figures.episode import trajectories
from ethbrake_marl.figures.run import harm_against_total_gap, learning_curve
from ethbrake_marl.figures.style import picture_bytes
from ethbrake_marl.learning.registry import algorithm_names
from ethbrake_marl.pages.evidence import shield_evidence
from ethbrake_marl.pages.report import Report, ReportFigure, ReportTest, play_for_report, write_report

REFERENCES = ("full_brake", "e_v2x_bm")  # level lines beside the learning curve
SHOWN = ("full_brake", "e_v2x_bm")  # columns of the figure of one episode, and the policy

LEARNING_CURVE = "learning_curve.png"
HARM_AGAINST_GAP = "harm_against_gap.png"
TRAJECTORIES = "trajectories.png"


def write_results(folder: Path, evaluation: Evaluation, rows: Sequence[SummaryRow]) -> None:
    """Write ``results.json`` (the rows), ``results.csv`` (the same, flat) and ``per_world.csv``."""
    per_world = folder / PER_WORLD
    write_per_world_csv(per_world, evaluation, force=True)
    content = json.dumps(results_to_json(rows, per_world=per_world), indent=2, allow_nan=False) + "\n"
    write_output(folder / "results.json", content.encode(), force=True)
    write_output(folder / "results.csv", results_csv(rows).encode(), force=True)


def write_beside(folder: Path, beside: Mapping[str, Sequence[SummaryRow]]) -> None:
    """Write ``other_tests.json`` and ``other_tests.csv``: the rows of the other tests; nothing where there are none."""
    rows = [row for rows in beside.values() for row in rows]
    if rows:
        content = json.dumps(results_to_json(rows), indent=2, allow_nan=False) + "\n"
        write_output(folder / "other_tests.json", content.encode(), force=True)
        write_output(folder / "other_tests.csv", results_csv(rows).encode(), force=True)


def results_csv(rows: Sequence[SummaryRow]) -> str:
    """One line per agent; the interval of column ``x`` is ``x_low`` and ``x_high``, what does not exist is empty."""
    flat = [_flat(row.to_json()) for row in rows]
    columns = list(dict.fromkeys(name for line in flat for name in line))
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return text.getvalue()


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    line: dict[str, Any] = {name: row["parameters"][name] for name in ("scenario", "seed")}
    for name, value in row.items():
        if name.endswith("_interval"):
            stem = name.removesuffix("_interval")
            line[f"{stem}_low"], line[f"{stem}_high"] = value or (None, None)
        elif name != "parameters":
            line[name] = json.dumps(value, allow_nan=False) if isinstance(value, list | dict) else value
    return line


def write_figures(
    folder: Path,
    evaluation: Evaluation,
    rows: Sequence[SummaryRow],
    *,
    course: Sequence[Mapping[str, float]],
    course_caption: str,
    agents: Mapping[str, Agent],
) -> list[ReportFigure]:
    """Draw the three figures, write them as PNG, and give them for the report."""
    references = [row for row in rows if row.agent in REFERENCES]
    shown = telling_world(evaluation)
    world = evaluation.worlds.take([shown])
    records = {
        name: record_episode(world, agents[name], scenario=evaluation.scenario, vehicle=evaluation.vehicle)
        for name in (*SHOWN, learned_name(evaluation))
    }
    drawn = {
        LEARNING_CURVE: learning_curve(course, references=references, caption=course_caption),
        HARM_AGAINST_GAP: harm_against_total_gap(evaluation),
        TRAJECTORIES: trajectories(records),
    }
    figures = []
    for name, figure in drawn.items():
        title, description = FIGURE_TEXTS[name]
        write_output(folder / name, picture_bytes(figure, name), force=True)
        figures.append(ReportFigure(title, description.format(world=int(evaluation.index[shown])), figure))
    return figures


FIGURE_TEXTS = {
    LEARNING_CURVE: (
        "Learning curve",
        "Harm and collisions of the policy on a fixed list of worlds while it learns; level lines: baselines.",
    ),
    HARM_AGAINST_GAP: (
        "Harm against the total initial gap",
        "Mean harm of each agent in worlds grouped by the sum of their gaps at the alert.",
    ),
    TRAJECTORIES: (
        "One episode",
        "World {world} of the list, driven by three agents: the world whose saving of harm, policy against full"
        " braking, is the median of all worlds in which full braking collides.",
    ),
}


def learned_name(evaluation: Evaluation) -> str:
    """What the trained policy is called among the agents."""
    return next(name for name in algorithm_names() if name in evaluation.outcomes)


def telling_world(evaluation: Evaluation) -> int:
    """Row of the world to draw: median saving of the policy among the worlds where full braking harms, else row 0."""
    before = evaluation.outcome(BASELINE).first_impact_harm
    rows = np.flatnonzero(before > 0.0)
    if not len(rows):
        return 0
    saved = before[rows] - evaluation.outcome(learned_name(evaluation)).first_impact_harm[rows]
    order = np.argsort(saved, kind="stable")
    return int(rows[order[(len(order) - 1) // 2]])


def write_page(
    folder: Path,
    evaluation: Evaluation,
    rows: Sequence[SummaryRow],
    figures: Sequence[ReportFigure],
    agents: Mapping[str, Agent],
    *,
    beside: Mapping[str, Sequence[SummaryRow]],
    summary: str,
    settings: Mapping[str, object],
    versions: Mapping[str, str],
) -> Path:
    """Write ``report.html``, which holds the figures and some episodes inside it; gives its path."""
    path = folder / "report.html"
    name, learned = evaluation.scenario.name, learned_name(evaluation)
    title = f"ethbrake run: {name}{' (the main test of three)' if beside and name == MAIN_TEST else ''}"
    spellings = {learned: f"{learned}@{folder}", "hybrid": f"{learned}@{folder}+episode"}
    report = Report(
        title,
        rows,
        evaluation,
        play_for_report(evaluation, agents, learned, spellings=spellings),
        shield_evidence(agents, evaluation),
        learned,
        figures,
        [ReportTest(name, TESTS[name], other) for name, other in beside.items()],
        summary=summary,
        settings=settings,
        versions=versions,
    )
    write_report(path, report, force=True)
    return path
