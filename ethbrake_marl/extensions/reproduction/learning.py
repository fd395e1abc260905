"""The paper's learning curves at high and low delay (``fig:ppo_sac_high_latency``, ``fig:ppo_sac_low_latency``)."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.seed_curves import SeedCurve, seed_curves
from ethbrake_marl.extensions.reproduction.limits import least_harm
from ethbrake_marl.extensions.reproduction.made import POLICIES, Drawn, Made, Settings
from ethbrake_marl.extensions.reproduction.readings import FOUR, NON_ETHICAL, PPO, PROVEN, READINGS, SAC, drive, harms
from ethbrake_marl.extensions.reproduction.trainings import HIGH, LOW, trained
from ethbrake_marl.extensions.reproduction.verdicts import Less, Verdict, judge_statement
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.motion.layout import Floats

PAIRS = {  # stem of the figure -> what its recipes are, and the recipes
    "ours": ("our recipes", "ppo", "sac"),
    "paper": ("the paper's hyperparameters and reward", "ppo-paper", "sac-paper"),
}
NEARLY = 0.05  # "nearly identical": returns that differ by at most this share of their rise
DONE = 0.9  # of the fall of the harm: then a training has converged
RETURN, HARM = "rollout/ep_rew_mean", "eval/first_impact_harm"  # columns of progress.csv
UNIVERSAL, WORLDS = "universal policy", 2_000

SHOWN, DECISIONS = Column("Final return", digits=3), Column("Decisions", digits=0)


class Course(NamedTuple):
    """Trainings by one recipe at one delay: two quantities over decisions, for each seed."""

    returns: SeedCurve  # mean return of training episodes
    harm: SeedCurve  # first-impact harm on the fixed list (m2/s2)

    @property
    def last_returns(self) -> Floats:
        """Mean return over the last tenth of the updates, [seeds]."""
        return np.asarray(self.returns.values[:, -max(len(self.returns.steps) // 10, 1) :].mean(axis=1))

    @property
    def rise(self) -> float:
        """Last return minus the first, mean over the seeds."""
        return float((self.last_returns - self.returns.values[:, 0]).mean())

    @property
    def decisions_to_converge(self) -> Floats:
        """Decisions until a training first has nine tenths of its largest fall of harm, [seeds]."""
        first, least = self.harm.values[:, :1], self.harm.values.min(axis=1, keepdims=True)
        return np.asarray(self.harm.steps[np.argmax(self.harm.values <= first - DONE * (first - least), axis=1)])

    def returns_at(self, shares: Floats) -> Floats:
        """Return the return at shares of the training, 0 its start and 1 its end, [seeds, k]."""
        steps = shares * self.returns.steps[-1]
        return np.array([np.interp(steps, self.returns.steps, own) for own in self.returns.values])

    def unrest(self, points: int) -> Floats:
        """Return the standard deviation of the changes of the return between points of the second half, [seeds].

        It is a share of the rise.
        """
        return np.asarray(np.diff(self.returns_at(np.linspace(0.5, 1.0, points)), axis=1).std(axis=1) / abs(self.rise))

    @property
    def still_rising(self) -> float:
        """Rise of the return in the last quarter, mean over the seeds, as a share of the rise."""
        before = self.returns_at(np.array([0.75]))[:, 0]
        return float((self.returns.values[:, -1] - before).mean()) / abs(self.rise)

    @property
    def spread(self) -> Floats:
        """Standard deviation of the return over the seeds, at each step of the second half, [k]."""
        return np.asarray(self.returns.values[:, len(self.returns.steps) // 2 :].std(axis=0, ddof=1))


Courses = Mapping[str, Course]  # recipe -> trainings


def column(run: Path, name: str) -> dict[int, float]:
    """Return a column of a run's table: decisions -> value, where there is one."""
    rows = csv.DictReader((run / "progress.csv").read_text("utf-8").splitlines())
    return {int(float(row["steps"])): float(row[name]) for row in rows if row.get(name)}


def courses_of(settings: Settings, delay: str) -> Courses:
    """Return the trainings at a delay that have finished."""
    if not settings.full:
        return {}
    return {
        recipe: Course(*(SeedCurve.of([column(run, name) for run in runs]) for name in (RETURN, HARM)))
        for recipe, runs in trained(settings.folder, delay).items()
    }


@cache
def finished_policies(episodes: int) -> tuple[list[Verdict], Sheet]:
    """Return what shipped policies reach at low and high delay, which both figures show."""
    verdicts, rows = [], []
    agents = {PPO: FOUR[PPO], SAC: FOUR[SAC], UNIVERSAL: "universal", NON_ETHICAL: FOUR[NON_ETHICAL]}
    for reading in READINGS:
        each = []
        for delay in (LOW, HIGH):
            scenario = reading.scenario(f"paper-delay-{delay}")
            result = drive(scenario, agents, episodes)
            each.append(harms(result) | {PROVEN: least_harm(scenario, result)})
        low, high = each
        rows += [(reading.name, name, mean(low[name]), mean(high[name])) for name in low]
        parts = [Less.of_lists(name, low[name], high[name]) for name in (PPO, SAC, UNIVERSAL)]
        verdicts.append(
            judge_statement(f"finished policies harm less at low delay than at high ({reading.name})", parts)
        )
    note = f"First-impact harm, m²/s², {episodes:,} worlds of seed 7 each. {POLICIES} universal: for all latencies."
    columns = ("Reading", "Strategy", Column("Low delay"), Column("High delay"))
    return verdicts, Sheet("What finished policies reach", columns, rows, note)


def reproduce_curves(delay: str, settings: Settings) -> Made:
    """Reproduce the learning curves at one delay from the trainings of ``--full``; without, finished policies stand in."""
    courses = {each: courses_of(settings, each) for each in (HIGH, LOW)}
    verdicts, sheet = finished_policies(min(WORLDS, settings.episodes))
    verdicts = [*judge(delay, courses[delay], courses[HIGH], courses[LOW]), *verdicts]
    own = courses[delay]
    if not own:
        return Made(verdicts, [sheet], notes=["Nothing was trained: --full trains. Finished policies show the ends."])
    figures = []
    for stem, (who, *recipes) in PAIRS.items():
        if chosen := {recipe: own[recipe] for recipe in recipes if recipe in own}:
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
            *(mean(each.last_returns), f"{each.decisions_to_converge.mean():,.0f}"),
        )
        for name, each in own.items()
    ]
    numbers = (
        *map(Column, ("Seeds", "Decisions", "Kept policy, harm", "Last policy, harm")),
        SHOWN,
        Column("90 % after"),
    )
    note = (
        "Harm: first-impact, m²/s², 1,000 worlds of seed 1007. Final return: of the last tenth of the updates. Means"
        " over seeds with t intervals. 90 % after: decisions until nine tenths of the fall of the harm are behind."
    )
    trainings = Sheet(f"Trainings at {delay} delay", ("Recipe", *numbers), rows, note)
    points = [
        (quantity, name, seed, int(step), float(value))
        for name, each in own.items()
        for quantity, curve in (("return", each.returns), ("first_impact_harm", each.harm))
        for seed, values in enumerate(curve.values)
        for step, value in zip(curve.steps, values, strict=True)
    ]
    data = Sheet("", [*map(Column, ("quantity", "recipe", "seed", "decisions", "value"))], points)
    notes = ["Our recipes ppo and sac have other rewards and lengths, so their returns are not compared."]
    return Made(verdicts, [trainings, sheet], figures, {f"learning-{delay}": data}, notes)


def judge(delay: str, own: Courses, high: Courses, low: Courses) -> list[Verdict]:
    """Return verdicts on the paper's statements about one delay, from the paper's two recipes, which share a reward."""
    _, first, second = PAIRS["paper"]
    if not {first, second} <= own.keys():
        return [Verdict(f"learning curves at {delay} delay", "not run", "no training; --full trains them")]
    ppo, sac = own[first], own[second]
    verdicts = []
    if delay == HIGH:
        verdicts.append(nearly_identical(ppo, sac))
    else:
        points = max(min(len(each.returns.steps) for each in (ppo, sac)) // 2, 2)
        for what, show, smaller, larger in (
            (
                "SAC converges faster than PPO at low delay",
                DECISIONS,
                sac.decisions_to_converge,
                ppo.decisions_to_converge,
            ),
            ("PPO is the more stable one at low delay", SHOWN, ppo.unrest(points), sac.unrest(points)),
        ):
            where = " against ".join(show.show(float(each.mean())).value for each in (smaller, larger))
            verdicts.append(judge_statement(what, [Less.of_lists(where, smaller, larger)], show=show))
    shared = [name for name in (first, second) if name in high and name in low]
    for what, of in (
        ("both algorithms reach higher returns at low delay than at high", lambda course: course.last_returns),
        ("returns of different seeds spread more at low delay than at high", lambda course: course.spread),
    ):
        verdicts.append(between_delays(what, of, {name: (high[name], low[name]) for name in shared}))
    return verdicts


def nearly_identical(ppo: Course, sac: Course) -> Verdict:
    """Return the verdict on "final return values being nearly identical" at high delay; undecided if they still rise."""
    what = "PPO and SAC end at nearly identical returns at high delay"
    rising = [
        f"{name} by {100.0 * each.still_rising:.0f} %"
        for name, each in (("PPO", ppo), ("SAC", sac))
        if each.still_rising > NEARLY
    ]
    if rising:
        text = f"in the last quarter the return still rose by more than {100.0 * NEARLY:g} % of its rise"
        return Verdict(what, "undecided", f"not converged: {text}, {' and '.join(rising)}")
    apart = abs(float(ppo.last_returns.mean() - sac.last_returns.mean())) / max(ppo.rise, sac.rise)
    where = f"apart by {100.0 * apart:.1f} % of the rise, at most {100.0 * NEARLY:g} % asked"
    return judge_statement(what, [Less(where, Estimate(apart - NEARLY, None))], show=SHOWN)


def between_delays(what: str, of: Callable[[Course], Floats], pairs: Mapping[str, tuple[Course, Course]]) -> Verdict:
    """Return the verdict on what is smaller at high delay than at low: recipe -> trainings at high and low delay."""
    if not pairs:
        return Verdict(what, "not run", "no recipe is trained at both delays")
    return judge_statement(
        what, [Less.of_lists(name, of(high), of(low)) for name, (high, low) in pairs.items()], show=SHOWN
    )
