"""An item of the paper made again: verdicts, parameters, tables, figures and data, before anything is written."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass as model

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import OnProgress, Progress
from ethbrake_marl.evaluation import Evaluation, evaluate
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, make_agents
from ethbrake_marl.evaluation.statistics import Estimate, mean, paired_difference, unpaired_difference
from ethbrake_marl.figures.style import Figure
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.limits.limits import Unproven
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario import Scenario, load_scenario

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
_MOST_NAMED = 2
_PLURAL = {"agrees": "agree", "differs": "differ"}
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


@dataclass(frozen=True, slots=True)
class Bound:
    """A quantity that no strategy brings below ``least``, proven world by world."""

    what: str  # "impacts that no command avoids"
    least: Estimate  # over our list


def compare_number(
    what: str,
    printed: float,
    ours: Estimate,
    *,
    show: Column = HARM,
    bound: Bound | None = None,
    others: Mapping[str, Estimate] | None = None,
) -> Verdict:
    """Compare a number that the paper prints with ours.

    Args:
        what: which number.
        printed: the paper's.
        ours: the same quantity, with its interval over worlds.
        show: how both are written.
        bound: what no strategy undercuts, where that is proven.
        others: the same quantity under other readings; the nearest of them is named where ours differs.

    """
    told = f"ours {show.show(ours).in_words}, printed {show.scale * printed:.{show.digits + 1}f}{show.unit}"
    if bound is not None and bound.least.value - printed > _chance(bound.least):
        least = show.show(bound.least).in_words
        return Verdict(what, "cannot agree", f"{bound.what}: at least {least}, whoever drives; {told}")
    if _is_near(printed, ours):
        return Verdict(what, "agrees", told)
    if abs(ours.value - printed) <= _chance(ours):
        return Verdict(what, "undecided", f"{told}: too few worlds to tell")
    return Verdict(what, "differs", f"{told} ({_off(printed, ours)}){_nearest(printed, ours, others or {}, show)}")


def _is_near(printed: float, ours: Estimate) -> bool:
    """Whether the two differ by no more than ``TOLERANCE``, or than chance between two lists where that is not wide."""
    chance = _chance(ours)
    told = chance if chance <= WIDE * max(abs(printed), abs(ours.value)) else 0.0
    return abs(ours.value - printed) <= max(told, TOLERANCE * abs(printed))


def _chance(estimate: Estimate) -> float:
    """How far apart two such estimates over two lists may lie: sqrt 2 times the half-width."""
    low, high = _ends(estimate)
    return math.sqrt(2.0) * 0.5 * (high - low)


def _ends(estimate: Estimate) -> tuple[float, float]:
    return estimate.interval or (estimate.value, estimate.value)


def _off(printed: float, ours: Estimate) -> str:
    return f"{ours.value:+.3g} off" if printed == 0.0 else f"{100.0 * (ours.value / printed - 1.0):+.1f} %"


def _nearest(printed: float, ours: Estimate, others: Mapping[str, Estimate], show: Column) -> str:
    """The reading that comes nearest to what is printed, if it comes nearer than ours."""
    if not others:
        return ""
    name, found = min(others.items(), key=lambda each: abs(each[1].value - printed))
    if abs(found.value - printed) >= abs(ours.value - printed):
        return "; no other reading here comes nearer"
    met = "which agrees" if _is_near(printed, found) else _off(printed, found)
    return f"; nearest: {name}, {show.show(found).in_words}, {met}"


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
    places = ", ".join(ties) if len(ties) <= _MOST_NAMED else f"{len(ties)} more"
    if not compared:
        return Verdict(what, "agrees", f"nothing to undercut: both are 0 in {places}")
    highest = [_ends(part.difference)[1] for part in compared]
    failing = [
        part for part, high in zip(compared, highest, strict=True) if not (high < 0.0 or (or_equal and high <= 0.0))
    ]
    impossible = [part for part in failing if part.least is not None and _ends(part.least)[0] > 0.0]
    counts = f"holds in {len(compared) - len(failing)} of {len(compared)}{f' (both are 0 in {places})' if ties else ''}"
    if impossible:
        told = ", ".join(f"{part.where} by {show.show(part.least).in_words}" for part in impossible if part.least)
        return Verdict(what, "cannot agree", f"{counts}; the harm proven to be the least is above it in: {told}")
    if failing:
        ends = [_ends(part.difference) for part in failing]
        is_open = all(low < 0.0 <= high for low, high in ends)  # another list may decide either way
        told = ", ".join(f"{part.where}, {show.show(part.difference).in_words}" for part in failing)
        lead = f"{counts}; not " if len(parts) > 1 else "not "
        outcome: Judgement = "undecided" if is_open else "differs"
        return Verdict(what, outcome, f"{lead}{'shown' if is_open else 'so'}: {told}")
    worst = max(compared, key=lambda part: part.difference.value)
    lead = f"{counts}; the nearest is " if len(parts) > 1 else ""
    return Verdict(what, "agrees", f"{lead}{worst.where}, {show.show(worst.difference).in_words}")


def summarise_verdicts(verdicts: Sequence[Verdict]) -> Verdict:
    """All of an item in one line: how many came out how, and the first of the worst."""
    if not verdicts:
        return Verdict("all", "not run", "nothing was compared")
    outcomes = [each.outcome for each in verdicts]
    first = min(verdicts, key=lambda each: get_args(Judgement).index(each.outcome))
    counted = [(outcomes.count(outcome), outcome) for outcome in get_args(Judgement) if outcome in outcomes]
    counts = ", ".join(f"{n} {outcome if n == 1 else _PLURAL.get(outcome, outcome)}" for n, outcome in counted)
    lead = "" if len(verdicts) == 1 else f"of {len(verdicts)} comparisons {counts}; "
    return Verdict("all", first.outcome, f"{lead}{first.what}: {first.because}")


Shared = TypeVar("Shared")
Mode = Literal["quick", "full"]
LIST_SEED = 7
MOST_EPISODES = 10_000


@dataclass(frozen=True, slots=True)
class Settings:
    """What a reproduction is asked for."""

    mode: Mode
    folder: Path  # of everything; its trainings are read from there
    episodes: int = MOST_EPISODES  # the most worlds of any list; the paper has 10,000
    tell: OnProgress = lambda progress: None
    machine: str = ""  # in words
    shared: dict[tuple[object, ...], Any] = field(default_factory=dict)  # what several items show, made once

    def once(self, key: tuple[object, ...], make: Callable[[], Shared]) -> Shared:
        """What ``make`` gives, made by the first item that asks for it by this key."""
        if key not in self.shared:
            self.shared[key] = make()
        found: Shared = self.shared[key]
        return found


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
    """A table in words, as it is written."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
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
    episodes: Mapping[str, Any] | None = None  # to watch on the page: what ``player_content`` gave


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


@dataclass(frozen=True, slots=True)
class Item:
    """One figure or table of the paper, and what makes it again."""

    name: str  # on the command line, and of its folder
    labels: tuple[str, ...]  # in the paper's source
    title: str
    what: str  # the paper's figure or table, in a sentence
    make: Callable[[Settings], Made]
    most_s: float  # processor seconds at the paper's numbers of worlds, and a little more
    trained: tuple[str, ...] = ()  # the groups of trainings that it shows with ``--full``


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A CSV file; an estimate takes three columns: value, low, high."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    for row in rows:
        parts = [(e.value, *(e.interval or ("", ""))) if isinstance(e, Estimate) else (e,) for e in row]
        writer.writerow([cell for part in parts for cell in part])
    return text.getvalue()


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
SAC, PPO, UNIVERSAL = "sac@shipped/sac", "ppo@shipped/ppo", "ppo@shipped/universal-ppo"
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


AS_STATED = Reading("as stated")
READINGS = (AS_STATED, Reading("Vehicle 2 acts at 0.2 s", 0.2))


def lineup(specs: Sequence[str], scenario: Scenario) -> dict[str, Agent]:
    """Agents by their names in ``NAMES``, else by their spec."""
    return {NAMES.get(spec, spec): agent for spec, agent in make_agents(specs, scenario).items()}


def drive_list(scenario: Scenario, agents: Mapping[str, Agent], episodes: int, settings: Settings) -> Evaluation:
    """Let every agent drive the first worlds of the list."""
    return evaluate(
        scenario.sample(episodes, LIST_SEED),
        agents,
        scenario=scenario,
        seed=LIST_SEED,
        chunk=PROGRESS_EVERY,
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
