"""The option ``--report`` of ``ethbrake evaluate``: the page of an evaluation, with its progress."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ethbrake_marl.agents.protocol import Driver
from ethbrake_marl.cli.terminal import Bars, say
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import Evaluation, SummaryRow, check_target
from ethbrake_marl.evaluation.outcome import parameter_line


def check_page(path: Path, *, force: bool = False) -> Path:
    """Refuse a page that cannot be written, before any work; raises ``InvalidInput`` and ``AlreadyExists``."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise InvalidInput(f"{path}: a report is a page; end the name in .html")
    return check_target(path, force=force)


def write_evaluation_report(
    path: Path,
    evaluation: Evaluation,
    rows: Sequence[SummaryRow],
    agents: Mapping[str, Driver],
    bars: Bars,
    *,
    harm_count: HarmCount,
    force: bool,
) -> None:
    """Write the page of an evaluation that has just been made.

    Args:
        path: of the page.
        evaluation: what the page is about.
        rows: its table.
        agents: that were evaluated, by the names of the rows.
        bars: shows the progress.
        harm_count: that agents minimised.
        force: replace the page that is there.

    """
    # Here: matplotlib takes a second to load, and most evaluations draw nothing.
    from ethbrake_marl.pages.report import Report, focus_of, play_for_report, shield_evidence, write_report

    done: list[str] = []

    def tell(agent: str) -> None:
        done.append(agent)
        bars.show("report: episodes", len(done), len(agents))

    focus = focus_of(rows)
    played = play_for_report(evaluation, agents, focus, harm_count=harm_count, on_agent=tell)
    scenario = evaluation.scenario
    names = ", ".join(row.agent for row in rows)
    report = Report(
        f"{scenario.name}: {names}" if len(names) <= 60 else f"{scenario.name}: {len(rows)} agents compared",
        rows,
        evaluation,
        played,
        shield_evidence(agents, evaluation, harm_count),
        focus,
        summary=scenario.title or "Agents on the same worlds.",
        settings=_settings(rows[0].parameters, names, harm_count),
        versions=rows[0].versions,
    )
    write_report(path, report, force=force)
    say(f"report: {path}")


def _settings(found: Mapping[str, Any], agents: str, harm_count: HarmCount) -> dict[str, object]:
    """What was asked for, in words."""
    driven = found.get("controlled_vehicle") or ", ".join(found["controlled_vehicles"])
    scripts = ", ".join(f"{vehicle} by {script}" for vehicle, script in found["scripts"].items())
    return {
        "Command": "ethbrake " + " ".join(sys.argv[1:]),
        "Agents": agents,
        "Harm that agents minimise": "first impacts only" if harm_count == "first" else "every impact",
        "Worlds": parameter_line(found),
        "Driven by the agents": driven,
        "Driven by scripts": scripts or "none",
        "Time step, horizon": f"{found['time_step_s']:g} s, {found['horizon_s']:g} s",
    }
