"""The main experiment: train a policy or team, and compare it, with and without a shield, with the baselines."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import write_output
from ethbrake_marl.first_edition.agents.learned import TRAINED_POLICY, TRAINED_TEAM, LearnedAgent
from ethbrake_marl.first_edition.agents.protocol import Agent, Driver, Team
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.identity import EPISODES, LIST_SEED
from ethbrake_marl.first_edition.evaluation.lineup import make_agents, make_lineup
from ethbrake_marl.first_edition.evaluation.per_world import results_to_json, write_per_world
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.summary import SummaryTable, summarise
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.messages import refuse_untold
from ethbrake_marl.first_edition.policies.teams import Trained
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.drivers import shielded
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent
from ethbrake_marl.first_edition.training.recipe import TrainingRecipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.session import TrainResult, train
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.registry import Registry

BASELINES = ("full_brake", "e_v2x_bm", "e_v2x_bm:pairwise")

TEAM_BASELINES = ("full_brake", "e_v2x_bm")  # baselines that can drive several learners

HYBRID = "hybrid"  # name of the trained policy with the paper's shield
SHIELDED_TEAM = "shielded team"  # name of the trained team with a shield in step mode


@dataclass(frozen=True, slots=True)
class Experiment:
    """A trained policy or team and its evaluation: the input of the functions that write reports about a run."""

    trained: TrainResult  # result of the training, which may have been interrupted
    agents: Mapping[str, Driver]  # compared agents by name (``compared_agents``)
    evaluation: Evaluation  # outcomes of these agents on the evaluation list
    rows: SummaryTable  # results table of the evaluation, one row per agent
    list_seed: int  # seed of the evaluation list
    harm_count: HarmCount  # count of harm that all agents minimise
    started: float  # ``time.monotonic`` at the start of the experiment (s)

    @property
    def learned(self) -> str:
        """Name of the trained policy or team in ``agents``."""
        return TRAINED_POLICY if TRAINED_POLICY in self.agents else TRAINED_TEAM

    @property
    def run(self) -> RunDirectory:
        """Folder of the run."""
        return RunDirectory(self.trained.directory)


@dataclass(frozen=True, slots=True)
class RunReport:
    """Tables and texts that ``ethbrake run`` prints about a report that it has written."""

    tables: tuple[Any, ...]  # tables to print instead of the results table
    note: str  # text that says where the report is


MakeReport = Callable[[Experiment, OnProgress], RunReport]  # writes a report, and calls the second argument meanwhile


def register_run_report(name: str, make: MakeReport) -> None:
    """Register a function that writes a report into the folder of every later ``ethbrake run``.

    Instead of calling this function, a package can declare an entry point of the group ``ethbrake_marl.first_edition.run_reports``.
    ``make`` writes the report about an ``Experiment``. Raises ``AlreadyExists`` if another report has the name.
    """
    RUN_REPORTS.add(name, make, lambda other: other is make)


RUN_REPORTS: Registry[MakeReport] = Registry("report of a run", "first_edition.run_reports", register_run_report)


@dataclass(frozen=True, slots=True)
class ExperimentResult:
    """Result of ``run_experiment``: the training, the results, and the tables and notes to print."""

    trained: TrainResult  # result of the training, which may have been interrupted
    results: list[dict[str, Any]]  # content of results.json: one object per agent
    tables: tuple[Any, ...]  # tables of the evaluation, for a terminal
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
    """Train the learners, compare them (with and without a shield) with the baselines, and write results and reports.

    Several learners are trained as a team, with the recipe's scheme. All compared agents minimise the count of harm
    that the learners are trained for (``reward.harm_count`` of the recipe). Installed extensions write reports about
    the results.

    Ctrl-C during the training stops the training after the current update, and the policy trained so far is evaluated.
    A second Ctrl-C, or Ctrl-C during the evaluation, raises ``KeyboardInterrupt``; the folder still contains the
    policy. ``run.json`` records how the run ended.

    ``episodes`` is the number of worlds of the evaluation list, and ``list_seed`` its seed. ``on_progress`` is called
    with the progress of training, evaluation and reports. For ``directory``, ``steps``, ``seed``, ``force`` and
    ``settings``, see ``train``.

    Raises the errors of ``train`` and ``evaluate``, and ``AlreadyExists`` before the training if ``directory`` exists
    and ``force`` is false.
    """
    started = time.monotonic()
    tell = on_progress or (lambda progress: None)
    reports = [RUN_REPORTS[name] for name in RUN_REPORTS]  # raises before the training if a report cannot be loaded
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
                f"training interrupted after {trained.steps:,} steps; now evaluating the policy so far (press Ctrl-C"
                " again to stop immediately)"
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
    _note(run, trained.status, "report", None)
    tables = tuple(table for report in written for table in report.tables)
    notes = tuple(report.note for report in written)
    return ExperimentResult(
        trained,
        results,
        tables or (*rows.tables(),),
        notes or (f"results, with every measure: {run.path / 'results.json'}",),
    )


def compared_agents(
    trained: Trained, scenario: Scenario, harm_count: HarmCount, baselines: Sequence[str] | None = None
) -> dict[str, Driver]:
    """Return the agents to compare, by name: baselines, and the trained policy or team with and without a shield.

    With one learner, the trained agent is ``trained policy``, and ``hybrid`` is this policy with the paper's shield.
    With several learners, the trained agent is ``trained team``, and ``shielded team`` is this team with a shield in
    step mode. For several learners there is also a team ``all but vehicle_i`` for each learner i, in which vehicle i
    brakes fully.

    ``harm_count`` is the count of harm that baselines minimise and shields bound. ``baselines`` has names as on the
    command line; None: ``BASELINES`` for one learner, ``TEAM_BASELINES`` for several learners.
    """
    several = len(scenario.learners) > 1
    specs = (TEAM_BASELINES if several else BASELINES) if baselines is None else baselines
    agents = make_lineup(specs, scenario, harm_count=harm_count)
    if not several:
        agent = LearnedAgent(next(iter(trained.drivers.values())), TRAINED_POLICY)
        return {**agents, TRAINED_POLICY: agent, HYBRID: HybridAgent(agent, scenario, harm_count=harm_count)}
    drivers: dict[int, Agent] = {
        i: LearnedAgent(trained.drivers[scenario.vehicle_names[i]], TRAINED_TEAM) for i in scenario.learners
    }
    team = Team(drivers, TRAINED_TEAM)
    agents[TRAINED_TEAM] = team
    braking = make_agents(["full_brake"], scenario)["full_brake"]
    for i in scenario.learners:
        name = without(scenario.vehicle_names[i])
        agents[name] = Team({**drivers, i: braking}, name)
    return {**agents, SHIELDED_TEAM: shielded(team, scenario, "step", harm_count=harm_count)}


def without(vehicle: str) -> str:
    """Return the name of the trained team in which ``vehicle`` brakes fully."""
    return f"all but {vehicle}"


def write_results(
    folder: Path, name: str, rows: Sequence[SummaryRow], harm_count: HarmCount, per_world: Path | None = None
) -> list[dict[str, Any]]:
    """Write a results table as ``NAME.json`` and ``NAME.csv`` into ``folder``, and return the content of the JSON file.

    The JSON file records ``harm_count`` (the count of harm that the agents minimise) and the path ``per_world`` of an
    existing file with one row per world; None: there is no such file.
    """
    results = results_to_json(rows, per_world=per_world, settings={"harm_count": harm_count})
    content = json.dumps(results, indent=2, allow_nan=False) + "\n"
    write_output(folder / f"{name}.json", content.encode(), force=True)
    write_output(folder / f"{name}.csv", results_csv(rows).encode(), force=True)
    return results


def results_csv(rows: Sequence[SummaryRow]) -> str:
    """Return the results table ``rows`` as CSV text, with one line per agent.

    The columns ``x_low`` and ``x_high`` are the ends of the interval of column ``x``. A missing value is an empty
    field.
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
    """Context manager that records the status of a run in ``run.json`` while the run's policies are evaluated.

    The status is ``running`` during the evaluation. After an exception, the status is ``interrupted`` (Ctrl-C) or
    ``failed``, and the error is recorded. The names of the files that the ``with`` block wrote are also recorded
    (``RunDirectory.WRITTEN``), so that ``resume`` can delete these files.
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
    """Write status, stage, reason and end time into ``run.json``; other entries, such as ``wall_s``, do not change."""
    content = read_object(run.status)
    ended = None if status == "running" else datetime.now(UTC).isoformat(timespec="seconds")
    run.write_json(run.status, {**content, "status": status, "stage": stage, "ended_utc": ended, "reason": reason})
