"""The trainings of ``ethbrake reproduce --full``: learning curves, a policy stopped early, open weights of the reward.

Each group is a folder of learning curves: finished trainings are kept, begun ones go on, by the rules of
``learning_curves.train_all``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import OnProgress
from ethbrake_marl.evaluation.seed_statistics import interquartile_mean
from ethbrake_marl.evaluation.statistics import Estimate, mean, unpaired_difference
from ethbrake_marl.figures.studies import SeedCurve, at_common_steps, seed_curves
from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.learning.training import RETURN, RunDirectory, is_finished, progress_column, progress_rows
from ethbrake_marl.physics import Floats
from ethbrake_marl.policies.bundle import Policy, load_policy
from ethbrake_marl.policies.shipped import load_shipped
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.shield import HybridAgent
from ethbrake_marl.shield.guard import Bound
from ethbrake_marl.studies.reproduction.item import (
    AS_STATED,
    FULL,
    FULL_BRAKE,
    HARM,
    NAMES,
    NOT_RUN,
    PPO,
    PROVEN,
    READINGS,
    SAC,
    UNDECIDED,
    UNIVERSAL,
    Drawn,
    Less,
    Made,
    Parameter,
    Settings,
    Show,
    Table,
    Verdict,
    csv_text,
    drive_list,
    harms,
    judge_statement,
    lineup,
    read_scenario,
    scenario_parameters,
)

FOLDER = "trainings"  # inside the folder of a reproduction
STOPPED, OPEN = "stopped", "open"
CURVES = {delay: (delay, f"{delay}-ppo-paper", f"{delay}-sac-paper") for delay in ("low", "high")}  # -> groups
SEEDS = 3
TRAINED_HARM = "eval/first_impact_harm"  # column of a training's table
STATED_STATE = (  # positions and speeds of all, and the others' actions: no more is in the paper's state
    "own.speed", "own.acceleration", "front_1.gap", "front_1.closing_speed", "front_1.acceleration", "rear_1.gap",
    "rear_1.closing_speed", "rear_1.acceleration",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TrainedRecipe:
    """So many decisions of a recipe, measured every so many updates, and what they take.

    ``per_s``: decisions per second of one core (Intel Xeon), for the estimate that is told beforehand.
    """

    recipe: str
    decisions: int
    every_updates: int
    per_s: int

    def load(self, name: str | None = None, **changes: Any) -> TrainingRecipe:
        """The recipe; under another name with ``changes``."""
        found = load_recipe(self.recipe)
        evaluation = {**found.evaluation.model_dump(), "every_updates": self.every_updates}
        if "log_every_updates" in type(found).model_fields:  # else a table has a row for every update
            changes["log_every_updates"] = self.every_updates
        return found.replace(name=name or found.name, total_steps=self.decisions, evaluation=evaluation, **changes)


PPO_RECIPE = TrainedRecipe("ppo", 400_000, 4, 16_000)
SAC_RECIPE = TrainedRecipe("sac", 60_000, 30, 3_000)
PPO_PAPER = TrainedRecipe("ppo-paper", 100_000, 1, 5_000)
SAC_PAPER = TrainedRecipe("sac-paper", 20_000, 1_000, 170)
EARLY = TrainedRecipe("ppo", 100_000, 4, 16_000)  # a fifteenth of the recipe's own number


@dataclass(frozen=True, slots=True)
class Group:
    """Trainings on one scenario in one folder, in the order in which they are done."""

    name: str
    scenario: str  # a shipped one
    trained: Mapping[str, tuple[TrainedRecipe, TrainingRecipe]]  # by the name that the recipe has there
    seeds: int

    def load_scenario(self) -> Scenario:
        """The scenario."""
        return load_scenario(self.scenario)


def _curves(name: str, scenario: str, recipes: Sequence[TrainedRecipe]) -> Group:
    return Group(name, scenario, {each.recipe: (each, each.load()) for each in recipes}, SEEDS)


def reward_variants() -> dict[str, dict[str, Any]]:
    """What differs from ``ppo-paper`` in each training of the open quantities, by its name there."""
    base = PPO_PAPER.load().reward.model_dump(exclude_defaults=True)
    changed = {"risk-0": {"risk": 0.0}, "risk-1": {"risk": 1.0}, "jerk-1e-4": {"jerk": 1e-4}}
    changed["terminal-0"] = {"terminal": 0.0}
    rewards = {f"ppo-paper-{name}": {"reward": {**base, **own}} for name, own in changed.items()}
    return {"ppo-paper": {}, **rewards, "ppo-paper-state": {"observation": STATED_STATE}}


def groups() -> tuple[Group, ...]:
    """Every group, the quickest first, so that results are there early."""
    variants = {name: (PPO_PAPER, PPO_PAPER.load(name, **own)) for name, own in reward_variants().items()}
    return (
        Group(STOPPED, "paper-random", {"ppo-stopped": (EARLY, EARLY.load("ppo-stopped"))}, 1),
        *(_curves(delay, f"paper-delay-{delay}", (PPO_RECIPE, SAC_RECIPE)) for delay in CURVES),
        *(_curves(f"{delay}-ppo-paper", f"paper-delay-{delay}", (PPO_PAPER,)) for delay in CURVES),
        Group(OPEN, "paper-random", variants, 2),
        *(_curves(f"{delay}-sac-paper", f"paper-delay-{delay}", (SAC_PAPER,)) for delay in CURVES),
    )


def group_named(name: str) -> Group:
    """The group of that name."""
    return {group.name: group for group in groups()}[name]


def training_folders(folder: Path, group: Group) -> Iterator[tuple[str, list[Path]]]:
    """Each recipe of a group, and the folders of its seeds."""
    for name in group.trained:
        yield name, [folder / FOLDER / group.name / f"{name}-seed{seed}" for seed in range(group.seeds)]


def finished(folder: Path, group: Group) -> dict[str, list[Path]]:
    """The recipes of a group all of whose seeds have been trained to the end, and their folders."""
    return {name: paths for name, paths in training_folders(folder, group) if all(is_finished(p) for p in paths)}


def seconds_left(folder: Path, wanted: Collection[str]) -> float:
    """Seconds of one core that the trainings of these groups still take, begun ones reckoned whole."""
    left = 0.0
    for group in groups():
        if group.name in wanted:
            for name, paths in training_folders(folder, group):
                trained, _ = group.trained[name]
                left += sum(trained.decisions / trained.per_s for path in paths if not is_finished(path))
    return left


def trained_names(folder: Path, wanted: Collection[str]) -> list[str]:
    """Every recipe of these groups whose seeds are all trained, as ``group/recipe``."""
    return [f"{group.name}/{name}" for group in groups() if group.name in wanted for name in finished(folder, group)]


def train_groups(folder: Path, wanted: Collection[str], tell: OnProgress | None = None) -> bool:
    """Train what is left of these groups, in their order; False when Ctrl-C stopped it."""
    # torch takes seconds to load, and nothing else here needs it
    from ethbrake_marl.studies.learning_curves import Trainings, train_all

    for group in groups():
        if group.name in wanted:
            plan = [Trainings(recipe, group.seeds) for _, recipe in group.trained.values()]
            if not train_all(group.load_scenario(), plan, folder / FOLDER / group.name, tell=tell):
                return False
    return True


# The policies that ``ethbrake reproduce`` lets drive beside the shipped ones, as agents.

STAND_IN = "universal-ppo"  # the shipped policy that stands in for one that has not converged, where nothing is trained


class Unconverged(NamedTuple):
    """The policy that stands for the paper's "PPO model obtained from training before convergence occurred"."""

    policy: Policy
    about: str  # what it is


def unconverged_policy(settings: Settings) -> Unconverged:
    """The one stopped early that ``--full`` has trained, else a shipped policy that stands in for it."""
    if settings.mode == FULL:
        for (path,) in finished(settings.folder, group_named(STOPPED)).values():
            policy = load_policy(RunDirectory(path).last_policy)
            about = f"PPO stopped early: the last policy of {EARLY.decisions:,} decisions on paper-random"
            return Unconverged(policy, about)
    about = f"the shipped policy {STAND_IN!r}, trained for other worlds, stands in for one that has not converged"
    return Unconverged(load_shipped(STAND_IN), about)


def hybrid(policy: Policy, scenario: Scenario, bound: Bound) -> Agent:
    """Algorithm 1 around a policy."""
    return HybridAgent(LearnedAgent(policy, "policy"), scenario, bound=bound)


# The ends of learning curves without the curves: what finished policies reach at high and low delay.

_WORLDS = 2_000
_SPECS = (PPO, SAC, UNIVERSAL, FULL_BRAKE)
_DELAYS = ("low", "high")


class Ends(NamedTuple):
    """Verdicts, tables and data."""

    verdicts: tuple[Verdict, ...]
    tables: tuple[Table, ...]
    data: dict[str, str]


def shipped_ends(settings: Settings) -> Ends:
    """Harm of shipped policies at both delays, in both readings of when Vehicle 2 acts."""
    episodes = settings.worlds(_WORLDS)
    verdicts, rows, raw = [], [], []
    for reading in READINGS:
        found: dict[str, dict[str, Floats]] = {}
        for delay in _DELAYS:
            scenario = read_scenario(f"paper-delay-{delay}", reading)
            found[delay] = harms(drive_list(scenario, lineup(_SPECS, scenario), episodes, settings))
        low, high = (found[delay] for delay in _DELAYS)
        for name in low:
            rows.append((reading.name, name, HARM.estimate(mean(low[name])), HARM.estimate(mean(high[name]))))
            raw += [[reading.name, name, delay, episodes, float(found[delay][name].mean())] for delay in _DELAYS]
        parts = [
            Less(name, unpaired_difference(mean(low[name]), episodes, mean(high[name]), episodes))
            for name in low
            if name not in (NAMES[FULL_BRAKE], PROVEN)
        ]
        what = f"finished policies harm less at low delay than at high ({reading.name})"
        verdicts.append(judge_statement(what, parts))
    note = (
        f"First-impact harm, m²/s², {episodes:,} worlds of seed 7 each. PPO and SAC were trained at 0.5 and 0.8 s,"
        " universal for all latencies; none at these delays alone."
    )
    head = ("Reading", "Strategy", "Low delay", "High delay")
    table = Table("What finished policies reach", head, tuple(rows), note)
    data = csv_text(("reading", "strategy", "delay", "worlds", "first_impact_harm"), raw)
    return Ends(tuple(verdicts), (table,), {"finished-policies": data})


# The paper's learning curves at high and low delay (``fig:ppo_sac_high_latency``, ``fig:ppo_sac_low_latency``).

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
