"""Harm against processor time: what each agent's computing buys, on the same worlds and the same clock.

An agent that searches does better the longer it may. Two such agents are compared where both took the same time, so
each is measured with its whole episode: what it does at the alert, every decision, and the motion of the worlds.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from ethbrake_marl.agents.knowledge import Knowledge, knowledge_text
from ethbrake_marl.agents.team import Driver
from ethbrake_marl.errors import check_whole_number, unknown_name
from ethbrake_marl.evaluation.identity import policies_by_name
from ethbrake_marl.evaluation.outcome import Outcome
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.statistics import Estimate, estimates_to_json, mean, paired_difference
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario import Sample, Scenario

if TYPE_CHECKING:
    from ethbrake_marl.figures.style import Figure

CHUNK = 500  # worlds driven together, for every agent alike
_WARM_UP = 2  # worlds that are driven first and not counted: kernels are compiled, tables are read


@dataclass(frozen=True, slots=True)
class TimedRow:
    """What one agent's computing bought; harms are means per world (m2/s2), times are per world (ms)."""

    agent: str
    knows: Knowledge
    median_ms: float  # processor time of all threads: median over the repetitions
    lowest_ms: float
    highest_ms: float
    first_impact_harm: Estimate
    total_harm: Estimate
    difference: Estimate  # of the harm that is compared, minus the reference agent's, paired by world
    policy_sha256: Mapping[str, str] = field(default_factory=dict)  # vehicle -> its policy's, where one drives

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON; an interval is ``[low, high]`` or null."""
        found: dict[str, Any] = {"agent": self.agent, "knows": knowledge_text(self.knows)}
        found |= {"cpu_ms": self.median_ms, "cpu_ms_range": [self.lowest_ms, self.highest_ms]}
        found["policy_sha256"] = dict(self.policy_sha256)
        harms = {"first_impact_harm": self.first_impact_harm, "total_harm": self.total_harm}
        return found | estimates_to_json({**harms, "difference": self.difference})


def equal_time(
    sample: Sample,
    agents: Mapping[str, Driver],
    *,
    scenario: Scenario,
    against: str,
    harm_count: HarmCount = "first",
    repeats: int = 3,
    on_progress: OnProgress | None = None,
) -> list[TimedRow]:
    """Time every agent on the list, ``repeats`` times in turn; quickest first.

    ``against`` is the agent that the others' harm under ``harm_count`` is compared with. ``on_progress`` is told how
    often each agent has driven the whole list. Harms are the same in every repetition, times are not. Raises
    ``InvalidInput`` for less than one repetition, ``UnknownName`` for an agent to compare with that is not among them,
    and what ``evaluate`` raises.
    """
    check_whole_number("equal time: repeats", repeats, 1)
    if against not in agents:
        raise unknown_name("agent to compare with", against, agents)
    n = sample.worlds.n
    few = sample.take(np.arange(min(n, _WARM_UP)))
    evaluate(few, agents, scenario=scenario, chunk=CHUNK)
    spent: dict[str, list[float]] = {name: [] for name in agents}
    outcomes: dict[str, Outcome] = {}
    for repetition in range(repeats):
        for name, agent in agents.items():
            begin = time.process_time()
            result = evaluate(sample, {name: agent}, scenario=scenario, chunk=CHUNK)
            spent[name].append(1e3 * (time.process_time() - begin) / n)
            outcomes[name] = result.outcome(name)
            if on_progress is not None:
                on_progress(Progress(name, repetition + 1, repeats))
    reference = outcomes[against].ledger.world_harm(harm_count)
    rows = [
        TimedRow(
            name,
            outcome.knows,
            float(np.median(spent[name])),
            min(spent[name]),
            max(spent[name]),
            mean(outcome.first_impact_harm),
            mean(outcome.total_harm),
            paired_difference(outcome.ledger.world_harm(harm_count), reference),
            policies_by_name(outcome.policies, scenario),
        )
        for name, outcome in outcomes.items()
    ]
    return sorted(rows, key=lambda row: row.median_ms)


def timed_table(rows: list[TimedRow], against: str) -> Table:
    """The rows for a terminal."""
    title = f"Harm (m²/s²) against processor time per world; difference: minus {against}, 95 % interval"
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("Agent", overflow="fold")
    table.add_column("Knows", overflow="fold")
    for heading in ("CPU ms", "range", "First", "Total", "Difference"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        interval = row.difference.interval
        within = "" if interval is None else f" [{interval[0]:+.3f}, {interval[1]:+.3f}]"
        table.add_row(
            Text(row.agent),
            knowledge_text(row.knows),
            f"{row.median_ms:.2f}",
            f"{row.lowest_ms:.2f}-{row.highest_ms:.2f}",
            f"{row.first_impact_harm.value:.3f}",
            f"{row.total_harm.value:.3f}",
            "" if row.agent == against else f"{row.difference.value:+.3f}{within}",
        )
    return table


def equal_time_figure(rows: Sequence[TimedRow], *, caption: str = "") -> Figure:
    """Both harms of each agent against its processor time."""
    # Here: matplotlib takes a second to load, and the command draws nothing.
    from ethbrake_marl.figures.report import harm_against_time

    points = {row.agent: (row.median_ms, row.first_impact_harm, row.total_harm) for row in rows}
    return harm_against_time(points, caption=caption)
