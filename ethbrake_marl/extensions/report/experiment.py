"""The report of ``ethbrake run``: an HTML page, three figures, and results of the policy on the other two tests."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.errors import Unfamiliar
from ethbrake_marl.extensions.report.episode_figure import trajectories
from ethbrake_marl.extensions.report.learners import learners_sheets
from ethbrake_marl.extensions.report.page import Part, Section
from ethbrake_marl.extensions.report.paper_rows import is_papers_test, with_paper_rows
from ethbrake_marl.extensions.report.report import Report
from ethbrake_marl.extensions.report.run_figures import harm_against_total_gap, learning_curve
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.extensions.report.three_tests import TESTS, brief, other_tests
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.first_edition.agents.learned import TRAINED_POLICY, TRAINED_TEAM
from ethbrake_marl.first_edition.agents.protocol import Driver
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.record import record_episode
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.summary import SummaryTable, summarise
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.game.rewards import RewardParams
from ethbrake_marl.first_edition.policies.manifest import installed_versions
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.experiment import (
    HYBRID,
    SHIELDED_TEAM,
    Experiment,
    RunReport,
    compared_agents,
    write_results,
)
from ethbrake_marl.first_edition.training.progress import objective_in_words
from ethbrake_marl.progress import OnProgress, Progress

BESIDE = ("full_brake", "e_v2x_bm")  # agents shown together with the policy in the figures and the other two tests

MOST_WORLDS = 2_000  # largest number of worlds in each of the other two tests


def make_report(experiment: Experiment, tell: OnProgress) -> RunReport:
    """Evaluate the policy on the other two tests, draw figures, write ``report.html``, and return the text to print."""
    evaluation, folder = experiment.evaluation, experiment.run.path
    others, done = other_tests(evaluation.scenario) if len(evaluation.vehicles) == 1 else (), count()

    def begin(stage: str) -> None:
        """Report that ``stage`` begins; an empty ``stage`` means that all stages have ended."""
        tell(Progress(f"report{stage and ': '}{stage}", next(done), 2 + len(others)))

    is_papers = is_papers_test(evaluation.task, evaluation.seed)
    rows = with_paper_rows(experiment.rows) if is_papers else experiment.rows
    beside: dict[str, SummaryTable] = {}
    for other in others:  # the policy was trained only on the scenario of the run
        begin(f"the same policy on {other.name}")
        beside[other.name] = _drive_other_test(experiment, other)
    if beside:
        flat = [row for table in beside.values() for row in table]
        write_results(folder, "other_tests", flat, experiment.harm_count)
    learners = learners_sheets(evaluation) if experiment.learned == TRAINED_TEAM else []
    begin("figures")
    config = read_object(experiment.run.config)
    figures = write_figures(
        folder,
        evaluation,
        rows,
        course=experiment.trained.evaluations,
        course_caption=_caption(experiment, config),
        agents=experiment.agents,
        learned=experiment.learned,
        harm_count=experiment.harm_count,
    )
    begin("page and episodes")
    page = folder / "report.html"
    report = _page(experiment, rows, beside, figures, learners, config)
    report.driven(experiment.agents).write(page, force=True)
    begin("")
    with_rows = " and the paper's rows" if is_papers else ""
    return RunReport(
        (brief(rows, beside), *rows.tables()[1:], *learners), f"report with all measures{with_rows}: {page}"
    )


def _drive_other_test(experiment: Experiment, test: Scenario) -> SummaryTable:
    """Evaluate the trained policy (without and with a shield) and the baselines in ``test``, and return the results."""
    evaluation = experiment.evaluation
    worlds = test.sample(min(evaluation.worlds.n, MOST_WORLDS), experiment.list_seed)
    agents = compared_agents(experiment.trained.trained, test, experiment.harm_count, BESIDE)
    with warnings.catch_warnings():  # the page says that the policy was not trained for this test
        warnings.simplefilter("ignore", Unfamiliar)
        return summarise(evaluate(worlds, agents, scenario=test, seed=experiment.list_seed))


def write_figures(
    folder: Path,
    evaluation: Evaluation,
    rows: Sequence[SummaryRow],
    *,
    course: Sequence[Mapping[str, float]],
    course_caption: str,
    agents: Mapping[str, Driver],
    learned: str = TRAINED_POLICY,
    harm_count: HarmCount = "first",
) -> list[Part]:
    """Draw the three figures, write them as PNG files into ``folder``, and return them as parts of an HTML page.

    ``course`` are evaluations during the training, each with ``steps``, ``first_impact_harm``, ``total_harm`` and
    ``collision_rate``; ``course_caption`` is the caption of this learning curve. ``learned`` is the name of the trained
    policy or team in ``agents``; it and two baselines drive a typical world again for the third figure. ``harm_count``
    is the count by which this world is chosen.
    """
    references = [row for row in rows if row.agent in BESIDE]
    shown = telling_world(evaluation, harm_count, learned)
    world, row = int(evaluation.index[shown]), evaluation.worlds.take([shown])
    records = {name: record_episode(row, agents[name], scenario=evaluation.scenario) for name in (*BESIDE, learned)}
    drawn = {
        "learning_curve.png": (
            "Learning curve",
            "Harm and collisions on a fixed list of worlds during the training. The horizontal lines are baselines.",
            learning_curve(course, learned=learned, references=references, caption=course_caption),
        ),
        "harm_against_gap.png": (
            "Harm against the total initial gap",
            "Mean harm of each agent in worlds grouped by the sum of their gaps at the alert.",
            harm_against_total_gap(evaluation),
        ),
        "trajectories.png": (
            "One episode",
            f"World {world} of the list, driven by three agents. It is a typical world: among the worlds in which full"
            f" braking collides, the harm that the {learned} avoids is the median here.",
            trajectories(records),
        ),
    }
    for name, (_, _, figure) in drawn.items():
        write_picture(folder / name, figure, force=True)
    return [Part.drawing(figure, title, description) for title, description, figure in drawn.values()]


def telling_world(evaluation: Evaluation, harm_count: HarmCount = "first", learned: str = TRAINED_POLICY) -> int:
    """Return the index of a typical world: the world in which ``learned`` reduces the harm by the median amount.

    The reduction is the harm of full braking minus the harm of ``learned``, the trained policy or team. The median is
    taken over the worlds in which full braking does harm; without such worlds, the function returns 0.
    """
    before = evaluation.outcome(BESIDE[0]).world_harm(harm_count)
    rows = np.flatnonzero(before > 0.0)
    if not len(rows):
        return 0
    saved = before[rows] - evaluation.outcome(learned).world_harm(harm_count)[rows]
    order = np.argsort(saved, kind="stable")
    return int(rows[order[(len(order) - 1) // 2]])


def _caption(experiment: Experiment, config: Mapping[str, Any]) -> str:
    plan, seed = config["recipe"]["evaluation"], config["seeds"]["training"]
    return (
        f"{experiment.evaluation.scenario.name}: worlds 0 to {plan['worlds'] - 1} of the list of seed {plan['seed']} at"
        f" every point; training seed {seed}. Horizontal lines: {experiment.rows[0].parameters.line}."
    )


def _page(
    experiment: Experiment,
    rows: SummaryTable,
    beside: Mapping[str, SummaryTable],
    figures: Sequence[Part],
    learners: Sequence[Sheet],
    config: Mapping[str, Any],
) -> Report:
    trained, evaluation, harm_count = experiment.trained, experiment.evaluation, experiment.harm_count
    reward = RewardParams(**config["recipe"]["reward"]).model_dump(exclude_defaults=True)
    facts = {
        "Training": f"{config['recipe']['title'] or config['recipe']['name']}: {trained.steps:,} steps"
        f" of {config['recipe']['total_steps']:,} ({trained.status}), {trained.wall_s:.0f} s",
        "Start": trained.training.begins,
        "Seeds": f"training {config['seeds']['training']}, evaluation list {evaluation.seed}",
        "Reward": ", ".join(f"{name} {value}" for name, value in reward.items()) or "minus the first-impact harm",
        "Objective": objective_in_words(trained.training),
        "Harm that agents minimise": "first impacts only" if harm_count == "first" else "every impact",
        "Whole run": f"{time.monotonic() - experiment.started:.0f} s",
        "Settings": ", ".join(config.get("settings", ())),
    }
    manifest, name = next(iter(trained.policies.values())).manifest, evaluation.scenario.name
    how = f"{manifest.algorithm}, scheme {trained.training.scheme}"
    which = (
        f"The {experiment.learned} was trained with {manifest.algorithm if len(trained.policies) == 1 else how}. It was"
        f" saved after {manifest.steps:,} steps, when it did the least harm in the worlds that the recipe names"
    )
    if experiment.learned == TRAINED_TEAM:
        summary = f"{which}. The agent “{SHIELDED_TEAM}” is the trained team with a shield in step mode."
        summary += " In the agent “all but” a vehicle, this vehicle brakes fully instead."
    else:
        summary = f"{which}. The agent “{HYBRID}” is the trained policy with the paper's shield."
    if beside:
        summary += f" {TESTS[name]} The results of the other two tests are further below."
    stopped = f"The training was interrupted. This is the {experiment.learned} after {manifest.steps:,} steps."
    return Report(
        f"ethbrake run: {name}",
        rows,
        evaluation,
        focus=experiment.learned,
        sections=[Section("Several learners", list(map(Part.table, learners)))],
        figures=figures,
        tests=[(TESTS[name].partition(":")[0], TESTS[name], other) for name, other in beside.items()],
        harm_count=harm_count,
        remarks=[stopped] if trained.status == "interrupted" else [],
        summary=summary,
        settings={name: value for name, value in facts.items() if value},
        versions=installed_versions(),
    )
