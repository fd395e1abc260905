"""The main job, end to end: train a policy, shield it, measure both against the baselines, and show the result."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import OnProgress, Progress, Unfamiliar, check_one_learner
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.identity import EPISODES, LIST_SEED
from ethbrake_marl.evaluation.named_worlds import make_agents
from ethbrake_marl.evaluation.per_world import results_to_json, write_per_world
from ethbrake_marl.evaluation.record import record_episode
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.summary import SummaryRow, SummaryTable, summarise
from ethbrake_marl.extensions.report.episode_figure import trajectories
from ethbrake_marl.extensions.report.page import Part
from ethbrake_marl.extensions.report.report import Report
from ethbrake_marl.extensions.report.run_figures import harm_against_total_gap, learning_curve
from ethbrake_marl.extensions.report.shown_worlds import TRAINED_POLICY
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.extensions.report.tests import TESTS, is_papers_test, other_tests
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import read_object, write_output
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.game.rewards import RewardParams
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.paper_hybrid import HybridAgent
from ethbrake_marl.training.recipe import TrainingRecipe
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.session import TrainResult, train

BESIDE = ("full_brake", "e_v2x_bm")  # beside the policy: in its figures, and on the other two of the three tests


def write_results(
    folder: Path, name: str, rows: Sequence[SummaryRow], harm_count: HarmCount, per_world: Path | None = None
) -> list[dict[str, Any]]:
    """Write the rows as ``NAME.json`` and, flat, as ``NAME.csv``; gives what the JSON holds."""
    results = results_to_json(rows, per_world=per_world, settings={"harm_count": harm_count})
    content = json.dumps(results, indent=2, allow_nan=False) + "\n"
    write_output(folder / f"{name}.json", content.encode(), force=True)
    write_output(folder / f"{name}.csv", results_csv(rows).encode(), force=True)
    return results


def results_csv(rows: Sequence[SummaryRow]) -> str:
    """One line per agent; the interval of column ``x`` is ``x_low`` and ``x_high``, what does not exist is empty."""
    lines = []
    for told in (row.to_json() for row in rows):
        parameters = told.pop("parameters")
        for name, value in told.items():
            if isinstance(value, list | dict) and not name.endswith("_interval"):
                told[name] = json.dumps(value, allow_nan=False)
        lines.append({"scenario": parameters["scenario"], "seed": parameters["seed"], **told})
    return csv_text(lines)


def write_figures(
    folder: Path,
    evaluation: Evaluation,
    rows: Sequence[SummaryRow],
    *,
    course: Sequence[Mapping[str, float]],
    course_caption: str,
    agents: Mapping[str, Agent],
    harm_count: HarmCount = "first",
) -> list[Part]:
    """Draw the three figures, write them as PNG, and give them for the report."""
    references = [row for row in rows if row.agent in BESIDE]
    shown = telling_world(evaluation, harm_count)
    world, row = int(evaluation.index[shown]), evaluation.worlds.take([shown])
    records = {
        name: record_episode(row, agents[name], scenario=evaluation.scenario, vehicle=evaluation.vehicle)
        for name in (*BESIDE, TRAINED_POLICY)
    }
    drawn = {
        "learning_curve.png": (
            "Learning curve",
            "Harm and collisions of the policy on a fixed list of worlds while it learns; level lines: baselines.",
            learning_curve(course, references=references, caption=course_caption),
        ),
        "harm_against_gap.png": (
            "Harm against the total initial gap",
            "Mean harm of each agent in worlds grouped by the sum of their gaps at the alert.",
            harm_against_total_gap(evaluation),
        ),
        "trajectories.png": (
            "One episode",
            f"World {world} of the list, driven by three agents: the world whose saving of harm, policy against full"
            " braking, is the median of all worlds in which full braking collides.",
            trajectories(records),
        ),
    }
    for name, (_, _, figure) in drawn.items():
        write_picture(folder / name, figure, force=True)
    return [Part.drawing(figure, title, description) for title, description, figure in drawn.values()]


def telling_world(evaluation: Evaluation, harm_count: HarmCount = "first") -> int:
    """Row of the world to draw: median saving of the policy among the worlds where full braking harms, else row 0."""
    before = evaluation.outcome(BESIDE[0]).world_harm(harm_count)
    rows = np.flatnonzero(before > 0.0)
    if not len(rows):
        return 0
    saved = before[rows] - evaluation.outcome(TRAINED_POLICY).world_harm(harm_count)[rows]
    order = np.argsort(saved, kind="stable")
    return int(rows[order[(len(order) - 1) // 2]])


@dataclass(frozen=True, slots=True)
class ExperimentResult:
    """What an experiment left behind."""

    trained: TrainResult  # interrupted: the policy was not trained to the end, everything else is there
    rows: SummaryTable
    report: Path
    results: list[dict[str, Any]]
    beside: Mapping[str, SummaryTable] = field(default_factory=dict)  # by test: the other two of the three tests


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
    """Train a policy on ``scenario``, evaluate it, its hybrid and the baselines on a fixed list, write everything.

    Hybrid and baselines minimise the harm that the policy is trained for (``reward.harm_count`` of the recipe).
    On one of the three tests the policy also drives the other two, which it was not trained for.

    ``seed`` is the training's; the list is ``episodes`` worlds of ``list_seed``; ``settings`` are noted.
    Ctrl-C during the training ends it
    after the update in progress, and the policy so far is evaluated; a second one, or one during the evaluation,
    raises ``KeyboardInterrupt``, and the folder keeps the policy. ``run.json`` always says which. Raises what
    ``train`` and ``evaluate`` raise, ``AlreadyExists`` for an existing run before any work.
    """
    started = time.monotonic()
    tell = on_progress or (lambda progress: None)
    names = [scenario.vehicle_names[i] for i in scenario.learners]
    check_one_learner(scenario.name, names, "say which vehicle the agents drive")
    sample = scenario.sample(episodes, list_seed)
    trained = train(
        recipe, scenario, directory, steps=steps, seed=seed, force=force, settings=settings, on_progress=on_progress
    )
    run = RunDirectory(trained.directory)
    with _status(run, trained.status):
        harm_count = recipe.reward.harm_count
        agents = _agents(trained.policy, scenario, harm_count)
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
        others, done = other_tests(scenario), count()

        def begin(stage: str) -> None:
            """Tell that a stage of the report begins, or that all have ended."""
            tell(Progress(f"report{stage and ': '}{stage}", next(done), 3 + len(others)))

        begin("what nobody can avoid")
        rows = summarise(evaluation, paper=is_papers_test(evaluation.task, list_seed))
        beside: dict[str, SummaryTable] = {}
        for other in others:  # the policy was trained on ``scenario`` alone
            part = other.sample(min(episodes, 2_000), list_seed)
            begin(f"the same policy on {other.name}")
            with warnings.catch_warnings():  # of what the page says
                warnings.simplefilter("ignore", Unfamiliar)
                driven = evaluate(
                    part, _agents(trained.policy, other, harm_count, BESIDE), scenario=other, seed=list_seed
                )
            beside[other.name] = summarise(driven)
        begin("results and figures")
        per_world = run.path / "per_world.csv"
        write_per_world(per_world, evaluation, force=True)
        results = write_results(run.path, "results", rows, harm_count, per_world)
        if beside:
            write_results(run.path, "other_tests", [row for rows in beside.values() for row in rows], harm_count)
        wall_s = time.monotonic() - started
        report = _show(run, evaluation, rows, beside, trained, agents, harm_count, begin, wall_s=wall_s)
        begin("")
    return ExperimentResult(trained, rows, report, results, beside)


def _agents(
    policy: Policy, scenario: Scenario, harm_count: HarmCount, baselines: Sequence[str] = (*BESIDE, "e_v2x_bm:pairwise")
) -> dict[str, Agent]:
    """The baselines, the trained policy alone, and the same behind its shield (``hybrid``)."""
    alone = LearnedAgent(policy, TRAINED_POLICY)
    learned: dict[str, Agent] = {TRAINED_POLICY: alone, "hybrid": HybridAgent(alone, scenario, harm_count=harm_count)}
    return {**make_agents(baselines, scenario, harm_count=harm_count), **learned}


def _show(
    run: RunDirectory,
    evaluation: Evaluation,
    rows: SummaryTable,
    beside: Mapping[str, SummaryTable],
    trained: TrainResult,
    agents: Mapping[str, Agent],
    harm_count: HarmCount,
    begin: Callable[[str], None],
    *,
    wall_s: float,
) -> Path:
    """Figures and page."""
    config = read_object(run.config)
    plan = config["recipe"]["evaluation"]
    caption = (
        f"{evaluation.scenario.name}: worlds 0 to {plan['worlds'] - 1} of the list of seed {plan['seed']} at every"
        f" point; training seed {config['seeds']['training']}. Level lines: {rows[0].parameters.line}."
    )
    figures = write_figures(
        run.path, evaluation, rows, course=trained.evaluations, course_caption=caption, agents=agents,
        harm_count=harm_count,
    )  # fmt: skip
    reward = RewardParams(**config["recipe"]["reward"]).model_dump(exclude_defaults=True)
    told = {
        "Training": f"{config['recipe']['title'] or config['recipe']['name']}: {trained.steps:,} steps"
        f" of {config['recipe']['total_steps']:,} ({trained.status}), {trained.wall_s:.0f} s",
        "Start": trained.training.begins,
        "Seeds": f"training {config['seeds']['training']}, evaluation list {evaluation.seed}",
        "Reward": ", ".join(f"{name} {value}" for name, value in reward.items()) or "minus the first-impact harm",
        "Harm that agents minimise": "first impacts only" if harm_count == "first" else "every impact",
        "Whole run": f"{wall_s:.0f} s",
        "Settings": ", ".join(config.get("settings", ())),
    }
    manifest, name = trained.policy.manifest, evaluation.scenario.name
    which = (
        f"The {TRAINED_POLICY} is by {manifest.algorithm}, after {manifest.steps:,} steps (least harm on its own list)"
    )
    summary = f"{which}; hybrid is the same behind its shield."
    if beside:
        summary += f" {TESTS[name]} The other two tests stand below."
    stopped = f"The training was interrupted: this is the policy after {manifest.steps:,} steps."
    begin("the page and its episodes")
    report = Report(
        f"ethbrake run: {name}",
        rows,
        evaluation,
        focus=TRAINED_POLICY,
        figures=figures,
        tests=[(TESTS[name].partition(":")[0], TESTS[name], other) for name, other in beside.items()],
        harm_count=harm_count,
        remarks=[stopped] if trained.status == "interrupted" else [],
        summary=summary,
        settings={name: value for name, value in told.items() if value},
        versions=installed_versions(),
    )
    path = run.path / "report.html"
    report.driven(agents).write(path, force=True)
    return path


@contextmanager
def _status(run: RunDirectory, status: str) -> Iterator[None]:
    """Keep ``run.json`` true while the evaluation runs: ``running``, then the training's status or what went wrong."""
    _note(run, "running", "evaluation", None)
    try:
        yield
    except BaseException as error:
        _note(run, "interrupted" if isinstance(error, KeyboardInterrupt) else "failed", "evaluation", repr(error))
        raise
    _note(run, status, "report", None)


def _note(run: RunDirectory, status: str, stage: str, reason: str | None) -> None:
    """Bring ``run.json`` up to date; its steps and ``wall_s`` stay those of the training."""
    content = read_object(run.status)
    ended = None if status == "running" else datetime.now(UTC).isoformat(timespec="seconds")
    run.write_json(run.status, {**content, "status": status, "stage": stage, "ended_utc": ended, "reason": reason})
