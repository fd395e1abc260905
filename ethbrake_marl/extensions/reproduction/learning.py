"""Trainings by the paper's own process, and the learning curves of these trainings.

The process uses the recipes ``ppo-paper`` and ``sac-paper`` in the paper's fixed-step map (``physics: paper-map``):
five seeds in the random test, and three each at a high and a low delay (``fig:ppo_sac_high_latency``,
``fig:ppo_sac_low_latency``). For the paper's policy that has not converged, a PPO training with our recipe is stopped
early.
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
STATUS = "run.json"  # file with the status of a run


class TrainingPlan(NamedTuple):
    scenario: str
    recipe: str
    seeds: int
    seconds: float  # processor time of the training of one seed, for estimates
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
    """Folders of the finished trainings in a group, such as ``RANDOM``: recipe -> one folder for each seed.

    A recipe is left out unless the trainings of all its seeds are finished.
    """
    runs_of_recipe = {plan.recipe: runs_of(folder, group, plan) for plan in TRAINING_GROUPS[group]}
    return {recipe: runs for recipe, runs in runs_of_recipe.items() if all(map(is_finished, runs))}


def seconds_left(folder: Path, groups: Iterable[str]) -> float:
    plans = [(group, plan) for group in groups for plan in TRAINING_GROUPS[group]]
    return sum(plan.seconds for group, plan in plans for run in runs_of(folder, group, plan) if not is_finished(run))


def train_groups(settings: ReproductionSettings, groups: Iterable[str]) -> bool:
    """Start or continue the unfinished trainings of groups such as ``RANDOM``. Return False if Ctrl-C stopped one.

    Raises ``MissingExtra`` if torch is not installed, and the errors of ``eb.train`` and ``eb.resume``.
    """
    for group in groups:
        for plan in TRAINING_GROUPS[group]:
            for seed, run in enumerate(runs_of(settings.folder, group, plan)):
                if not (is_finished(run) or _train(plan, run, seed, settings)):
                    return False
    return True


def _train(plan: TrainingPlan, run: Path, seed: int, settings: ReproductionSettings) -> bool:
    """Start or continue the training of one seed in the folder ``run``. Return False if Ctrl-C stopped it."""
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
    """Agent name of our PPO policy whose training is stopped after a fifteenth of the recipe's decisions.

    It stands for the paper's policy "obtained from training before convergence occurred".
    """
    ((run,),) = finished_runs(folder, STOPPED).values()
    return f"policy@{run / 'policy-last'}"


def process(settings: ReproductionSettings, group: str = RANDOM) -> dict[str, list[str]]:
    """Agent names of policies trained as in the paper: ``PPO`` and ``SAC`` -> one agent name for each seed.

    ``group``: which trainings, such as ``RANDOM``. Empty unless ``settings.full``. An algorithm with an unfinished
    training is left out.
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
    """Learning curves of one recipe at one delay, for all seeds, over the progress of the training (0 to 100 %)."""

    returns: LearningCurves  # mean return of training episodes
    harm: LearningCurves  # first-impact harm in a fixed list of worlds (m2/s2)
    decisions: float = 100.0  # of the whole training

    @property
    def values(self) -> Floats:
        """Mean return of training episodes at k points of the training, [seeds, k]."""
        return np.array([[*curve.values()] for curve in self.returns])

    @property
    def late(self) -> Floats:
        """The ``values`` in the last quarter of the training, [seeds, at least 2]."""
        return self.values[:, -max(self.values.shape[1] // 4, 2) :]

    @property
    def last(self) -> Floats:
        """Mean return over the last tenth of the training, [seeds]."""
        return np.asarray(self.values[:, -max(self.values.shape[1] // 10, 1) :].mean(axis=1))

    @property
    def rise(self) -> Floats:
        """Increase of the return from its first value to ``last``, [seeds]."""
        return np.asarray(self.last - self.values[:, 0])

    @property
    def converged(self) -> Floats:
        """Number of decisions until the return has made nine tenths of its ``rise``, [seeds].

        If the return of a seed does not rise: all decisions of the training.
        """
        risen = self.values >= (self.values[:, 0] + RISEN * self.rise)[:, np.newaxis]
        progress = np.where(self.rise > 0.0, np.array([*self.returns[0]])[risen.argmax(axis=1)], 100.0)
        return 0.01 * self.decisions * progress

    @property
    def unrest(self) -> Floats:
        """Standard deviation of the return over the last quarter of the training, [seeds]."""
        return np.asarray(self.late.std(axis=1, ddof=1))

    @property
    def spread(self) -> Floats:
        """Mean distance of a seed's return from the mean of all seeds, in the last quarter of the training, [seeds]."""
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
    """Fig. 2 or 3: learning curves at a high or low ``delay``, and the paper's statements about them.

    Without finished trainings at both delays, the verdict on these statements is "not run".
    """
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
    """Verdicts on the paper's statements about the learning curves at a high or low ``delay``.

    ``courses``: delay -> algorithm -> learning curves.
    """
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
    """Verdict on the statement that SAC converges faster than PPO: always "undecided".

    The paper's axis is the progress (%) of trainings, but the paper does not state their lengths. ``courses``:
    algorithm -> learning curves. ``by_decisions``: the verdict if convergence is counted in decisions.
    """
    ends = {name: (course.converged.mean(), course.decisions) for name, course in courses.items()}
    text = ", ".join(f"{name} after {at:,.0f} of {total:,.0f} decisions" for name, (at, total) in ends.items())
    why = f"in decisions or in % of the training? The lengths are ours: {text} is at nine tenths of its rise"
    return by_decisions._replace(ours=f"by decisions it {by_decisions.ours}", outcome="undecided", why=why)
