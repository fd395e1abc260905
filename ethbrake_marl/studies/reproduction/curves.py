"""The paper's learning curves at high and low delay (``fig:ppo_sac_high_latency``, ``fig:ppo_sac_low_latency``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from ethbrake_marl.evaluation.seed_statistics import interquartile_mean
from ethbrake_marl.evaluation.statistics import Estimate, mean, unpaired_difference
from ethbrake_marl.figures.curves import SeedCurve, at_common_steps, seed_curves
from ethbrake_marl.learning.recipe import load_recipe
from ethbrake_marl.learning.run_folder import RETURN, progress_column, progress_rows
from ethbrake_marl.physics import Floats
from ethbrake_marl.studies.reproduction.finished_policies import shipped_ends
from ethbrake_marl.studies.reproduction.item import (
    FULL,
    Drawn,
    Made,
    Parameter,
    Settings,
    Table,
    csv_text,
    scenario_parameters,
)
from ethbrake_marl.studies.reproduction.measure import AS_STATED, read_scenario
from ethbrake_marl.studies.reproduction.trainings import CURVES, TRAINED_HARM, finished, group_named
from ethbrake_marl.studies.reproduction.verdicts import HARM, NOT_RUN, UNDECIDED, Less, Show, Verdict, judge_statement

HIGH, LOW = "high", "low"
_PAIRS = (("ppo", "sac", "our recipes"), ("ppo-paper", "sac-paper", "the paper's hyperparameters and reward"))
_SHOWN = (("ours", "our recipes", _PAIRS[0][:2]), ("paper", "the paper's hyperparameters", _PAIRS[1][:2]))
_NEARLY = 0.05  # of the rise of the return: what "nearly identical" allows
_DONE = 0.9  # of the fall of the harm: when a training has converged
_NUMBER = Show(3)


@dataclass(frozen=True, slots=True)
class Course:
    """The trainings of one recipe at one delay."""

    returns: SeedCurve  # mean return of training episodes, exploration included
    harm: SeedCurve  # first-impact harm on the fixed list

    @property
    def last_returns(self) -> Floats:
        """Of each seed: the mean of the last tenth of its updates."""
        values: Floats = self.returns.values[:, -max(len(self.returns.steps) // 10, 1) :].mean(axis=1)
        return values

    def worth(self, *, shaped: bool) -> Floats:
        """Of each seed: its last return; of a shaped one, minus the harm of the last policy."""
        return -self.harm.values[:, -1] if shaped else self.last_returns

    @property
    def rise(self) -> float:
        """By how much the return rises, mean over seeds."""
        return float((self.last_returns - self.returns.values[:, 0]).mean())

    @property
    def decisions_to_converge(self) -> Floats:
        """Of each seed: decisions until ``_DONE`` of the fall of the harm is behind it."""
        first, least = self.harm.values[:, :1], self.harm.values.min(axis=1, keepdims=True)
        there = self.harm.values <= first - _DONE * (first - least)
        reached: Floats = self.harm.steps[np.argmax(there, axis=1)]
        return reached

    def unrest(self, points: int) -> Floats:
        """Of each seed: spread of the changes of its return between ``points`` in the second half, share of the rise.

        The points lie at equal parts of the training, so trainings of other lengths compare.
        """
        steps = np.linspace(0.5, 1.0, points) * self.returns.steps[-1]
        values = np.array([np.interp(steps, self.returns.steps, own) for own in self.returns.values])
        changes: Floats = np.diff(values, axis=1).std(axis=1) / abs(self.rise)
        return changes

    @property
    def still_rising(self) -> float:
        """The share of the rise that falls into the last quarter of the training, mean over seeds."""
        at = 0.75 * self.returns.steps[-1]
        before = np.array([np.interp(at, self.returns.steps, own) for own in self.returns.values])
        return float((self.returns.values[:, -1] - before).mean()) / abs(self.rise)

    @property
    def spread(self) -> Floats:
        """Standard deviation over seeds of the return, at each step of the second half."""
        half = self.returns.values[:, len(self.returns.steps) // 2 :]
        deviations: Floats = half.std(axis=0, ddof=1)
        return deviations


def reproduce_curves(delay: str, settings: Settings) -> Made:
    """The curves that ``--full`` has trained; without them what finished policies reach at this delay."""
    courses = {each: read_courses(settings.folder, each) if settings.mode == FULL else {} for each in (HIGH, LOW)}
    ends = settings.once(("finished policies",), lambda: shipped_ends(settings))
    verdicts = [*_judge(delay, courses), *ends.verdicts]
    scenario = read_scenario(f"paper-delay-{delay}", AS_STATED)
    parameters = (
        *scenario_parameters(scenario, latency_s="", gaps_m="", speeds_mps=""),
        Parameter("hyperparameters of ppo-paper, sac-paper", "Table table:params", "table:params"),
        Parameter("ends of the cosine, decisions, worlds side by side, weights of the reward", "in the recipes", ""),
        Parameter("hyperparameters and reward of ppo, sac", "in the recipes", ""),
        Parameter("seeds", "0, 1, 2 where trained", ""),
    )
    own = courses[delay]
    if not own:
        note = "Nothing was trained: --full trains the curves. Finished policies stand in for their ends."
        return Made((*verdicts,), parameters, ends.tables, notes=(note,), data=ends.data)
    drawn = tuple(
        _draw(f"learning-{delay}-{stem}", f"Learning curves, {delay} delay, {about}", chosen)
        for stem, about, names in _SHOWN
        if (chosen := {name: own[name] for name in names if name in own})
    )
    notes = (f"Trained: {_trained(own)}. With Vehicle 2 acting at 0.2 s nothing was trained.", *_missing(own))
    data = {f"learning-{delay}": _csv(own), **ends.data}
    return Made(tuple(verdicts), parameters, (_table(delay, own), *ends.tables), drawn, data, notes)


reproduce_high = partial(reproduce_curves, HIGH)
reproduce_low = partial(reproduce_curves, LOW)


def read_courses(folder: Path, delay: str) -> dict[str, Course]:
    """The courses of every recipe all of whose seeds have been trained."""
    found = {}
    for group in CURVES[delay]:
        for name, paths in finished(folder, group_named(group)).items():
            tables = [progress_rows(path) for path in paths]
            returns = at_common_steps([progress_column(table, RETURN) for table in tables])
            harm = at_common_steps([progress_column(table, TRAINED_HARM) for table in tables])
            found[name] = Course(returns, harm)
    return found


def _judge(delay: str, courses: Mapping[str, Mapping[str, Course]]) -> list[Verdict]:
    """The paper's statements about one of the two figures."""
    if not courses[delay]:
        return [Verdict(f"learning curves at {delay} delay", NOT_RUN, "no training; --full trains them")]
    verdicts = [_higher_when_low(courses)] if courses[HIGH] and courses[LOW] else []
    for ppo, sac, about in _PAIRS:
        if not {ppo, sac} <= courses[delay].keys():
            verdicts.append(Verdict(f"PPO against SAC, {about}", NOT_RUN, f"{ppo} and {sac} are not both trained"))
        elif delay == HIGH:
            verdicts.append(_nearly_identical(courses[HIGH][ppo], courses[HIGH][sac], about))
        else:
            verdicts += _faster_and_steadier(courses[LOW][ppo], courses[LOW][sac], about)
    if delay == LOW and courses[HIGH]:
        verdicts.append(_spreads_more(courses))
    return verdicts


def _higher_when_low(courses: Mapping[str, Mapping[str, Course]]) -> Verdict:
    parts = []
    for name in courses[HIGH].keys() & courses[LOW].keys():
        # shaping adds what the first state is worth, so its returns do not compare between delays: harm does
        shaped = load_recipe(name).reward.shaping > 0.0
        high, low = (courses[delay][name].worth(shaped=shaped) for delay in (HIGH, LOW))
        where = f"{name} (minus its harm: its return holds shaping)" if shaped else name
        parts.append(Less(where, unpaired_difference(mean(high), len(high), mean(low), len(low))))
    what = "both algorithms reach higher returns at low delay than at high"
    if not parts:
        return Verdict(what, NOT_RUN, "no recipe is trained at both delays")
    return judge_statement(what, sorted(parts, key=lambda part: part.where), show=_NUMBER)


def _nearly_identical(ppo: Course, sac: Course, about: str) -> Verdict:
    what = f"PPO and SAC end at nearly identical returns at high delay ({about})"
    rising = [f"{name} by {100.0 * each.still_rising:.0f} %" for name, each in (("PPO", ppo), ("SAC", sac))
              if each.still_rising > _NEARLY]  # fmt: skip
    if rising:
        told = (
            f"not converged: in the last quarter the return still rose by more than {100.0 * _NEARLY:g} % of its rise"
        )
        return Verdict(what, UNDECIDED, f"{told}, {' and '.join(rising)}")
    rise = max(ppo.rise, sac.rise)
    apart = abs(float(ppo.last_returns.mean() - sac.last_returns.mean())) / rise
    where = f"apart by {100.0 * apart:.1f} % of the rise, at most {100.0 * _NEARLY:g} % asked"
    return judge_statement(what, [Less(where, Estimate(apart - _NEARLY, None))], show=_NUMBER)


def _faster_and_steadier(ppo: Course, sac: Course, about: str) -> list[Verdict]:
    """SAC converges faster, PPO is the more stable one, at low delay."""
    fast, slow = sac.decisions_to_converge, ppo.decisions_to_converge
    faster = Less(
        f"{mean(fast).value:,.0f} decisions against {mean(slow).value:,.0f}",
        unpaired_difference(mean(fast), len(fast), mean(slow), len(slow)),
    )
    points = max(min(len(ppo.returns.steps), len(sac.returns.steps)) // 2, 2)
    calm, restless = ppo.unrest(points), sac.unrest(points)
    steadier = Less(
        f"{mean(calm).value:.3f} of the rise against {mean(restless).value:.3f}",
        unpaired_difference(mean(calm), len(calm), mean(restless), len(restless)),
    )
    return [
        judge_statement(f"SAC converges faster than PPO at low delay ({about})", [faster], show=Show(0)),
        judge_statement(f"PPO is the more stable one at low delay ({about})", [steadier], show=_NUMBER),
    ]


def _spreads_more(courses: Mapping[str, Mapping[str, Course]]) -> Verdict:
    parts = []
    for name in sorted(courses[HIGH].keys() & courses[LOW].keys()):
        if any(len(courses[delay][name].returns.values) < 2 for delay in (HIGH, LOW)):
            continue  # one seed has no spread
        high, low = (courses[delay][name].spread for delay in (HIGH, LOW))
        parts.append(Less(name, unpaired_difference(mean(high), len(high), mean(low), len(low))))
    what = "the returns of different seeds spread more at low delay than at high"
    if not parts:
        return Verdict(what, NOT_RUN, "no recipe has several seeds at both delays")
    return judge_statement(what, parts, show=_NUMBER)


def _draw(stem: str, title: str, courses: Mapping[str, Course]) -> Drawn:
    """Return and harm of recipes with one reward."""
    text = f"{title}: return and harm against decisions, mean over seeds; bands: one standard deviation."
    harm = "First-impact harm on the fixed list (m²/s²)"
    panels = {
        "Mean return of training episodes": {name: course.returns for name, course in courses.items()},
        harm: {name: course.harm for name, course in courses.items()},
    }
    return Drawn(stem, title, text, seed_curves(panels, logarithmic=[harm], caption=text))


def _table(delay: str, courses: Mapping[str, Course]) -> Table:
    rows = []
    for name, course in courses.items():
        kept = interquartile_mean([course.harm.values.min(axis=1)])
        last = interquartile_mean([course.harm.values[:, -1]])
        returns = mean(course.last_returns)
        decisions = mean(course.decisions_to_converge)
        rows.append((
            name, str(len(course.harm.values)), f"{course.harm.steps[-1]:,.0f}", HARM.estimate(kept),
            HARM.estimate(last), _NUMBER.estimate(returns), f"{decisions.value:,.0f}",
        ))  # fmt: skip
    head = ("Recipe", "Seeds", "Decisions", "Kept policy, harm", "Last policy, harm", "Final return", "90 % after")
    note = (
        "Harm: first-impact, m²/s², 1,000 worlds of seed 1007, interquartile mean over seeds with its bootstrap"
        " interval. Final return: mean over seeds of the last tenth of the updates, t interval. 90 % after: decisions"
        " until nine tenths of the fall of the harm are behind."
    )
    return Table(f"Trainings at {delay} delay", head, tuple(rows), note)


def _trained(courses: Mapping[str, Course]) -> str:
    return ", ".join(
        f"{len(course.harm.values)} seeds of {name} to {course.harm.steps[-1]:,.0f} decisions"
        for name, course in courses.items()
    )


def _missing(courses: Mapping[str, Course]) -> tuple[str, ...]:
    missing = [name for pair in _PAIRS for name in pair[:2] if name not in courses]
    return (f"Not trained to the end: {', '.join(missing)}.",) if missing else ()


def _csv(courses: Mapping[str, Course]) -> str:
    rows = [
        [figure, name, seed, int(step), float(value)]
        for name, course in courses.items()
        for figure, curve in (("return", course.returns), ("first_impact_harm", course.harm))
        for seed, values in enumerate(curve.values)
        for step, value in zip(curve.steps, values, strict=True)
    ]
    return csv_text(("figure", "recipe", "seed", "steps", "value"), rows)
