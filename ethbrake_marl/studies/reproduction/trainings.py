"""The trainings of ``ethbrake reproduce --full``: learning curves, a policy stopped early, open weights of the reward.

Each group is a folder of learning curves: finished trainings are kept, begun ones go on, by the rules of
``learning_curves.train_all``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import OnProgress
from ethbrake_marl.evaluation.seed_statistics import interquartile_mean
from ethbrake_marl.evaluation.statistics import Estimate, mean
from ethbrake_marl.figures.studies import SeedCurve, at_common_steps, seed_curves
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.learning.training import RETURN, RunDirectory, is_finished, progress_column, progress_rows
from ethbrake_marl.physics import Floats
from ethbrake_marl.policies.bundle import Policy, load_policy
from ethbrake_marl.policies.shipped import load_shipped
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.shield import HybridAgent
from ethbrake_marl.shield.guard import Bound
from ethbrake_marl.studies.reproduction.item import (
    FULL_BRAKE,
    NAMES,
    PPO,
    PROVEN,
    READINGS,
    SAC,
    UNIVERSAL,
    Drawn,
    Less,
    Made,
    Parameter,
    Settings,
    Verdict,
    csv_text,
    drive_list,
    harms,
    judge_statement,
    lineup,
    scenario_parameters,
    stated,
)

STOPPED, OPEN = "stopped", "open"
CURVES = {delay: (delay, f"{delay}-ppo-paper", f"{delay}-sac-paper") for delay in ("low", "high")}  # -> groups
_SEEDS = 3
_HARM = "eval/first_impact_harm"  # column of a training's table
_STATED_STATE = (  # positions and speeds of all, and the others' actions: no more is in the paper's state
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

    def load(self, name: str, **changes: Any) -> TrainingRecipe:
        """The recipe under this name, with ``changes``."""
        found = load_recipe(self.recipe)
        evaluation = {**found.evaluation.model_dump(), "every_updates": self.every_updates}
        if "log_every_updates" in type(found).model_fields:  # else a table has a row for every update
            changes["log_every_updates"] = self.every_updates
        return found.replace(name=name, total_steps=self.decisions, evaluation=evaluation, **changes)


PPO_PAPER = TrainedRecipe("ppo-paper", 100_000, 1, 5_000)
_OURS = (TrainedRecipe("ppo", 400_000, 4, 16_000), TrainedRecipe("sac", 60_000, 30, 3_000))
_SAC_PAPER = TrainedRecipe("sac-paper", 20_000, 1_000, 170)
_EARLY = TrainedRecipe("ppo", 100_000, 4, 16_000)  # a fifteenth of the recipe's own number


@dataclass(frozen=True, slots=True)
class Group:
    """Trainings on one scenario in one folder, in the order in which they are done."""

    name: str
    scenario: str  # a shipped one
    trained: Mapping[str, tuple[TrainedRecipe, TrainingRecipe]]  # by the name that the recipe has there
    seeds: int

    def folders(self, folder: Path) -> dict[str, list[Path]]:
        """The folders of the seeds of each recipe, in the folder of a reproduction."""
        place = folder / "trainings" / self.name
        return {name: [place / f"{name}-seed{seed}" for seed in range(self.seeds)] for name in self.trained}

    def finished(self, folder: Path) -> dict[str, list[Path]]:
        """The recipes all of whose seeds have been trained to the end, and their folders."""
        return {name: paths for name, paths in self.folders(folder).items() if all(map(is_finished, paths))}


def groups() -> dict[str, Group]:
    """Every group by its name, the quickest first, so that results are there early."""
    base = PPO_PAPER.load("ppo-paper").reward.model_dump(exclude_defaults=True)
    changed = {"risk-0": {"risk": 0.0}, "risk-1": {"risk": 1.0}, "jerk-1e-4": {"jerk": 1e-4}}
    changed["terminal-0"] = {"terminal": 0.0}
    variants: dict[str, dict[str, Any]] = {
        "ppo-paper": {},
        **{f"ppo-paper-{name}": {"reward": {**base, **own}} for name, own in changed.items()},
        "ppo-paper-state": {"observation": _STATED_STATE},
    }

    def curves(suffix: str, *recipes: TrainedRecipe) -> list[Group]:
        trained = {each.recipe: (each, each.load(each.recipe)) for each in recipes}
        return [Group(f"{delay}{suffix}", f"paper-delay-{delay}", trained, _SEEDS) for delay in CURVES]

    found = [
        Group(STOPPED, "paper-random", {"ppo-stopped": (_EARLY, _EARLY.load("ppo-stopped"))}, 1),
        *curves("", *_OURS),
        *curves("-ppo-paper", PPO_PAPER),
        Group(
            OPEN, "paper-random", {name: (PPO_PAPER, PPO_PAPER.load(name, **own)) for name, own in variants.items()}, 2
        ),
        *curves("-sac-paper", _SAC_PAPER),
    ]
    return {group.name: group for group in found}


def seconds_left(folder: Path, wanted: Collection[str]) -> float:
    """Seconds of one core that the trainings of these groups still take, begun ones reckoned whole."""
    left = 0.0
    for group in groups().values():
        if group.name in wanted:
            for name, paths in group.folders(folder).items():
                trained, _ = group.trained[name]
                left += sum(trained.decisions / trained.per_s for path in paths if not is_finished(path))
    return left


def trained_names(folder: Path, wanted: Collection[str]) -> list[str]:
    """Every recipe of these groups whose seeds are all trained, as ``group/recipe``."""
    chosen = [group for group in groups().values() if group.name in wanted]
    return [f"{group.name}/{name}" for group in chosen for name in group.finished(folder)]


def train_groups(folder: Path, wanted: Collection[str], tell: OnProgress | None = None) -> bool:
    """Train what is left of these groups, in their order; False when Ctrl-C stopped it."""
    # torch takes seconds to load, and nothing else here needs it
    from ethbrake_marl.studies.learning_curves import Trainings, train_all

    for group in groups().values():
        if group.name in wanted:
            plan = [Trainings(recipe, group.seeds) for _, recipe in group.trained.values()]
            if not train_all(load_scenario(group.scenario), plan, folder / "trainings" / group.name, tell=tell):
                return False
    return True


def kept_harms(settings: Settings, group: str) -> dict[str, list[float]]:
    """Harm of the kept policy of each seed of each recipe of a group; none where nothing was trained."""
    found = groups()[group].finished(settings.folder) if settings.mode == "full" else {}
    return {
        name: [min(progress_column(progress_rows(path), _HARM).values()) for path in paths]
        for name, paths in found.items()
    }


# The policies that ``ethbrake reproduce`` lets drive beside the shipped ones, as agents.

_STAND_IN = (
    "universal-ppo"  # the shipped policy that stands in for one that has not converged, where nothing is trained
)


class Unconverged(NamedTuple):
    """The policy that stands for the paper's "PPO model obtained from training before convergence occurred"."""

    policy: Policy
    about: str  # what it is


def unconverged_policy(settings: Settings) -> Unconverged:
    """The one stopped early that ``--full`` has trained, else a shipped policy that stands in for it."""
    if settings.mode == "full":
        for (path,) in groups()[STOPPED].finished(settings.folder).values():
            about = f"PPO stopped early: the last policy of {_EARLY.decisions:,} decisions on paper-random"
            return Unconverged(load_policy(RunDirectory(path).last_policy), about)
    about = f"the shipped policy {_STAND_IN!r}, trained for other worlds, stands in for one that has not converged"
    return Unconverged(load_shipped(_STAND_IN), about)


def hybrid(policy: Policy, scenario: Scenario, bound: Bound) -> Agent:
    """Algorithm 1 around a policy."""
    return HybridAgent(LearnedAgent(policy, "policy"), scenario, bound=bound)


# The paper's learning curves at high and low delay (``fig:ppo_sac_high_latency``, ``fig:ppo_sac_low_latency``).

HIGH, LOW = "high", "low"
_WORLDS = 2_000
_PAIRS = {  # stem of the figure -> recipes, and what is about them
    "ours": ("ppo", "sac", "our recipes", "our recipes"),
    "paper": (
        "ppo-paper", "sac-paper", "the paper's hyperparameters", "the paper's hyperparameters and reward",
    ),
}  # fmt: skip
_NEARLY = 0.05  # of the rise of the return: what "nearly identical" allows
_DONE = 0.9  # of the fall of the harm: when a training has converged
_NUMBER, _DECISIONS = Column("Final return", digits=3), Column("Decisions", digits=0)


def _shipped_ends(settings: Settings) -> Made:
    """What finished policies reach at both delays, in both readings of when Vehicle 2 acts."""
    episodes = min(_WORLDS, settings.episodes)
    verdicts, rows, data = [], [], []
    for reading in READINGS:
        found: dict[str, dict[str, Floats]] = {}
        for delay in (LOW, HIGH):
            scenario = reading.scenario(f"paper-delay-{delay}")
            agents = lineup((PPO, SAC, UNIVERSAL, FULL_BRAKE), scenario)
            found[delay] = harms(drive_list(scenario, agents, episodes, settings))
        low, high = found[LOW], found[HIGH]
        for name in low:
            rows.append((reading.name, name, mean(low[name]), mean(high[name])))
            data += [[reading.name, name, delay, episodes, float(found[delay][name].mean())] for delay in found]
        learned = [name for name in low if name not in (NAMES[FULL_BRAKE], PROVEN)]
        parts = [Less.of_lists(name, low[name], high[name]) for name in learned]
        verdicts.append(
            judge_statement(f"finished policies harm less at low delay than at high ({reading.name})", parts)
        )
    note = (
        f"First-impact harm, m²/s², {episodes:,} worlds of seed 7 each. PPO and SAC were trained at 0.5 and 0.8 s,"
        " universal for all latencies; none at these delays alone."
    )
    table = Sheet("What finished policies reach", ("Reading", "Strategy", "Low delay", "High delay"), rows, note)
    csv = csv_text(("reading", "strategy", "delay", "worlds", "first_impact_harm"), data)
    return Made(verdicts, (), [table], data={"finished-policies": csv})


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

    def returns_at(self, shares: Floats) -> Floats:
        """Of each seed, its return after these shares of the training [seeds, k]."""
        steps = shares * self.returns.steps[-1]
        return np.array([np.interp(steps, self.returns.steps, own) for own in self.returns.values])

    def unrest(self, points: int) -> Floats:
        """Of each seed: spread of the changes of its return between ``points`` in the second half, share of the rise.

        The points lie at equal parts of the training, so trainings of other lengths compare.
        """
        changes: Floats = np.diff(self.returns_at(np.linspace(0.5, 1.0, points)), axis=1).std(axis=1) / abs(self.rise)
        return changes

    @property
    def still_rising(self) -> float:
        """The share of the rise that falls into the last quarter of the training, mean over seeds."""
        before = self.returns_at(np.array([0.75]))[:, 0]
        return float((self.returns.values[:, -1] - before).mean()) / abs(self.rise)

    @property
    def spread(self) -> Floats:
        """Standard deviation over seeds of the return, at each step of the second half."""
        half = self.returns.values[:, len(self.returns.steps) // 2 :]
        deviations: Floats = half.std(axis=0, ddof=1)
        return deviations


Courses = Mapping[str, Course]  # by recipe


def reproduce_curves(delay: str, settings: Settings) -> Made:
    """The curves that ``--full`` has trained; without them what finished policies reach at this delay."""
    courses = {each: read_courses(settings.folder, each) if settings.mode == "full" else {} for each in (HIGH, LOW)}
    ends = settings.once(("finished policies",), lambda: _shipped_ends(settings))
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
    return Made(verdicts, parameters, [_table(delay, own), *ends.tables], figures, data, notes)


def read_courses(folder: Path, delay: str) -> dict[str, Course]:
    """The courses of every recipe all of whose seeds have been trained."""
    found, every = {}, groups()
    for group in CURVES[delay]:
        for name, paths in every[group].finished(folder).items():
            tables = [progress_rows(path) for path in paths]
            found[name] = Course(
                *(at_common_steps([progress_column(table, what) for table in tables]) for what in (RETURN, _HARM))
            )
    return found


def _judge(delay: str, courses: Mapping[str, Courses]) -> list[Verdict]:
    """The paper's statements about one of the two figures."""
    own = courses[delay]
    if not own:
        return [Verdict(f"learning curves at {delay} delay", "not run", "no training; --full trains them")]
    verdicts = [_higher_when_low(courses)] if courses[HIGH] and courses[LOW] else []
    for ppo, sac, _, about in _PAIRS.values():
        if not {ppo, sac} <= own.keys():
            verdicts.append(Verdict(f"PPO against SAC, {about}", "not run", f"{ppo} and {sac} are not both trained"))
        elif delay == HIGH:
            verdicts.append(_nearly_identical(own[ppo], own[sac], about))
        else:
            verdicts += _faster_and_steadier(own[ppo], own[sac], about)
    if delay == LOW and courses[HIGH]:
        verdicts.append(_spreads_more(courses))
    return verdicts


def _higher_when_low(courses: Mapping[str, Courses]) -> Verdict:
    what, parts = "both algorithms reach higher returns at low delay than at high", []
    for name in sorted(courses[HIGH].keys() & courses[LOW].keys()):
        high, low, where = courses[HIGH][name].last_returns, courses[LOW][name].last_returns, name
        # shaping adds what the first state is worth, so its returns do not compare between delays: harm does
        if load_recipe(name).reward.shaping > 0.0:
            high, low = (-courses[each][name].harm.values[:, -1] for each in (HIGH, LOW))
            where = f"{name} (minus its harm: its return holds shaping)"
        parts.append(Less.of_lists(where, high, low))
    if not parts:
        return Verdict(what, "not run", "no recipe is trained at both delays")
    return judge_statement(what, sorted(parts, key=lambda part: part.where), show=_NUMBER)


def _nearly_identical(ppo: Course, sac: Course, about: str) -> Verdict:
    what = f"PPO and SAC end at nearly identical returns at high delay ({about})"
    rising = [f"{name} by {100.0 * each.still_rising:.0f} %" for name, each in (("PPO", ppo), ("SAC", sac))
              if each.still_rising > _NEARLY]  # fmt: skip
    if rising:
        told = (
            f"not converged: in the last quarter the return still rose by more than {100.0 * _NEARLY:g} % of its rise"
        )
        return Verdict(what, "undecided", f"{told}, {' and '.join(rising)}")
    apart = abs(float(ppo.last_returns.mean() - sac.last_returns.mean())) / max(ppo.rise, sac.rise)
    where = f"apart by {100.0 * apart:.1f} % of the rise, at most {100.0 * _NEARLY:g} % asked"
    return judge_statement(what, [Less(where, Estimate(apart - _NEARLY, None))], show=_NUMBER)


def _faster_and_steadier(ppo: Course, sac: Course, about: str) -> list[Verdict]:
    """SAC converges faster, PPO is the more stable one, at low delay."""
    fast, slow = sac.decisions_to_converge, ppo.decisions_to_converge
    points = max(min(len(ppo.returns.steps), len(sac.returns.steps)) // 2, 2)
    calm, restless = ppo.unrest(points), sac.unrest(points)
    faster = Less.of_lists(f"{mean(fast).value:,.0f} decisions against {mean(slow).value:,.0f}", fast, slow)
    steadier = Less.of_lists(f"{mean(calm).value:.3f} of the rise against {mean(restless).value:.3f}", calm, restless)
    return [
        judge_statement(
            f"SAC converges faster than PPO at low delay ({about})", [faster], show=Column("Decisions", digits=0)
        ),
        judge_statement(f"PPO is the more stable one at low delay ({about})", [steadier], show=_NUMBER),
    ]


def _spreads_more(courses: Mapping[str, Courses]) -> Verdict:
    high, low = courses[HIGH], courses[LOW]
    parts = [
        Less.of_lists(name, high[name].spread, low[name].spread)
        for name in sorted(high.keys() & low.keys())
        if min(len(high[name].returns.values), len(low[name].returns.values)) > 1  # one seed has no spread
    ]
    what = "the returns of different seeds spread more at low delay than at high"
    if not parts:
        return Verdict(what, "not run", "no recipe has several seeds at both delays")
    return judge_statement(what, parts, show=_NUMBER)


def _table(delay: str, courses: Courses) -> Sheet:
    rows = []
    for name, course in courses.items():
        harm = course.harm
        kept, last = (interquartile_mean([each]) for each in (harm.values.min(axis=1), harm.values[:, -1]))
        rows.append((
            name, len(harm.values), f"{harm.steps[-1]:,.0f}", kept, last, mean(course.last_returns),
            f"{mean(course.decisions_to_converge).value:,.0f}",
        ))  # fmt: skip
    head = ("Recipe", "Seeds", "Decisions", "Kept policy, harm", "Last policy, harm", _NUMBER, "90 % after")
    note = (
        "Harm: first-impact, m²/s², 1,000 worlds of seed 1007, interquartile mean over seeds with its bootstrap"
        " interval. Final return: mean over seeds of the last tenth of the updates, t interval. 90 % after: decisions"
        " until nine tenths of the fall of the harm are behind."
    )
    return Sheet(f"Trainings at {delay} delay", head, rows, note)
