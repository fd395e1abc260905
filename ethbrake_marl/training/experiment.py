"""The main experiment: train a policy or a team, and evaluate it, alone and behind its shield, beside the baselines."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ethbrake_marl.agents.learned import TRAINED_POLICY, TRAINED_TEAM, LearnedAgent
from ethbrake_marl.agents.protocol import Agent, Driver, Team
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.identity import EPISODES, LIST_SEED
from ethbrake_marl.evaluation.lineup import make_agents, make_lineup
from ethbrake_marl.evaluation.per_world import results_to_json, write_per_world
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.summary import SummaryTable, summarise
from ethbrake_marl.evaluation.summary_row import SummaryRow
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import write_output
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.messages import refuse_untold
from ethbrake_marl.policies.teams import Trained
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.registry import Registry
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shields.drivers import shielded
from ethbrake_marl.shields.paper_hybrid import HybridAgent
from ethbrake_marl.training.recipe import TrainingRecipe
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.session import TrainResult, train

BASELINES = ("full_brake", "e_v2x_bm", "e_v2x_bm:pairwise")

TEAM_BASELINES = ("full_brake", "e_v2x_bm")  # each drives every learner; the closed form is for one

SHIELDED = "hybrid"  # the policy, or the team, behind its shield


@dataclass(frozen=True, slots=True)
class Experiment:
    """A trained policy or team and its evaluation: the input of the functions that write reports about a run."""

    trained: TrainResult  # result of the training, which may have been interrupted
    agents: Mapping[str, Driver]  # by name, see ``compared_agents``
    evaluation: Evaluation  # outcomes of these agents on the evaluation list
    rows: SummaryTable  # results table of the evaluation, one row per agent
    list_seed: int  # seed of the evaluation's worlds
    harm_count: HarmCount  # harm that all agents minimise
    started: float  # start of the experiment by ``time.monotonic`` (s)

    @property
    def learned(self) -> str:
        """Name of the trained policy or team among the agents."""
        return TRAINED_POLICY if TRAINED_POLICY in self.agents else TRAINED_TEAM

    @property
    def run(self) -> RunDirectory:
        """Folder of the run, as an object that names its files."""
        return RunDirectory(self.trained.directory)


@dataclass(frozen=True, slots=True)
class RunReport:
    """What ``ethbrake run`` prints about a report that was written."""

    tables: tuple[Any, ...]  # tables to print instead of the usual ones
    note: str  # text that says where the report is
    interrupted: str = (
        ""  # what Ctrl-C stopped, so that the report lacks it: "the training alone/vehicle_2"; "": nothing
    )


MakeReport = Callable[[Experiment, OnProgress], RunReport]  # writes a report; the second argument takes its progress


def register_run_report(name: str, make: MakeReport) -> None:
    """Register a function that writes a report into the folder of every ``ethbrake run``, after its results.

    ``name`` is the name of the report, which no other report may have; ``make`` writes it from an ``Experiment``.

    An installed package does the same with an entry point of the group ``ethbrake_marl.run_reports``.
    """
    RUN_REPORTS.add(name, make, lambda other: other is make)


RUN_REPORTS: Registry[MakeReport] = Registry("report of a run", "run_reports", register_run_report)


@dataclass(frozen=True, slots=True)
class ExperimentResult:
    """What ``run_experiment`` returns: the training, the results, and the tables and notes to print."""

    trained: TrainResult  # result of the training, which may have been interrupted
    results: list[dict[str, Any]]  # content of results.json: one object per agent
    tables: tuple[Any, ...]  # tables of the evaluation for a terminal
    notes: tuple[str, ...]  # texts that say where results and reports are
    interrupted: str = ""  # what Ctrl-C stopped after the training (``RunReport.interrupted``); "": nothing


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
    """Train the learners, evaluate them alone and behind their shield beside the baselines, and write the results.

    All agents minimise the harm that the learners are trained for (``reward.harm_count`` of the recipe). Installed
    extensions then write their reports.

    Ctrl-C during the training ends it after the current update, and the policy so far is evaluated. A second Ctrl-C, or
    one during the evaluation, raises ``KeyboardInterrupt``; the folder still contains the policy. Ctrl-C during a
    further training of a report ends that training, and the report is written without it
    (``ExperimentResult.interrupted``). ``run.json`` records how the run ended.

    Args:
        scenario: scenario with at least one learner. Several are trained as a team, by the recipe's scheme.
        directory: the new folder of the run.
        recipe: recipe of the training.
        steps: overrides the recipe's number of decisions.
        seed: overrides the recipe's seed of the training.
        episodes: number of worlds of the evaluation list.
        list_seed: seed of the evaluation list.
        force: replace an earlier run.
        settings: how recipe and scenario differ from their files, ``KEY=VALUE`` each; recorded in ``config.json``.
        on_progress: called with the progress of training, evaluation and reports.

    Raises what ``train`` and ``evaluate`` raise; ``AlreadyExists`` for an existing run, before any work.

    """
    started = time.monotonic()
    tell = on_progress or (lambda progress: None)
    reports = [RUN_REPORTS[name] for name in RUN_REPORTS]  # one that cannot be loaded ends the run before it begins
    sample = scenario.sample(episodes, list_seed)
    refuse_untold(sample.worlds, scenario.learners, "run, with the baseline e_v2x_bm and a shield")
    trained = train(
        recipe, scenario, directory, steps=steps, seed=seed, force=force, settings=settings, on_progress=on_progress
    )
    run, harm_count = RunDirectory(trained.directory), recipe.reward.harm_count
    with _status(run):
        agents = compared_agents(trained.trained, scenario, harm_count)
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
        written = [make(experiment, tell) for make in reports]
    stopped = ", ".join(report.interrupted for report in written if report.interrupted)
    _note(run, trained.status, "report", f"interrupted: {stopped}" if stopped else None)
    tables = tuple(table for report in written for table in report.tables)
    notes = tuple(report.note for report in written)
    return ExperimentResult(
        trained,
        results,
        tables or (*rows.tables(),),
        notes or (f"results, with every measure: {run.path / 'results.json'}",),
        stopped,
    )


def compared_agents(
    trained: Trained, scenario: Scenario, harm_count: HarmCount, baselines: Sequence[str] | None = None
) -> dict[str, Driver]:
    """Return the agents to compare, by name: the baselines, what was trained, and ``hybrid``, the same behind a shield.

    One policy is ``trained policy``, its shield the paper's. Several learners are ``trained team``, shielded together
    by the step shield; for each learner there is also the team in which that vehicle brakes fully.

    Args:
        trained: the trained policy or policies.
        scenario: scenario whose learners they drive.
        harm_count: harm that baselines minimise and the shield bounds: ``first`` or ``total``.
        baselines: specs of the baselines; None: ``BASELINES``, or ``TEAM_BASELINES`` for several learners.

    """
    several = len(scenario.learners) > 1
    specs = (TEAM_BASELINES if several else BASELINES) if baselines is None else baselines
    agents = make_lineup(specs, scenario, harm_count=harm_count)
    if not several:
        agent = LearnedAgent(next(iter(trained.drivers.values())), TRAINED_POLICY)
        return {**agents, TRAINED_POLICY: agent, SHIELDED: HybridAgent(agent, scenario, harm_count=harm_count)}
    drivers: dict[int, Agent] = {
        i: LearnedAgent(trained.drivers[scenario.vehicle_names[i]], TRAINED_TEAM) for i in scenario.learners
    }
    team = Team(drivers, TRAINED_TEAM)
    agents[TRAINED_TEAM] = team
    braking = make_agents(["full_brake"], scenario)["full_brake"]
    for i in scenario.learners:
        name = without(scenario.vehicle_names[i])
        agents[name] = Team({**drivers, i: braking}, name)
    return {**agents, SHIELDED: shielded(team, scenario, "step", harm_count=harm_count)}


def without(vehicle: str) -> str:
    """Return the name of the trained team in which this vehicle brakes fully instead."""
    return f"all but {vehicle}"


def write_results(
    folder: Path, name: str, rows: Sequence[SummaryRow], harm_count: HarmCount, per_world: Path | None = None
) -> list[dict[str, Any]]:
    """Write a results table as ``NAME.json`` and ``NAME.csv`` into ``folder``; return the content of the JSON file.

    Args:
        folder: existing folder.
        name: name of the files, without their endings.
        rows: rows of the table, one per agent.
        harm_count: harm that the agents minimise, which is recorded.
        per_world: existing file with one row per world, to which the JSON file refers.

    """
    results = results_to_json(rows, per_world=per_world, settings={"harm_count": harm_count})
    content = json.dumps(results, indent=2, allow_nan=False) + "\n"
    write_output(folder / f"{name}.json", content.encode(), force=True)
    write_output(folder / f"{name}.csv", results_csv(rows).encode(), force=True)
    return results


def results_csv(rows: Sequence[SummaryRow]) -> str:
    """Return a results table as CSV text, with one line per agent.

    ``rows`` is the table. The interval of column ``x`` is in ``x_low`` and ``x_high``; missing values are empty.
    """
    lines = []
    for entry in (row.to_json() for row in rows):
        parameters = entry.pop("parameters")
        for name, value in entry.items():
            if isinstance(value, list | dict) and not name.endswith("_interval"):
                entry[name] = json.dumps(value, allow_nan=False)
        lines.append({"scenario": parameters["scenario"], "seed": parameters["seed"], **entry})
    return csv_text(lines)


@contextmanager
def _status(run: RunDirectory) -> Iterator[None]:
    """Context manager around the evaluation of a run: record in ``run.json`` that it is running, and if it fails.

    For an exception inside, ``interrupted`` (Ctrl-C) or ``failed`` is recorded with the error, which is raised again.
    The new files are recorded too (``RunDirectory.WRITTEN``), so that ``resume`` can delete them.
    """
    _note(run, "running", "evaluation", None)
    before = {path.name for path in run.path.iterdir()}
    try:
        yield
    except BaseException as error:
        _note(run, "interrupted" if isinstance(error, KeyboardInterrupt) else "failed", "evaluation", repr(error))
        raise
    finally:
        written = sorted({path.name for path in run.path.iterdir()} - before)
        run.write_json(run.status, {**read_object(run.status), RunDirectory.WRITTEN: written})


def _note(run: RunDirectory, status: str, stage: str, reason: str | None) -> None:
    """Update status, stage and reason in ``run.json``. Its steps and ``wall_s`` remain those of the training."""
    content = read_object(run.status)
    ended = None if status == "running" else datetime.now(UTC).isoformat(timespec="seconds")
    run.write_json(run.status, {**content, "status": status, "stage": stage, "ended_utc": ended, "reason": reason})
