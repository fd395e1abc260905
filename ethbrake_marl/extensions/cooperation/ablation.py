"""Run an ablation, a comparison of trainings at several levels of cooperation, and estimate its cost."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.extensions.cooperation.joint_optimum import measure, questions
from ethbrake_marl.extensions.cooperation.levels import Json, Plan, common_worlds
from ethbrake_marl.extensions.cooperation.page import write_ablation
from ethbrake_marl.extensions.search.best_harm import best_harm, chunks_left
from ethbrake_marl.extensions.studies.trainings import Timed, train_all
from ethbrake_marl.game.harm import HARM_COUNTS
from ethbrake_marl.progress import OnProgress
from ethbrake_marl.scenario.task import Task
from ethbrake_marl.shield.episodes import drive_shielded
from ethbrake_marl.training.team import load_team


def run_ablation(
    plan: Plan, jobs: int = 1, machine: str = "", tell: OnProgress | None = None
) -> tuple[Json, list[Path]] | None:
    """Run all trainings of an ablation, measure the trained policies, and write all files, replacing existing ones.

    Args:
        plan: settings of the ablation.
        jobs: number of trainings at once.
        machine: description of this machine, which is recorded.
        tell: called with the progress; None: silent.

    Returns the content of ``ablation.json``, and the paths of page, Markdown and figures. Returns None if Ctrl-C
    stopped the trainings. Raises the exceptions of ``StudyFolder.work``, ``train_all`` and ``measure``.

    """
    with plan.study_folder().work():
        if not train_all([training for _, _, training in plan.trainings()], jobs, tell):
            return None
        return write_ablation(plan, measure(plan, jobs, tell), machine)


def ablation_cost(plan: Plan) -> str:
    """Return a text for users that estimates the remaining work of an ablation in time of one core.

    To estimate it, a short training of each level and recipe, an evaluation and a search are timed by the wall clock,
    so other work on the machine makes the estimate larger. If results of earlier searches for the joint optimum are
    damaged, the text has a line for each of them.

    Raises the exceptions of ``TrainingJob.steps_left``, and those of ``load_team`` for a finished training whose
    policies cannot be loaded.
    """
    left = [(level, algorithm, training, training.steps_left()) for level, algorithm, training in plan.trainings()]
    decisions: Counter[tuple[str, str]] = Counter()
    for level, algorithm, training, steps in left:
        decisions[level.name, algorithm] += steps
        if not steps:
            load_team(training.folder, level.scenario)
    lists = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    samples = {level.name: sample for level, sample in zip(plan.levels, lists, strict=True)}
    kinds = {(level.name, algorithm): training for level, algorithm, training, _ in left}
    short = {kind: kinds[kind].time(samples[kind[0]]) for kind, steps in decisions.items() if steps}
    training_s = sum(each.seconds(decisions[kind]) for kind, each in short.items())
    level, _, first, _ = left[0]
    worlds_s = [each.world_s for each in short.values()] or [first.world_seconds(samples[level.name])]
    driving_s = sum(worlds_s) / len(worlds_s) * plan.episodes * (len(left) + len(plan.levels))
    for level in plan.levels if plan.shield else ():  # timed with full braking, which the shield replaces most often
        if level.scenario.learners:
            task, often = Task(level.scenario, level.scenario.learners), plan.seeds * len(plan.recipes)
            shielded = partial(drive_shielded, make_agent("full_brake"), task=task)
            world_s = Timed.each_s(samples[level.name].worlds, shielded)
            driving_s += plan.episodes * often * len(HARM_COUNTS) * world_s
    search_s, damaged = 0.0, []
    for level, part, _ in questions(plan, lists):
        number, broken = chunks_left(level.scenario, part, budget=plan.budget, chunks=plan.optimum_folder(level))
        damaged += broken
        if number:
            searching = partial(best_harm, level.scenario, budget=plan.budget, threads=1)
            search_s += number * Timed.each_s(part.worlds, searching, most=4)
    speed = f" at {decisions.total() / training_s:,.0f}/s" if training_s > 0.0 else ""
    told = Timed.in_words
    line = (
        f"to do: {sum(steps > 0 for *_, steps in left)} trainings, {decisions.total():,} decisions{speed}:"
        f" {told(training_s)}; joint optima {told(search_s)}; driving the common worlds {told(driving_s)};"
        f" together about {told(training_s + driving_s + search_s)} of one core"
    )
    return "\n".join([line, *(f"{file}: is damaged; its worlds are searched again" for file in damaged)])
