"""The main experiment: train a policy, and evaluate it, alone and behind its shield, beside the baselines."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ethbrake_marl.agents.learned import TRAINED_POLICY, LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import check_one_learner
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.identity import EPISODES, LIST_SEED
from ethbrake_marl.evaluation.lineup import make_agents
from ethbrake_marl.evaluation.per_world import results_to_json, write_per_world
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.summary import SummaryTable, summarise
from ethbrake_marl.evaluation.summary_row import SummaryRow
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import write_output
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.messages import refuse_untold
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.registry import Registry
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.paper_hybrid import HybridAgent
from ethbrake_marl.training.recipe import TrainingRecipe
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.session import TrainResult, train

BASELINES = ("full_brake", "e_v2x_bm", "e_v2x_bm:pairwise")


@dataclass(frozen=True, slots=True)
class Experiment:
    """A trained policy and its evaluation, as input for reports."""

    trained: TrainResult  # result of the training, which may have been interrupted
    agents: Mapping[str, Agent]  # baselines, the trained policy, and the trained policy behind its shield
    evaluation: Evaluation
    rows: SummaryTable
    list_seed: int  # seed of the evaluation's worlds
    harm_count: HarmCount  # harm that all agents minimise
    started: float  # start of the experiment by ``time.monotonic`` (s)

    @property
    def run(self) -> RunDirectory:
        """Folder of the run."""
        return RunDirectory(self.trained.directory)


@dataclass(frozen=True, slots=True)
class RunReport:
    """Tables and note of a report about a run."""

    tables: tuple[Any, ...]  # tables to print instead of the usual ones
    note: str  # text that says where the report is


MakeReport = Callable[[Experiment, OnProgress], RunReport]


def register_run_report(name: str, make: MakeReport) -> None:
    """Register a function that writes a report into the folder of every ``ethbrake run``, after its results.

    An installed package does the same with an entry point of the group ``ethbrake_marl.run_reports``.
    """
    RUN_REPORTS.add(name, make, lambda other: other is make)


RUN_REPORTS: Registry[MakeReport] = Registry("report of a run", "run_reports", register_run_report)


@dataclass(frozen=True, slots=True)
class ExperimentResult:
    """Result of an experiment: the training, and the tables and notes to print."""

    trained: TrainResult
    results: list[dict[str, Any]]  # content of results.json
    tables: tuple[Any, ...]  # tables for a terminal
    notes: tuple[str, ...]  # texts that say where results and reports are


def run_experiment(
    scenario: Scenario,
    directory: Path,
    *,
    recipe: TrainingRecipe,
    steps: int | None = None,
    seed: int | None = None,
    episodes: int = EPISODES,
    list_seed: int = LIST_SEED,
    force: bool = False,
    settings: Sequence[str] = (),
    on_progress: OnProgress | None = None,
) -> ExperimentResult:
    """Train a policy, evaluate it alone and behind its shield beside the baselines, and write the results.

    All agents minimise the harm that the policy is trained for (``reward.harm_count`` of the recipe). Installed
    extensions then write their reports.

    ``seed`` is the seed of the training. The evaluation list is ``episodes`` worlds of ``list_seed``. ``settings`` are
    recorded in ``config.json``. Ctrl-C during the training ends it after the current update, and the policy so far is
    evaluated. A second Ctrl-C, or one during the evaluation, raises ``KeyboardInterrupt``; the folder still contains
    the policy. ``run.json`` records how the run ended. Raises what ``train`` and ``evaluate`` raise; ``AlreadyExists``
    for an existing run, before any work.
    """
    started = time.monotonic()
    tell = on_progress or (lambda progress: None)
    names = [scenario.vehicle_names[i] for i in scenario.learners]
    check_one_learner(scenario.name, names, "say which vehicle the agents drive")
    reports = [RUN_REPORTS[name] for name in RUN_REPORTS]  # one that cannot be loaded ends the run before it begins
    sample = scenario.sample(episodes, list_seed)
    refuse_untold(sample.worlds, scenario.learners, "run, with the baseline e_v2x_bm and a shield")
    trained = train(
        recipe, scenario, directory, steps=steps, seed=seed, force=force, settings=settings, on_progress=on_progress
    )
    run, harm_count = RunDirectory(trained.directory), recipe.reward.harm_count
    with _status(run, trained.status):
        agents = compared_agents(trained.policy, scenario, harm_count)
        order, n = list(agents), sample.worlds.n
        total = n * len(order)
        if trained.status == "interrupted":
            note = (
                f"interrupted after {trained.steps:,} steps: evaluating the policy so far; Ctrl-C again stops at once"
            )
            tell(Progress("evaluation", 0, total, note=note))
        evaluation = evaluate(
            sample,
            agents,
            scenario=scenario,
            seed=list_seed,
            on_progress=lambda name, done: tell(Progress("evaluation", n * order.index(name) + done, total)),
        )
        tell(Progress("results", 0, 1))
        rows = summarise(evaluation)
        per_world = run.path / "per_world.csv"
        write_per_world(per_world, evaluation, force=True)
        results = write_results(run.path, "results", rows, harm_count, per_world)
        tell(Progress("results", 1, 1))
        experiment = Experiment(trained, agents, evaluation, rows, list_seed, harm_count, started)
        made = [make(experiment, tell) for make in reports]
    tables = tuple(table for report in made for table in report.tables)
    notes = tuple(report.note for report in made)
    return ExperimentResult(
        trained,
        results,
        tables or (*rows.tables(),),
        notes or (f"results, with every measure: {run.path / 'results.json'}",),
    )


def compared_agents(
    policy: Policy, scenario: Scenario, harm_count: HarmCount, baselines: Sequence[str] = BASELINES
) -> dict[str, Agent]:
    """Return the baselines, the trained policy alone, and the trained policy behind its shield (``hybrid``)."""
    alone = LearnedAgent(policy, TRAINED_POLICY)
    learned: dict[str, Agent] = {TRAINED_POLICY: alone, "hybrid": HybridAgent(alone, scenario, harm_count=harm_count)}
    return {**make_agents(baselines, scenario, harm_count=harm_count), **learned}


def write_results(
    folder: Path, name: str, rows: Sequence[SummaryRow], harm_count: HarmCount, per_world: Path | None = None
) -> list[dict[str, Any]]:
    """Write the rows as ``NAME.json`` and, as a flat table, ``NAME.csv``; return the content of the JSON file."""
    results = results_to_json(rows, per_world=per_world, settings={"harm_count": harm_count})
    content = json.dumps(results, indent=2, allow_nan=False) + "\n"
    write_output(folder / f"{name}.json", content.encode(), force=True)
    write_output(folder / f"{name}.csv", results_csv(rows).encode(), force=True)
    return results


def results_csv(rows: Sequence[SummaryRow]) -> str:
    """Return a CSV with one line per agent.

    The interval of column ``x`` is in ``x_low`` and ``x_high``; missing values are empty.
    """
    lines = []
    for told in (row.to_json() for row in rows):
        parameters = told.pop("parameters")
        for name, value in told.items():
            if isinstance(value, list | dict) and not name.endswith("_interval"):
                told[name] = json.dumps(value, allow_nan=False)
        lines.append({"scenario": parameters["scenario"], "seed": parameters["seed"], **told})
    return csv_text(lines)


@contextmanager
def _status(run: RunDirectory, status: str) -> Iterator[None]:
    """Record in ``run.json`` that the evaluation is running, and afterwards the training's status or the error."""
    _note(run, "running", "evaluation", None)
    try:
        yield
    except BaseException as error:
        _note(run, "interrupted" if isinstance(error, KeyboardInterrupt) else "failed", "evaluation", repr(error))
        raise
    _note(run, status, "report", None)


def _note(run: RunDirectory, status: str, stage: str, reason: str | None) -> None:
    """Update status and stage in ``run.json``. Its steps and ``wall_s`` remain those of the training."""
    content = read_object(run.status)
    ended = None if status == "running" else datetime.now(UTC).isoformat(timespec="seconds")
    run.write_json(run.status, {**content, "status": status, "stage": stage, "ended_utc": ended, "reason": reason})
