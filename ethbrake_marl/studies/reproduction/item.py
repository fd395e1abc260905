"""An item of the paper made again: verdicts, parameters, tables, figures and data, before anything is written."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import OnProgress, Progress
from ethbrake_marl.evaluation import Evaluation, evaluate
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY, make_agents
from ethbrake_marl.evaluation.outcome import Outcome, PaperRow
from ethbrake_marl.evaluation.statistics import Estimate, mean, paired_difference, rate, relative_decrease
from ethbrake_marl.figures.studies import Line
from ethbrake_marl.figures.style import Figure
from ethbrake_marl.limits.limits import Unproven
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.scenario import Scenario, load_scenario

# Verdicts on the paper's numbers and statements, computed from ours; nobody writes one by hand.
#
# A number that the paper prints agrees with ours where the two differ by no more than chance between two lists of
# worlds,
# or by no more than ``TOLERANCE`` of the printed number. Where chance alone makes more than ``WIDE`` of it, it is
# undecided. It cannot agree where a bound that holds for every strategy lies beyond it by more than chance. A statement
# agrees where every comparison that it makes comes out as it says; where one does not but its interval holds 0, it is
# undecided.

Judgement = Literal["agrees", "differs", "cannot agree", "undecided", "not run"]
AGREES: Judgement = "agrees"
DIFFERS: Judgement = "differs"
CANNOT: Judgement = "cannot agree"
UNDECIDED: Judgement = "undecided"
NOT_RUN: Judgement = "not run"
TOLERANCE = 0.02  # of the printed number
WIDE = 0.15  # of the printed number: where chance alone makes more, nothing is shown
_MOST_NAMED = 2
_PLURAL = {AGREES: "agree", DIFFERS: "differ", CANNOT: "cannot agree", UNDECIDED: "undecided", NOT_RUN: "not run"}
OUTCOMES: tuple[Judgement, ...] = (CANNOT, DIFFERS, UNDECIDED, NOT_RUN, AGREES)  # the worst first


@dataclass(frozen=True, slots=True)
class Verdict:
    """The outcome of one comparison with the paper, and the numbers that it follows from."""

    what: str
    outcome: Judgement
    because: str

    def to_json(self) -> dict[str, str]:
        """Plain data for JSON."""
        return {"what": self.what, "outcome": self.outcome, "because": self.because}


@dataclass(frozen=True, slots=True)
class Show:
    """The writing of a quantity: each number times ``scale``, then its unit."""

    digits: int = 2
    scale: float = 1.0
    unit: str = ""

    def number(self, value: float, digits: int | None = None) -> str:
        """One number."""
        return f"{self.scale * value:.{self.digits if digits is None else digits}f}{self.unit}"

    def estimate(self, estimate: Estimate) -> str:
        """A value with its interval."""
        return estimate.in_words(digits=self.digits, scale=self.scale, unit=self.unit)


HARM = Show()
PERCENT = Show(1, 100.0, " %")


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
    show: Show = HARM,
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
    told = f"ours {show.estimate(ours)}, printed {show.number(printed, show.digits + 1)}"
    if bound is not None and bound.least.value - printed > _chance(bound.least):
        least = show.estimate(bound.least)
        return Verdict(what, CANNOT, f"{bound.what}: at least {least}, whoever drives; {told}")
    if is_near(printed, ours):
        return Verdict(what, AGREES, told)
    if abs(ours.value - printed) <= _chance(ours):
        return Verdict(what, UNDECIDED, f"{told}: too few worlds to tell")
    return Verdict(what, DIFFERS, f"{told} ({_off(printed, ours)}){_nearest(printed, ours, others or {}, show)}")


def is_near(printed: float, ours: Estimate) -> bool:
    """Whether the two differ by no more than ``TOLERANCE``, or than chance between two lists where that is not wide."""
    chance = _chance(ours)
    told = chance if chance <= WIDE * max(abs(printed), abs(ours.value)) else 0.0
    return abs(ours.value - printed) <= max(told, TOLERANCE * abs(printed))


def _chance(estimate: Estimate) -> float:
    """How far apart two such estimates over two lists may lie: sqrt 2 times the half-width."""
    if estimate.interval is None:
        return 0.0
    return math.sqrt(2.0) * 0.5 * (estimate.interval[1] - estimate.interval[0])


def _off(printed: float, ours: Estimate) -> str:
    if printed == 0.0:
        return f"{ours.value:+.3g} off"
    return f"{100.0 * (ours.value / printed - 1.0):+.1f} %"


def _nearest(printed: float, ours: Estimate, others: Mapping[str, Estimate], show: Show) -> str:
    """The reading that comes nearest to what is printed, if it comes nearer than ours."""
    if not others:
        return ""
    name = min(others, key=lambda each: abs(others[each].value - printed))
    found = others[name]
    if abs(found.value - printed) >= abs(ours.value - printed):
        return "; no other reading here comes nearer"
    met = "which agrees" if is_near(printed, found) else _off(printed, found)
    return f"; nearest: {name}, {show.estimate(found)}, {met}"


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

    @property
    def holds(self) -> bool:
        """Whether the whole interval is below 0."""
        return _ends(self.difference)[1] < 0.0

    @property
    def is_open(self) -> bool:
        """Whether the interval holds 0, so that another list or another seed may decide either way."""
        low, high = _ends(self.difference)
        return low < 0.0 <= high

    @property
    def is_impossible(self) -> bool:
        """Whether the proven least exceeds the larger one."""
        return self.least is not None and _ends(self.least)[0] > 0.0


def judge_statement(what: str, parts: Sequence[Less], *, or_equal: bool = False, show: Show = HARM) -> Verdict:
    """Whether every comparison of a statement comes out below 0, or at most 0, by its interval."""
    compared = [part for part in parts if not part.neither]
    ties = [part.where for part in parts if part.neither]
    tied = f" (both are 0 in {_named(ties)})" if ties else ""
    if not compared:
        return Verdict(what, AGREES, f"nothing to undercut: both are 0 in {_named(ties)}")
    failing = [part for part in compared if not part.holds and not (or_equal and _ends(part.difference)[1] <= 0.0)]
    impossible = [part for part in failing if part.is_impossible]
    counts = f"holds in {len(compared) - len(failing)} of {len(compared)}"
    if impossible:
        told = ", ".join(f"{part.where} by {show.estimate(part.least)}" for part in impossible if part.least)
        return Verdict(what, CANNOT, f"{counts}{tied}; the harm proven to be the least is above it in: {told}")
    if failing:
        is_open = all(part.is_open for part in failing)
        outcome: Judgement = UNDECIDED if is_open else DIFFERS
        told = ", ".join(f"{part.where}, {show.estimate(part.difference)}" for part in failing)
        lead = f"{counts}{tied}; not " if len(parts) > 1 else "not "
        return Verdict(what, outcome, f"{lead}{'shown' if is_open else 'so'}: {told}")
    worst = max(compared, key=lambda part: part.difference.value)
    lead = f"{counts}{tied}; the nearest is " if len(parts) > 1 else ""
    return Verdict(what, AGREES, f"{lead}{worst.where}, {show.estimate(worst.difference)}")


def _named(places: Sequence[str]) -> str:
    """The places, or how many where they are many."""
    return ", ".join(places) if len(places) <= _MOST_NAMED else f"{len(places)} more"


def _ends(estimate: Estimate) -> tuple[float, float]:
    return estimate.interval or (estimate.value, estimate.value)


def summarise_verdicts(verdicts: Sequence[Verdict]) -> Verdict:
    """All of an item in one line: how many came out how, and the first of the worst."""
    if not verdicts:
        return Verdict("all", NOT_RUN, "nothing was compared")
    worst = min((each.outcome for each in verdicts), key=OUTCOMES.index)
    counted = [(outcome, sum(each.outcome == outcome for each in verdicts)) for outcome in OUTCOMES]
    words = [(n, outcome if n == 1 else _PLURAL[outcome]) for outcome, n in counted if n]
    counts = ", ".join(f"{n} {word}" for n, word in words)
    first = next(each for each in verdicts if each.outcome == worst)
    lead = "" if len(verdicts) == 1 else f"of {len(verdicts)} comparisons {counts}; "
    return Verdict("all", worst, f"{lead}{first.what}: {first.because}")


Shared = TypeVar("Shared")
Mode = Literal["quick", "full"]
QUICK: Mode = "quick"
FULL: Mode = "full"
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

    def worlds(self, wanted: int) -> int:
        """How many worlds of a list that should have ``wanted``."""
        return min(wanted, self.episodes)

    def once(self, key: tuple[object, ...], make: Callable[[], Shared]) -> Shared:
        """What ``make`` gives, made by the first item that asks for it by this key."""
        if key not in self.shared:
            self.shared[key] = make()
        found: Shared = self.shared[key]
        return found

    def say(self, name: str, done: int, total: int) -> None:
        """Tell how far a part is."""
        self.tell(Progress(name, done, total))


@dataclass(frozen=True, slots=True)
class Parameter:
    """A quantity that shapes an item, and who says what it is."""

    name: str
    value: str
    stated: str  # where the paper says it; empty: it is ours

    @property
    def origin(self) -> str:
        """In words."""
        return f"stated in the paper ({self.stated})" if self.stated else "our default"


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {"title": self.title, "head": list(self.head), "rows": [list(r) for r in self.rows], "note": self.note}


@dataclass(frozen=True, slots=True)
class Drawn:
    """A figure; ``text`` says in words what it shows."""

    stem: str  # of its files
    title: str
    text: str
    figure: Figure


Column = Sequence[object]


@dataclass(frozen=True, slots=True)
class Made:
    """What became of an item."""

    verdicts: tuple[Verdict, ...]
    parameters: tuple[Parameter, ...]
    tables: tuple[Table, ...] = ()
    figures: tuple[Drawn, ...] = ()
    data: Mapping[str, str] | None = None  # stem of a CSV file -> its text
    notes: tuple[str, ...] = ()  # computed sentences: what was run, what was not
    episodes: Mapping[str, Any] | None = None  # to watch on the page: what ``player_content`` gave

    @property
    def verdict(self) -> Verdict:
        """All in one line."""
        return summarise_verdicts(self.verdicts)


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


def csv_text(head: Sequence[str], rows: Iterable[Column]) -> str:
    """A CSV file."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
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


def scenario_parameters(scenario: Scenario, **stated: str) -> tuple[Parameter, ...]:
    """The quantities of a scenario, each with its origin.

    ``stated`` changes for a key where the paper states it; an empty text makes it ours.
    """
    content = scenario.model_dump(mode="json", exclude_none=True)
    found = [
        Parameter(name, f"{_plain(content[key])}{f' {unit}' if unit else ''}", stated.get(key, where))
        for name, key, unit, where in _QUANTITIES
        if key in content
    ]
    early = "worlds in which Vehicle 2 is hit before it may act are drawn again"
    found.append(Parameter("early impacts", early, "sec:system_model, assumed away"))
    return tuple(found)


def list_parameter(episodes: int, stated: str = "") -> Parameter:
    """How many worlds were drawn, and from which seed (which is ours: the paper says "a fixed random seed")."""
    return Parameter("worlds", f"{episodes:,}, the first of the list of seed {LIST_SEED}", stated)


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
FOUR = (FULL_BRAKE, PAIRWISE, COUPLED, SAC, PPO)  # the paper's four, E-V2X-BM twice
ABOUT_BASELINE = (
    "E-V2X-BM, predicted: what the closed form expects, pair by pair. Realised: what that deceleration does once speeds"
    " are exchanged. Coupled: the constant deceleration of least harm in the same physics."
)
ABOUT_POLICIES = "PPO and SAC are the shipped policies, trained on paper-random at 0.5 and 0.8 s"


@dataclass(frozen=True, slots=True)
class Reading:
    """A time from which Vehicle 2 acts."""

    name: str
    acts_s: float | None  # None: the scenario's own

    def of(self, scenario: Scenario) -> Scenario:
        """The scenario so read."""
        if self.acts_s is None:
            return scenario
        first, _, *others = scenario.model_dump()["latency_s"]
        return scenario.replace(latency_s=[first, self.acts_s, *others])


AS_STATED, AT_200_MS = Reading("as stated", None), Reading("Vehicle 2 acts at 0.2 s", 0.2)
READINGS = (AS_STATED, AT_200_MS)


def read_scenario(name: str, reading: Reading) -> Scenario:
    """A shipped scenario in a reading."""
    return reading.of(load_scenario(name))


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
        on_progress=lambda name, done: settings.say(scenario.name, done, episodes),
    )


def collision_rate(collided: Bools) -> Estimate:
    """Share of worlds with an impact."""
    return rate(int(collided.sum()), len(collided))


def harms(evaluation: Evaluation) -> dict[str, Floats]:
    """First-impact harm of each strategy in each world, what E-V2X-BM predicts, what nobody undercuts, [n] m2/s2."""
    found = {name: outcome.first_impact_harm for name, outcome in evaluation.outcomes.items()}
    pairwise = evaluation.outcomes.get(NAMES[PAIRWISE])
    if pairwise is not None and pairwise.predicted_harm is not None:
        found = {**found, PREDICTED: pairwise.predicted_harm}
    proven = proven_harm(evaluation)
    return found if proven is None else {**found, PROVEN: proven}


def proven_harm(evaluation: Evaluation) -> Floats | None:
    """The harm of each world that no command undercuts, [n] m2/s2; None where nothing is proven."""
    limits = evaluation.limits
    return None if isinstance(limits, Unproven) else limits.proof.harm


def less_in(where: str, harm: Mapping[str, Floats], smaller: str, larger: str) -> Less:
    """That one strategy harms less than another in the same worlds, and whether anybody could."""
    low, high = harm[smaller], harm[larger]
    least = paired_difference(harm[PROVEN], high) if PROVEN in harm else None
    return Less(where, paired_difference(low, high), not low.any() and not high.any(), least)


DISTANCES_M = (10.0, 12.0, 14.0, 16.0, 18.0, 20.0)  # ends of the groups of d_1 + d_2


@dataclass(frozen=True, slots=True)
class Grouped:
    """Harm of each strategy over groups of the total distance."""

    groups: tuple[str, ...]
    at_m: tuple[float, ...]  # mean distance of each group
    rows: tuple[Bools, ...]  # of each group, which worlds
    harm: Mapping[str, Floats]

    def estimate(self, strategy: str, group: int) -> Estimate:
        """Mean harm of a strategy in a group."""
        return mean(self.harm[strategy][self.rows[group]])

    def line(self, strategy: str) -> Line:
        """Of one strategy, for a figure."""
        return Line.of(self.at_m, [self.estimate(strategy, k) for k in range(len(self.groups))])

    def less(self, smaller: str, larger: str) -> list[Less]:
        """The comparison of two strategies in every group, paired by world."""
        return [
            less_in(group, {name: harm[rows] for name, harm in self.harm.items()}, smaller, larger)
            for group, rows in zip(self.groups, self.rows, strict=True)
        ]


def group_by_distance(evaluation: Evaluation) -> Grouped:
    """Group the worlds by the sum of their gaps; groups without a world are left out."""
    total = evaluation.worlds.gaps_m.sum(axis=1)
    inner = np.digitize(total, DISTANCES_M[1:-1])
    kept = [k for k in range(len(DISTANCES_M) - 1) if (inner == k).any()]
    rows = tuple(inner == k for k in kept)
    names = tuple(f"{DISTANCES_M[k]:g}-{DISTANCES_M[k + 1]:g} m" for k in kept)
    return Grouped(names, tuple(float(total[each].mean()) for each in rows), rows, harms(evaluation))


# Our rows beside those of the paper's tables: what agrees, what differs, and what no strategy can reach.

RATE, MEAN_HARM, DECREASE = "collision rate", "average harm", "harm decrease"
_SHOWS: Mapping[str, Show] = {RATE: PERCENT, MEAN_HARM: HARM, DECREASE: PERCENT}
NOBODY = "least possible (proven)"


@dataclass(frozen=True)
class Beside:
    """Our results in one reading, to stand beside the paper's rows."""

    title: str
    evaluation: Evaluation
    ours: Mapping[str, Sequence[str]]  # the paper's row -> our strategies, the first is the one compared

    @cached_property
    def numbers(self) -> dict[str, dict[str, Estimate]]:
        """Every quantity of every strategy."""
        return {name: self._numbers(outcome) for name, outcome in self.evaluation.outcomes.items()}

    def _numbers(self, outcome: Outcome) -> dict[str, Estimate]:
        found = {RATE: collision_rate(outcome.collided), MEAN_HARM: mean(outcome.first_impact_harm)}
        braking = self.evaluation.outcomes.get(NAMES[FULL_BRAKE])
        if braking is not None:
            decrease = relative_decrease(outcome.first_impact_harm, braking.first_impact_harm)
            found |= {} if decrease is None else {DECREASE: decrease}
        return found

    @cached_property
    def bounds(self) -> dict[str, Bound]:
        """What no strategy undercuts in these worlds."""
        limits, harm = self.evaluation.limits, proven_harm(self.evaluation)
        if isinstance(limits, Unproven) or harm is None:
            return {}
        impact = rate(int((harm > 0.0).sum()), len(harm))
        return {
            RATE: Bound("worlds in which no command avoids an impact", impact),
            MEAN_HARM: Bound("harm that no command undercuts", mean(harm)),
        }

    def candidates(self, row: str, quantity: str) -> Iterator[tuple[str, Estimate]]:
        """Everything of ours that may be meant by a number of a row, the compared one first."""
        for name in self.ours[row]:
            if quantity in self.numbers[name]:
                yield f"{name} ({self.title})", self.numbers[name][quantity]
            predicted = self.evaluation.outcomes[name].predicted_harm
            if quantity == MEAN_HARM and predicted is not None and name == NAMES["e_v2x_bm:pairwise"]:
                yield f"{PREDICTED} ({self.title})", mean(predicted)
        if quantity == MEAN_HARM:
            for name in self.ours[row]:
                yield f"{name}, total harm ({self.title})", mean(self.evaluation.outcomes[name].total_harm)


def compare_rows(printed: Sequence[PaperRow], besides: Sequence[Beside]) -> list[Verdict]:
    """One verdict per reading, row and quantity."""
    verdicts = []
    for beside in besides:
        for row in printed:
            numbers = {RATE: row.collision_rate, MEAN_HARM: row.average_harm}
            if row.harm_decrease:
                numbers[DECREASE] = row.harm_decrease
            for quantity, number in numbers.items():
                (_, ours), *own = beside.candidates(row.agent, quantity)
                others = dict(own)
                for other in besides:
                    others |= dict(other.candidates(row.agent, quantity)) if other is not beside else {}
                verdicts.append(
                    compare_number(
                        f"{row.agent}, {quantity} ({beside.title})",
                        number,
                        ours,
                        show=_SHOWS[quantity],
                        bound=beside.bounds.get(quantity),
                        others=others,
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
    return Verdict(what, AGREES if avoided[2] <= together else CANNOT, told)


def decrease_verdict(row: PaperRow, baseline: PaperRow) -> Verdict:
    """Whether a printed harm decrease follows from the printed harms, to the printed digits."""
    follows = 1.0 - row.average_harm / baseline.average_harm
    printed = row.harm_decrease or 0.0
    told = (
        f"1 - {row.average_harm:g} / {baseline.average_harm:g} = {100.0 * follows:.2f} %; printed {100 * printed:g} %"
    )
    what = f"{row.agent}, harm decrease follows from the printed harms"
    return Verdict(what, AGREES if abs(follows - printed) < 0.0001 else CANNOT, told)


def rows_table(beside: Beside) -> Table:
    """Our rows of one reading, with what no strategy undercuts."""
    head = ["Strategy", "Collision rate", "First-impact harm", "Total harm", "Predicted harm"]
    with_decrease = any(DECREASE in numbers for numbers in beside.numbers.values())
    rows = []
    for name, numbers in beside.numbers.items():
        outcome = beside.evaluation.outcomes[name]
        predicted = "–" if outcome.predicted_harm is None else HARM.estimate(mean(outcome.predicted_harm))
        row = [name, PERCENT.estimate(numbers[RATE]), HARM.estimate(numbers[MEAN_HARM])]
        row += [HARM.estimate(mean(outcome.total_harm)), predicted]
        rows.append((*row, *([PERCENT.estimate(numbers[DECREASE])] if with_decrease else [])))
    if beside.bounds:
        least = (PERCENT.estimate(beside.bounds[RATE].least), HARM.estimate(beside.bounds[MEAN_HARM].least))
        rows.append((NOBODY, *least, least[1], "–", *(["–"] if with_decrease else [])))
    count = beside.evaluation.worlds.n
    note = f"{count:,} worlds; 95 % intervals; harm in m²/s². {ABOUT_BASELINE}"
    return Table(beside.title, tuple(head + ["Harm decrease"] * with_decrease), tuple(rows), note)


def rows_csv(besides: Sequence[Beside]) -> str:
    """One row per reading, strategy and quantity."""
    rows: list[list[object]] = []
    for beside in besides:
        found = dict(beside.numbers)
        found |= {NOBODY: {name: bound.least for name, bound in beside.bounds.items()}} if beside.bounds else {}
        for name, numbers in found.items():
            for quantity, estimate in numbers.items():
                low, high = estimate.interval or ("", "")
                rows.append([beside.title, name, quantity, beside.evaluation.worlds.n, estimate.value, low, high])
    return csv_text(("reading", "strategy", "quantity", "worlds", "value", "low", "high"), rows)


# The register of what the paper leaves open: each quantity, what the paper says of it, our default, alternatives.
#
# ``gaps`` measures how far the headline moves when a quantity changes.

Harm = Literal["first", "total", "sampled", "predicted"]


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another reading of a quantity, and how it is put into the random test."""

    value: str
    changes: Mapping[str, Any] = field(default_factory=dict)  # of the scenario
    seed: int | None = None  # of the list
    harm: Harm = "first"  # what is counted
    bound: Literal["coupled", "pairwise"] | None = None  # of the hybrid that drives in the place of PPO


@dataclass(frozen=True, slots=True, eq=False)
class Gap:
    """A quantity that the paper leaves open, or that can be read in two ways."""

    name: str
    paper: str  # what it says, with the label in its source
    ours: str
    alternatives: tuple[Alternative, ...] = ()
    trained: str = ""  # the trainings of ``--full`` that measure it begin with this name
    unmeasured: str = ""  # why nothing is measured

    @property
    def is_measured(self) -> bool:
        """Whether alternatives are driven here."""
        return bool(self.alternatives)


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
        "brake until they stand", unmeasured="the engine has no vehicle that rolls on after its braking time"),
    Gap("weights of the reward", "w_h, w_p, w_j, R_safe, k_energy, k_d, d_safe, d_target: none stated",
        "1, 0.1, 1e-5, 10 in ppo-paper", trained="ppo-paper-"),
    Gap("state of the policy", "MDP formulation: positions, speeds, actions of the others",
        "also capacities, masses, latencies, e and derived features", trained="ppo-paper-state"),
    Gap("seeds of the training", "multiple training tests with different random seeds", "0, 1, 2",
        trained="ppo-paper"),
    Gap("ends of the cosine, number of decisions", "table:params: cosine, no numbers", "3e-4 to 3e-5; in the recipes",
        unmeasured="one training each takes minutes; docs/learning.md compares recipes"),
)  # fmt: skip
