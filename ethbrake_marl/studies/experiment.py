"""The main job, end to end: train a policy, shield it, measure both against the baselines, and show the result."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.defaults import EPISODES, LIST_SEED
from ethbrake_marl.errors import InvalidInput, OnProgress, Progress, count_of
from ethbrake_marl.evaluation import (
    Evaluation,
    SummaryRow,
    evaluate,
    parameter_line,
    record_episode,
    summarise,
    write_per_world_csv,
)
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, make_agents
from ethbrake_marl.evaluation.measures import BASELINE
from ethbrake_marl.evaluation.outcome import MAIN_TEST, TESTS, other_tests
from ethbrake_marl.evaluation.results import PER_WORLD, results_to_json, write_output
from ethbrake_marl.evaluation.rollout import controlled_vehicle
from ethbrake_marl.figures.evaluation import harm_against_total_gap, learning_curve, trajectories
from ethbrake_marl.figures.style import picture_bytes
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.learning.recipe import TrainingRecipe, algorithm_names
from ethbrake_marl.learning.train import TrainResult, train
from ethbrake_marl.learning.training import RunDirectory, RunStatus, read_object
from ethbrake_marl.pages.report import Report, ReportFigure, ReportTest, play_for_report, shield_evidence, write_report
from ethbrake_marl.policies.actor import installed_versions
from ethbrake_marl.policies.bundle import Policy
from ethbrake_marl.rewards import RewardParams
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield import HybridAgent

# The results of an experiment beside its policy: CSV and JSON, every world, three figures and one page.

REFERENCES = ("full_brake", "e_v2x_bm")  # level lines beside the learning curve
SHOWN = ("full_brake", "e_v2x_bm")  # columns of the figure of one episode, and the policy

LEARNING_CURVE = "learning_curve.png"
HARM_AGAINST_GAP = "harm_against_gap.png"
TRAJECTORIES = "trajectories.png"


def write_results(folder: Path, name: str, rows: Sequence[SummaryRow], per_world: Path | None = None) -> None:
    """Write the rows as ``NAME.json`` and, flat, as ``NAME.csv``."""
    content = json.dumps(results_to_json(rows, per_world=per_world), indent=2, allow_nan=False) + "\n"
    write_output(folder / f"{name}.json", content.encode(), force=True)
    write_output(folder / f"{name}.csv", results_csv(rows).encode(), force=True)


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


RUNS = Path("runs")
BASELINES = ("full_brake", "e_v2x_bm", "e_v2x_bm:pairwise")
BESIDE = ("full_brake", "e_v2x_bm")  # baselines on the other two of the three tests
BESIDE_EPISODES = 2_000  # at most so many worlds of each

Ended = Literal["finished", "interrupted"]


@dataclass(frozen=True, slots=True)
class ExperimentResult:
    """What an experiment left behind."""

    directory: Path
    status: Ended  # interrupted: the policy was not trained to the end, everything else is there
    steps: int
    rows: list[SummaryRow]
    report: Path
    beside: Mapping[str, list[SummaryRow]] = field(default_factory=dict)  # by test: the other two of the three tests


def run_folder(
    scenario: Scenario,
    recipe: TrainingRecipe,
    *,
    seed: int | None = None,
    name: str | None = None,
    output: Path | None = None,
) -> Path:
    """Folder of a run: ``output``, or ``runs/<name>``, by default ``runs/<scenario>-<recipe>-seed<seed>``.

    The default has the scheme behind the recipe where the recipe names one. Raises ``InvalidInput`` when both are
    given, or for a name that is not a plain folder name.
    """
    if output is not None:
        if name is not None:
            raise InvalidInput(f"name {name!r} and output {str(output)!r}: give one of the two")
        return output
    if name is not None and not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,127}", name):
        raise InvalidInput(
            f"run name {name!r:.60}: must be up to 128 letters, digits, . _ -, not beginning with . or -"
        )
    plan = recipe.name if recipe.scheme is None else f"{recipe.name}-{recipe.scheme}"
    return RUNS / (name or f"{scenario.name}-{plan}-seed{recipe.seed if seed is None else seed}")


def run_experiment(
    scenario: Scenario,
    directory: Path,
    *,
    recipe: TrainingRecipe,
    steps: int | None = None,
    seed: int | None = None,
    episodes: int = EPISODES,
    list_seed: int = LIST_SEED,
    stop_when_lost: bool = False,
    force: bool = False,
    settings: Sequence[str] = (),
    on_progress: OnProgress | None = None,
) -> ExperimentResult:
    """Train a policy on ``scenario``, evaluate it, its hybrid and the baselines on a fixed list, write everything.

    On one of the three tests the policy also drives the other two, which it was not trained for.

    ``seed`` is the training's; the list is ``episodes`` worlds of ``list_seed``; ``settings`` are noted;
    ``stop_when_lost`` is as in ``train``.
    Ctrl-C during the training ends it
    after the update in progress, and the policy so far is evaluated; a second one, or one during the evaluation,
    raises ``KeyboardInterrupt``, and the folder keeps the policy. ``run.json`` always says which. Raises what
    ``train`` and ``evaluate`` raise, ``AlreadyExists`` for an existing run before any work.
    """
    started = time.monotonic()
    tell = on_progress or (lambda progress: None)
    vehicle = controlled_vehicle(scenario, None)
    sample = scenario.sample(episodes, list_seed)
    trained = train(
        recipe,
        scenario,
        directory,
        steps=steps,
        seed=seed,
        force=force,
        stop_when_lost=stop_when_lost,
        settings=settings,
        on_progress=on_progress,
    )
    run = RunDirectory(trained.directory)
    with _status(run, trained.status):
        agents = _agents(trained.policy, scenario)
        total = sample.worlds.n
        if trained.status == "interrupted":
            note = (
                f"interrupted after {trained.steps:,} steps: evaluating the policy so far; Ctrl-C again stops at once"
            )
            tell(Progress(next(iter(agents)), 0, total, note=note))
        evaluation = evaluate(
            sample,
            agents,
            scenario=scenario,
            vehicle=vehicle,
            seed=list_seed,
            chunk=PROGRESS_EVERY,
            on_progress=lambda name, done: tell(Progress(name, done, total)),
        )
        begin = _stages(tell, 3 + len(other_tests(scenario)))
        begin("what nobody can avoid in these worlds, proven world by world")
        rows = summarise(evaluation)
        beside = _beside(trained.policy, scenario, min(episodes, BESIDE_EPISODES), list_seed, begin)
        begin("results and figures")
        per_world = run.path / PER_WORLD
        write_per_world_csv(per_world, evaluation, force=True)
        write_results(run.path, "results", rows, per_world)
        if beside:
            write_results(run.path, "other_tests", [row for rows in beside.values() for row in rows])
        wall_s = time.monotonic() - started
        report = _show(run, evaluation, rows, beside, trained, agents, begin, wall_s=wall_s)
        begin("")
    return ExperimentResult(run.path, trained.status, trained.steps, rows, report, beside)


def _stages(tell: OnProgress, total: int) -> Callable[[str], None]:
    """What is to be called when each of so many parts of the report begins, with a line about it, and at the end."""
    done = count()
    return lambda note: tell(Progress("report", next(done), total, note=note))


def _beside(
    policy: Policy, scenario: Scenario, episodes: int, list_seed: int, begin: Callable[[str], None]
) -> dict[str, list[SummaryRow]]:
    """The same policy, trained on ``scenario`` alone, on the other two of the three tests, beside two baselines."""
    found: dict[str, list[SummaryRow]] = {}
    for other in other_tests(scenario):
        begin(f"the same policy on {other.name}: {count_of(episodes, 'world')}")
        agents = _agents(policy, other, BESIDE)
        evaluation = evaluate(other.sample(episodes, list_seed), agents, scenario=other, seed=list_seed)
        found[other.name] = summarise(evaluation)
    return found


def _agents(policy: Policy, scenario: Scenario, baselines: Sequence[str] = BASELINES) -> dict[str, Agent]:
    """The baselines, the policy alone (``ppo`` or ``sac``), and the policy behind its shield (``hybrid``)."""
    name = policy.manifest.algorithm
    learned: dict[str, Agent] = {
        name: LearnedAgent(policy, name),
        "hybrid": HybridAgent(LearnedAgent(policy, name), scenario),
    }
    return {**make_agents(baselines, scenario), **learned}


def _show(
    run: RunDirectory,
    evaluation: Evaluation,
    rows: list[SummaryRow],
    beside: Mapping[str, list[SummaryRow]],
    trained: TrainResult,
    agents: Mapping[str, Agent],
    begin: Callable[[str], None],
    *,
    wall_s: float,
) -> Path:
    """Figures and page."""
    config = read_object(run.config)
    plan = config["recipe"]["evaluation"]
    caption = (
        f"{evaluation.scenario.name}: worlds 0 to {plan['worlds'] - 1} of the list of seed {plan['seed']} at every"
        f" point; training seed {config['seeds']['training']}. Level lines: {parameter_line(rows[0].parameters)}."
    )
    figures = write_figures(
        run.path, evaluation, rows, course=trained.evaluations, course_caption=caption, agents=agents
    )
    told = {
        "Training": f"{config['recipe']['title'] or config['recipe']['name']}: {trained.steps:,} steps"
        f" of {config['recipe']['total_steps']:,} ({trained.status}), {trained.wall_s:.0f} s",
        "Seeds": f"training {config['seeds']['training']}, evaluation list {evaluation.seed}",
        "Reward": _reward(config["recipe"]["reward"]),
        "Whole run": f"{wall_s:.0f} s",
        **_own_parts(config),
    }
    manifest = trained.policy.manifest
    which = f"Policy by {manifest.algorithm}, after {manifest.steps:,} steps (least harm on its own list)"
    summary = f"{which}, alone and behind its shield, against the baselines."
    if evaluation.scenario.name in TESTS and beside:
        summary += f" {TESTS[evaluation.scenario.name]} The other two tests stand below."
    if trained.status == "interrupted":
        summary += " The training was interrupted; this is the policy it had by then."
    begin("the page, and the episodes to watch there")
    name, learned = evaluation.scenario.name, learned_name(evaluation)
    spellings = {learned: f"{learned}@{run.path}", "hybrid": f"{learned}@{run.path}+episode"}
    report = Report(
        f"ethbrake run: {name}{' (the main test of three)' if beside and name == MAIN_TEST else ''}",
        rows,
        evaluation,
        play_for_report(evaluation, agents, learned, spellings=spellings),
        shield_evidence(agents, evaluation),
        learned,
        figures,
        [ReportTest(name, TESTS[name], other) for name, other in beside.items()],
        summary=summary,
        settings=told,
        versions=installed_versions(),
    )
    path = run.path / "report.html"
    write_report(path, report, force=True)
    return path


def _own_parts(config: Mapping[str, Any]) -> dict[str, str]:
    """What the command line changed or added: settings and plug-ins; nothing where there are none."""
    told = {
        "Settings": config.get("settings", ()),
        "Plug-ins": [f"{each['name']} (SHA-256 {each['sha256']})" for each in config["plugins"]],
    }
    return {what: ", ".join(each) for what, each in told.items() if each}


def _reward(given: dict[str, Any]) -> str:
    """The settings of a reward that are not its defaults."""
    own = RewardParams(**given).model_dump(exclude_defaults=True)
    return ", ".join(f"{name} {value}" for name, value in own.items()) or "minus the first-impact harm"


@contextmanager
def _status(run: RunDirectory, status: Ended) -> Iterator[None]:
    """Keep ``run.json`` true while the evaluation runs: ``running``, then the training's status or what went wrong."""
    _note(run, "running", "evaluation", None)
    try:
        yield
    except BaseException as error:
        _note(run, "interrupted" if isinstance(error, KeyboardInterrupt) else "failed", "evaluation", repr(error))
        raise
    _note(run, status, "report", None)


def _note(run: RunDirectory, status: RunStatus, stage: str, reason: str | None) -> None:
    """Bring ``run.json`` up to date; its steps and ``wall_s`` stay those of the training."""
    content = read_object(run.status)
    ended = None if status == "running" else datetime.now(UTC).isoformat(timespec="seconds")
    run.write_json(run.status, {**content, "status": status, "stage": stage, "ended_utc": ended, "reason": reason})
