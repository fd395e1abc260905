"""Run an ablation (train and compare policies at several levels of cooperation), and estimate how long this takes."""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from typing import NamedTuple

from ethbrake_marl.extensions.cooperation.joint_optimum import measure, questions
from ethbrake_marl.extensions.cooperation.levels import Json, Plan, common_worlds
from ethbrake_marl.extensions.cooperation.results import write_ablation
from ethbrake_marl.extensions.search.best_harm import best_harm, chunks_left
from ethbrake_marl.extensions.studies.trainings import Timed, train_all
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.shields.episodes import drive_shielded
from ethbrake_marl.first_edition.training.team import load_team
from ethbrake_marl.progress import OnProgress


def run_ablation(
    plan: Plan, jobs: int = 1, machine: str = "", tell: OnProgress | None = None
) -> tuple[Json, list[Path]] | None:
    """Do all training runs of an ablation, evaluate the trained policies, and write results and figure.

    ``jobs`` is the number of training runs at the same time, and of threads in the search for joint optima. ``machine``
    describes the computer; it is stored with the results. Returns the content of ``ablation.json``, and the paths of
    the JSON file, the CSV file and the figure. Returns None if Ctrl-C stopped the training runs. Output files of an
    earlier call are replaced. Raises the exceptions of ``StudyFolder.work``, ``train_all`` and ``measure``.
    """
    with plan.study_folder().work():
        if not train_all([training for _, _, training in plan.trainings()], jobs, tell):
            return None
        return write_ablation(plan, measure(plan, jobs, tell), machine)


class Cost(NamedTuple):
    """Estimate of the time that an ablation still needs. All times are processor time of one core, in s."""

    trainings: int  # number of unfinished trainings
    decisions: int  # number of decisions that these trainings still need
    training_s: float  # time for trainings (s)
    search_s: float  # time for searches of joint optima (s)
    driving_s: float  # time for evaluating the trained policies (s)
    training_folders: int  # number of folders of trainings, finished trainings included
    search_folders: int  # number of folders of searches
    damaged: tuple[Path, ...]  # damaged result files of searches; the search of their worlds is repeated

    @property
    def total_s(self) -> float:
        """Training, search and evaluation together, s."""
        return self.training_s + self.search_s + self.driving_s

    def to_json(self) -> Json:
        return {**self._asdict(), "damaged": [str(file) for file in self.damaged], "total_s": self.total_s}

    def __str__(self) -> str:
        """Return the estimate as text, with one more line for each damaged file."""
        speed = f" at {self.decisions / self.training_s:,.0f}/s" if self.training_s > 0.0 else ""
        text = Timed.in_words
        line = (
            f"to do: {self.trainings} trainings, {self.decisions:,} decisions{speed}: {text(self.training_s)}; joint"
            f" optima {text(self.search_s)}; driving the common worlds {text(self.driving_s)}; together about"
            f" {text(self.total_s)} of one core"
        )
        return "\n".join([line, *(f"{file}: is damaged; its worlds are searched again" for file in self.damaged)])


HOW_MEASURED = (
    "processor time of short trials, which are not stored: four updates of each recipe, 50 worlds evaluated, 4 searched"
    " (in a sweep: for one of its values)"
)


def ablation_cost(plan: Plan) -> Cost:
    """Estimate the time that an ablation still needs.

    The function measures the time of a short training run for each level and recipe, of a short evaluation, and of a
    short search for the joint optimum. In a sweep it measures only one level, because all levels take about the same
    time.

    Raises the exceptions of ``TrainingJob.steps_left``. Raises the exceptions of ``load_team`` if the policies of a
    finished training run cannot be loaded.
    """
    left = [(level, algorithm, training, training.steps_left()) for level, algorithm, training in plan.trainings()]
    decisions: Counter[tuple[str, str]] = Counter()  # (scenario, algorithm) -> number of decisions
    for level, algorithm, training, steps in left:
        decisions[level.scenario.name, algorithm] += steps
        if not steps:
            load_team(training.folder, level.scenario)
    lists = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    pairs = zip(reversed(plan.levels), reversed(lists), strict=True)  # the first level of a sweep stays
    samples = {level.scenario.name: sample for level, sample in pairs}
    kinds = {(level.scenario.name, algorithm): training for level, algorithm, training, _ in reversed(left)}
    short = {kind: kinds[kind].time(samples[kind[0]]) for kind, steps in decisions.items() if steps}
    training_s = sum(each.seconds(decisions[kind]) for kind, each in short.items())
    level, _, first, _ = left[0]
    worlds_s = [each.world_s for each in short.values()] or [first.world_seconds(samples[level.scenario.name])]
    driving_s = sum(worlds_s) / len(worlds_s) * plan.episodes * (len(left) + len(plan.levels))
    shielded_s: dict[str, float] = {}
    for level in plan.levels if plan.shield else ():  # timed with full braking, because the shield replaces it often
        if level.scenario.learners:
            task, often = Task(level.scenario, level.scenario.learners), plan.seeds * len(plan.recipes)
            name, shielded = level.scenario.name, partial(drive_shielded, make_agent("full_brake"), task=task)
            if name not in shielded_s:
                shielded_s[name] = Timed.each_s(samples[name].worlds, shielded)
            driving_s += plan.episodes * often * len(HARM_COUNTS) * shielded_s[name]
    search_s, damaged, searches = 0.0, [], questions(plan, lists)
    searched_s: dict[str, float] = {}
    for level, part, _ in searches:
        number, broken = chunks_left(level.scenario, part, budget=plan.budget, chunks=plan.optimum_folder(level))
        damaged += broken
        name = level.scenario.name
        if number and name not in searched_s:
            searching = partial(best_harm, level.scenario, budget=plan.budget, threads=1)
            searched_s[name] = Timed.each_s(part.worlds, searching, most=4)
        search_s += number * searched_s.get(name, 0.0)
    started = sum(steps > 0 for *_, steps in left)
    return Cost(started, decisions.total(), training_s, search_s, driving_s, len(left), len(searches), tuple(damaged))
