"""Report of a training run: learning curves, the three tests, the rule ``plan``, and several learners."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
from markupsafe import Markup

from ethbrake_marl.agent_names import AGENTS
from ethbrake_marl.episode.counts import IMPACT_COUNTS, HarmCount
from ethbrake_marl.errors import Unfamiliar
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.evaluate import evaluate
from ethbrake_marl.evaluation.results import write_results
from ethbrake_marl.evaluation.statistics import difference, mean
from ethbrake_marl.evaluation.summary import BASELINE, caption
from ethbrake_marl.extensions.report.best_known import REPORT_MEASURES
from ethbrake_marl.extensions.report.figures import curves_figure, harm_against_total_gap, trajectories
from ethbrake_marl.extensions.report.page import Section, drawing, table
from ethbrake_marl.extensions.report.report import SHORT_TABLE, ReportPage, Test, short_table
from ethbrake_marl.extensions.report.style import axis_title
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import Column, Estimate, Row, Sheet
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.training.experiment import (
    HYBRID,
    SHIELDED,
    TEAM,
    TEAM_BASELINES,
    Experiment,
    Tables,
    usable,
    without,
)
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.mixture import DESCRIPTIVE_KEYS
from ethbrake_marl.worlds.scenario import Scenario

REPORT_FILE = "report.html"
RULE = "plan"  # needs no training
RULE_WORLDS = 500  # in which it is compared; an evaluation of all would take longer than a training
TESTS = {
    "paper-random": "Main test: Vehicle 2 may drive, and there is no obstacle ahead of Vehicle 1. Neither first-impact"
    " nor total harm includes pushing Vehicle 1; the honest cost does.",
    "paper-random-brake-only": "Brake-only test: the same worlds, but Vehicle 2 may only brake and coast, so it cannot"
    " push with its engine.",
    "paper-random-obstacle": "Obstacle test: the same worlds with an obstacle 1.7 m beyond the place where Vehicle 1"
    " stops by itself. An impact of Vehicle 1 with the obstacle is harm.",
}


class RunReport:
    measures: tuple[str, ...] = (*Tables.measures, *REPORT_MEASURES)

    def write(self, experiment: Experiment, tell: OnProgress) -> tuple[Sequence[Any], str]:
        compared, folder = experiment.compared, experiment.trained.directory
        single = experiment.learned != TEAM
        tests, stage_numbers = other_tests(compared.scenario) if single else [], count()

        def begin(stage: str) -> None:
            tell(Progress(f"report{stage and ': '}{stage}", next(stage_numbers), 3 + len(tests)))

        begin(f"the rule {RULE}")
        rule = beside_rule(experiment, tell)
        test_results: dict[str, Comparison] = {}
        for test in tests:
            begin(f"the same policy in {test.name}")
            with warnings.catch_warnings():  # the page says on what the policy was trained
                warnings.simplefilter("ignore", Unfamiliar)
                test_results[test.name] = experiment.in_another(
                    test, compared.result.n, TEAM_BASELINES, Tables.measures
                )
            write_results(folder, test_results[test.name].table, name=f"results-{test.name}.json", force=True)
        learners = [] if single else learners_sheets(compared)
        sheets = learners if rule is None else [short_sheet(rule), *learners]
        begin("figures")
        figures = run_figures(experiment)
        begin("page and episodes")
        report_page(experiment, test_results, figures, rule, learners).write(folder / REPORT_FILE, force=True)
        begin("")
        return [short_sheet(compared), *sheets], f"report with all measures: {folder / REPORT_FILE}"


def beside_rule(experiment: Experiment, tell: OnProgress) -> Comparison | None:
    """The learned agents and the rule in the first worlds of the list; None where the rule cannot drive."""
    compared, rules = experiment.compared, [RULE] if RULE in AGENTS else []
    rules = usable("rules", rules, lambda name: evaluate(compared.scenario, name, episodes=1), tell)
    worlds = min(compared.result.n, RULE_WORLDS)
    return experiment.in_another(compared.scenario, worlds, (BASELINE, *rules), Tables.measures) if rules else None


def rule_section(compared: Comparison, learned: str) -> Section:
    result, count = compared.result, compared.harm_count
    more = difference(result[learned][count.column], result[RULE][count.column], result.clusters)
    words = count.words
    text = (
        f"The rule {RULE} needs no training. {words.capitalize()} of the {learned} minus {words} of the rule, mean of"
        f" the first {result.n:,} worlds of the list: {more.in_words()} m²/s²."
    )
    return Section(f"The rule {RULE}", [text, short_table(compared.table, count)])


def other_tests(scenario: Scenario) -> list[Scenario]:
    """The other two of the three shipped tests. Empty unless ``scenario`` is one of the three, unchanged."""
    tests = {name: load_scenario(name) for name in TESTS}
    shipped = tests.pop(scenario.name, None)
    if shipped is None or shipped.content(without=DESCRIPTIVE_KEYS) != scenario.content(without=DESCRIPTIVE_KEYS):
        return []
    return [*tests.values()]


def title_of(name: str) -> str:
    return TESTS[name].partition(":")[0]


def short_sheet(compared: Comparison) -> Sheet:
    """Table of the agents for a terminal, with the columns of ``SHORT_TABLE``."""
    sheet = compared.table.terminal()
    return replace(sheet.only(k for k, name in enumerate(sheet.names) if k == 0 or name in SHORT_TABLE), keep=None)


def run_figures(experiment: Experiment) -> list[Markup]:
    """Learning curve, harm against the total gap, and one episode, as HTML."""
    compared, learned, trained = experiment.compared, experiment.learned, experiment.trained
    training, recipe = trained.training, trained.training.recipe
    typical_row = typical_row_of(compared, learned)
    world, number = compared.worlds([typical_row]), int(compared.result.worlds["world"][typical_row])
    plan = recipe.evaluation
    curves = {
        **{axis_title(count): count.column for count in _counts(compared)},
        "Share of collisions": "collision_rate",
    }
    course = (
        f"{training.scenario.name}: worlds 0 to {plan.worlds - 1} of the list of seed {plan.seed} at every point;"
        f" training seed {recipe.seed}."
    )
    references = []
    if training.scenario == compared.scenario:
        references = [row for row in compared.table if row.agent in TEAM_BASELINES]
        course += f" Horizontal lines: {caption(compared.table.parameters)}."
    beside = [agent for agent in compared.teams if agent in (*TEAM_BASELINES, learned)]
    figures = [
        (
            "Learning curve",
            "Harm and collisions on a fixed list of worlds during the training.",
            curves_figure(
                {
                    title: {learned: {point["steps"]: Estimate(point[key], None) for point in trained.evaluations}}
                    for title, key in curves.items()
                },
                "Training steps",
                course,
                lines={
                    title: {row.agent: estimate.value for row in references if (estimate := row[key]) is not None}
                    for title, key in curves.items()
                },
            ),
        ),
        (
            "Harm against the total initial gap",
            "Mean harm of each agent in worlds grouped by the sum of their gaps at the alert.",
            harm_against_total_gap(compared.result),
        ),
        (
            "One episode",
            f"World {number} of the list, driven by these agents. It is a typical world: among the worlds in which full"
            f" braking collides, the harm that the {learned} avoids is the median here.",
            trajectories(world, {agent: compared.teams[agent] for agent in beside}, scenario=compared.scenario),
        ),
    ]  # fmt: skip
    return [drawing(figure, title, description) for title, description, figure in figures]


def typical_row_of(compared: Comparison, learned: str) -> int:
    """Row with the median saving of harm among the worlds in which full braking does harm; 0 if there are none."""
    harm = compared.harm_count.column
    before = compared.result[BASELINE][harm]
    rows = np.flatnonzero(before > 0.0)
    if not len(rows):
        return 0
    saved = before[rows] - compared.result[learned][harm][rows]
    return int(rows[np.argsort(saved, kind="stable")[(len(rows) - 1) // 2]])


def report_page(
    experiment: Experiment,
    test_results: Mapping[str, Comparison],
    figures: Sequence[Markup],
    rule: Comparison | None,
    learners: Sequence[Sheet],
) -> ReportPage:
    """Page about a training run: settings, the compared agents, and other tests."""
    trained, compared, learned = experiment.trained, experiment.compared, experiment.learned
    training, recipe, name = trained.training, trained.training.recipe, compared.scenario.name
    steps = next(iter(trained.policies.values())).manifest.steps
    reward = recipe.reward.model_dump(exclude_defaults=True)
    if reward.keys() <= {"harm_count"}:
        reward = {"minus the": recipe.reward.harm_count.words}
    facts = {
        "Training": f"{recipe.title or recipe.name}, on {training.scenario.name}: {trained.steps:,} steps of"
        f" {recipe.total_steps:,} ({trained.status}), {trained.wall_s:.0f} s",
        "Seeds": f"training {recipe.seed}, evaluation list {compared.result.about['seed']}",
        "Reward": ", ".join(f"{key} {value}" for key, value in reward.items()),
        "Objective": training.objective,
        "Agents minimise": compared.harm_count.words,
        "Whole run": f"{time.monotonic() - experiment.started:.0f} s",
        "Settings": ", ".join(read_object(RunFolder(trained.directory).config).get("settings", ())),
    }
    scheme = f" and the scheme {training.scheme}" if learned == TEAM else ""
    summary = (
        f"The {learned} learned by the recipe {recipe.name}, with the algorithm {recipe.algorithm}{scheme}"
        f" (docs/train.md). It is the best of those measured during the training: that of step {steps:,}."
    )
    if learned == TEAM:
        summary += f" The agent “{SHIELDED}” is the trained team with the step shield."
        summary += " In the agent “all but” a vehicle, this vehicle brakes fully instead."
    else:
        summary += f" The agent “{HYBRID}” is the trained policy with the paper's shield."
    if test_results:
        summary += f" {TESTS[name]} The results of the other two tests are further below."
    stopped = f"The training was interrupted. This is the {learned} after {steps:,} steps."
    return ReportPage(
        f"ethbrake run: {name}",
        compared,
        summary,
        {key: value for key, value in facts.items() if value},
        focus=learned,
        sections=[
            *([] if rule is None else [rule_section(rule, learned)]),
            Section("Several learners", [table(sheet) for sheet in learners]),
        ],
        figures=figures,
        tests={title_of(test): Test(TESTS[test], comparison) for test, comparison in test_results.items()},
        remarks=[stopped] if trained.status == "interrupted" else (),
    )


def learners_sheets(compared: Comparison) -> list[Sheet]:
    return [*(_borne_sheet(compared, count) for count in _counts(compared)), _added_sheet(compared)]


def _counts(compared: Comparison) -> list[HarmCount]:
    return [*dict.fromkeys([*IMPACT_COUNTS, compared.harm_count])]


def _borne_sheet(compared: Comparison, count: HarmCount) -> Sheet:
    scenario, by = compared.scenario, compared.result.clusters
    names = [name.replace("_", " ").capitalize() for name in scenario.vehicle_names]
    columns = [Column("Agent", "agent", text=True)]
    columns += [Column(heading, interval="hidden") for heading in (*names, "Whole line")]
    endings = [*(f"_{i + 1}" for i in range(len(names))), ""]
    rows: list[Row] = [
        (agent, *(mean(harm_columns[count.column + ending], by) for ending in endings))
        for agent, harm_columns in compared.result.columns.items()
    ]
    learn = ", ".join(names[body - 1] for body in scenario.learners)
    return Sheet(f"Who bears what: {count.words}, mean per world (m²/s²)", columns, rows, f"{learn} learn.")


def _added_sheet(compared: Comparison) -> Sheet:
    """Table of the harm that is added if a learner of the trained team brakes fully instead, for each learner."""
    result, counts, rows = compared.result, _counts(compared), list[Row]()
    for name in (compared.scenario.vehicle_names[body - 1] for body in compared.scenario.learners):
        pairs = ((result[without(name)][count.column], result[TEAM][count.column]) for count in counts)
        rows.append(
            (name, *(difference(harm_without, team_harm, result.clusters) for harm_without, team_harm in pairs))
        )
    columns = [Column("Learner", text=True)]
    columns += [Column(count.words.capitalize(), sign="+") for count in counts]
    about = (
        "How much more harm there is without it: the vehicle brakes fully, and the others were not trained for that."
    )
    return Sheet("What each learner adds, mean per world (m²/s²)", columns, rows, about)
