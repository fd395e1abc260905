"""The benchmark: its measures, its table to read, and its rows for a file, one row for each task and team."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ethbrake_marl.agents.action_scale import ActionScale
from ethbrake_marl.evaluation.evaluate import SEED, Result, evaluate
from ethbrake_marl.evaluation.measure_registry import MEASURES
from ethbrake_marl.evaluation.summary import SummaryTable
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.registry import DISTRIBUTION
from ethbrake_marl.worlds.catalogue import group_of_scenarios, load_scenario
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.scenario import Scenario

BENCHMARK = "benchmark"  # group of scenarios, the tasks
EPISODES = 2_000  # worlds of each task, from the evaluation list of seed ``SEED``
START = ActionScale(offset=-0.9, scale=0.3)  # what tasks offer to methods: brake hard at first, with little noise
BEST_KNOWN = "limits"  # measure that gives the share of the possible reduction
PERCENT: dict[str, Any] = {"digits": 1, "scale": 100.0, "unit": " %"}
COLUMNS = (
    Column(
        "Share of the possible", "share_of_possible_reduction_honest", **PERCENT, short="Possible", interval="below"
    ),
    Column("Honest cost", "honest_cost", short="Honest\ncost", interval="below"),
    Column("Worst 5 %", "worst5_honest", short="Worst\n5 %", interval="below"),
    Column("Worst-off vehicle", "maximin_honest", short="Worst\noff", interval="hidden"),
    Column("First-impact harm", "first_impact_harm", short="First\nimpact", interval="hidden"),
    Column("Total harm", "total_harm", short="Total\nharm", interval="hidden"),
    Column("Collisions", "collision_rate", **PERCENT, short="Colli-\nsions", interval="hidden"),
    Column("Push (m/s)", "pushed_mps", short="Push\nm/s", interval="hidden"),
)
NOTE = (
    "Means per world; harm and cost in m²/s². Possible: 0 % for full braking, 100 % for the best known cost; it needs"
    " the agent full_brake beside yours, and worlds of the benchmark's lists. Worst 5 %: mean honest cost of the worst"
    " 5 % of the worlds. Worst off: honest cost that the worst-off vehicle of a world bears."
)


def benchmark_measures(scenario: Scenario, *, episodes: int, seed: int) -> list[str]:
    """Names of the measures of ``COLUMNS`` that are installed, except those of every evaluation.

    The best known cost is measured only in the first ``EPISODES`` worlds of ``SEED`` of an unchanged task.
    """
    is_listed = scenario.name in group_of_scenarios(BENCHMARK) and seed == SEED and episodes <= EPISODES
    is_listed = is_listed and scenario.content() == load_scenario(scenario.name).content()
    return ["worst5", "maximin", *(name for name in (BEST_KNOWN,) if is_listed and name in MEASURES)]


def evaluate_task(scenario: AnyScenario, agents: Any, *, episodes: int = EPISODES, seed: int = SEED) -> Result:
    """Result of agents in the evaluation list of a task. Agents that choose minimise the honest cost."""
    loaded = load_scenario(scenario)
    measures = ["pushed_mps", *benchmark_measures(loaded, episodes=episodes, seed=seed)]
    return evaluate(loaded, agents, episodes=episodes, seed=seed, measures=measures)


def benchmark_sheet(tables: Mapping[str, SummaryTable]) -> Sheet:
    rows: list[Any] = []
    for task, table in tables.items():
        rows.append(task)
        rows += [(row.marked, *(row.estimates.get(column.key) for column in COLUMNS)) for row in table]
    return Sheet("", [Column("Agent", "agent", text=True), *COLUMNS], rows, NOTE, gap=1, keep=3)


def benchmark_rows(tables: Mapping[str, SummaryTable], **about: Any) -> list[dict[str, Any]]:
    """Rows of the benchmark's file. ``about``: further columns, such as ``method`` or ``cpu_s``."""
    rows = []
    for task, table in tables.items():
        identity = {key: table.parameters[key] for key in ("worlds_sha256", "physics_digest")}
        version = table.parameters["versions"][DISTRIBUTION]
        for row in table:
            keys = *(column.key for column in COLUMNS), "best_known_honest"
            values = Estimate.side_by_side({key: row.estimates.get(key) for key in keys})
            names = {"task": task, "agent": row.agent, **about}
            known = {"knows": row.knows, "sees_through_channel": row.sees_through, "episodes": row.episodes}
            rows.append({**names, **values, **known, **identity, "version": version})
    return rows
