"""The paper's learning curves at high and low delay (``fig:ppo_sac_high_latency``, ``fig:ppo_sac_low_latency``)."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.seed_curves import SeedCurve, seed_curves
from ethbrake_marl.extensions.reproduction.made import Drawn, Made, Settings
from ethbrake_marl.extensions.reproduction.trainings import HIGH, LOW, trained
from ethbrake_marl.extensions.reproduction.verdicts import Less, Verdict, judge_statement
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats

PAIRS = {  # stem of the figure -> what its recipes are, and the recipes
    "ours": ("our recipes", "ppo", "sac"),
    "paper": ("the paper's hyperparameters and reward", "ppo-paper", "sac-paper"),
}
RETURN, HARM = "rollout/ep_rew_mean", "eval/first_impact_harm"  # columns of progress.csv
SHOWN = Column("Final return", digits=3)


class Course(NamedTuple):
    """Trainings by one recipe at one delay: two quantities over decisions, for each seed."""

    returns: SeedCurve  # mean return of training episodes
    harm: SeedCurve  # first-impact harm on the fixed list (m2/s2)

    @property
    def last_returns(self) -> Floats:
        """Mean return over the last tenth of the updates, [seeds]."""
        return np.asarray(self.returns.values[:, -max(len(self.returns.steps) // 10, 1) :].mean(axis=1))

    @property
    def spread(self) -> Floats:
        """Standard deviation of the return over the seeds, at each of k steps of the second half, [k]."""
        return np.asarray(self.returns.values[:, len(self.returns.steps) // 2 :].std(axis=0, ddof=1))


Courses = Mapping[str, Course]  # recipe -> trainings


def column(run: Path, name: str) -> dict[int, float]:
    """Return a column of a run's table: decisions -> value, where there is one."""
    rows = csv.DictReader((run / "progress.csv").read_text("utf-8").splitlines())
    return {int(float(row["steps"])): float(row[name]) for row in rows if row.get(name)}


def courses_of(settings: Settings, delay: str) -> Courses:
    """Return the trainings at a delay that have finished; none without ``full``."""
    return {
        recipe: Course(*(SeedCurve.of([column(run, name) for run in runs]) for name in (RETURN, HARM)))
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
                "Mean return of training episodes": {name: each.returns for name, each in chosen.items()},
                "First-impact harm on the fixed list (m²/s²)": {name: each.harm for name, each in chosen.items()},
            }
            figure = seed_curves(panels, logarithmic=[*panels][1:], caption=text)
            figures.append(Drawn(f"learning-{delay}-{stem}", title, text, figure))
    rows = [
        (
            *(name, len(each.harm.values), f"{each.harm.steps[-1]:,.0f}"),
            *(mean(harm) for harm in (each.harm.values.min(axis=1), each.harm.values[:, -1])),
            mean(each.last_returns),
        )
        for name, each in own.items()
    ]
    note = (
        "Harm: first-impact, m²/s², 1,000 worlds of seed 1007. Final return: of the last tenth of the updates. Means"
        " over seeds with t intervals. Recipes ppo and sac have other rewards and lengths: their returns are not"
        " compared."
    )
    numbers = map(Column, ("Seeds", "Decisions", "Kept policy, harm", "Last policy, harm"))
    sheet = Sheet(f"Trainings at {delay} delay", ("Recipe", *numbers, SHOWN), rows, note)
    return Made(judge(courses[HIGH], courses[LOW]), [sheet], figures)


def judge(high: Courses, low: Courses) -> list[Verdict]:
    """Return verdicts on the paper's statements, from the paper's two recipes, which share a reward."""
    pairs = {name: (high[name], low[name]) for name in PAIRS["paper"][1:] if name in high and name in low}
    claims = {
        "both algorithms reach higher returns at low delay than at high": [
            Less.of_lists(name, at_high.last_returns, at_low.last_returns) for name, (at_high, at_low) in pairs.items()
        ],
        "returns of different seeds spread more at low delay than at high": [
            Less.of_lists(name, at_high.spread, at_low.spread) for name, (at_high, at_low) in pairs.items()
        ],
    }
    missing = "ppo-paper and sac-paper are not both trained at both delays"
    return [
        *(
            judge_statement(what, parts, show=SHOWN) if len(parts) == 2 else Verdict(what, "not run", missing)
            for what, parts in claims.items()
        ),
        Verdict(
            "nearly identical final returns at high delay; at low delay SAC converges faster, PPO is more stable",
            "not run", "ppo-paper and sac-paper have not converged at these lengths",
        ),
    ]  # fmt: skip
