"""Reproduce the paper's learning curves at high and low delay.

The labels of the two figures in the paper's source are ``fig:ppo_sac_high_latency`` and ``fig:ppo_sac_low_latency``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ethbrake_marl.extensions.report.seed_curves import SeedCurve, seed_curves
from ethbrake_marl.extensions.reproduction.folder import (
    Drawn,
    Made,
    Parameter,
    Reproduction,
    csv_text,
    scenario_parameters,
    stated,
)
from ethbrake_marl.extensions.reproduction.strategies import (
    FULL_BRAKE,
    NAMES,
    PPO,
    READINGS,
    SAC,
    UNIVERSAL,
    drive_list,
    harms,
    lineup,
)
from ethbrake_marl.extensions.reproduction.trainings import CURVES, HARM_COLUMN
from ethbrake_marl.extensions.reproduction.verdicts import PROVEN, Less, Verdict, judge_statement
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.first_edition.evaluation.seeds import interquartile_mean
from ethbrake_marl.first_edition.evaluation.statistics import mean
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.training.recipe import load_recipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory

HIGH, LOW = "high", "low"

_PAIRS = {  # stem of the figure -> two recipes, description in the title, description in verdicts
    "ours": ("ppo", "sac", "our recipes", "our recipes"),
    "paper": (
        "ppo-paper", "sac-paper", "the paper's hyperparameters", "the paper's hyperparameters and reward",
    ),
}  # fmt: skip

_NEARLY = 0.05  # "nearly identical" returns differ by at most this share of the rise of the return

_DONE = 0.9  # a training has converged after this share of the fall of the harm

_NUMBER, _DECISIONS = Column("Final return", digits=3), Column("Decisions", digits=0)


@lru_cache(maxsize=1)  # both figures show the same results
def _shipped_ends(settings: Reproduction) -> Made:
    """Evaluate shipped policies at low and high delay; return verdicts, a table and data.

    The policies are evaluated under both assumptions on when Vehicle 2 may act (``strategies.READINGS``).
    """
    episodes = min(2_000, settings.episodes)
    verdicts, rows, data = [], [], []
    for reading in READINGS:
        scenarios = {delay: reading.scenario(f"paper-delay-{delay}") for delay in (LOW, HIGH)}
        shipped = {
            delay: harms(drive_list(each, lineup(each, PPO, SAC, UNIVERSAL, FULL_BRAKE), episodes, settings))
            for delay, each in scenarios.items()
        }
        low, high = shipped.values()
        rows += [(reading.name, name, mean(low[name]), mean(high[name])) for name in low]
        data += [
            [reading.name, name, delay, episodes, float(shipped[delay][name].mean())]
            for name in low
            for delay in shipped
        ]
        parts = [Less.of_lists(name, low[name], high[name]) for name in low if name not in (NAMES[FULL_BRAKE], PROVEN)]
        what = f"finished policies harm less at low delay than at high ({reading.name})"
        verdicts.append(judge_statement(what, parts))
    note = (
        f"First-impact harm, m²/s², {episodes:,} worlds of seed 7 each. PPO and SAC were trained at 0.5 and 0.8 s,"
        " universal for all latencies; none at these delays alone."
    )
    table = Sheet("What finished policies reach", ("Reading", "Strategy", "Low delay", "High delay"), rows, note)
    csv = csv_text(("reading", "strategy", "delay", "worlds", "first_impact_harm"), data)
    return Made(verdicts, (), [table], data={"finished-policies": csv})


@dataclass(frozen=True, slots=True)
class Course:
    """Training runs of one recipe at one delay, one run for each seed."""

    returns: SeedCurve  # mean return of training episodes (exploration included) against decisions
    harm: SeedCurve  # first-impact harm on the fixed list (m2/s2) against decisions

    @property
    def last_returns(self) -> Floats:
        """Mean return of each training run over the last tenth of its updates, [seeds]."""
        return np.asarray(self.returns.values[:, -max(len(self.returns.steps) // 10, 1) :].mean(axis=1))

    @property
    def rise(self) -> float:
        """Mean return over the last tenth of the updates, minus the return at the first update; mean over the runs."""
        return float((self.last_returns - self.returns.values[:, 0]).mean())

    @property
    def decisions_to_converge(self) -> Floats:
        """Number of decisions until a run first reaches 90 % (``_DONE``) of its largest decrease of harm, [seeds]."""
        first, least = self.harm.values[:, :1], self.harm.values.min(axis=1, keepdims=True)
        there = self.harm.values <= first - _DONE * (first - least)
        return np.asarray(self.harm.steps[np.argmax(there, axis=1)])

    def returns_at(self, shares: Floats) -> Floats:
        """Return the mean return of training episodes at k points of each training run, [seeds, k].

        ``shares`` [k] gives each point as a share of the run: 0 is its start and 1 its end.
        """
        steps = shares * self.returns.steps[-1]
        return np.array([np.interp(steps, self.returns.steps, own) for own in self.returns.values])

    def unrest(self, points: int) -> Floats:
        """Return how much the return fluctuates in the second half of each run, [seeds].

        The return is read at ``points`` equally spaced points of this half, so runs of different lengths can be
        compared. The result is the standard deviation of the changes from one point to the next, divided by
        abs(``rise``).
        """
        return np.asarray(np.diff(self.returns_at(np.linspace(0.5, 1.0, points)), axis=1).std(axis=1) / abs(self.rise))

    @property
    def still_rising(self) -> float:
        """Rise of the return in the last quarter of a run, averaged over the runs, divided by abs(``rise``)."""
        before = self.returns_at(np.array([0.75]))[:, 0]
        return float((self.returns.values[:, -1] - before).mean()) / abs(self.rise)

    @property
    def spread(self) -> Floats:
        """Standard deviation of the return over the runs, at each of k steps in their second half, [k]."""
        return np.asarray(self.returns.values[:, len(self.returns.steps) // 2 :].std(axis=0, ddof=1))


Courses = Mapping[str, Course]  # trainings by recipe


def reproduce_curves(delay: str, settings: Reproduction) -> Made:
    """Reproduce the paper's learning curves at one delay (``high`` or ``low``) from the training runs of ``--full``.

    Without such training runs, there are no curves, and the tables show results of shipped policies.
    """
    courses = {
        each: {
            name.partition("/")[2]: Course(
                *(
                    SeedCurve.of([RunDirectory(path).column(what) for path in paths])
                    for what in (RunDirectory.RETURN, HARM_COLUMN)
                )
            )
            for name, paths in settings.trained(CURVES[each]).items()
        }
        for each in (HIGH, LOW)
    }
    ends = _shipped_ends(settings)
    verdicts = [*_judge(delay, courses), *ends.verdicts]
    parameters = [
        *scenario_parameters(load_scenario(f"paper-delay-{delay}"), latency_s="", gaps_m="", speeds_mps=""),
        stated("hyperparameters of ppo-paper, sac-paper", "Table table:params", "table:params"),
        Parameter("ends of the cosine, decisions, worlds side by side, weights of the reward", "in the recipes"),
        Parameter("hyperparameters and reward of ppo, sac", "in the recipes"),
        Parameter("seeds", "0, 1, 2 where trained"),
    ]
    own = courses[delay]
    if not own:
        note = "Nothing was trained: --full trains the curves. Finished policies stand in for their ends."
        return Made(verdicts, parameters, ends.tables, notes=[note], data=ends.data)
    figures = {}
    for stem, (*names, about, _) in _PAIRS.items():
        if chosen := {name: own[name] for name in names if name in own}:
            title = f"Learning curves, {delay} delay, {about}"
            text = f"{title}: return and harm against decisions, mean over seeds; bands: one standard deviation."
            panels = {
                "Mean return of training episodes": {name: course.returns for name, course in chosen.items()},
                "First-impact harm on the fixed list (m²/s²)": {name: each.harm for name, each in chosen.items()},
            }
            figure = seed_curves(panels, logarithmic=list(panels)[1:], caption=text)
            figures[Drawn(f"learning-{delay}-{stem}", title, text)] = figure
    lengths = [
        f"{len(course.harm.values)} seeds of {name} to {course.harm.steps[-1]:,.0f} decisions"
        for name, course in own.items()
    ]
    notes = [f"Trained: {', '.join(lengths)}. With Vehicle 2 acting at 0.2 s nothing was trained."]
    if missing := [name for pair in _PAIRS.values() for name in pair[:2] if name not in own]:
        notes.append(f"Not trained to the end: {', '.join(missing)}.")
    rows = [
        (figure, name, seed, int(step), float(value))
        for name, course in own.items()
        for figure, curve in (("return", course.returns), ("first_impact_harm", course.harm))
        for seed, values in enumerate(curve.values)
        for step, value in zip(curve.steps, values, strict=True)
    ]
    data = {f"learning-{delay}": csv_text(("figure", "recipe", "seed", "steps", "value"), rows), **ends.data}
    reached = [
        (
            *(name, len(course.harm.values), f"{course.harm.steps[-1]:,.0f}"),
            *(interquartile_mean([each]) for each in (course.harm.values.min(axis=1), course.harm.values[:, -1])),
            *(mean(course.last_returns), f"{mean(course.decisions_to_converge).value:,.0f}"),
        )
        for name, course in own.items()
    ]
    head = ("Recipe", "Seeds", "Decisions", "Kept policy, harm", "Last policy, harm", _NUMBER, "90 % after")
    about = (
        "Harm: first-impact, m²/s², 1,000 worlds of seed 1007, interquartile mean over seeds with its bootstrap"
        " interval. Final return: mean over seeds of the last tenth of the updates, t interval. 90 % after: decisions"
        " until nine tenths of the fall of the harm are behind."
    )
    tables = [Sheet(f"Trainings at {delay} delay", head, reached, about), *ends.tables]
    return Made(verdicts, parameters, tables, figures, data, notes)


def _judge(delay: str, courses: Mapping[str, Courses]) -> list[Verdict]:
    """Return verdicts on the paper's statements about the learning curves at one delay (``high`` or ``low``).

    ``courses`` has the training runs by delay and name of the recipe.
    """
    own, high, low = courses[delay], courses[HIGH], courses[LOW]
    if not own:
        return [Verdict(f"learning curves at {delay} delay", "not run", "no training; --full trains them")]
    verdicts = [_higher_when_low(courses)] if high and low else []
    for first, second, _, about in _PAIRS.values():
        if not {first, second} <= own.keys():
            text = f"{first} and {second} are not both trained"
            verdicts.append(Verdict(f"PPO against SAC, {about}", "not run", text))
            continue
        ppo, sac = own[first], own[second]
        if delay == LOW:
            fast, slow = sac.decisions_to_converge, ppo.decisions_to_converge
            points = max(min(len(ppo.returns.steps), len(sac.returns.steps)) // 2, 2)
            calm, restless = ppo.unrest(points), sac.unrest(points)
            faster = f"{mean(fast).value:,.0f} decisions against {mean(slow).value:,.0f}"
            calmer = f"{mean(calm).value:.3f} of the rise against {mean(restless).value:.3f}"
            verdicts += [
                judge_statement(
                    f"SAC converges faster than PPO at low delay ({about})",
                    [Less.of_lists(faster, fast, slow)],
                    show=_DECISIONS,
                ),
                judge_statement(
                    f"PPO is the more stable one at low delay ({about})",
                    [Less.of_lists(calmer, calm, restless)],
                    show=_NUMBER,
                ),
            ]
            continue
        what = f"PPO and SAC end at nearly identical returns at high delay ({about})"
        rising = [
            f"{name} by {100.0 * each.still_rising:.0f} %"
            for name, each in (("PPO", ppo), ("SAC", sac))
            if each.still_rising > _NEARLY
        ]
        apart = abs(float(ppo.last_returns.mean() - sac.last_returns.mean())) / max(ppo.rise, sac.rise)
        where = f"apart by {100.0 * apart:.1f} % of the rise, at most {100.0 * _NEARLY:g} % asked"
        text = (
            f"not converged: in the last quarter the return still rose by more than {100.0 * _NEARLY:g} % of its rise,"
            f" {' and '.join(rising)}"
        )
        parts = [Less(where, Estimate(apart - _NEARLY, None))]
        verdicts.append(Verdict(what, "undecided", text) if rising else judge_statement(what, parts, show=_NUMBER))
    if delay == LOW and high:
        what = "the returns of different seeds spread more at low delay than at high"
        parts = [
            Less.of_lists(name, high[name].spread, low[name].spread)
            for name in sorted(high.keys() & low.keys())
            if min(len(high[name].returns.values), len(low[name].returns.values)) > 1  # one seed has no spread
        ]
        text = "no recipe has several seeds at both delays"
        verdicts.append(judge_statement(what, parts, show=_NUMBER) if parts else Verdict(what, "not run", text))
    return verdicts


def _higher_when_low(courses: Mapping[str, Courses]) -> Verdict:
    what, parts = "both algorithms reach higher returns at low delay than at high", []
    for name in sorted(courses[HIGH].keys() & courses[LOW].keys()):
        high, low, where = courses[HIGH][name].last_returns, courses[LOW][name].last_returns, name
        # with shaping, the return includes the potential of the first state, which depends on the delay: compare harm
        if load_recipe(name).reward.shaping > 0.0:
            high, low = (-courses[each][name].harm.values[:, -1] for each in (HIGH, LOW))
            where = f"{name} (minus its harm: its return holds shaping)"
        parts.append(Less.of_lists(where, high, low))
    if not parts:
        return Verdict(what, "not run", "no recipe is trained at both delays")
    return judge_statement(what, sorted(parts, key=lambda part: part.where), show=_NUMBER)


ALL_CURVES = tuple(group for groups in CURVES.values() for group in groups)
