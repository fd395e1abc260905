"""Trainings by the paper's own process, and the learning curves of these trainings.

The process uses the recipes ``ppo-paper`` and ``sac-paper`` in the paper's fixed-step map (``physics: paper-map``):
five seeds in the random test, and three each at a high and a low delay (``fig:ppo_sac_high_latency``,
``fig:ppo_sac_low_latency``); two PPO trainings at the low delay have no terminal reward. For the paper's policy that
has not converged, a PPO training with our recipe is stopped early.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import FIRST_IMPACTS
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.figures import curve_over_seeds, curves_figure
from ethbrake_marl.extensions.report.style import axis_title
from ethbrake_marl.extensions.reproduction.made import DrawnFigure, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.verdicts import VERDICT_TOLERANCE, Claim, Less, judge
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.training.training import Training
from ethbrake_marl.worlds.scenario import Scenario

RANDOM, HIGH, LOW, STOPPED, DENSE = "random", "high", "low", "stopped", "dense"
STATUS = "run.json"  # file with the status of a run
FEWEST_RETURNS = 3  # of a learning curve: it has a middle and a last third


class TrainingPlan(NamedTuple):
    scenario: str
    recipe: str
    seeds: int
    seconds: float  # processor time of the training of one seed, for estimates
    decisions: int | None = None  # None: those of the recipe
    mapped: bool = True  # in the paper's map
    terminal: float | None = None  # reward at an end without a collision; None: that of the recipe


def _process(scenario: str, seeds: int, sac_s: float, sac_decisions: int | None = None) -> tuple[TrainingPlan, ...]:
    sac = TrainingPlan(scenario, "sac-paper", seeds, sac_s, sac_decisions)
    return TrainingPlan(scenario, "ppo-paper", seeds, 280.0), sac


TRAINING_GROUPS = {
    STOPPED: (
        TrainingPlan("paper-random", "ppo", 1, 6.0, 100_000, mapped=False),
    ),  # a fifteenth of the recipe's decisions
    RANDOM: _process("paper-random", 5, 3_900.0, 200_000),
    HIGH: _process("paper-delay-high", 3, 300.0),
    LOW: _process("paper-delay-low", 3, 300.0),
    DENSE: (TrainingPlan("paper-delay-low", "ppo-paper", 2, 280.0, terminal=0.0),),
}


def runs_of(folder: Path, group: str, plan: TrainingPlan) -> list[Path]:
    return [folder / "trainings" / group / f"{plan.recipe}-seed{seed}" for seed in range(plan.seeds)]


def is_finished(run: Path) -> bool:
    return (run / STATUS).is_file() and read_object(run / STATUS).get("status") == "finished"


def trained_runs(folder: Path, group: str) -> dict[TrainingPlan, list[Path]]:
    """Plan -> one folder of a run for each seed, without plans that have no training."""
    trained = {plan: [*filter(is_finished, runs_of(folder, group, plan))] for plan in TRAINING_GROUPS[group]}
    return {plan: runs for plan, runs in trained.items() if runs}


def seconds_left(folder: Path, groups: Iterable[str]) -> float:
    plans = [(group, plan) for group in groups for plan in TRAINING_GROUPS[group]]
    return sum(plan.seconds for group, plan in plans for run in runs_of(folder, group, plan) if not is_finished(run))


def train_groups(settings: ReproductionSettings, groups: Iterable[str]) -> bool:
    """False if Ctrl-C stopped one.

    Raises ``MissingExtra`` if torch is not installed, and the errors of ``eb.train`` and ``eb.resume``.
    """
    for group in groups:
        for plan in TRAINING_GROUPS[group]:
            for seed, run in enumerate(runs_of(settings.folder, group, plan)):
                if not (is_finished(run) or _train(plan, run, seed, settings)):
                    return False
    return True


def _train(plan: TrainingPlan, run: Path, seed: int, settings: ReproductionSettings) -> bool:
    """False if Ctrl-C stopped it."""
    import ethbrake_marl as eb

    if (run / STATUS).is_file():
        result = eb.resume(run, on_progress=settings.tell)
    else:
        training = planned_training(plan, seed)
        result = eb.train(training.recipe, training.scenario, run, on_progress=settings.tell)
    return result.status == "finished"


def planned_training(plan: TrainingPlan, seed: int) -> Training:
    import ethbrake_marl as eb

    scenario, recipe = eb.load_scenario(plan.scenario), eb.load_recipe(plan.recipe)
    if plan.mapped:
        scenario = scenario.replace(physics="paper-map")
    reward = {**recipe.reward.model_dump(mode="json"), "harm_count": "first"}
    if plan.terminal is not None:
        reward["terminal"] = plan.terminal
    return Training.of(recipe, scenario, reward=reward, seed=seed, total_steps=plan.decisions or recipe.total_steps)


def check_trainings(folder: Path) -> None:
    """Raise ``InvalidInput`` if a training in ``folder`` has another scenario or recipe than its plan."""
    plans = [(group, plan) for group in TRAINING_GROUPS for plan in TRAINING_GROUPS[group]]
    seeds = [(plan, seed, run) for group, plan in plans for seed, run in enumerate(runs_of(folder, group, plan))]
    for plan, seed, run in seeds:
        if (run / STATUS).is_file():
            file, right = run / "config.json", planned_training(plan, seed).content()
            config = read_object(file)
            try:
                content = Training.of(config["recipe"], Scenario(**config["scenario"])).content()
            except (KeyError, TypeError, InvalidInput) as error:
                raise InvalidInput(f"{file}: does not describe a training ({error})") from None
            others = [key for part in right for key in right[part] if content[part].get(key) != right[part][key]]
            if content != right:
                raise InvalidInput(
                    f"{file}: has other values of {', '.join(others)} than the plan, {plan.recipe} on {plan.scenario};"
                    f" delete the folder {run}, or use another --output"
                )


def unconverged_policy(folder: Path) -> str:
    """Agent name of our PPO policy whose training is stopped after a fifteenth of the recipe's decisions.

    It stands for the paper's policy "obtained from training before convergence occurred".
    """
    ((run,),) = trained_runs(folder, STOPPED).values()
    return f"policy@{run / 'policy-last'}"


def process(settings: ReproductionSettings) -> dict[str, list[str]]:
    """``PPO`` and ``SAC`` -> one agent name for each seed."""
    trained = trained_runs(settings.folder, RANDOM)
    return {NAMES[plan.recipe]: [f"policy@{run / 'policy'}" for run in runs] for plan, runs in trained.items()}


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
    decisions: float = 100.0  # of a training
    seconds: float = 0.0  # processor time of a training, mean over seeds
    planned_seeds: int = 1

    @property
    def values(self) -> Floats:
        """At k points of the training, [seeds, k]."""
        return np.array([[*curve.values()] for curve in self.returns])

    @property
    def late(self) -> Floats:
        """The last quarter of ``values``, [seeds, at least 2]."""
        return self.values[:, -max(self.values.shape[1] // 4, 2) :]

    @property
    def last(self) -> Floats:
        """Mean over the last tenth of the training, [seeds]."""
        return np.asarray(self.values[:, -max(self.values.shape[1] // 10, 1) :].mean(axis=1))

    @property
    def rise(self) -> Floats:
        """From the first value to ``last``, [seeds]."""
        return np.asarray(self.last - self.values[:, 0])

    @property
    def improvement(self) -> float:
        """Last third of the training minus middle third, mean over seeds."""
        third = self.values.shape[1] // 3
        return float((self.values[:, -third:] - self.values[:, -2 * third : -third]).mean())

    @property
    def is_converged(self) -> bool:
        """Whether the return rises, and the ``improvement`` is at most 2 % of the mean ``rise``.

        The last quarter alone cannot show it: the learning rate falls, so every training is calm in the end.
        """
        rise = float(self.rise.mean())
        return rise > 0.0 and self.improvement <= VERDICT_TOLERANCE * rise

    @property
    def has_interval(self) -> bool:
        return len(self.returns) > 1

    @property
    def length(self) -> str:
        return (
            f"{len(self.returns)} of {self.planned_seeds} seeds, {self.decisions:,.0f} decisions,"
            f" {self.seconds:,.0f} CPU-s, last third {self.improvement:+.2f} of a rise of {self.rise.mean():.1f}"
        )

    @property
    def converged(self) -> Floats:
        """Number of decisions until the return has made nine tenths of its ``rise``, [seeds].

        If the return of a seed does not rise: all decisions of the training.
        """
        risen = self.values >= (self.values[:, 0] + RISEN * self.rise)[:, np.newaxis]
        progress = np.where(self.rise > 0.0, np.array([*self.returns[0]])[risen.argmax(axis=1)], 100.0)
        return 0.01 * self.decisions * progress

    @property
    def last_harm(self) -> Floats:
        """[seeds] m2/s2."""
        return np.array([curve[100.0] for curve in self.harm])

    @property
    def unrest(self) -> Floats:
        """Standard deviation of the return over the last quarter, [seeds]."""
        return np.asarray(self.late.std(axis=1, ddof=1))

    @property
    def spread(self) -> Floats:
        """Mean distance from the mean of all seeds, in the last quarter of the training, [seeds]."""
        return np.asarray(np.abs(self.late - self.late.mean(axis=0)).mean(axis=1))


def column(run: Path, name: str) -> dict[float, float]:
    rows = csv.DictReader((run / "progress.csv").read_text("utf-8").splitlines())
    return {float(row["steps"]): float(row[name]) for row in rows if row.get(name)}


def course_of(runs: Sequence[Path], planned_seeds: int) -> Course:
    """Raises ``InvalidInput`` if the runs share fewer than three steps with a return, or none with a harm."""
    curves = [[column(run, name) for run in runs] for name in (RETURN, HARM)]
    seconds = [read_object(run / STATUS)["evaluations"][-1]["cpu_s"] for run in runs]
    steps = [sorted(set.intersection(*map(set, of_seeds))) for of_seeds in curves]
    if len(steps[0]) < FEWEST_RETURNS or not steps[1]:
        raise InvalidInput(
            f"{runs[0].parent}: the files progress.csv of {', '.join(run.name for run in runs)} share too few steps for"
            " a learning curve; delete the folder whose file is damaged, or use another --output"
        )
    last = steps[1][-1]
    returns, harm = (
        [{100.0 * k / last: curve[k] for k in shared} for curve in of_seeds]
        for of_seeds, shared in zip(curves, steps, strict=True)
    )
    return Course(returns, harm, last, sum(seconds) / len(seconds), planned_seeds)


def courses_of(settings: ReproductionSettings, group: str) -> dict[str, Course]:
    trained = trained_runs(settings.folder, group)
    return {NAMES[plan.recipe]: course_of(runs, plan.seeds) for plan, runs in trained.items()}


def judge_trained(
    name: str, courses: Mapping[str, Course], parts: Sequence[Less], *, numbers: str = "", choice_decides: bool = False
) -> Claim:
    """The verdict is "not converged" unless all trainings have converged, and "undecided" if one of several planned
    seeds is trained, or if only our choice of trainings decides (``choice_decides``).
    """
    claim = judge(name, parts, numbers=numbers)
    lengths = "; ".join(f"{algorithm}: {course.length}" for algorithm, course in courses.items())
    decided = not choice_decides and all(course.has_interval for course in courses.values())
    verdict = claim.verdict if decided else "undecided"
    if not all(course.is_converged for course in courses.values()):
        verdict = "not converged"
    return claim._replace(ours=f"{claim.ours} ({lengths})", verdict=verdict)


def reproduce_curves(delay: str, settings: ReproductionSettings) -> Made:
    """Fig. 2 or 3. All statements but those about the terminal reward need PPO and SAC at both delays."""
    courses = {level: courses_of(settings, level) for level in (HIGH, LOW)}
    delay_courses, claims = courses[delay], list[Claim]()
    if not delay_courses:
        return Made()
    title = f"Learning curves at {delay} delay, the paper's process"
    text = f"{title}: return and harm against progress, mean over seeds; bands: one standard deviation."
    panels = {
        "Mean return of training episodes": {
            name: curve_over_seeds(course.returns) for name, course in delay_courses.items()
        },
        f"{axis_title(FIRST_IMPACTS)}, fixed list": {
            name: curve_over_seeds(course.harm) for name, course in delay_courses.items()
        },
    }
    figure = DrawnFigure(f"learning-{delay}", title, text, curves_figure(panels, "Training progress (%)", text))
    rows = [
        (name, len(course.harm), course.length, mean(course.last_harm), mean(course.last))
        for name, course in delay_courses.items()
    ]
    note = "Harm: first-impact, m²/s², 1,000 worlds of seed 1007. Return: of the last tenth. t intervals over seeds."
    columns = ("Algorithm", Column("Seeds"), "Length", Column("Last policy, harm"), Column("Last return"))
    if all(len(courses[level]) == len(NAMES) for level in courses):
        high, low = courses.values()
        claims += claims_at_high_delay(high) if delay == HIGH else claims_at_low_delay(high, low)
    if delay == LOW and "PPO" in delay_courses:
        claims += reward_claims(delay_courses["PPO"], courses_of(settings, DENSE))
    return Made(claims, [Sheet(title, columns, rows, note)], [figure])


def claims_at_high_delay(high: Mapping[str, Course]) -> list[Claim]:
    apart = np.abs(high["PPO"].last - high["SAC"].last) - ALIKE * high["PPO"].rise
    suits = [
        Less.of_lists("PPO minus SAC, deviation in the last quarter", high["PPO"].unrest, high["SAC"].unrest),
        Less.of_lists("PPO minus SAC, harm", high["PPO"].last_harm, high["SAC"].last_harm),
    ]
    near = [Less("difference minus a tenth of PPO's rise", mean(apart))]
    return [
        judge_trained("steady", high, [steadiness(name, course) for name, course in high.items()]),
        judge_trained("alike", high, near, choice_decides=True),
        judge_trained("PPO suits", high, suits),
    ]


def steadiness(name: str, course: Course) -> Less:
    return Less(f"{name}: deviation minus a tenth of the rise", mean(course.unrest - ALIKE * course.rise))


def claims_at_low_delay(high: Mapping[str, Course], low: Mapping[str, Course]) -> list[Claim]:
    """That SAC converges faster is at best "undecided": the paper's axis is the progress (%) of trainings, and the
    paper does not state their lengths.
    """
    ppo, sac = low["PPO"], low["SAC"]
    pairs = {name: {f"{name}, {HIGH}": high[name], f"{name}, {LOW}": low[name]} for name in low}
    both = pairs["PPO"] | pairs["SAC"]
    sooner = ", ".join(f"{name} after {course.converged.mean():,.0f} decisions" for name, course in low.items())
    faster = [Less.of_lists("SAC minus PPO, decisions", sac.converged, ppo.converged)]
    higher = [Less.of_lists(name, high[name].last, low[name].last) for name in high]
    safer = [Less.of_lists(f"{name}, harm", low[name].last_harm, high[name].last_harm) for name in high]
    varied = [Less.of_lists(name, high[name].spread, low[name].spread) for name in high]
    steadier = [Less.of_lists("PPO minus SAC, deviation in the last quarter", ppo.unrest, sac.unrest)]
    suits = [*faster, Less.of_lists("SAC minus PPO, harm", sac.last_harm, ppo.last_harm)]
    return [
        *(
            judge_trained(f"{name} converges", pair, [steadiness(delay, course) for delay, course in pair.items()])
            for name, pair in pairs.items()
        ),
        judge_trained("faster", low, faster, numbers=f"{sooner} is at nine tenths of its rise", choice_decides=True),
        judge_trained("higher", both, higher),
        judge_trained("safer", both, safer),
        judge_trained("steadier", low, steadier),
        judge_trained("varied", both, varied),
        judge_trained("SAC suits", low, suits, choice_decides=True),
    ]


def reward_claims(sparse: Course, dense: Mapping[str, Course]) -> list[Claim]:
    """Empty if there is no training without the terminal reward."""
    if not dense:
        return []
    (course,) = dense.values()
    both = {"with": sparse, "without": course}
    unrest = [curve.unrest / curve.rise for curve in both.values()]
    shares = " with it, ".join(f"{100.0 * share.mean():.1f} %" for share in unrest)
    harms = " with it, ".join(f"{curve.last_harm.mean():.2f}" for curve in both.values())
    calmer = [Less.of_lists("", unrest[1], 0.5 * unrest[0])]  # without it, less than half of the deviation
    safer = [Less.of_lists("", sparse.last_harm, course.last_harm)]
    return [
        judge_trained("sparse", both, calmer, numbers=f"deviation in the last quarter {shares} of the rise without"),
        judge_trained("terminal", both, safer, numbers=f"harm {harms} without"),
    ]
