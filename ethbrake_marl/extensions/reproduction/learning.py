"""Trainings by the paper's own process, and its learning curves.

The process consists of the recipes ``ppo-paper`` and ``sac-paper`` in the paper's map: five seeds in the random test,
three at a high and a low delay (``fig:ppo_sac_high_latency``, ``fig:ppo_sac_low_latency``). Another PPO training, with
our recipe, is stopped before it has converged.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import SHORT_NAMES
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.figures import curve_over_seeds, curves_figure
from ethbrake_marl.extensions.report.style import TITLES
from ethbrake_marl.extensions.reproduction.made import DrawnFigure, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.verdicts import Claim, Less, judge
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats

RANDOM, HIGH, LOW, STOPPED = "random", "high", "low", "stopped"
STATUS = "run.json"  # of a run


class TrainingPlan(NamedTuple):
    scenario: str
    recipe: str
    seeds: int
    seconds: float  # of each on one core, to tell how long it takes
    decisions: int | None = None  # None: those of the recipe
    mapped: bool = True  # in the paper's map


def _process(scenario: str, seeds: int) -> tuple[TrainingPlan, ...]:
    return TrainingPlan(scenario, "ppo-paper", seeds, 210.0), TrainingPlan(scenario, "sac-paper", seeds, 240.0)


TRAINING_GROUPS = {
    STOPPED: (
        TrainingPlan("paper-random", "ppo", 1, 6.0, 100_000, mapped=False),
    ),  # a fifteenth of the recipe's decisions
    RANDOM: _process("paper-random", 5),
    HIGH: _process("paper-delay-high", 3),
    LOW: _process("paper-delay-low", 3),
}


def runs_of(folder: Path, group: str, plan: TrainingPlan) -> list[Path]:
    return [folder / "trainings" / group / f"{plan.recipe}-seed{seed}" for seed in range(plan.seeds)]


def is_finished(run: Path) -> bool:
    status = run / STATUS
    return status.is_file() and read_object(status).get("status") == "finished"


def finished_runs(folder: Path, group: str) -> dict[str, list[Path]]:
    """Finished trainings of a group of trainings (such as ``RANDOM``): recipe -> folder for each seed.

    Recipes with an unfinished training are left out.
    """
    runs_of_recipe = {plan.recipe: runs_of(folder, group, plan) for plan in TRAINING_GROUPS[group]}
    return {recipe: runs for recipe, runs in runs_of_recipe.items() if all(map(is_finished, runs))}


def seconds_left(folder: Path, groups: Iterable[str]) -> float:
    plans = [(group, plan) for group in groups for plan in TRAINING_GROUPS[group]]
    return sum(plan.seconds for group, plan in plans for run in runs_of(folder, group, plan) if not is_finished(run))


def train_groups(settings: ReproductionSettings, groups: Iterable[str]) -> bool:
    """Start, or continue, the unfinished trainings of some groups. Return False if Ctrl-C stopped one.

    Raises ``MissingExtra`` without torch, and the errors of ``eb.train`` and ``eb.resume``.
    """
    for group in groups:
        for plan in TRAINING_GROUPS[group]:
            for seed, run in enumerate(runs_of(settings.folder, group, plan)):
                if not (is_finished(run) or _train(plan, run, seed, settings)):
                    return False
    return True


def _train(plan: TrainingPlan, run: Path, seed: int, settings: ReproductionSettings) -> bool:
    import ethbrake_marl as eb

    if (run / STATUS).is_file():
        return eb.resume(run, on_progress=settings.tell).status == "finished"
    scenario, recipe = eb.load_scenario(plan.scenario), eb.load_recipe(plan.recipe)
    if plan.mapped:
        scenario = scenario.replace(physics="paper-map")
    reward = {**recipe.reward.model_dump(mode="json"), "harm_count": SHORT_NAMES["paper"]}
    recipe = recipe.replace(reward=reward)
    result = eb.train(recipe, scenario, run, seed=seed, steps=plan.decisions, on_progress=settings.tell)
    return result.status == "finished"


def unconverged_policy(folder: Path) -> str:
    """Agent name of the policy that the paper calls "obtained from training before convergence occurred"."""
    ((run,),) = finished_runs(folder, STOPPED).values()
    return f"policy@{run / 'policy-last'}"


def process(settings: ReproductionSettings, group: str = RANDOM) -> dict[str, list[str]]:
    """Policies trained as in the paper, of one ``group`` of trainings: name -> one agent name per seed.

    Empty without ``settings.full``.
    """
    runs = finished_runs(settings.folder, group) if settings.full else {}
    return {
        name: [f"policy@{run / 'policy'}" for run in runs[recipe]] for recipe, name in NAMES.items() if recipe in runs
    }


NAMES = {"ppo-paper": "PPO", "sac-paper": "SAC"}
RETURN, HARM = "rollout/ep_rew_mean", "eval/first_impact_harm"  # columns of progress.csv
ALIKE, RISEN = 0.1, 0.9  # parts of the rise of a return: what counts as nearly identical, and as converged

LearningCurves = Sequence[
    Mapping[float, float]
]  # for each seed: progress (%) -> value; all seeds have the same progress


class Course(NamedTuple):
    """Learning curves of one recipe at one delay, for each seed, over the progress of the training (%)."""

    returns: LearningCurves  # mean return of training episodes
    harm: LearningCurves  # first-impact harm on the fixed list (m2/s2)
    decisions: float = 100.0  # at the end

    @property
    def values(self) -> Floats:
        """Returns of the training episodes, [seeds, k], at k values of the progress."""
        return np.array([[*curve.values()] for curve in self.returns])

    @property
    def late(self) -> Floats:
        """Returns in the last quarter of the progress, [seeds, at least 2]."""
        return self.values[:, -max(self.values.shape[1] // 4, 2) :]

    @property
    def last(self) -> Floats:
        """Mean return in the last tenth of the progress, [seeds]."""
        return np.asarray(self.values[:, -max(self.values.shape[1] // 10, 1) :].mean(axis=1))

    @property
    def rise(self) -> Floats:
        """Increase of the return from the first value to the last ones, [seeds]."""
        return np.asarray(self.last - self.values[:, 0])

    @property
    def converged(self) -> Floats:
        """Number of decisions until the return has made nine tenths of its rise, [seeds]; all if it does not rise."""
        risen = self.values >= (self.values[:, 0] + RISEN * self.rise)[:, np.newaxis]
        progress = np.where(self.rise > 0.0, np.array([*self.returns[0]])[risen.argmax(axis=1)], 100.0)
        return 0.01 * self.decisions * progress

    @property
    def unrest(self) -> Floats:
        """Standard deviation of the return in the last quarter of the progress, [seeds]."""
        return np.asarray(self.late.std(axis=1, ddof=1))

    @property
    def spread(self) -> Floats:
        """Mean distance of the return from the mean over all seeds, in the last quarter of the progress, [seeds]."""
        return np.asarray(np.abs(self.late - self.late.mean(axis=0)).mean(axis=1))


def column(run: Path, name: str) -> dict[float, float]:
    rows = csv.DictReader((run / "progress.csv").read_text("utf-8").splitlines())
    return {float(row["steps"]): float(row[name]) for row in rows if row.get(name)}


def course_of(runs: Sequence[Path]) -> Course:
    returns, harm = ([column(run, name) for run in runs] for name in (RETURN, HARM))
    last = max(harm[0])
    returns, harm = (
        [{100.0 * k / last: x for k, x in curve.items()} for curve in curves] for curves in (returns, harm)
    )
    return Course(returns, harm, last)


def courses_of(settings: ReproductionSettings, delay: str) -> dict[str, Course]:
    return {
        NAMES[recipe]: course_of(runs)
        for recipe, runs in (finished_runs(settings.folder, delay) if settings.full else {}).items()
    }


def reproduce_curves(delay: str, settings: ReproductionSettings) -> Made:
    courses = {level: courses_of(settings, level) for level in (HIGH, LOW)}
    if not all(name in courses[level] for level in courses for name in NAMES.values()):
        why = "needs trainings at both delays; --full does them"
        return Made([Claim(FIGURE[delay], what, "", "", "not run", why) for what in STATEMENTS[delay]])
    delay_courses = courses[delay]
    title = f"Learning curves at {delay} delay, the paper's process"
    text = f"{title}: return and harm against progress, mean over seeds; bands: one standard deviation."
    panels = {
        "Mean return of training episodes": {
            name: curve_over_seeds(course.returns) for name, course in delay_courses.items()
        },
        f"{TITLES['first']}, fixed list": {
            name: curve_over_seeds(course.harm) for name, course in delay_courses.items()
        },
    }
    figure = DrawnFigure(f"learning-{delay}", title, text, curves_figure(panels, "Training progress (%)", text))
    rows = [
        (
            name,
            len(course.harm),
            *(mean(np.array([course.harm[k][100.0] for k in range(len(course.harm))])), mean(course.last)),
        )
        for name, course in delay_courses.items()
    ]
    note = "Harm: first-impact, m²/s², 1,000 worlds of seed 1007. Return: of the last tenth. t intervals over seeds."
    sheet = Sheet(title, ("Algorithm", Column("Seeds"), Column("Last policy, harm"), Column("Last return")), rows, note)
    return Made(judge_courses(delay, courses), [sheet], [figure])


FIGURE = {HIGH: "Fig. 2", LOW: "Fig. 3"}
STATEMENTS = {
    HIGH: (
        "both algorithms converge steadily",
        "the final returns are nearly identical across delay settings (here: those of PPO and SAC at one delay)",
    ),
    LOW: (
        "both algorithms reach higher returns than at high delay",
        "SAC converges faster than PPO",
        "PPO converges more stably than SAC",
        "returns of different seeds vary more than at high delay",
    ),
}


def judge_courses(delay: str, courses: Mapping[str, Mapping[str, Course]]) -> list[Claim]:
    high, low = courses[HIGH], courses[LOW]
    if delay == HIGH:
        last_difference = np.abs(high["PPO"].last - high["SAC"].last) - ALIKE * high["PPO"].rise
        unrest = {name: course.unrest - ALIKE * course.rise for name, course in high.items()}
        parts = [
            [Less(f"{name}: deviation minus a tenth of the rise", mean(excess)) for name, excess in unrest.items()],
            [Less("difference minus a tenth of PPO's rise", mean(last_difference))],
        ]
    else:
        parts = [
            [Less.of_lists(name, high[name].last, low[name].last) for name in high],
            [Less.of_lists("SAC minus PPO, decisions", low["SAC"].converged, low["PPO"].converged)],
            [Less.of_lists("PPO minus SAC, deviation in the last quarter", low["PPO"].unrest, low["SAC"].unrest)],
            [Less.of_lists(name, high[name].spread, low[name].spread) for name in high],
        ]
    claims = [judge(FIGURE[delay], text, part) for text, part in zip(STATEMENTS[delay], parts, strict=True)]
    return claims if delay == HIGH else [claims[0], convergence_claim(low, claims[1]), *claims[2:]]


def convergence_claim(courses: Mapping[str, Course], by_decisions: Claim) -> Claim:
    """Claim that SAC converges faster, as undecided.

    The paper's axis is the progress of trainings of unknown length. ``courses``: name -> learning curves.
    ``by_decisions``: the claim, judged by the number of decisions.
    """
    ends = {name: (course.converged.mean(), course.decisions) for name, course in courses.items()}
    text = ", ".join(f"{name} after {at:,.0f} of {total:,.0f} decisions" for name, (at, total) in ends.items())
    why = f"in decisions or in % of the training? The lengths are ours: {text} is at nine tenths of its rise"
    return by_decisions._replace(ours=f"by decisions it {by_decisions.ours}", outcome="undecided", why=why)
