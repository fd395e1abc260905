"""The paper's figures and tables made again: what each drives, trains and draws, how it is judged, and its pages.

Items are made one by one into a folder, which a page shows, and ``docs/reproduction.md`` too.
"""

from __future__ import annotations

import json
import math
import re
import textwrap
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import cache, cached_property, lru_cache, partial
from itertools import chain, pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, get_args
from urllib.parse import quote

import numpy as np
from markupsafe import Markup
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as model

from ethbrake_marl import __version__
from ethbrake_marl.agents import Agent, LearnedAgent
from ethbrake_marl.errors import InvalidInput, OnProgress, Progress, count_of, plain_text, unknown_name
from ethbrake_marl.evaluation import (
    PAPER_ROWS,
    EpisodeRecord,
    Evaluation,
    PaperRow,
    evaluate,
    interquartile_mean,
    make_agents,
    mean,
    paired_difference,
    rate,
    record_episode,
    relative_decrease,
    unpaired_difference,
)
from ethbrake_marl.figures import (
    Figure,
    SeedCurve,
    changes_figure,
    estimates_figure,
    profiles_figure,
    road_figure,
    seed_curves,
    trajectories,
    write_picture,
)
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, Shown, csv_text as csv_of
from ethbrake_marl.files.store import check_target, read_object, read_plain, write_file, write_output
from ethbrake_marl.learning import RunDirectory, TrainingRecipe, load_recipe
from ethbrake_marl.limits import Unproven
from ethbrake_marl.pages.page import Page, Part, Played, Section, shown
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.policies import Policy, load_policy, load_shipped
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.shield import HybridAgent
from ethbrake_marl.studies.folder import StudyFolder

# Verdicts on the paper's numbers and statements, computed from ours; nobody writes one by hand.
#
# A number that the paper prints agrees with ours where the two differ by no more than chance between two lists of
# worlds, or by no more than ``TOLERANCE`` of the printed number. Where chance alone makes more than ``WIDE`` of it, it
# is undecided. It cannot agree where a bound that holds for every strategy lies beyond it by more than chance. A
# statement agrees where every comparison that it makes comes out as it says; where one does not but its interval holds
# 0, it is undecided.

Judgement = Literal["cannot agree", "differs", "undecided", "not run", "agrees"]  # the worst first
TOLERANCE = 0.02  # of the printed number
WIDE = 0.15  # of the printed number: where chance alone makes more, nothing is shown
HOW_JUDGED = (
    "Every verdict is computed: a number agrees where it is within the chance between two lists of worlds or"
    f" {100.0 * TOLERANCE:g} % of what is printed, is undecided where that chance alone makes more than"
    f" {100.0 * WIDE:g} %, and cannot agree where a bound that holds for every strategy excludes it. Statements are"
    " those of the paper's text; its figures hold no printed numbers."
)
_WRITTEN = ConfigDict(strict=True, extra="forbid")  # what a file holds, and nothing else


@model(frozen=True, config=_WRITTEN)
class Verdict:
    """The outcome of one comparison with the paper, and the numbers that it follows from."""

    what: str
    outcome: Judgement
    because: str


# How a quantity is written.
HARM = Column("Harm")
PERCENT = Column("Collision rate", digits=1, scale=100.0, unit=" %")


def compare_number(
    what: str,
    printed: float,
    ours: Estimate,
    *,
    show: Column = HARM,
    least: tuple[str, Estimate] | None = None,
    others: Mapping[str, Estimate] | None = None,
) -> Verdict:
    """Compare a number that the paper prints with ours.

    Args:
        what: which number.
        printed: the paper's.
        ours: the same quantity, with its interval over worlds.
        show: how both are written.
        least: what no strategy undercuts, in words, and how much that is over our list, proven world by world.
        others: the same quantity under other readings; the nearest of them is named where ours differs.

    """
    told = f"ours {show.show(ours).in_words}, printed {show.scale * printed:.{show.digits + 1}f}{show.unit}"
    if least is not None and least[1].value - printed > _chance(least[1]):
        undercut = f"{least[0]}: at least {show.show(least[1]).in_words}, whoever drives"
        return Verdict(what, "cannot agree", f"{undercut}; {told}")
    off = _off(printed, ours)
    if not off:
        return Verdict(what, "agrees", told)
    if abs(ours.value - printed) <= _chance(ours):
        return Verdict(what, "undecided", f"{told}: too few worlds to tell")
    told += f" ({off})"
    if others:
        name, found = min(others.items(), key=lambda each: abs(each[1].value - printed))
        if abs(found.value - printed) < abs(ours.value - printed):
            met = _off(printed, found) or "which agrees"
            told += f"; nearest: {name}, {show.show(found).in_words}, {met}"
        else:
            told += "; no other reading here comes nearer"
    return Verdict(what, "differs", told)


def _off(printed: float, ours: Estimate) -> str:
    """How far off ours is; empty where it is by no more than ``TOLERANCE``, or than chance where that is not wide."""
    chance = _chance(ours)
    told = chance if chance <= WIDE * max(abs(printed), abs(ours.value)) else 0.0
    if abs(ours.value - printed) <= max(told, TOLERANCE * abs(printed)):
        return ""
    return f"{ours.value:+.3g} off" if printed == 0.0 else f"{100.0 * (ours.value / printed - 1.0):+.1f} %"


def _chance(estimate: Estimate) -> float:
    """How far apart two such estimates over two lists may lie: sqrt 2 times the half-width."""
    low, high = estimate.ends
    return math.sqrt(2.0) * 0.5 * (high - low)


@dataclass(frozen=True, slots=True)
class Less:
    """One comparison that a statement makes: ``difference`` (smaller minus larger) should be below 0.

    ``neither`` says that both are 0, where nothing is left to compare. ``least`` is what no strategy undercuts minus
    the larger one, where that is proven: above 0, nobody can bring the smaller one below it.
    """

    where: str
    difference: Estimate
    neither: bool = False
    least: Estimate | None = None

    @classmethod
    def of_lists(cls, where: str, smaller: Floats, larger: Floats) -> Less:
        """Of two lists that are not of the same worlds."""
        return cls(where, unpaired_difference(mean(smaller), len(smaller), mean(larger), len(larger)))

    @classmethod
    def of_harms(cls, where: str, harm: Mapping[str, Floats], smaller: str, larger: str) -> Less:
        """That one strategy harms less than another in the same worlds, and whether anybody could."""
        low, high = harm[smaller], harm[larger]
        least = paired_difference(harm[PROVEN], high) if PROVEN in harm else None
        return cls(where, paired_difference(low, high), not low.any() and not high.any(), least)


def judge_statement(what: str, parts: Sequence[Less], *, or_equal: bool = False, show: Column = HARM) -> Verdict:
    """Whether every comparison of a statement comes out below 0, or at most 0, by its interval."""
    compared, ties = [part for part in parts if not part.neither], [part.where for part in parts if part.neither]
    places = ", ".join(ties) if len(ties) <= 2 else f"{len(ties)} more"
    if not compared:
        return Verdict(what, "agrees", f"nothing to undercut: both are 0 in {places}")
    highest = [part.difference.ends[1] for part in compared]
    failing = [
        part for part, high in zip(compared, highest, strict=True) if not (high < 0.0 or (or_equal and high <= 0.0))
    ]
    impossible = [
        f"{part.where} by {show.show(part.least).in_words}"
        for part in failing
        if part.least is not None and part.least.ends[0] > 0.0
    ]
    counts = f"holds in {len(compared) - len(failing)} of {len(compared)}{f' (both are 0 in {places})' if ties else ''}"
    if impossible:
        told = f"the harm proven to be the least is above it in: {', '.join(impossible)}"
        return Verdict(what, "cannot agree", f"{counts}; {told}")
    if failing:
        ends = [part.difference.ends for part in failing]
        is_open = all(low < 0.0 <= high for low, high in ends)  # another list may decide either way
        told = ", ".join(f"{part.where}, {show.show(part.difference).in_words}" for part in failing)
        lead = f"{counts}; not " if len(parts) > 1 else "not "
        shown = f"{lead}{'shown' if is_open else 'so'}: {told}"
        return Verdict(what, "undecided" if is_open else "differs", shown)
    worst = max(compared, key=lambda part: part.difference.value)
    lead = f"{counts}; the nearest is " if len(parts) > 1 else ""
    return Verdict(what, "agrees", f"{lead}{worst.where}, {show.show(worst.difference).in_words}")


def summarise_verdicts(verdicts: Sequence[Verdict]) -> Verdict:
    """All of an item in one line: how many came out how, and the first of the worst."""
    if not verdicts:
        return Verdict("all", "not run", "nothing was compared")
    counted = {outcome: sum(each.outcome == outcome for each in verdicts) for outcome in get_args(Judgement)}
    plural = {"agrees": "agree", "differs": "differ"}
    told = [f"{n} {plural.get(outcome, outcome) if n > 1 else outcome}" for outcome, n in counted.items() if n]
    first = next(each for outcome in counted for each in verdicts if each.outcome == outcome)
    lead = "" if len(verdicts) == 1 else f"of {len(verdicts)} comparisons {', '.join(told)}; "
    return Verdict("all", first.outcome, f"{lead}{first.what}: {first.because}")


Mode = Literal["quick", "full"]
LIST_SEED = 7
MOST_EPISODES = 10_000

# The folder: ``reproduction.json`` says what was asked for, ``index.html`` shows everything, each item has a folder.

_SETTINGS, _RESULT = "reproduction.json", "result.json"
_FORMAT = {"format": "ethbrake-reproduction", "format_version": 2}
_LIMIT_BYTES = 16 << 20  # of a figure that is read again


@dataclass(frozen=True, slots=True, eq=False)
class Reproduction:
    """What a reproduction is asked for."""

    mode: Mode
    folder: Path  # of everything; its trainings are read from there
    episodes: int = MOST_EPISODES  # the most worlds of any list; the paper has 10,000
    tell: OnProgress = lambda progress: None
    machine: str = ""  # in words
    docs: Path | None = None  # a page of the results as Markdown

    def __post_init__(self) -> None:
        """Refuse a page whose name does not end in ``.md``, or that cannot be written."""
        if self.docs is not None:
            if self.docs.suffix != ".md":
                raise InvalidInput(f"{self.docs}: must end in .md")
            check_target(self.docs, force=True)

    def seeds_of(self, wanted: Collection[str]) -> list[tuple[Group, str, list[Path]]]:
        """Each recipe of these groups of trainings, in their order, with the folders of its seeds; none of --quick."""
        return [
            (
                group,
                name,
                [self.folder / "trainings" / group.name / f"{name}-seed{seed}" for seed in range(group.seeds)],
            )
            for group in groups().values()
            if group.name in wanted and self.mode == "full"
            for name in group.trained
        ]

    def trained(self, wanted: Collection[str]) -> dict[str, list[Path]]:
        """The recipes of these groups all of whose seeds are trained, as ``group/recipe``, with their folders."""
        return {
            f"{group.name}/{name}": paths
            for group, name, paths in self.seeds_of(wanted)
            if all(RunDirectory(path).is_finished for path in paths)
        }

    def seconds_left(self, wanted: Collection[str]) -> float:
        """Seconds of one core that the trainings of these groups still take, begun ones reckoned whole."""
        return sum(
            group.trained[name][0].decisions / group.trained[name][0].per_s
            for group, name, paths in self.seeds_of(wanted)
            for path in paths
            if not RunDirectory(path).is_finished
        )

    def train(self, wanted: Collection[str]) -> bool:
        """Train what is left of these groups, in their order; False when Ctrl-C stopped it."""
        from ethbrake_marl.studies.learning_curves import LearningCurves

        for group in groups().values():
            if group.name in wanted:
                plan = [(recipe, group.seeds) for _, recipe in group.trained.values()]
                place = self.folder / "trainings" / group.name
                if not LearningCurves(load_scenario(group.scenario), plan, place).train(tell=self.tell):
                    return False
        return True

    def cost(self, items: Sequence[Item]) -> str:
        """What is left to do and about how long it takes, in one line."""
        wanted = {group for item in items for group in item.trained} if self.mode == "full" else set()
        told = (
            f"to do: {count_of(len(items), 'item')}, at most about {sum(item.most_s for item in items)} s of one core"
        )
        training_s = self.seconds_left(wanted)
        return f"{told}; trainings before them about {training_s / 60.0:.0f} min of one core" if wanted else told


@model(frozen=True, config=_WRITTEN)
class Parameter:
    """A quantity that shapes an item, and who says what it is."""

    name: str
    value: str
    origin: str = "our default"


def stated(name: str, value: str, where: str) -> Parameter:
    """A quantity that the paper states there; an empty place makes it ours."""
    return Parameter(name, value, f"stated in the paper ({where})") if where else Parameter(name, value)


@model(frozen=True, config=_WRITTEN)
class Table:
    """A table as it is shown: each cell a value, and an interval where there is one."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[Shown]]
    note: str = ""


@model(frozen=True, config=_WRITTEN)
class Drawn:
    """A figure; ``text`` says in words what it shows."""

    stem: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,63}$")]  # of its files
    title: str
    text: str


@dataclass(frozen=True, slots=True)
class Made:
    """What became of an item."""

    verdicts: Sequence[Verdict]
    parameters: Sequence[Parameter]
    tables: Sequence[Sheet] = ()
    figures: Mapping[Drawn, Figure] = field(default_factory=dict)
    data: Mapping[str, str] = field(default_factory=dict)  # stem of a CSV file -> its text
    notes: Sequence[str] = ()  # computed sentences: what was run, what was not


@model(frozen=True, config=_WRITTEN, kw_only=True)
class Result:
    """An item and what became of it, as its file holds it and pages show it."""

    name: str
    labels: Sequence[str]
    title: str
    what: str
    mode: Mode = "quick"
    episodes: int = MOST_EPISODES
    trained: Sequence[str]
    processor_s: float
    made_utc: str
    machine: str
    verdict: Verdict
    comparisons: Sequence[Verdict]
    parameters: Sequence[Parameter]
    tables: Sequence[Table]
    figures: Sequence[Drawn]
    data: Sequence[str]
    notes: Sequence[str]

    def in_words(self) -> dict[str, Any]:
        """As plain data, each cell of a table one text."""
        tables = [
            {**asdict(table), "rows": [[cell.in_words for cell in row] for row in table.rows]} for table in self.tables
        ]
        return asdict(self) | {"tables": tables}


@dataclass(frozen=True, slots=True)
class Item:
    """One figure or table of the paper, and what makes it again."""

    name: str  # on the command line, and of its folder
    labels: tuple[str, ...]  # in the paper's source
    title: str
    what: str  # the paper's figure or table, in a sentence
    make: Callable[[Reproduction], Made]
    most_s: float  # processor seconds at the paper's numbers of worlds, and a little more
    trained: tuple[str, ...] = ()  # the groups of trainings that it shows with ``--full``
    play: Callable[[], Part] | None = None  # episodes to watch on its page


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A CSV file; an estimate takes three columns: value, low, high."""
    parts = ([(e.value, *(e.interval or ("", ""))) if isinstance(e, Estimate) else (e,) for e in row] for row in rows)
    return csv_of([dict(zip(head, chain(*row), strict=True)) for row in parts], head)


_SETTING = "sec:result, text to Fig:Harm-ivds"
_QUANTITIES = (  # name, key of a scenario, unit, where the paper states it
    ("braking capacities", "braking_capacity_mps2", "m/s²", _SETTING),
    ("driving capacities", "driving_capacity_mps2", "m/s²", _SETTING),
    ("masses", "mass_t", "t", _SETTING),
    ("gaps", "gaps_m", "m", "the item's text"),
    ("speeds", "speeds_mps", "m/s", "the item's text"),
    ("latencies (Vehicle 1, 2, 3)", "latency_s", "s", _SETTING),
    ("restitution e", "restitution", "", ""),
    ("time step", "time_step_s", "s", ""),
    ("horizon", "horizon_s", "s", ""),
    ("speed limit v_max", "speed_limit_mps", "m/s", ""),
)
POLICIES = "PPO and SAC are the shipped policies, trained on paper-random at 0.5 and 0.8 s"
FIRST_IMPACTS = stated("harm", "each pair's first impact", "sec:result, Experimental Set-Up")


def scenario_parameters(scenario: Scenario, **places: str) -> list[Parameter]:
    """The quantities of a scenario, each with its origin.

    ``places`` changes for a key where the paper states it; an empty text makes it ours.
    """
    content = scenario.model_dump(mode="json", exclude_none=True)
    found = [
        stated(name, f"{_plain(content[key])}{f' {unit}' if unit else ''}", places.get(key, where))
        for name, key, unit, where in _QUANTITIES
        if key in content
    ]
    early = "worlds in which Vehicle 2 is hit before it may act are drawn again"
    return [*found, stated("early impacts", early, "sec:system_model, assumed away")]


def list_parameter(episodes: int, where: str = "") -> Parameter:
    """How many worlds were drawn, and from which seed (which is ours: the paper says "a fixed random seed")."""
    return stated("worlds", f"{episodes:,}, the first of the list of seed {LIST_SEED}", where)


def _plain(value: object) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{name} {_plain(each)}" for name, each in value.items())
    if isinstance(value, list):
        return "(" + ", ".join(_plain(each) for each in value) + ")"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


# Strategies on the paper's worlds, at the latencies that it states and with Vehicle 2 acting at 0.2 s.

FULL_BRAKE, PAIRWISE, COUPLED = "full_brake", "e_v2x_bm:pairwise", "e_v2x_bm"
SAC, PPO, UNIVERSAL = "sac@shipped/sac", "ppo@shipped/ppo", "universal@shipped"
PREDICTED, PROVEN = "E-V2X-BM, predicted", "least harm, proven"
NAMES = {  # of the strategies in tables and figures
    FULL_BRAKE: "Non-ethical (full braking)",
    PAIRWISE: "E-V2X-BM, realised",
    COUPLED: "E-V2X-BM, coupled",
    SAC: "SAC",
    PPO: "PPO",
    UNIVERSAL: "universal policy",
}


@dataclass(frozen=True, slots=True)
class Reading:
    """A time from which Vehicle 2 acts."""

    name: str
    acts_s: float | None = None  # None: the scenario's own

    def scenario(self, name: str, **changes: object) -> Scenario:
        """A shipped scenario so read."""
        found = load_scenario(name).replace(**changes) if changes else load_scenario(name)
        if self.acts_s is None:
            return found
        first, _, *others = found.model_dump()["latency_s"]
        return found.replace(latency_s=[first, self.acts_s, *others])


READINGS = (Reading("as stated"), Reading("Vehicle 2 acts at 0.2 s", 0.2))


def lineup(scenario: Scenario, *specs: str) -> dict[str, Agent]:
    """Agents by their names in ``NAMES``, else by their spec."""
    return {NAMES.get(spec, spec): agent for spec, agent in make_agents(specs, scenario).items()}


def drive_list(scenario: Scenario, agents: Mapping[str, Agent], episodes: int, settings: Reproduction) -> Evaluation:
    """Let every agent drive the first worlds of the list."""
    return evaluate(
        scenario.sample(episodes, LIST_SEED),
        agents,
        scenario=scenario,
        seed=LIST_SEED,
        aftermath=False,
        on_progress=lambda name, done: settings.tell(Progress(scenario.name, done, episodes)),
    )


def harms(evaluation: Evaluation) -> dict[str, Floats]:
    """First-impact harm of each strategy in each world, what E-V2X-BM predicts, what nobody undercuts, [n] m2/s2."""
    found = {name: outcome.first_impact_harm for name, outcome in evaluation.outcomes.items()}
    pairwise = evaluation.outcomes.get(NAMES[PAIRWISE])
    if pairwise is not None and pairwise.predicted_harm is not None:
        found[PREDICTED] = pairwise.predicted_harm
    if not isinstance(evaluation.limits, Unproven) and evaluation.limits.proof.harm is not None:
        found[PROVEN] = evaluation.limits.proof.harm
    return found


# The trainings of ``ethbrake reproduce --full``: learning curves, a policy stopped early, open weights of the reward.
#
# Each group is a folder of learning curves: finished trainings are kept, begun ones go on, by the rules of
# ``learning_curves.train_all``.

STOPPED, OPEN = "stopped", "open"
CURVES = {delay: (delay, f"{delay}-ppo-paper", f"{delay}-sac-paper") for delay in ("low", "high")}  # -> groups
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
_EARLY = TrainedRecipe("ppo", 100_000, 4, 16_000)  # a fifteenth of the recipe's own number


@dataclass(frozen=True, slots=True)
class Group:
    """Trainings on one scenario in one folder, in the order in which they are done."""

    name: str
    scenario: str  # a shipped one
    trained: Mapping[str, tuple[TrainedRecipe, TrainingRecipe]]  # by the name that the recipe has there
    seeds: int


def groups() -> dict[str, Group]:
    """Every group by its name, the quickest first, so that results are there early."""
    base = PPO_PAPER.load("ppo-paper").reward.model_dump(exclude_defaults=True)
    changed = {
        "risk-0": {"risk": 0.0},
        "risk-1": {"risk": 1.0},
        "jerk-1e-4": {"jerk": 1e-4},
        "terminal-0": {"terminal": 0.0},
    }
    variants: dict[str, dict[str, Any]] = {
        "ppo-paper": {},
        **{f"ppo-paper-{name}": {"reward": {**base, **own}} for name, own in changed.items()},
        "ppo-paper-state": {"observation": _STATED_STATE},
    }

    def curves(suffix: str, *recipes: TrainedRecipe) -> list[Group]:
        trained = {each.recipe: (each, each.load(each.recipe)) for each in recipes}
        return [Group(f"{delay}{suffix}", f"paper-delay-{delay}", trained, 3) for delay in CURVES]

    found = [
        Group(STOPPED, "paper-random", {"ppo-stopped": (_EARLY, _EARLY.load("ppo-stopped"))}, 1),
        *curves("", TrainedRecipe("ppo", 400_000, 4, 16_000), TrainedRecipe("sac", 60_000, 30, 3_000)),
        *curves("-ppo-paper", PPO_PAPER),
        Group(
            OPEN, "paper-random", {name: (PPO_PAPER, PPO_PAPER.load(name, **own)) for name, own in variants.items()}, 2
        ),
        *curves("-sac-paper", TrainedRecipe("sac-paper", 20_000, 1_000, 170)),
    ]
    return {group.name: group for group in found}


# The policies that ``ethbrake reproduce`` lets drive beside the shipped ones, as agents.

_STAND_IN = "ppo-paper-random-obstacle"  # for one that has not converged, where nothing is trained


def unconverged_policy(settings: Reproduction) -> tuple[Policy, str]:
    """What stands for the paper's "PPO model obtained from training before convergence occurred", and what it is.

    The one stopped early that ``--full`` has trained, else a shipped policy that stands in for it.
    """
    for (path,) in settings.trained([STOPPED]).values():
        about = f"PPO stopped early: the last policy of {_EARLY.decisions:,} decisions on paper-random"
        return load_policy(RunDirectory(path).last_policy), about
    about = f"the shipped policy {_STAND_IN!r}, trained for other worlds, stands in for one that has not converged"
    return load_shipped(_STAND_IN), about


def hybrid(policy: Policy, scenario: Scenario, bound: Literal["coupled", "pairwise"]) -> Agent:
    """Algorithm 1 around a policy."""
    return HybridAgent(LearnedAgent(policy, "policy"), scenario, bound=bound)


# The paper's learning curves at high and low delay (``fig:ppo_sac_high_latency``, ``fig:ppo_sac_low_latency``).

HIGH, LOW = "high", "low"
_PAIRS = {  # stem of the figure -> recipes, and what is about them
    "ours": ("ppo", "sac", "our recipes", "our recipes"),
    "paper": (
        "ppo-paper", "sac-paper", "the paper's hyperparameters", "the paper's hyperparameters and reward",
    ),
}  # fmt: skip
_NEARLY = 0.05  # of the rise of the return: what "nearly identical" allows
_DONE = 0.9  # of the fall of the harm: when a training has converged
_NUMBER, _DECISIONS = Column("Final return", digits=3), Column("Decisions", digits=0)


@lru_cache(maxsize=1)  # both figures show them
def _shipped_ends(settings: Reproduction) -> Made:
    """What finished policies reach at both delays, in both readings of when Vehicle 2 acts."""
    episodes = min(2_000, settings.episodes)
    verdicts, rows, data = [], [], []
    for reading in READINGS:
        scenarios = {delay: reading.scenario(f"paper-delay-{delay}") for delay in (LOW, HIGH)}
        found = {
            delay: harms(drive_list(each, lineup(each, PPO, SAC, UNIVERSAL, FULL_BRAKE), episodes, settings))
            for delay, each in scenarios.items()
        }
        low, high = found.values()
        rows += [(reading.name, name, mean(low[name]), mean(high[name])) for name in low]
        data += [
            [reading.name, name, delay, episodes, float(found[delay][name].mean())] for name in low for delay in found
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
    """The trainings of one recipe at one delay."""

    returns: SeedCurve  # mean return of training episodes, exploration included
    harm: SeedCurve  # first-impact harm on the fixed list

    @property
    def last_returns(self) -> Floats:
        """Of each seed: the mean of the last tenth of its updates."""
        return np.asarray(self.returns.values[:, -max(len(self.returns.steps) // 10, 1) :].mean(axis=1))

    @property
    def rise(self) -> float:
        """By how much the return rises, mean over seeds."""
        return float((self.last_returns - self.returns.values[:, 0]).mean())

    @property
    def decisions_to_converge(self) -> Floats:
        """Of each seed: decisions until ``_DONE`` of the fall of the harm is behind it."""
        first, least = self.harm.values[:, :1], self.harm.values.min(axis=1, keepdims=True)
        there = self.harm.values <= first - _DONE * (first - least)
        return np.asarray(self.harm.steps[np.argmax(there, axis=1)])

    def returns_at(self, shares: Floats) -> Floats:
        """Of each seed, its return after these shares of the training [seeds, k]."""
        steps = shares * self.returns.steps[-1]
        return np.array([np.interp(steps, self.returns.steps, own) for own in self.returns.values])

    def unrest(self, points: int) -> Floats:
        """Of each seed: spread of the changes of its return between ``points`` in the second half, share of the rise.

        The points lie at equal parts of the training, so trainings of other lengths compare.
        """
        return np.asarray(np.diff(self.returns_at(np.linspace(0.5, 1.0, points)), axis=1).std(axis=1) / abs(self.rise))

    @property
    def still_rising(self) -> float:
        """The share of the rise that falls into the last quarter of the training, mean over seeds."""
        before = self.returns_at(np.array([0.75]))[:, 0]
        return float((self.returns.values[:, -1] - before).mean()) / abs(self.rise)

    @property
    def spread(self) -> Floats:
        """Standard deviation over seeds of the return, at each step of the second half."""
        return np.asarray(self.returns.values[:, len(self.returns.steps) // 2 :].std(axis=0, ddof=1))


Courses = Mapping[str, Course]  # by recipe


def reproduce_curves(delay: str, settings: Reproduction) -> Made:
    """The curves that ``--full`` has trained; without them what finished policies reach at this delay."""
    courses = {
        each: {
            name.partition("/")[2]: Course(
                *(
                    SeedCurve.of([RunDirectory(path).column(what) for path in paths])
                    for what in (RunDirectory.RETURN, _HARM)
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
    """The paper's statements about one of the two figures."""
    own, high, low = courses[delay], courses[HIGH], courses[LOW]
    if not own:
        return [Verdict(f"learning curves at {delay} delay", "not run", "no training; --full trains them")]
    verdicts = [_higher_when_low(courses)] if high and low else []
    for first, second, _, about in _PAIRS.values():
        if not {first, second} <= own.keys():
            told = f"{first} and {second} are not both trained"
            verdicts.append(Verdict(f"PPO against SAC, {about}", "not run", told))
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
        told = (
            f"not converged: in the last quarter the return still rose by more than {100.0 * _NEARLY:g} % of its rise,"
            f" {' and '.join(rising)}"
        )
        parts = [Less(where, Estimate(apart - _NEARLY, None))]
        verdicts.append(Verdict(what, "undecided", told) if rising else judge_statement(what, parts, show=_NUMBER))
    if delay == LOW and high:
        what = "the returns of different seeds spread more at low delay than at high"
        parts = [
            Less.of_lists(name, high[name].spread, low[name].spread)
            for name in sorted(high.keys() & low.keys())
            if min(len(high[name].returns.values), len(low[name].returns.values)) > 1  # one seed has no spread
        ]
        told = "no recipe has several seeds at both delays"
        verdicts.append(judge_statement(what, parts, show=_NUMBER) if parts else Verdict(what, "not run", told))
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


_CURVES = tuple(group for groups in CURVES.values() for group in groups)


# The items that drive lists of worlds: over the total distance, at three delays, the two tables, and what is open.

FOUR = (FULL_BRAKE, PAIRWISE, COUPLED, SAC, PPO)  # the paper's four, E-V2X-BM twice
_BASELINES = (NAMES[PAIRWISE], NAMES[COUPLED], PREDICTED)
_ABOUT_BASELINE = (
    "E-V2X-BM, predicted: what the closed form expects, pair by pair. Realised: what that deceleration does once speeds"
    " are exchanged. Coupled: the constant deceleration of least harm in the same physics."
)
_H_STAR = stated("H*", "realised (ours) and predicted pair by pair (the paper's)", "sec:baseline_drl, Hybrid DRL")
_NOT_THEIRS = Parameter("policies", f"{POLICIES}; not the paper's")

# Harm in groups of worlds: by distance (``Fig:Harm-ivds``, ``Fig:hybrid illu``), or by delay (``Fig:harm-delay``).

Groups = Mapping[str, Mapping[str, Floats]]  # group of worlds -> strategy -> harm of each world
_HARM_TITLE = "First-impact harm (m²/s²)"
_DISTANCE, _DISTANCE_WORLDS = "paper-distance", 5_000
_ENDS_M = (10.0, 12.0, 14.0, 16.0, 18.0, 20.0)  # of the groups of d_1 + d_2


def by_distance(evaluation: Evaluation) -> tuple[list[float], Groups]:
    """Worlds in groups of d_1 + d_2: the mean distance of each and its harm; groups without a world are left out."""
    total, found = evaluation.worlds.gaps_m.sum(axis=1), harms(evaluation)
    inner, at, groups = np.digitize(total, _ENDS_M[1:-1]), [], {}
    for k, (low, high) in enumerate(pairwise(_ENDS_M)):
        if (rows := inner == k).any():
            at.append(float(total[rows].mean()))
            groups[f"{low:g}-{high:g} m"] = {name: harm[rows] for name, harm in found.items()}
    return at, groups


def less_in_each(groups: Groups, smaller: str, *larger: str) -> list[Less]:
    """The comparison of a strategy with others in every group, paired by world."""
    return [
        Less.of_harms(group if len(larger) == 1 else f"{group}, {other}", harm, smaller, other)
        for group, harm in groups.items()
        for other in larger
    ]


def _harm_table(title: str, groups: Groups, note: str) -> Sheet:
    """Harm with its interval: one row per strategy, one column per group."""
    strategies = next(iter(groups.values()))
    rows = [(name, *(mean(harm[name]) for harm in groups.values())) for name in strategies]
    return Sheet(title, ("Strategy", *groups), rows, f"First-impact harm, m²/s²{note}. {_ABOUT_BASELINE}")


def _over_distance(
    stem: str,
    found: Mapping[str, tuple[Sequence[float], Groups]],
    verdicts: Sequence[Verdict],
    lines: Sequence[str],
    told: Sequence[Parameter],
    episodes: int,
) -> Made:
    """Harm of strategies over the total distance, as ``by_distance`` gives it in each reading."""
    panels = {
        reading: {
            name: {at: mean(harm[name]) for at, harm in zip(at_m, groups.values(), strict=True)} for name in lines
        }
        for reading, (at_m, groups) in found.items()
    }
    figure = estimates_figure(
        panels,
        x_label="Total distance d1 + d2 at the alert (m)",
        y_label=_HARM_TITLE,
        caption=f"Means over {episodes:,} worlds in groups of 2 m; bands: 95 % intervals.",
    )
    text = "Mean harm of each strategy against the sum of both gaps; left as the paper states it, right with Vehicle 2"
    rows = [
        (reading, name, group, at, len(harm[name]), mean(harm[name]))
        for reading, (at_m, groups) in found.items()
        for name in next(iter(groups.values()))
        for at, (group, harm) in zip(at_m, groups.items(), strict=True)
    ]
    head = ("reading", "strategy", "total_distance", "mean_distance_m", "worlds", "first_impact_harm", "low", "high")
    title, note = "Harm by total distance", ", with 95 % intervals"
    return Made(
        verdicts,
        [
            *scenario_parameters(load_scenario(_DISTANCE), gaps_m="5 to 10 m, text to Table:hybrid"),
            *told,
            list_parameter(episodes),
        ],
        [_harm_table(f"{title}, {reading}", groups, note) for reading, (_, groups) in found.items()],
        {Drawn(stem, "Harm over total distance", f"{text} acting at 0.2 s."): figure},
        {stem: csv_text(head, rows)},
    )


def reproduce_distance(settings: Reproduction) -> Made:
    """Harm of the four strategies over the total distance, and the paper's statements about it."""
    episodes, braking = min(_DISTANCE_WORLDS, settings.episodes), NAMES[FULL_BRAKE]
    found, verdicts = {}, []
    for reading in READINGS:
        scenario = reading.scenario(_DISTANCE)
        found[reading.name] = by_distance(drive_list(scenario, lineup(scenario, *FOUR), episodes, settings))
        _, groups = found[reading.name]
        claims = {
            "non-ethical: the larger the distance, the larger the harm": [
                Less.of_lists(f"{one} to {other}", groups[one][braking], groups[other][braking])
                for one, other in pairwise(groups)
            ],
            **{f"{name} harms less than non-ethical": less_in_each(groups, name, braking) for name in _BASELINES},
            **{
                f"{NAMES[policy]} harms less than {name} over the whole range": less_in_each(
                    groups, NAMES[policy], name
                )
                for policy in (SAC, PPO)
                for name in _BASELINES
            },
        }
        verdicts += [judge_statement(f"{claim} ({reading.name})", parts) for claim, parts in claims.items()]
    told = [Parameter("distances", "each gap drawn on its own, then grouped by the sum"), FIRST_IMPACTS, _NOT_THEIRS]
    lines = [*(NAMES[spec] for spec in FOUR), PREDICTED, PROVEN]
    return _over_distance("harm-distance", found, verdicts, lines, told, episodes)


_DELAYS, _DELAY_WORLDS = ("low", "middle", "high"), 2_000
_STATE = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}  # of the figure: one world at each delay
_ONE, _LIST = "d = 7, 7 m; v = 20, 18, 20 m/s", "d = 5-10 m; v = 18-22 m/s"


def reproduce_delays(settings: Reproduction) -> Made:
    """Harm of the four strategies at low, middle and high delay, in the figure's world and in a list of worlds."""
    episodes = min(_DELAY_WORLDS, settings.episodes)
    found: dict[tuple[str, str], Groups] = {}  # worlds and reading
    for reading in READINGS:
        for worlds, state, count in ((_ONE, _STATE, 1), (_LIST, {}, episodes)):
            scenarios = [reading.scenario(f"paper-delay-{delay}", **state) for delay in _DELAYS]
            found[worlds, reading.name] = {
                _delay_name(each): harms(drive_list(each, lineup(each, *FOUR), count, settings)) for each in scenarios
            }
    figures = {}
    for worlds, stem in ((_ONE, "world"), (_LIST, "list")):
        panels = {
            reading: {
                name: {at: mean(harm[name]) for at, harm in zip(_DELAYS, delays.values(), strict=True)}
                for name in next(iter(delays.values()))
            }
            for (own, reading), delays in found.items()
            if own == worlds
        }
        caption = f"{worlds}. Low, middle, high: τ3 = 0.3, 0.6, 1.2 s; left τ2 = 0.1, 0.3, 0.8 s. Bars: 95 % intervals."
        about = f"Harm of each strategy at three delays, {worlds}."
        figures[Drawn(f"harm-delays-{stem}", "Harm at three delays", about)] = estimates_figure(
            panels, y_label=_HARM_TITLE, caption=caption
        )
    low, *_ = scenarios = [load_scenario(f"paper-delay-{delay}") for delay in _DELAYS]
    parameters = [
        *(each for each in scenario_parameters(low.replace(**_STATE)) if not each.name.startswith("latencies")),
        Parameter("delays (Vehicle 2, 3)", "; ".join(map(_delay_name, scenarios))),
        Parameter("policies", f"{POLICIES}; not the paper's, and not trained at these delays"),
        stated("worlds of the figure", "one at each delay", "text to Fig:harm-delay"),
        Parameter("list beside it", f"{_LIST}; {list_parameter(episodes).value} (seed {LIST_SEED})"),
    ]
    rows = [
        (*where, delay, name, len(values), mean(values))
        for where, delays in found.items()
        for delay, harm in delays.items()
        for name, values in harm.items()
    ]
    head = ("worlds", "reading", "delay", "strategy", "count", "first_impact_harm", "low", "high")
    verdicts = [  # "both SAC and PPO consistently achieve the lowest harm values across all tested delay setting"
        judge_statement(
            f"{NAMES[policy]} harms less than non-ethical and E-V2X-BM at every delay ({'; '.join(where)})",
            less_in_each(delays, NAMES[policy], NAMES[FULL_BRAKE], *_BASELINES),
        )
        for where, delays in found.items()
        for policy in (SAC, PPO)
    ]
    tables = [_harm_table(", ".join(where), delays, "; one world has no interval") for where, delays in found.items()]
    return Made(verdicts, parameters, tables, figures, {"harm-delays": csv_text(head, rows)})


def _delay_name(scenario: Scenario) -> str:
    """A delay with its latencies."""
    _, middle, rear = scenario.model_dump()["latency_s"]
    return f"{scenario.name.removeprefix('paper-delay-')} ({middle:g}, {rear:g} s)"


# Our rows beside those of the paper's tables: what agrees, what differs, and what no strategy can reach.

_RATE, _MEAN_HARM, _DECREASE, _TOTAL = "collision rate", "average harm", "harm decrease", "total harm"
_PREDICTED_HARM = "predicted harm"
_PRINTED: Mapping[str, Column] = {_RATE: PERCENT, _MEAN_HARM: HARM, _DECREASE: PERCENT}
NOBODY = "least possible (proven)"
_UNDERCUT = {_RATE: "worlds in which no command avoids an impact", _MEAN_HARM: "harm that no command undercuts"}


def collision_rate(collided: Bools) -> Estimate:
    """Share of worlds with an impact."""
    return rate(int(collided.sum()), len(collided))


@dataclass(frozen=True)
class Beside:
    """Our results in one reading, to stand beside the paper's rows."""

    title: str
    evaluation: Evaluation
    ours: Mapping[str, Sequence[str]]  # the paper's row -> our strategies, the first is the one compared

    @cached_property
    def numbers(self) -> dict[str, dict[str, Estimate]]:
        """Every quantity of every strategy, and of nobody in particular what is proven to be the least."""
        found, braking = {}, self.evaluation.outcomes.get(NAMES[FULL_BRAKE])
        for name, outcome in self.evaluation.outcomes.items():
            harm, predicted = outcome.first_impact_harm, outcome.predicted_harm
            own = {
                _RATE: collision_rate(outcome.collided),
                _MEAN_HARM: mean(harm),
                _DECREASE: None if braking is None else relative_decrease(harm, braking.first_impact_harm),
                _TOTAL: mean(outcome.total_harm),
                _PREDICTED_HARM: None if predicted is None else mean(predicted),
            }
            found[name] = {quantity: estimate for quantity, estimate in own.items() if estimate is not None}
        least = harms(self.evaluation).get(PROVEN)
        if least is not None:
            found[NOBODY] = {_RATE: collision_rate(least > 0.0), _MEAN_HARM: mean(least), _TOTAL: mean(least)}
        return found

    def candidates(self, row: str, quantity: str) -> Iterator[tuple[str, Estimate]]:
        """Everything of ours that may be meant by a number of a row, the compared one first."""
        for name in self.ours[row]:
            if quantity in self.numbers[name]:
                yield f"{name} ({self.title})", self.numbers[name][quantity]
            if quantity == _MEAN_HARM and name == NAMES[PAIRWISE] and _PREDICTED_HARM in self.numbers[name]:
                yield f"{PREDICTED} ({self.title})", self.numbers[name][_PREDICTED_HARM]
        if quantity == _MEAN_HARM:
            for name in self.ours[row]:
                yield f"{name}, total harm ({self.title})", self.numbers[name][_TOTAL]


def compare_rows(printed: Sequence[PaperRow], besides: Sequence[Beside]) -> list[Verdict]:
    """One verdict per reading, row and quantity."""
    verdicts = []
    for beside in besides:
        least = beside.numbers.get(NOBODY, {})
        for row in printed:
            numbers = {_RATE: row.collision_rate, _MEAN_HARM: row.average_harm, _DECREASE: row.harm_decrease}
            for quantity, number in numbers.items():
                if not number:  # the decrease of the baseline, or none is printed
                    continue
                (_, ours), *own = beside.candidates(row.agent, quantity)
                others = [other.candidates(row.agent, quantity) for other in besides if other is not beside]
                verdicts.append(
                    compare_number(
                        f"{row.agent}, {quantity} ({beside.title})",
                        number,
                        ours,
                        show=_PRINTED[quantity],
                        least=(_UNDERCUT[quantity], least[quantity]) if quantity in least else None,
                        others=dict([*own, *chain(*others)]),
                    )
                )
    return verdicts


def selection_verdict(one: PaperRow, other: PaperRow, chosen: PaperRow) -> Verdict:
    """Whether a choice between two strategies, world by world, can avoid as many collisions as is printed.

    It avoids a collision only where one of the two does: at most as many as both together.
    """
    avoided = [row.episodes - row.collisions for row in (one, other, chosen)]
    together = avoided[0] + avoided[1]
    told = (
        f"{chosen.agent} is one of the two in every world, so it avoids at most {avoided[0]:,} + {avoided[1]:,} ="
        f" {together:,} collisions; printed: {avoided[2]:,}"
    )
    what = f"{chosen.agent} avoids no more than {one.agent} and {other.agent} together (arithmetic of the printed rows)"
    return Verdict(what, "agrees" if avoided[2] <= together else "cannot agree", told)


def decrease_verdict(row: PaperRow, baseline: PaperRow) -> Verdict:
    """Whether a printed harm decrease follows from the printed harms, to the printed digits."""
    follows = 1.0 - row.average_harm / baseline.average_harm
    printed = row.harm_decrease or 0.0
    told = (
        f"1 - {row.average_harm:g} / {baseline.average_harm:g} = {100.0 * follows:.2f} %; printed {100 * printed:g} %"
    )
    what = f"{row.agent}, harm decrease follows from the printed harms"
    return Verdict(what, "agrees" if abs(follows - printed) < 0.0001 else "cannot agree", told)


def rows_table(beside: Beside) -> Sheet:
    """Our rows of one reading, with what no strategy undercuts."""
    columns: dict[str, Column | str] = {
        _RATE: PERCENT, _MEAN_HARM: "First-impact harm", _TOTAL: "Total harm", _PREDICTED_HARM: "Predicted harm",
        _DECREASE: replace(PERCENT, heading="Harm decrease"),
    }  # fmt: skip
    if not any(_DECREASE in numbers for numbers in beside.numbers.values()):
        del columns[_DECREASE]
    rows = [(name, *map(numbers.get, columns)) for name, numbers in beside.numbers.items()]
    note = f"{beside.evaluation.worlds.n:,} worlds; 95 % intervals; harm in m²/s². {_ABOUT_BASELINE}"
    return Sheet(beside.title, ("Strategy", *columns.values()), rows, note)


def _beside_printed(
    stem: str,
    printed: Sequence[PaperRow],
    besides: Sequence[Beside],
    arithmetic: Sequence[Verdict],
    parameters: Sequence[Parameter],
    notes: Sequence[str] = (),
) -> Made:
    """A table of the paper, and ours in each reading."""
    columns: dict[str, list[str]] = {
        "Strategy": [row.agent for row in printed],
        "Collisions": [f"{row.collisions:,}" for row in printed],
        "Rate": [f"{100.0 * row.collision_rate:g} %" for row in printed],
        "Average harm": [f"{row.average_harm:g}" for row in printed],
    }
    if any(row.harm_decrease for row in printed):
        columns["Decrease"] = [f"{100.0 * (row.harm_decrease or 0.0):g} %" for row in printed]
    data = [
        (beside.title, name, quantity, beside.evaluation.worlds.n, numbers[quantity])
        for beside in besides
        for name, numbers in beside.numbers.items()
        for quantity in _PRINTED
        if quantity in numbers
    ]
    csv = csv_text(("reading", "strategy", "quantity", "worlds", "value", "low", "high"), data)
    tables = [
        Sheet("The paper's rows, as printed", [*columns], [*zip(*columns.values(), strict=True)]),
        *map(rows_table, besides),
    ]
    return Made([*arithmetic, *compare_rows(printed, besides)], parameters, tables, data={stem: csv}, notes=notes)


# The paper's hybrid around a policy that has not converged: ``Fig:hybrid illu`` and ``Table:hybrid``.

_RANDOM, _HYBRID_WORLDS, _RANDOM_WORLDS, _KINDS = "paper-random", 5_000, 10_000, ("SAC", "PPO")
_ALONE, _REALISED, _AS_PRINTED = "policy alone", "hybrid, realised H*", "hybrid, predicted H*"


def _drive_hybrid(name: str, settings: Reproduction, reading: Reading) -> Evaluation:
    """The strategies on the worlds of a scenario."""
    return _driven_hybrid(name, settings, reading, unconverged_policy(settings)[1])


@lru_cache(maxsize=2 * len(READINGS))  # figure and table share what they drive
def _driven_hybrid(name: str, settings: Reproduction, reading: Reading, about: str) -> Evaluation:
    """... with the policy that is told ``about``: a training that has ended since takes the place of a shipped one."""
    scenario, (policy, _) = reading.scenario(name), unconverged_policy(settings)
    agents: dict[str, Agent] = {
        **lineup(scenario, PAIRWISE, COUPLED),
        _ALONE: LearnedAgent(policy, "policy"),
        _REALISED: hybrid(policy, scenario, "coupled"),
        _AS_PRINTED: hybrid(policy, scenario, "pairwise"),
    }
    return drive_list(scenario, agents, min(_HYBRID_WORLDS, settings.episodes), settings)


def reproduce_illustration(settings: Reproduction) -> Made:
    """Harm of E-V2X-BM, of a policy that has not converged, and of the hybrid, over the total distance.

    Judged is whether it "consistently selects the strategy that results in lower harm": in each world, in each group.
    """
    found, verdicts = {}, []
    for reading in READINGS:
        evaluation = _drive_hybrid(_DISTANCE, settings, reading)
        found[reading.name], harm = by_distance(evaluation), harms(evaluation)
        for name, baseline in ((_REALISED, NAMES[COUPLED]), (_AS_PRINTED, NAMES[PAIRWISE])):
            lower = np.minimum(harm[_ALONE], harm[baseline])
            worse = harm[name] > lower + 1e-9
            because = (
                f"in {int(worse.sum()):,} of {len(worse):,} worlds the {name} harms more than the lower of policy and"
                f" {baseline}; mean excess {mean(harm[name] - lower).in_words()}"
            )
            what = f"the {name} takes the lower of the two ({reading.name})"
            verdicts.append(Verdict(what, "differs" if worse.any() else "agrees", because))
        for other in (_ALONE, NAMES[COUPLED]):
            what = f"the {_REALISED} harms no more than {other} at every distance ({reading.name})"
            parts = less_in_each(found[reading.name][1], _REALISED, other)
            verdicts.append(judge_statement(what, parts, or_equal=True))
    lines = [NAMES[PAIRWISE], NAMES[COUPLED], _ALONE, _REALISED, _AS_PRINTED, PREDICTED]
    told = [Parameter("policy", unconverged_policy(settings)[1]), _H_STAR, FIRST_IMPACTS]
    episodes = min(_HYBRID_WORLDS, settings.episodes)
    return _over_distance("hybrid-illustration", found, verdicts, lines, told, episodes)


def reproduce_hybrid_table(settings: Reproduction) -> Made:
    """The 5,000 episodes of the paper's table, with both speeds that it may mean."""
    ours = {
        "E-V2X-BM": (NAMES[PAIRWISE], NAMES[COUPLED]),
        "Standalone DRL": (_ALONE,),
        "Hybrid": (_AS_PRINTED, _REALISED),
    }
    besides = [
        Beside(f"{speeds}, {reading.name}", _drive_hybrid(name, settings, reading), ours)
        for name, speeds in ((_RANDOM, "speeds 18 to 22 m/s"), (_DISTANCE, "speeds 20, 18, 20 m/s"))
        for reading in READINGS
    ]
    printed = {row.agent: row for row in PAPER_ROWS if row.table == "hybrid test"}
    episodes = min(_HYBRID_WORLDS, settings.episodes)
    both = "uniform (18, 22) m/s, the random test's, and (20, 18, 20) m/s, the figure's"
    found = scenario_parameters(load_scenario(_RANDOM), gaps_m="text to Table:hybrid", latency_s="identical settings")
    parameters = [
        *(Parameter("speeds", both) if each.name == "speeds" else each for each in found),
        Parameter("policy", unconverged_policy(settings)[1]),
        _H_STAR,
        FIRST_IMPACTS,
        list_parameter(episodes, "5,000, text to Table:hybrid" if episodes == _HYBRID_WORLDS else ""),
    ]
    arithmetic = [selection_verdict(*(printed[agent] for agent in ours))]
    note = (
        "The paper does not describe its policy that has not converged. The rows of Standalone DRL and Hybrid are of"
        " ours: whether they agree depends on when a training is stopped."
    )
    return _beside_printed("hybrid-table", list(printed.values()), besides, arithmetic, parameters, [note])


def reproduce_random_table(settings: Reproduction) -> Made:
    """Collisions, harm and its decrease of the four strategies in the random test (``Table:Random``)."""
    episodes, besides = min(_RANDOM_WORLDS, settings.episodes), []
    ours: dict[str, tuple[str, ...]] = {
        "Non-E": (NAMES[FULL_BRAKE],),
        "E-V2X-BM": (NAMES[PAIRWISE], NAMES[COUPLED]),
        **{
            f"Hybrid {kind}": (f"Hybrid {kind}, realised H*", f"Hybrid {kind}, predicted H*") for kind in ("SAC", "PPO")
        },
    }
    for reading in READINGS:
        scenario = reading.scenario(_RANDOM)
        agents: dict[str, Agent] = lineup(scenario, FULL_BRAKE, PAIRWISE, COUPLED)
        for kind in _KINDS:
            policy, (realised, predicted) = load_shipped(kind.lower()), ours[f"Hybrid {kind}"]
            agents |= {realised: hybrid(policy, scenario, "coupled"), predicted: hybrid(policy, scenario, "pairwise")}
        besides.append(Beside(reading.name, drive_list(scenario, agents, episodes, settings), ours))
    baseline, *others = printed = [row for row in PAPER_ROWS if row.table == "random test"]
    text = "text to Table:Random"
    parameters = [
        *scenario_parameters(load_scenario(_RANDOM), gaps_m=text, speeds_mps=text),
        _NOT_THEIRS,
        _H_STAR,
        FIRST_IMPACTS,
        list_parameter(episodes, f"10,000, {text}" if episodes == _RANDOM_WORLDS else ""),
    ]
    arithmetic = [decrease_verdict(row, baseline) for row in others]
    return _beside_printed("random-table", printed, besides, arithmetic, parameters)


# What the paper leaves open: each quantity, what the paper says of it, our default, alternatives, and how far the
# headline of the random test moves when one of them changes.


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another reading of a quantity, and how it is put into the random test."""

    value: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # of the scenario
    seed: int | None = None  # of the list
    harm: Literal["first", "total", "sampled", "predicted"] = "first"  # what is counted
    bound: Literal["coupled", "pairwise"] | None = None  # of the hybrid that drives in the place of PPO


@dataclass(frozen=True, slots=True, eq=False)
class Gap:
    """A quantity that the paper leaves open, or that can be read in two ways."""

    name: str
    paper: str  # what it says, with the label in its source
    ours: str
    alternatives: tuple[Alternative, ...] = ()
    otherwise: str = ""  # why there are none


def _of(key: str, *values: float, unit: str = "") -> tuple[Alternative, ...]:
    return tuple(Alternative(f"{value:g}{unit}", {key: value}) for value in values)


GAPS = (
    Gap("restitution e", "eq:12: e in [0, 1], typically at most 0.3; not said for its tests", "0.1",
        _of("restitution", 0.0, 0.2, 0.3, 0.5)),
    Gap("time step Δt", "sec:optimization_problem: a sampling period, no number", "0.1 s",
        _of("time_step_s", 0.05, 0.2, unit=" s")),
    Gap("impacts at samples or exact", "dynamics2: at samples", "at their exact time; each impact once",
        (Alternative("the paper's map at 0.1 s, harm at every sample of an overlap (eq:Jharmn)", harm="sampled"),)),
    Gap("horizon N", "Jfunc: N steps, no number", "8 s", _of("horizon_s", 5.0, 16.0, unit=" s")),
    Gap("largest speed v_max", "eq:52: a limit, no number", "40 m/s", _of("speed_limit_mps", 25.0, unit=" m/s")),
    Gap("when Vehicle 2 may act", "text to Fig:Harm-ivds: τ2 = 0.5 s", "0.5 s",
        (Alternative("0.2 s", {"latency_s": [0, 0.2, 0.8]}), Alternative("0.3 s", {"latency_s": [0, 0.3, 0.8]}))),
    Gap("what the latency of Vehicle 3 is counted from", "eq:olle2: from t = 0", "from t = 0",
        (Alternative("from τ2 (τ3 = 1.3 s)", {"latency_s": [0, 0.5, 1.3]}),)),
    Gap("which impacts count", "sec:result: each pairwise collision once; eq:Jharmn: at every sample",
        "each pair's first impact", (Alternative("every impact", harm="total"),)),
    Gap("H* of E-V2X-BM, predicted or realised", "Eq:BaselineHarm: the expected harm", "realised; both are shown",
        (Alternative("predicted, pair by pair", harm="predicted"),)),
    Gap("H* inside the hybrid", "alg:hybrid: H* of Eq:BaselineHarm", "realised (coupled)",
        (Alternative("hybrid with realised H*", bound="coupled"),
         Alternative("hybrid with predicted H*", bound="pairwise"))),
    Gap("initial speeds of Table:hybrid", "identical simulation settings; only gaps are named", "18 to 22 m/s",
        (Alternative("20, 18, 20 m/s", {"speeds_mps": [20, 18, 20]}),)),
    Gap("seed of the test", "text to Table:hybrid: a fixed random seed", "7",
        (Alternative("8", seed=8), Alternative("9", seed=9))),
    Gap("impacts before Vehicle 2 may act", "sec:system_model: assumed not to happen", "such worlds are drawn again",
        (Alternative("kept", {"early_impacts": "keep"}),)),
    Gap("what Vehicle 1 brakes for", "sec:problem: an unforeseen obstacle, not modelled", "nothing ahead",
        (Alternative("an obstacle 1.7 m beyond its stopping point", {"obstacle_margin_m": 1.7}),)),
    Gap("may Vehicle 2 drive", "text to Fig:Harm-ivds: yes, a_u,2 = 7 m/s²; E-V2X-BM only brakes", "yes",
        (Alternative("no, brake and coast only", {"driving_capacity_mps2": [6, 0, 6]}),)),
    Gap("Vehicles 1 and 3 after an impact", "eq:olle1, eq:olle2: brake for a time fixed by the initial speeds",
        "brake until they stand",
        otherwise="not measured: the engine has no vehicle that rolls on after its braking time"),
    Gap("weights of the reward", "w_h, w_p, w_j, R_safe, k_energy, k_d, d_safe, d_target: none stated",
        "1, 0.1, 1e-5, 10 in ppo-paper", otherwise="trained by --full: ppo-paper-..."),
    Gap("state of the policy", "MDP formulation: positions, speeds, actions of the others",
        "also capacities, masses, latencies, e and derived features",
        otherwise="trained by --full: ppo-paper-state..."),
    Gap("seeds of the training", "multiple training tests with different random seeds", "0, 1, 2",
        otherwise="trained by --full: ppo-paper..."),
    Gap("ends of the cosine, number of decisions", "table:params: cosine, no numbers", "3e-4 to 3e-5; in the recipes",
        otherwise="not measured: one training each takes minutes; docs/learning.md compares recipes"),
)  # fmt: skip


_SPECS = (FULL_BRAKE, PAIRWISE, COUPLED, PPO)
_SHOWN = tuple(NAMES[spec] for spec in _SPECS)


@dataclass(frozen=True, slots=True)
class Headline:
    """Harm and collisions of each strategy in each world of a list."""

    gaps_m: Floats  # [n, P] by which lists of the same worlds are known
    harm: Mapping[str, Floats]
    collided: Mapping[str, Bools]

    def change(self, base: Headline, strategy: str) -> Estimate:
        """Harm minus that of ``base``: paired by world where the worlds are the same, else of two lists."""
        own, other = self.harm[strategy], base.harm[strategy]
        if np.array_equal(self.gaps_m, base.gaps_m):
            return paired_difference(own, other)
        return Less.of_lists(strategy, own, other).difference


def reproduce_gaps(settings: Reproduction) -> Made:
    """The sensitivity table: every quantity, our default, alternatives, and how far the headline moves."""
    episodes, scenario = min(2_000, settings.episodes), load_scenario(_RANDOM)
    base = _measure(scenario, Alternative("default"), episodes)
    measured = [gap for gap in GAPS if gap.alternatives]
    found: dict[tuple[Gap, Alternative], Headline] = {}
    for number, gap in enumerate(measured):
        settings.tell(Progress("open quantities", number, len(measured)))
        found |= {(gap, each): _measure(scenario, each, episodes) for each in gap.alternatives}
    settings.tell(Progress("open quantities", len(measured), len(measured)))
    rows = {f"{gap.name}: {each.value}": headline for (gap, each), headline in found.items()}
    changes = {row: {name: headline.change(base, name) for name in _SHOWN} for row, headline in rows.items()}
    verdicts, notes, printed = [], [], {row.agent: row for row in PAPER_ROWS if row.table == "random test"}
    for agent, spec in (("Non-E", FULL_BRAKE), ("E-V2X-BM", PAIRWISE), ("Hybrid PPO", PPO)):
        others = {row: mean(headline.harm[NAMES[spec]]) for row, headline in rows.items()}
        what = f"{agent}, average harm of Table:Random, one open quantity changed at a time"
        ours = mean(base.harm[NAMES[spec]])
        verdicts.append(compare_number(what, printed[agent].average_harm, ours, others=others))
    order = (NAMES[PPO], NAMES[COUPLED], NAMES[FULL_BRAKE])
    means = {row: [float(headline.harm[name].mean()) for name in order] for row, headline in rows.items()}
    broken = [row for row, in_order in means.items() if in_order != sorted(in_order)]
    stays = f"in {len(rows) - len(broken)} of {len(rows)} alternatives{'; not with ' * bool(broken)}{'; '.join(broken)}"
    verdicts.append(Verdict(f"the order stays: {' < '.join(order)}", "differs" if broken else "agrees", stays))
    for name in _SHOWN:
        most = max(rows, key=lambda row: abs(changes[row][name].value))
        harm = mean(base.harm[name]).in_words()
        notes.append(f"What moves {name} ({harm}) most: {most}, by {changes[most][name].in_words()}.")
    tables = [
        Sheet(
            "Register of what the paper leaves open",
            ("Quantity", "The paper", "Our default", "Alternatives, or why none is measured"),
            [
                (gap.name, gap.paper, gap.ours, "; ".join(each.value for each in gap.alternatives) or gap.otherwise)
                for gap in GAPS
            ],
            "Labels are those of the paper's source.",
        ),
        Sheet(
            "Headline at our defaults",
            ("Strategy", PERCENT, HARM),
            [(name, collision_rate(base.collided[name]), mean(base.harm[name])) for name in _SHOWN],
            f"{episodes:,} worlds of the random test, seed {LIST_SEED}; first-impact harm, m²/s²; 95 % intervals.",
        ),
        Sheet(
            "How far the headline moves",
            [
                *("Quantity", "Default", "Alternative", *_SHOWN),
                *(replace(PERCENT, heading=f"Collisions, {name}") for name in ("E-V2X-BM", "PPO")),
            ],
            [
                (
                    *(gap.name, gap.ours, each.value, *(headline.change(base, name) for name in _SHOWN)),
                    *(collision_rate(headline.collided[NAMES[spec]]).value for spec in (PAIRWISE, PPO)),
                )
                for (gap, each), headline in found.items()
            ],
            "Change of the mean harm (m²/s²) with its 95 % interval, paired by world where the worlds are the same;"
            " then the collision rates in the alternative. In the rows of H* inside the hybrid, PPO stands behind"
            " Algorithm 1.",
        ),
    ]
    trained = {
        name.partition("/")[2]: [min(RunDirectory(path).column(_HARM).values()) for path in paths]
        for name, paths in settings.trained([OPEN]).items()
    }
    if trained:
        note = (
            "First-impact harm (m²/s²) of the kept policy on 1,000 worlds of seed 1007; ppo-paper is the paper's table"
            f" with our weights. Each had {PPO_PAPER.decisions:,} of the recipe's"
            f" {load_recipe(PPO_PAPER.recipe).total_steps:,} decisions; two seeds say little about others."
        )
        told = [
            (name, len(kept), float(np.mean(kept)), ", ".join(f"{harm:.2f}" for harm in kept))
            for name, kept in trained.items()
        ]
        tables.append(Sheet("What is open in training", ("Training", "Seeds", "Mean harm", "Each seed"), told, note))
    else:
        verdicts.append(Verdict("what is open in training", "not run", "no training; --full trains"))
    data = [
        (row, name, len(each.gaps_m), mean(each.harm[name]).value, each.change(base, name),
         collision_rate(each.collided[name]).value)
        for row, each in {"default": base, **rows}.items()
        for name in _SHOWN
    ]  # fmt: skip
    head = ("alternative", "strategy", "worlds", "harm", "change", "change_low", "change_high", "collision_rate")
    about = "Change of the mean harm of each strategy on the random test when one open quantity changes."
    figure = changes_figure(changes, x_label="Change of the mean harm (m²/s²)", caption=about)
    parameters = [
        *scenario_parameters(scenario, gaps_m="text to Table:Random", speeds_mps="text to Table:Random"),
        Parameter("policies", f"{POLICIES}; not trained anew for an alternative"),
        list_parameter(episodes),
    ]
    drawn = Drawn("gaps", "How far the headline moves", about)
    return Made(verdicts, parameters, tables, {drawn: figure}, {"gaps": csv_text(head, data)}, notes)


def _measure(scenario: Scenario, alternative: Alternative, episodes: int) -> Headline:
    """The strategies in one alternative; a strategy that predicts no harm has its first-impact harm."""
    own = scenario.replace(**alternative.changes) if alternative.changes else scenario
    agents: dict[str, Agent] = lineup(own, *_SPECS)
    if alternative.bound is not None:
        agents[NAMES[PPO]] = hybrid(load_shipped("ppo"), own, alternative.bound)
    seed = LIST_SEED if alternative.seed is None else alternative.seed
    evaluation = evaluate(
        own.sample(episodes, seed), agents, scenario=own, seed=seed, aftermath=alternative.harm == "sampled"
    )
    harm = {}
    for name, outcome in evaluation.outcomes.items():
        predicted = outcome.predicted_harm if name == NAMES[PAIRWISE] else None
        counted = {"total": outcome.total_harm, "sampled": outcome.sampled_harm, "predicted": predicted}
        chosen = counted.get(alternative.harm)
        harm[name] = outcome.first_impact_harm if chosen is None else chosen
    collided = {name: outcome.collided for name, outcome in evaluation.outcomes.items()}
    return Headline(evaluation.worlds.gaps_m, harm, collided)


# The paper's Scenarios 1 and 2: trajectories (``Fig:pic5sim``) and acceleration profiles (``Fig:pic5act``).

_AGENTS = (PPO, SAC, COUPLED, FULL_BRAKE)
_POLICIES = (NAMES[PPO], NAMES[SAC])
_SCENARIOS = (1, 2)
_CELLS = [(reading, number) for reading in READINGS for number in _SCENARIOS]

Records = dict[tuple[Reading, int, str], EpisodeRecord]  # reading, scenario, strategy


def reproduce_trajectories(settings: Reproduction) -> Made:
    """Positions of the three vehicles in both scenarios, against the vehicle and against time."""
    records, figures, verdicts = _record_all(settings), {}, []
    for reading, stem in zip(READINGS, ("stated", "early"), strict=True):
        own = {f"{name}, Scenario {k}": records[reading, k, name] for name in _POLICIES for k in _SCENARIOS}
        text = f"Positions of the vehicles, {reading.name}; an arrow every second, dashed lines join equal times."
        road = Drawn(f"trajectories-road-{stem}", f"Trajectories, {reading.name}", text)
        figures[road] = road_figure(own, caption=text)
        text = f"The same over time, {reading.name}: positions with impacts, gaps, commands of Vehicle 2."
        over_time = Drawn(f"trajectories-time-{stem}", f"Over time, {reading.name}", text)
        figures[over_time] = trajectories(own, caption=text)
        one, two = _apart(records, reading, "positions_m")
        ahead, behind = ([float(gaps.mean()) for gaps in _both(records, reading, 2, "gaps_m", k)] for k in (0, 1))
        claims = {
            "Vehicle 2 of PPO and SAC is nearer together in Scenario 1 than in 2": (
                f"root mean square {one:.2f} m against {two:.2f} m", one, two,
            ),
            "Scenario 2: PPO keeps the larger distance to Vehicle 3": (
                f"mean gap {behind[1]:.2f} m under SAC, {behind[0]:.2f} m under PPO", behind[1], behind[0],
            ),
            "Scenario 2: SAC keeps the larger distance to Vehicle 1": (
                f"mean gap {ahead[0]:.2f} m under PPO, {ahead[1]:.2f} m under SAC", ahead[0], ahead[1],
            ),
        }  # fmt: skip
        verdicts += _judge_one_world(claims, reading, Column("Distance", unit=" m"))
    rows = [
        (
            *(reading.name, number, name, len(record.impacts.time_s)),
            *(float(record.ledger.world_harm("first")[0]), *map(float, record.gaps_m[-1])),
        )
        for (reading, number, name), record in records.items()
    ]
    head = ("Reading", "Scenario", "Strategy", "Impacts", "First-impact harm", "Last gap 1 (m)", "Last gap 2 (m)")
    table = Sheet("How the episodes end", head, rows, "One world each: no intervals. Harm in m²/s².")
    return Made(verdicts, _parameters(), [table], figures, {"trajectories": _csv(records)})


def reproduce_accelerations(settings: Reproduction) -> Made:
    """Commands of Vehicle 2 in both scenarios."""
    records, verdicts = _record_all(settings), []
    driven = {key: _asked_of_vehicle_2(record) for key, record in records.items()}
    panels = {
        f"{name}, Scenario {number}": {reading.name: records[reading, number, name] for reading in READINGS}
        for name in _POLICIES
        for number in _SCENARIOS
    }
    text = "Command of Vehicle 2 over time, as the paper states the latencies and with Vehicle 2 acting at 0.2 s."
    figures = {Drawn("accelerations", "Acceleration profiles", text): profiles_figure(panels, caption=text)}
    for reading in READINGS:
        one, two = _apart(records, reading, "command_mps2")
        (first, ppo_changes, _), (_, sac_changes, braking) = (driven[reading, 2, name] for name in _POLICIES)
        claims = {
            "the profiles are more alike in Scenario 1 than in 2": (
                f"root mean square difference {one:.2f} m/s² against {two:.2f} m/s²", one, two,
            ),
            "Scenario 2: PPO accelerates before it brakes": (f"first command {first:+.2f} m/s²", 0.0, first),
            "Scenario 2: SAC decelerates throughout most of it": (
                f"braking in {100.0 * braking:.0f} % of the time it moves", 0.5, braking,
            ),
            "Scenario 2: PPO's profile is the smoother one": (
                f"ups and downs {ppo_changes:.1f} m/s² under PPO, {sac_changes:.1f} m/s² under SAC", ppo_changes,
                sac_changes,
            ),
        }  # fmt: skip
        verdicts += _judge_one_world(claims, reading, Column("Command", unit=" m/s²"))
    rows = [
        (
            *(reading.name, number, name, f"{first:+.2f}"),
            f"{records[reading, number, name].command_mps2[:, 1].min():+.2f}",
            *(f"{100.0 * braking:.0f} %", f"{changes:.1f}"),
        )
        for (reading, number, name), (first, changes, braking) in driven.items()
    ]
    head = ("Reading", "Scenario", "Strategy", "First command", "Hardest", "Braking while it moves", "Ups and downs")
    note = "Commands of Vehicle 2 in m/s². One world each: no intervals."
    table = Sheet("Commands of Vehicle 2", head, rows, note)
    return Made(verdicts, _parameters(), [table], figures, {"accelerations": _csv(records)})


def _record_all(settings: Reproduction) -> Records:
    found: Records = {}
    for reading, number in _CELLS:
        scenario = reading.scenario(f"paper-scenario-{number}")
        world = scenario.sample(1, LIST_SEED).worlds
        for name, agent in lineup(scenario, *_AGENTS).items():
            found[reading, number, name] = record_episode(world, agent, scenario=scenario)
            settings.tell(Progress("recorded episodes", len(found), len(_CELLS) * len(_AGENTS)))
    return found


@cache
def _play() -> Part:
    """Both scenarios in both readings, PPO and SAC side by side, for the page."""
    found = []
    for reading, number in _CELLS:
        scenario = reading.scenario(f"paper-scenario-{number}")
        world = scenario.sample(1, LIST_SEED).worlds
        latencies = ",".join(f"{each:g}" for each in scenario.model_dump()["latency_s"])
        again = "" if reading.acts_s is None else f"--set latency_s=[{latencies}]"
        one = Played(0, reading.name, again, title=f"Scenario {number}, {reading.name}")
        for spec, agent in make_agents(_AGENTS, scenario).items():
            Played.drive([one], world, NAMES[spec], agent, scenario)
        found.append(one)
    return Part.player(found, scenario.learners, shown_first=[_AGENTS.index(PPO), _AGENTS.index(SAC)])


def _parameters() -> list[Parameter]:
    one, two = (scenario_parameters(load_scenario(f"paper-scenario-{k}")) for k in _SCENARIOS)
    told = [
        stated(first.name, f"{first.value}; Scenario 2: {second.value}", "text to Fig:pic5sim")
        if first.value != second.value
        else first
        for first, second in zip(one, two, strict=True)
    ]
    return [*told, Parameter("policies", f"{POLICIES}; not the paper's")]


def _both(records: Records, reading: Reading, number: int, what: str, column: int) -> tuple[Floats, Floats]:
    """A column of PPO's and SAC's record at equal times until the later one ends; beyond its end it stays."""
    pair = [records[reading, number, name] for name in _POLICIES]
    times = np.arange(0.0, float(max(record.time_s[-1] for record in pair)), 0.02)
    one, other = (np.interp(times, each.time_s, getattr(each, what)[:, column]) for each in pair)
    return one, other


def _apart(records: Records, reading: Reading, what: str) -> list[float]:
    """In each scenario, the root mean square difference between Vehicle 2 under PPO and under SAC."""
    pairs = (_both(records, reading, number, what, 1) for number in _SCENARIOS)
    return [float(np.sqrt(np.mean((one - other) ** 2))) for one, other in pairs]


def _judge_one_world(claims: Mapping[str, tuple[str, float, float]], reading: Reading, show: Column) -> list[Verdict]:
    """Claims, each with the numbers that it follows from, the smaller and the larger: of one world, no intervals."""
    return [
        judge_statement(f"{claim} ({reading.name})", [Less(told, Estimate(smaller - larger, None))], show=show)
        for claim, (told, smaller, larger) in claims.items()
    ]


def _asked_of_vehicle_2(record: EpisodeRecord) -> tuple[float, float, float]:
    """Its command at its first decision (m/s2), how far that goes up and down from then on (m/s2), and its braking.

    That is the share of the time until its standstill in which it brakes.
    """
    acting = record.time_s >= float(record.initial.vehicles.latency_s[0, 1])
    command, moving = record.command_mps2[acting, 1], record.speeds_mps[acting, 1] > 0.0
    braking = float((command[moving] < 0.0).mean()) if moving.any() else 0.0
    return float(command[0]), float(np.abs(np.diff(command)).sum()), braking


def _csv(records: Records) -> str:
    every = range(1, 4)
    head = [
        *("reading", "scenario", "strategy", "time_s"),
        *(f"position_{i}_m" for i in every),
        *(f"speed_{i}_mps" for i in every),
        *("gap_1_m", "gap_2_m"),
        *(f"command_{i}_mps2" for i in every),
    ]
    rows = [
        [reading.name, number, name, round(float(time_s), 9), *(value for column in columns for value in column[k])]
        for (reading, number, name), record in records.items()
        for columns in [(record.positions_m, record.speeds_mps, record.gaps_m, record.command_mps2)]
        for k, time_s in enumerate(record.time_s)
    ]
    return csv_text(head, rows)


ITEMS = (  # in the order of the paper
    Item(
        "learning-high",
        ("fig:ppo_sac_high_latency",),
        "Learning curves at high delay",
        "Returns of PPO and SAC in training under large communication delays.",
        partial(reproduce_curves, HIGH),
        10,
        _CURVES,
    ),
    Item(
        "learning-low",
        ("fig:ppo_sac_low_latency",),
        "Learning curves at low delay",
        "Returns of PPO and SAC in training under small communication delays.",
        partial(reproduce_curves, LOW),
        10,
        _CURVES,
    ),
    Item(
        "harm-distance",
        ("Fig:Harm-ivds",),
        "Harm over total distance",
        "Harm of the non-ethical strategy, E-V2X-BM, SAC and PPO against the sum of both gaps.",
        reproduce_distance,
        15,
    ),
    Item(
        "harm-delays",
        ("Fig:harm-delay",),
        "Harm at three delays",
        "Harm of the four strategies at three communication delays, gaps of 7 m.",
        reproduce_delays,
        15,
    ),
    Item(
        "trajectories",
        ("Fig:pic5sim",),
        "Trajectories of Scenarios 1 and 2",
        "Positions of the three vehicles under PPO and SAC, against the vehicle and against time.",
        reproduce_trajectories,
        5,
        play=_play,
    ),
    Item(
        "accelerations",
        ("Fig:pic5act",),
        "Acceleration profiles of Scenarios 1 and 2",
        "Commands of Vehicle 2 under PPO and SAC.",
        reproduce_accelerations,
        5,
    ),
    Item(
        "hybrid-illustration",
        ("Fig:hybrid illu",),
        "Illustration of the hybrid",
        "Harm of E-V2X-BM, of a policy that has not converged, and of the hybrid of both, against total distance.",
        reproduce_illustration,
        20,
        (STOPPED,),
    ),
    Item(
        "hybrid-table",
        ("Table:hybrid",),
        "E-V2X-BM, DRL and hybrid in 5,000 episodes",
        "Collisions and harm of E-V2X-BM, of a policy that has not converged, and of the hybrid.",
        reproduce_hybrid_table,
        20,
        (STOPPED,),
    ),
    Item(
        "random-table",
        ("Table:Random",),
        "Four strategies in 10,000 random episodes",
        "Collisions, harm and its decrease of the non-ethical strategy, E-V2X-BM and the hybrids of SAC and PPO.",
        reproduce_random_table,
        60,
    ),
    Item(
        "gaps",
        (),
        "What the paper leaves open",
        "Every quantity that the paper leaves open, our default, and how far the headline moves when it changes.",
        reproduce_gaps,
        40,
        (OPEN,),
    ),
)


def _text(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def read_results(folder: Path) -> list[Result]:
    """The results that are there, in the order of the paper.

    Raises ``InvalidInput`` for one that is damaged, or another item's.
    """
    files = {item.name: folder / item.name / _RESULT for item in ITEMS}
    return [checked_result(read_object(file), file, name) for name, file in files.items() if file.is_file()]


def checked_result(content: Mapping[str, Any], where: Path | str, name: str) -> Result:
    """The result in the file of an item.

    Raises ``InvalidInput`` where what pages show is not there or of another kind, or another item's.
    """
    try:
        result = TypeAdapter(Result).validate_json(json.dumps(content))
    except ValidationError as error:
        wrong = ": ".join(map(str, error.errors()[0]["loc"]))
    else:
        lines = [(each.head, row) for each in result.tables for row in [each.head, *each.rows]]
        checks = {
            "name": result.name == name,
            "data": all(Path(file).name == file for file in result.data),
            "tables: rows": all(head and len(row) == len(head) for head, row in lines),
            "verdict": result.verdict == summarise_verdicts(result.comparisons),
        }
        wrong = next((what for what, is_right in checks.items() if not is_right), "")
    if wrong:
        raise InvalidInput(f"{where}: {wrong}: is not what a reproduction writes; make it again (--force)")
    return result


# The pages: one HTML file that holds its figures and loads nothing from anywhere, and Markdown with figures beside it.

_TITLE = "The paper, made again"
_PAPER = "How to Brake? Ethical Emergency Braking with Deep Reinforcement Learning"
_LEAD = f" of {_PAPER}, with the paper's numbers and statements. {HOW_JUDGED}"
_NUMERAL = re.compile(r"[-+−]?\d[\d,.]*( ?%)?|–|")


def _account(results: Sequence[Result]) -> tuple[str, str, str, list[str]]:
    """What a page of these results is about; the command that makes them; when, where and in how much time they were.

    Then that lists are shorter than the paper's, where they are.
    """
    every = len(results) == len(ITEMS)
    most = max((result.episodes for result in results), default=MOST_EPISODES)
    fewer = most < MOST_EPISODES
    names = [] if every else [result.name for result in results]
    mode = "--full" if any(result.mode == "full" for result in results) else "--quick"
    command = ["ethbrake reproduce", *names, mode, *(["--episodes", str(most)] if fewer else [])]
    unloaded = [re.sub(r", load [0-9.]+", "", each.machine) for each in results]  # the load differs item by item
    machines = (f"{each.made_utc[:10]}, {machine}" for each, machine in zip(results, unloaded, strict=True))
    seconds = sum(each.processor_s for each in results)
    return (
        f"Every figure and table{_LEAD}" if every else f"{len(results)} of the {len(ITEMS)} items{_LEAD}",
        " ".join(command),
        f"{'; '.join(dict.fromkeys(machines))}; {seconds:.0f} s of one core without the trainings",
        [f"At most {most:,} worlds of each list are driven here; the paper has {MOST_EPISODES:,}."] if fewer else [],
    )


def render_page(folder: Path, results: Sequence[Result]) -> str:
    """The page as HTML; whatever the results say is shown as text.

    Raises ``InvalidInput`` for a figure that is not there or holds more than a figure of ours does.
    """
    lead, command, made, few = _account(results)
    _, *names = Page.anchors(["Overview", *(result.title for result in results)])
    link = Markup('<a href="#{}">{}</a>')
    rows = [
        [Shown(link.format(name, shown(each.title))), Shown(_outcome(each.verdict.outcome), each.verdict.because)]
        for name, each in zip(names, results, strict=True)
    ]
    overview = [
        Part(Markup("<p>Made by <code>{}</code> ({}).</p>\n").format(shown(command), shown(made))),
        *(Part.paragraph(text, "note") for text in few),
        Part.table(Sheet("Verdict on each item", ["Item", "Verdict"], rows)),
    ]
    return Page(_TITLE, [Section("Overview", overview), *(_section(folder, each) for each in results)], lead).html


def _section(folder: Path, result: Result) -> Section:
    code, link = Markup("<code>{}</code>"), Markup('<a href="./{}/{}">{}</a>')
    data = [
        link.format(quote(result.name, ""), quote(file, ""), shown(f"{result.name}/{file}")) for file in result.data
    ]
    account = {
        "Verdict": _outcome(result.verdict.outcome),
        "Because": result.verdict.because,
        "In the paper's source": Markup(", ").join(code.format(shown(label)) for label in result.labels),
        "Data": Markup(", ").join(data),
    }
    facts = Part.facts({name: value for name, value in account.items() if value})
    body: list[str | Part] = [result.what, facts, *result.notes]
    for drawn in result.figures:
        file = folder / result.name / f"{drawn.stem}.svg"
        body.append(Part.drawing(read_plain(file, _LIMIT_BYTES), drawn.title, drawn.text, where=file))
    for item in ITEMS:
        if item.name == result.name and item.play is not None:
            body += [Part.heading("Episodes"), item.play()]
    for each in result.tables:
        words = [not all(_NUMERAL.fullmatch(value) for value, _ in column) for column in zip(*each.rows, strict=True)]
        columns = [
            Column(name, text=wordy) for name, wordy in zip(each.head, words or [False] * len(each.head), strict=True)
        ]
        body.append(Part.table(Sheet(each.title, columns, [[row[0].in_words, *row[1:]] for row in each.rows])))
        body += [Part.paragraph(each.note, "quiet")] if each.note else []
    compared = [[each.what, Shown(_outcome(each.outcome), each.because)] for each in result.comparisons]
    comparisons = Part.table(Sheet("Comparisons with the paper", ["What", "Verdict"], compared))
    shaped = [[each.name, each.value, each.origin] for each in result.parameters]
    parameters = Part.table(Sheet("What shapes the item", ["Parameter", "Value", "Origin"], shaped))
    rest = (
        Part.opened(f"Comparisons: {len(compared)}", [comparisons]),
        Part.opened(f"Parameters: {len(shaped)}", [parameters]),
    )
    return Section(result.title, [*body, *rest])


def _outcome(word: str) -> Markup:
    """The word of a verdict, with a sign and a colour."""
    return Markup('<span class="outcome {}">{}</span>').format(word.replace(" ", "-"), word)


FIGURES, PREFIX = "figures", "reproduction-"  # of the figures beside docs/reproduction.md


def write_docs(file: Path, folder: Path, results: Sequence[Result]) -> None:
    """Write the page, the results as ``.json`` beside it, and the figures into ``figures/``; all are replaced."""
    figures = file.parent / FIGURES
    figures.mkdir(exist_ok=True)
    for result in results:
        for drawn in result.figures:
            data = read_plain(folder / result.name / f"{drawn.stem}.svg", _LIMIT_BYTES)
            write_output(figures / f"{PREFIX}{drawn.stem}.svg", data, force=True)
    content = json.dumps([each.in_words() for each in results], indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_output(file.with_suffix(".json"), content.encode(), force=True)
    write_output(file, docs_page(results).encode(), force=True)


def docs_page(results: Sequence[Result]) -> str:
    """The page of these results as Markdown: verdicts; the site shows everything else from the ``.json`` beside it."""
    lead, command, made, few = _account(results)
    blocks = [
        f"# {_TITLE}",
        "What comes out where the paper's experiments are made again, and where it cannot?",
        _wrapped(lead),
        _wrapped(f"Made by `{command} --output runs/reproduction --docs docs/reproduction.md` ({_escaped(made)})."),
        _wrapped(
            "That command writes this page, its figures and `reproduction.json`; nothing is written by hand. `ethbrake"
            " reproduce` makes them again without training. [All that was measured](results/reproduction.md) has every"
            " comparison, table, figure and parameter of each item; [the paper, line by line](paper.md) has every"
            " equation."
        ),
        *map(_wrapped, few),
    ]
    for result in results:
        labels = f" ({', '.join(map(_escaped, result.labels))})" if result.labels else ""
        blocks += [
            f"## {_escaped(result.title)}: {result.verdict.outcome}",
            _wrapped(f"{_escaped(result.what)}{labels}"),
            _wrapped(_escaped(result.verdict.because[:1].upper() + result.verdict.because[1:])),
        ]
    return "\n\n".join(blocks) + "\n"


def _wrapped(text: str) -> str:
    """A paragraph in lines of the pages' width; no line of it begins a list or a heading."""
    lines = textwrap.wrap(text, 99, break_long_words=False, break_on_hyphens=False)
    return "\n".join(re.sub(r"^(?=[-+#>] )", r"\\", line) for line in lines)


def _escaped(text: str) -> str:
    """Text that is no markup: what would be is escaped."""
    plain = plain_text(text, keep="\u00a0").replace("<", "&lt;")
    return re.sub(r"([\\|*_`])", r"\\\1", plain).replace("](", "]\\(")


# Making items: those that are asked for, in their folder.


def choose_items(names: Sequence[str]) -> list[Item]:
    """The items of these names in the order of the paper, all of them for none.

    Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for one that is given twice.
    """
    known = {item.name: item for item in ITEMS}
    for k, name in enumerate(names):
        if name not in known:
            raise unknown_name("item", name, known)
        if name in names[:k]:
            raise InvalidInput(f"item {name!r} is given twice")
    return [item for item in ITEMS if not names or item.name in names]


def open_folder(asked: Reproduction, *, force: bool = False) -> StudyFolder:
    """The folder, in which the same settings go on; with ``force`` its results go and its trainings stay.

    Raises ``InvalidInput`` for a link.
    """
    path, question = asked.folder, {"episodes": asked.episodes, "version": __version__}
    if path.is_symlink():
        raise InvalidInput(f"{path}: is no plain folder; give another (--output)")
    if force and (path / _SETTINGS).is_file() and read_object(path / _SETTINGS).get("format") == _FORMAT["format"]:
        for item in ITEMS:  # figures and data are replaced as they are made again
            (path / item.name / _RESULT).unlink(missing_ok=True)
        write_file(path / _SETTINGS, _text({**_FORMAT, **question}))
    advice = "give another folder (--output), or replace it with force (--force)"
    return StudyFolder(
        path, "reproduction", question, record=_SETTINGS, more=_FORMAT, advice=advice, beside=("trainings",),
        writes=("index.html",),
    )  # fmt: skip


def make_items(asked: Reproduction, items: Sequence[Item], *, force: bool = False) -> tuple[list[Result], bool]:
    """Make the items; gives every result that the folder then holds, and whether nothing stopped the trainings.

    Items that need no training come first. One whose result is there, with the same trainings behind it, is kept.
    After each item the page is written anew. Ctrl-C during a training ends all trainings, and the items are made
    of those that are finished; a second one stops at once. Raises what ``open_folder`` and ``StudyFolder.work``
    raise.
    """
    full, finished = asked.mode == "full", True
    with open_folder(asked, force=force).work():
        for item in sorted(items, key=lambda each: len(each.trained) if full else 0):
            if full and finished:
                finished = asked.train(item.trained)
            trained = list(asked.trained(item.trained))
            kept = {result.name: list(result.trained) for result in read_results(asked.folder)}
            if kept.get(item.name) != trained:
                _make_item(asked, item, trained)
                write_file(asked.folder / "index.html", render_page(asked.folder, read_results(asked.folder)).encode())
        results = read_results(asked.folder)
    if asked.docs is not None:
        write_docs(asked.docs, asked.folder, results)
    return results, finished


def _make_item(asked: Reproduction, item: Item, trained: Sequence[str]) -> None:
    """Make an item, and write its figures and data, then its result, which makes them count."""
    place, started = asked.folder / item.name, time.process_time()
    made = item.make(asked)
    result = Result(
        name=item.name,
        labels=item.labels,
        title=item.title,
        what=item.what,
        mode=asked.mode,
        episodes=asked.episodes,
        trained=trained,
        processor_s=round(time.process_time() - started, 1),
        made_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        machine=asked.machine,
        verdict=summarise_verdicts(made.verdicts),
        comparisons=made.verdicts,
        parameters=made.parameters,
        tables=[
            Table(each.title, each.headings, [row for row in each.shown() if not isinstance(row, str)], each.note)
            for each in made.tables
        ],
        figures=list(made.figures),
        data=sorted(f"{stem}.csv" for stem in made.data),
        notes=made.notes,
    )
    if place.is_symlink() or (place.exists() and not place.is_dir()):
        raise InvalidInput(f"{place}: is no plain folder; move it away")
    place.mkdir(exist_ok=True)
    for drawn, figure in made.figures.items():
        for ending in (".svg", ".png"):
            write_picture(place / f"{drawn.stem}{ending}", figure, force=True)
    for stem, text in made.data.items():
        write_output(place / f"{stem}.csv", text.encode(), force=True)
    write_output(place / _RESULT, _text(asdict(result)), force=True)
