"""Trainings, and the paper's learning curves (``fig:ppo_sac_high_latency``, ``fig:ppo_sac_low_latency``).

A further PPO is stopped before it has converged.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import RULES
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.curves import curves_figure, over_seeds
from ethbrake_marl.extensions.report.style import TITLES
from ethbrake_marl.extensions.reproduction.made import Drawn, Made, Settings
from ethbrake_marl.extensions.reproduction.verdicts import Less, Verdict, judge_statement
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats

HIGH, LOW, STOPPED = "high", "low", "stopped"
STATUS = "run.json"  # of a run


class Plan(NamedTuple):
    """Trainings by one recipe in one scenario, one for each seed."""

    scenario: str
    recipe: str
    decisions: int
    every_updates: int  # between two measurements
    seeds: int
    per_s: int  # decisions in a second on one core (Intel Xeon), to tell how long it takes


def _curves(scenario: str) -> tuple[Plan, ...]:
    return (
        Plan(scenario, "ppo", 400_000, 4, 3, 16_000),
        Plan(scenario, "sac", 60_000, 30, 3, 3_000),
        Plan(scenario, "ppo-paper", 100_000, 1, 3, 5_000),
        Plan(scenario, "sac-paper", 20_000, 1_000, 3, 170),
    )


GROUPS = {
    STOPPED: (Plan("paper-random", "ppo", 100_000, 4, 1, 16_000),),  # a fifteenth of the recipe's decisions
    HIGH: _curves("paper-delay-high"),
    LOW: _curves("paper-delay-low"),
}


def runs_of(folder: Path, group: str, plan: Plan) -> list[Path]:
    """Return the folders of the runs of a plan, one for each seed."""
    return [folder / "trainings" / group / f"{plan.recipe}-seed{seed}" for seed in range(plan.seeds)]


def is_finished(run: Path) -> bool:
    """Return whether a run has finished. Raises ``InvalidInput`` if its status is damaged."""
    status = run / STATUS
    return status.is_file() and read_object(status).get("status") == "finished"


def trained(folder: Path, group: str) -> dict[str, list[Path]]:
    """Return the runs of a group: recipe -> folder for each seed. A recipe with an unfinished run is left out."""
    every = {plan.recipe: runs_of(folder, group, plan) for plan in GROUPS[group]}
    return {recipe: runs for recipe, runs in every.items() if all(map(is_finished, runs))}


def seconds_left(folder: Path, groups: Iterable[str]) -> float:
    """Return about how long the runs take that have not finished, in processor seconds."""
    left = [
        plan.decisions / plan.per_s
        for group in groups
        for plan in GROUPS[group]
        for run in runs_of(folder, group, plan)
        if not is_finished(run)
    ]
    return sum(left)


def train(settings: Settings, groups: Iterable[str]) -> bool:
    """Do, or continue, the runs of some groups that have not finished. Return False if Ctrl-C stopped one.

    Raises ``MissingExtra`` without torch, and the errors of ``eb.train`` and ``eb.resume``.
    """
    for group in groups:
        for plan in GROUPS[group]:
            for seed, run in enumerate(runs_of(settings.folder, group, plan)):
                if not (is_finished(run) or _train(plan, run, seed, settings)):
                    return False
    return True


def _train(plan: Plan, run: Path, seed: int, settings: Settings) -> bool:
    import ethbrake_marl as eb

    if (run / STATUS).is_file():
        return eb.resume(run, on_progress=settings.tell).status == "finished"
    recipe = eb.load_recipe(plan.recipe)
    changes = {"log_every_updates": plan.every_updates} if hasattr(recipe, "log_every_updates") else {}
    measured = {**recipe.evaluation.model_dump(), "every_updates": plan.every_updates}
    reward = {**recipe.reward.model_dump(mode="json"), "harm_count": RULES["paper"]}
    recipe = recipe.replace(evaluation=measured, reward=reward, **changes)
    result = eb.train(recipe, plan.scenario, run, seed=seed, steps=plan.decisions, on_progress=settings.tell)
    return result.status == "finished"


def unconverged(folder: Path) -> str:
    """Return the spec of the policy "obtained from training before convergence occurred", which has been trained."""
    ((run,),) = trained(folder, STOPPED).values()
    return f"policy@{run / 'policy-last'}"


PAIRS = {  # stem of the figure -> what its recipes are, and the recipes
    "ours": ("our recipes", "ppo", "sac"),
    "paper": ("the paper's hyperparameters and reward", "ppo-paper", "sac-paper"),
}
RETURN, HARM = "rollout/ep_rew_mean", "eval/first_impact_harm"  # columns of progress.csv
SHOWN = Column("Final return", digits=3)

Values = Sequence[Mapping[int, float]]  # for each seed: decisions -> value; all seeds have the same decisions


class Course(NamedTuple):
    """Trainings by one recipe at one delay: two quantities over decisions, for each seed."""

    returns: Values  # mean return of training episodes
    harm: Values  # first-impact harm on the fixed list (m2/s2)

    @property
    def last_returns(self) -> Floats:
        """Mean return over the last tenth of the updates, [seeds]."""
        values = as_array(self.returns)
        return np.asarray(values[:, -max(values.shape[1] // 10, 1) :].mean(axis=1))

    @property
    def spread(self) -> Floats:
        """Standard deviation of the return over the seeds, at each of k steps of the second half, [k]."""
        values = as_array(self.returns)
        return np.asarray(values[:, values.shape[1] // 2 :].std(axis=0, ddof=1))


def as_array(values: Values) -> Floats:
    """Return values by seed and decision, [seeds, k]."""
    return np.array([[*each.values()] for each in values])


def column(run: Path, name: str) -> dict[int, float]:
    """Return a column of a run's table: decisions -> value, where there is one."""
    rows = csv.DictReader((run / "progress.csv").read_text("utf-8").splitlines())
    return {int(float(row["steps"])): float(row[name]) for row in rows if row.get(name)}


def courses_of(settings: Settings, delay: str) -> dict[str, Course]:
    """Return the trainings at a delay that have finished, by recipe; none without ``full``."""
    return {
        recipe: Course(*([column(run, name) for run in runs] for name in (RETURN, HARM)))
        for recipe, runs in (trained(settings.folder, delay) if settings.full else {}).items()
    }


def reproduce_curves(delay: str, settings: Settings) -> Made:
    """Reproduce the learning curves at one delay from the trainings of ``--full``."""
    courses = {each: courses_of(settings, each) for each in (HIGH, LOW)}
    own = courses[delay]
    if not own:
        return Made([Verdict(f"learning curves at {delay} delay", "not run", "no training; --full trains them")])
    figures = []
    for stem, (who, *recipes) in PAIRS.items():
        chosen = {recipe: own[recipe] for recipe in recipes if recipe in own}
        if chosen:
            title = f"Learning curves, {delay} delay, {who}"
            text = f"{title}: return and harm against decisions, mean over seeds; bands: one standard deviation."
            panels = {
                "Mean return of training episodes": {name: over_seeds(each.returns) for name, each in chosen.items()},
                f"{TITLES['first']}, fixed list": {name: over_seeds(each.harm) for name, each in chosen.items()},
            }
            figures.append(Drawn(f"learning-{delay}-{stem}", title, text, curves_figure(panels, "Decisions", text)))
    rows = []
    for name, each in own.items():
        harm = as_array(each.harm)
        last = max(each.harm[0])
        rows.append(
            (*(name, len(harm), f"{last:,}"), *(mean(harm.min(axis=1)), mean(harm[:, -1]), mean(each.last_returns)))
        )
    note = (
        "Harm: first-impact, m²/s², 1,000 worlds of seed 1007. Final return: of the last tenth of the updates. Means"
        " over seeds with t intervals. Recipes ppo and sac have other rewards and lengths: their returns are not"
        " compared."
    )
    numbers = map(Column, ("Seeds", "Decisions", "Kept policy, harm", "Last policy, harm"))
    sheet = Sheet(f"Trainings at {delay} delay", ("Recipe", *numbers, SHOWN), rows, note)
    return Made(judge(courses[HIGH], courses[LOW]), [sheet], figures)


def judge(high: Mapping[str, Course], low: Mapping[str, Course]) -> list[Verdict]:
    """Return verdicts on the paper's statements, from the paper's two recipes, which share a reward."""
    recipes = PAIRS["paper"][1:]
    claims = {
        "both algorithms reach higher returns at low delay than at high": "last_returns",
        "returns of different seeds spread more at low delay than at high": "spread",
        "nearly identical final returns at high delay; at low delay SAC converges faster, PPO is more stable": "",
    }
    if not all(name in courses for name in recipes for courses in (high, low)):
        missing = "ppo-paper and sac-paper are not both trained at both delays"
        return [Verdict(what, "not run", missing) for what in claims]
    return [
        judge_statement(
            what,
            [Less.of_lists(name, getattr(high[name], value), getattr(low[name], value)) for name in recipes],
            show=SHOWN,
        )
        if value
        else Verdict(what, "not run", "ppo-paper and sac-paper have not converged at these lengths")
        for what, value in claims.items()
    ]
