"""Measures of an episode: each is one entry, and every table, file and page loops over the entries."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import AlreadyExists, InvalidInput, describe_error
from ethbrake_marl.evaluation.inputs import result_identity
from ethbrake_marl.evaluation.outcome import Evaluation, Outcome
from ethbrake_marl.evaluation.statistics import Moments, decrease_of, difference, exact_products, mean_of, moments
from ethbrake_marl.files.sheet import Cell, Column, Estimate, Sheet
from ethbrake_marl.limits.best_harm import BestHarmTable, shipped_tables, world_identity
from ethbrake_marl.limits.limits import Limits, Unproven, prove, unproven_because
from ethbrake_marl.physics import Bools, Floats, ImpactRows, Ints, Worlds, advance, leaving_out_failed, make_worlds
from ethbrake_marl.physics.worlds import read_only
from ethbrake_marl.scenario import Task, load_scenario

# The limits of an evaluation: the least harm known of each world is that of ``limits.limits``, or what an agent of the
# same evaluation achieved, whichever is less.

NO_HARM = 1e-3  # m2/s2: nobody is hurt by 0.03 m/s
TOLERANCE = 1e-6  # m2/s2; less than this below the best known harm is rounding


@dataclass(frozen=True, slots=True)
class Regrets:
    """The limits after all agents of one evaluation drove, [n] each."""

    limits: Limits
    first_impact_harm: Floats  # best known, the agents of this evaluation among them (m2/s2)
    total_harm: Floats
    source: NDArray[np.str_]  # where these come from: witness, table, agents or below_table

    def best(self, harm_count: HarmCount) -> Floats:
        """Best known harm under one count, [n] m2/s2."""
        return self.first_impact_harm if harm_count == "first" else self.total_harm

    def regret(self, outcome: Outcome, harm_count: HarmCount) -> Floats:
        """The outcome's harm minus the best known, [n] m2/s2, never negative."""
        return outcome.ledger.world_harm(harm_count) - self.best(harm_count)

    def below(self, outcome: Outcome) -> Bools:
        """Worlds in which the outcome is below what was known before, in either count, by more than rounding, [n]."""
        first, total = self.limits.first_impact_harm, self.limits.total_harm
        return (outcome.first_impact_harm < first - TOLERANCE) | (outcome.total_harm < total - TOLERANCE)


def assess(evaluation: Evaluation) -> Regrets | None:
    """Best known harm of every world, the agents of this evaluation included; None where nothing is proven."""
    limits = evaluation.limits
    if isinstance(limits, Unproven):
        return None
    outcomes = evaluation.outcomes.values()
    first = np.fmin.reduce([limits.first_impact_harm, *(outcome.first_impact_harm for outcome in outcomes)])
    total = np.fmin.reduce([limits.total_harm, *(outcome.total_harm for outcome in outcomes)])
    regrets = Regrets(limits, first, total, np.zeros(0, np.str_))
    below = np.logical_or.reduce([regrets.below(outcome) for outcome in outcomes])
    avoidable = limits.proof.avoidable
    witness = np.zeros(below.shape, np.bool_) if avoidable is None else avoidable
    source = np.select([witness, ~limits.known, below], ["witness", "agents", "below_table"], "table")
    return Regrets(limits, first, total, source)


@dataclass(frozen=True, slots=True)
class Between:
    """The worlds with proven contact in which no impact is proven, and the least harm known there (m2/s2)."""

    rate: float  # share of all worlds
    mean_first: float | None  # None where there is no such world, or the least harm of none of them is known
    mean_total: float | None
    harmless_rate: float | None  # share of them whose best known total harm is below 1e-3


def between(contact: Bools, impact: Bools, first: Floats, total: Floats) -> Between:
    """The worlds between the two proofs; ``first`` and ``total`` [n] are the least harms known, NaN where none is."""
    there = contact & ~impact
    known = there & np.isfinite(first) & np.isfinite(total)
    if not known.any():
        return Between(float(there.mean()), None, None, None)
    harmless = float((total[known] < NO_HARM).mean())
    return Between(float(there.mean()), float(first[known].mean()), float(total[known].mean()), harmless)


# The entries.

BASELINE = "full_brake"
FAR_M = 5.0  # Vehicle 1 counts as shoved far beyond this
COLUMN = "metric_"  # before the name of a registered measure, in JSON and in files with every world
Values = NDArray[Any]  # [n]


@dataclass(frozen=True, slots=True)
class Measure:
    """Something that is told of every agent: where each world has a truth, a rate; where it has a number, a mean.

    ``of`` gives the values of all worlds, [n], from outcome and limits (None where nothing is proven), or None where
    there are none; or it names the measure whose values these are.
    """

    name: str  # in JSON
    of: Callable[[Outcome, Any], Values | None] | str
    heading: str = ""  # of its column in tables; "": in none
    short: str = ""  # the same in a terminal
    about: str = ""  # what it means; stands once for headings that begin alike
    percent: bool = False  # how a table shows it
    against: Literal["", "difference", "decrease"] = ""  # of the baseline, paired by world
    limits: bool = False  # it needs them
    always: bool = True  # JSON tells it where it does not exist, too: null

    def values(self, outcome: Outcome, regrets: Regrets | None) -> Values | None:
        """Those of an outcome."""
        if isinstance(self.of, str) or (self.limits and regrets is None):
            return None
        return self.of(outcome, regrets)

    def column(self) -> Column:
        """Its column in a table."""
        shown = {"digits": 1, "scale": 100.0, "unit": " %"} if self.percent else {}
        return Column(self.heading, self.name, short=self.short, sign="-", **shown)  # type: ignore[arg-type]


def _avoidable(regrets: Regrets, values: Callable[[Bools], Bools]) -> Bools | None:
    """What is counted of the worlds where contact can be avoided; None where that is not decided."""
    avoidable = regrets.limits.proof.avoidable
    return None if avoidable is None else values(avoidable)


_OF_THE_EPISODE = (
    Measure(
        "collision_rate", lambda o, _: o.collided, "Collisions", percent=True,
        about="Share of worlds with at least one impact; Wilson's interval. Every agent meets the same worlds, each"
        " once.",
    ),
    Measure(
        "first_impact_harm", lambda o, _: o.first_impact_harm, "First-impact harm", "First-impact\nharm",
        "Squared closing speed (m²/s²), summed over the pairs, each pair's first impact only (the paper's protocol);"
        " mean per world.",
    ),
    Measure(
        "total_harm", lambda o, _: o.total_harm, "Total harm", "Total\nharm",
        "The same over every impact. A light early touch makes a later, harder impact of the same pair free under the"
        " first count, so both are shown.",
    ),
    Measure(
        "sampled_harm", lambda o, _: o.sampled_harm, "Sampled harm", "Sampled\nharm",
        "The paper's own sum (its eq. Jharm): the agent's commands replayed through the paper's fixed-step map at the"
        " time step; at every sample each pair that overlaps and closes adds its squared closing speed (m²/s²), so"
        " pushing costs harm for as long as it lasts.",
    ),
    Measure(
        "vehicle_1_shoved_m", lambda o, _: o.shoved_m, "Vehicle 1 shoved (m)", "Shoved\nm",
        "How far Vehicle 1 ends beyond the point where it would stop by itself, mean per world; and the share of worlds"
        " in which that is more than 5 m. Both counts of harm leave pushing free unless something stands ahead; Vehicle"
        " 1 brakes for something.",
    ),
    Measure(
        "vehicle_1_shoved_far_rate", lambda o, _: None if o.shoved_m is None else o.shoved_m > FAR_M,
        "Vehicle 1 shoved > 5 m", "Shoved\n> 5 m", percent=True,
    ),
    Measure("first_impact_harm_difference", "first_impact_harm", against="difference"),
    Measure("total_harm_difference", "total_harm", against="difference"),
    Measure(
        "harm_decrease_first", "first_impact_harm", "Decrease, first-impact", "Decrease\nfirst",
        "1 − harm / harm of full braking in the same worlds; interval by the delta method, paired by world.",
        percent=True, against="decrease",
    ),
    Measure(
        "harm_decrease_total", "total_harm", "Decrease, total", "Decrease\ntotal", percent=True, against="decrease"
    ),
    Measure(
        "predicted_harm",
        lambda o, _: None if o.predicted_harm is None or not np.isfinite(o.predicted_harm).all() else o.predicted_harm,
        "Predicted harm", "Pre-\ndicted",
        "What the agent itself expected at the alert, under the count that it minimises.", always=False,
    ),
)  # fmt: skip

_OF_THE_LIMITS = (
    Measure("unavoidable_rate", lambda _, r: _avoidable(r, np.logical_not), limits=True),
    Measure("impact_proven_rate", lambda _, r: r.limits.proof.impact, limits=True),
    Measure("avoidable_collision_rate", lambda o, r: _avoidable(r, lambda a: o.collided & a), limits=True),
    Measure("best_known_first_impact_harm", lambda _, r: r.first_impact_harm, limits=True),
    Measure("best_known_total_harm", lambda _, r: r.total_harm, limits=True),
    Measure("proven_harm", lambda _, r: r.limits.proof.harm, limits=True),
    Measure("best_known_minus_proven_first", lambda _, r: r.first_impact_harm - r.limits.proof.harm, limits=True),
    Measure("best_known_minus_proven_total", lambda _, r: r.total_harm - r.limits.proof.harm, limits=True),
    Measure("mean_regret", "mean_regret_first", limits=True),
    Measure(
        "mean_regret_first", lambda o, r: r.regret(o, "first"), "Regret, first-impact", "Regret\nfirst",
        "First-impact harm minus the best known first-impact harm of the same world; mean per world. The best known is"
        " 0 where contact is proven avoidable, else the result of a search over whole profiles of Vehicle 2, or of an"
        " agent in this table that did better. With ≥: the best of some world is known from these agents alone.",
        limits=True,
    ),
    Measure("mean_regret_total", lambda o, r: r.regret(o, "total"), limits=True),
    Measure("realised_share", "mean_regret_first", against="decrease", limits=True),
    Measure(
        "realised_share_first", "mean_regret_first", "Realised share, first-impact", "Realised\nfirst",
        "(Full braking − agent) / (full braking − best known), first-impact harm: how much of the reduction of harm"
        " that is known to be possible the agent brings.",
        percent=True, against="decrease", limits=True,
    ),
    Measure("realised_share_total", "mean_regret_total", against="decrease", limits=True),
)  # fmt: skip

HORIZON, CHOSEN, KNOWN, BELOW = "horizon_ends", "policy_share", "known", "below_best_known"
COUNTED = (  # told as numbers of worlds or shares, without an interval
    Measure(HORIZON, lambda o, _: ~o.at_rest),
    Measure(CHOSEN, lambda o, _: o.chosen_policy),
    Measure(KNOWN, lambda _, r: r.limits.known, limits=True),
    Measure(BELOW, lambda o, r: r.below(o), limits=True),
)


def measures(columns: Iterable[str]) -> tuple[Measure, ...]:
    """All that are told, in the order of JSON; ``columns`` are those of registered measures, as an outcome has them."""
    own = [Measure(COLUMN + each, _own_values(each), _heading(each)) for each in columns]
    return (*_OF_THE_EPISODE, *own, *_OF_THE_LIMITS)


def _own_values(column: str) -> Callable[[Outcome, object], Values]:
    return lambda outcome, _: outcome.metrics[column]


# Their sums over some worlds, exact: they merge in any order to the same bits.


@dataclass(frozen=True, slots=True)
class AgentTally:
    """What one agent did in some worlds, by measure."""

    counts: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # worlds in which it is so, of how many
    moments: Mapping[str, Moments] = field(default_factory=dict)
    products: Mapping[str, int] = field(default_factory=dict)  # with the baseline's

    def __add__(self, other: AgentTally) -> AgentTally:
        counts = {name: list(pair) for name, pair in self.counts.items()}
        for name, (so, of) in other.counts.items():
            before = self.counts.get(name, (0, 0))
            counts[name] = [before[0] + so, before[1] + of]
        return AgentTally(
            {name: (so, of) for name, (so, of) in counts.items()},
            added(self.moments, other.moments, Moments()),
            added(self.products, other.products, 0),
        )

    def count(self, name: str) -> int:
        """Worlds in which it is so."""
        return self.counts.get(name, (0, 0))[0]

    def share(self, name: str, worlds: int) -> float | None:
        """Their share; None unless all of the worlds have it."""
        so, of = self.counts.get(name, (0, 0))
        return so / worlds if of == worlds else None

    def found(self, name: str, worlds: int) -> Moments | None:
        """The moments of a number; None unless all of the worlds have it."""
        moments = self.moments.get(name)
        return moments if moments is not None and moments.count == worlds else None

    def to_json(self) -> dict[str, Any]:
        """Plain data; whole numbers of any size are hexadecimal texts."""
        return {
            "counts": {name: list(pair) for name, pair in self.counts.items()},
            "moments": {name: [m.count, hex(m.total), hex(m.squares)] for name, m in self.moments.items()},
            "products": {name: hex(value) for name, value in self.products.items()},
        }


def added(one: Mapping[str, Any], other: Mapping[str, Any], zero: Any) -> dict[str, Any]:
    """Sums by name; what one of both lacks is ``zero`` there."""
    return {name: one.get(name, zero) + other.get(name, zero) for name in {**one, **other}}


Extra = Callable[[Outcome], Mapping[str, Floats]]  # further numbers of each world, by name


def tally_agents(
    evaluation: Evaluation, *, baseline: str = BASELINE, limits: bool = True, extra: Extra | None = None
) -> dict[str, AgentTally]:
    """The tally of every agent.

    Args:
        evaluation: of the worlds.
        baseline: what is compared with, but for regrets, which are compared with full braking.
        limits: with what needs the best known harm of each world.
        extra: gives numbers that are summed too.

    """
    regrets = assess(evaluation) if limits else None
    values = {agent: _values(outcome, regrets, extra) for agent, outcome in evaluation.outcomes.items()}
    paired = {m.of: BASELINE if m.limits else baseline for m in measures(()) if m.against}
    found = {}
    for agent, own in values.items():
        truths = {name: column for name, column in own.items() if column.dtype == np.bool_}
        products = {
            str(name): exact_products(own[name], values[other][name])
            for name, other in paired.items()
            if name in own and other in values
        }
        found[agent] = AgentTally(
            {name: (int(column.sum()), len(column)) for name, column in truths.items()},
            {name: moments(column) for name, column in own.items() if name not in truths},
            products,
        )
    return found


def _values(outcome: Outcome, regrets: Regrets | None, extra: Extra | None) -> dict[str, Values]:
    """The values of all measures of one agent."""
    told = ((m.name, m.values(outcome, regrets)) for m in (*measures(outcome.metrics), *COUNTED))
    found = {name: column for name, column in told if column is not None}
    return found if extra is None else {**found, **extra(outcome)}


def estimate_all(
    tallies: Mapping[str, AgentTally],
    agent: str,
    worlds: int,
    rate: Callable[[int, int], Estimate],
    *,
    baseline: str = BASELINE,
) -> dict[str, Estimate | None]:
    """What one agent did in so many worlds, by measure; None for what not all of them have.

    ``rate`` gives the share of so many worlds, of all, with its interval.
    """
    own = tallies[agent]
    columns = [name.removeprefix(COLUMN) for name in (*own.counts, *own.moments) if name.startswith(COLUMN)]
    registered = list(REGISTERED.values())
    columns.sort(key=lambda column: registered.index(each) if (each := _registered(column)) else len(registered))

    def estimate(measure: Measure) -> Estimate | None:
        name = measure.name if callable(measure.of) else measure.of
        if own.share(name, worlds) is not None:
            return rate(own.count(name), worlds)
        found = own.found(name, worlds)
        if found is None or not measure.against:
            return None if found is None else mean_of(found)
        compared = tallies.get(BASELINE if measure.limits else baseline)
        other = None if compared is None else compared.found(name, worlds)
        if other is None or (measure.limits and own.count(KNOWN) != worlds):
            return None
        product = own.products[name]
        if measure.against == "decrease":
            return decrease_of(found, other, product)
        return mean_of(difference(found, other, product))

    return {measure.name: estimate(measure) for measure in measures(columns)}


def between_of(evaluation: Evaluation) -> Between | None:
    """The worlds with proven contact and no proven impact; None where one of both is not decided."""
    regrets = assess(evaluation)
    avoidable = None if regrets is None else regrets.limits.proof.avoidable
    if regrets is None or avoidable is None:
        return None
    return between(~avoidable, regrets.limits.proof.impact, regrets.first_impact_harm, regrets.total_harm)


# Measures of the user's own: functions of every impact of an episode.

_NAME = re.compile(r"(?!.*_([0-9]+|interval|low|high)\Z)[a-z][a-z0-9_]{0,63}")  # x_2 is that of the second vehicle


@dataclass(frozen=True, slots=True)
class EpisodeImpacts:
    """What a registered measure is computed from, for n episodes of N vehicles; its arrays cannot be written to."""

    worlds: Worlds  # [n] at the alert
    rows: ImpactRows  # every impact, by world and then by time, arrays [k]

    @property
    def largest_speed_change_mps(self) -> Floats:
        """The largest change of speed of each vehicle in one impact (delta-v), [n, N]; 0 without one."""
        rows, change = self.rows, np.zeros(self.worlds.speeds_mps.shape)
        np.maximum.at(change, (rows.world, rows.pair + 1), np.abs(rows.rear_speed_change_mps))
        pairs = rows.pair >= 0  # an obstacle ahead is no vehicle
        np.maximum.at(change, (rows.world[pairs], rows.pair[pairs]), np.abs(rows.front_speed_change_mps[pairs]))
        return change


EpisodeFunction = Callable[[EpisodeImpacts], Values]


@dataclass(frozen=True, slots=True)
class _Registered:
    """A measure of a user's own file."""

    name: str
    unit: str
    about: str
    function: EpisodeFunction
    form: str = ""  # what it gives: a truth or a number, per world or per vehicle


REGISTERED: dict[str, _Registered] = {}


def register_measure(name: str, function: EpisodeFunction, *, unit: str) -> None:
    """Make every evaluation from now on tell ``name`` with its interval: in tables, files, shards and pages.

    Args:
        name: 1 to 64 of ``a-z``, digits and ``_``, beginning with a letter, not ending in ``_`` and a number,
            ``_interval``, ``_low`` or ``_high``; columns are called ``metric_NAME``.
        function: from ``EpisodeImpacts`` to a number for each world [n], or one for each vehicle [n, N], which
            become columns of their own; of truths a rate is told. Its docstring says what it is. It must work for
            lines of any length.
        unit: of its numbers.

    Registering the same again changes nothing. Raises ``AlreadyExists`` for another one under a name that is taken,
    ``InvalidInput`` for what cannot be used, a function among that which fails, or gives another shape or a number that
    is not finite, in two worlds.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"measure {name!r:.80}: must be 1 to 64 of a-z, 0-9 and _, beginning with a letter, not ending in _"
            " and a number, _interval, _low or _high"
        )
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"measure {name!r}: needs a function with a docstring that says what it is")
    metric = _Registered(name, str(unit), " ".join((function.__doc__ or "").split()), function)
    metric = replace(metric, form=_form(_checked(metric, _tried())))
    if REGISTERED.setdefault(name, metric) != metric:
        raise AlreadyExists(f"measure {name!r} is registered already; give another name")


def metric_columns(episodes: EpisodeImpacts) -> dict[str, Values]:
    """Every registered measure by column, [n]: ``NAME``, or ``NAME_1``, ``NAME_2``, ... front to rear.

    Raises ``InvalidInput`` that names measure and world.
    """
    found: dict[str, Values] = {}
    for metric in REGISTERED.values():
        values = _checked(metric, episodes)
        if _form(values) != metric.form:
            raise InvalidInput(
                f"measure {metric.name!r}: gave {_form(values)}; when it was registered it gave {metric.form}"
            )
        if values.ndim == 1:
            found[metric.name] = values
        else:
            found |= {f"{metric.name}_{i + 1}": column.copy() for i, column in enumerate(values.T)}
    return found


def metric_headings(columns: Mapping[str, object]) -> dict[str, str]:
    """Column -> its heading with vehicle and unit: ``delta_v, vehicle 2 (m/s)``."""
    return {column: _heading(column) for column in columns}


def metric_meanings(columns: Mapping[str, object]) -> dict[str, str]:
    """Name -> what each measure among the columns means."""
    metrics = [_registered(column) for column in columns]
    return {metric.name: metric.about for metric in metrics if metric is not None}


def _heading(column: str) -> str:
    metric = _registered(column)
    if metric is None:  # of results that were computed before it was forgotten
        return column
    vehicle = column.removeprefix(metric.name).removeprefix("_")
    return f"{metric.name}{f', vehicle {vehicle}' if vehicle else ''} ({metric.unit})"


def _registered(column: str) -> _Registered | None:
    return REGISTERED.get(column) or REGISTERED.get(column.rpartition("_")[0])


def _form(values: Values) -> str:
    return f"a {'truth' if values.dtype == np.bool_ else 'number'} per {'world' if values.ndim == 1 else 'vehicle'}"


def _checked(metric: _Registered, episodes: EpisodeImpacts) -> Values:
    """What it gives, [n] or [n, N], checked."""
    what, (n, vehicles) = f"measure {metric.name!r}", episodes.worlds.speeds_mps.shape
    try:
        given = metric.function(episodes)
        value = np.asarray(None if np.ma.isMaskedArray(given) else given)
    except Exception as error:
        raise InvalidInput(f"{what}: its function fails: {describe_error(error)}") from error
    if value.shape not in ((n,), (n, vehicles)) or value.dtype.kind not in "fiub":
        raise InvalidInput(
            f"{what}: gave {value.dtype} of shape {value.shape}; must be numbers of shape ({n},), one per world, or"
            f" ({n}, {vehicles}), one per vehicle too"
        )
    finite = np.isfinite(value).reshape(n, -1).all(axis=1)
    if not finite.all():
        world = int(np.argmin(finite))
        raise InvalidInput(f"{what}: is {value[world]} in world {world}; must be finite")
    return value if value.dtype == np.bool_ else value.astype(np.float64)


def _tried() -> EpisodeImpacts:
    """Two lines of three, one with an impact of its second pair."""
    worlds = make_worlds(
        [[8.0, 6.0], [3.0, 21.0]],
        [[20.0, 18.0, 22.0], [9.0, 13.0, 11.0]],
        braking_capacity_mps2=[6.0, 7.0, 5.0],
        driving_capacity_mps2=[1.0, 2.0, 3.0],
        latency_s=[0.0, 0.5, 0.25],
        mass_t=[4.5, 15.5, 5.9],
        restitution=[0.0, 0.3],
    )
    one = (np.array([each]) for each in (2.5, 4.0, True, 1.2, -3.1))
    return _read_only(worlds, ImpactRows(np.array([0]), np.array([1]), *one))


def _read_only(worlds: Worlds, rows: ImpactRows) -> EpisodeImpacts:
    for column in fields(rows):
        getattr(rows, column.name).flags.writeable = False
    return EpisodeImpacts(read_only(worlds), rows)


class Tape:
    """The steps of a batch of episodes as they are driven (``Watch``), and every impact in them.

    With ``steps`` False only the impacts are kept.
    """

    def __init__(self, worlds: Worlds, *, steps: bool = True) -> None:
        self.worlds = worlds  # at the alert
        self.steps: list[tuple[Worlds, Floats, Floats]] = []  # before, commands [n, N], until [n]
        self._keeps_steps = steps
        self._rows: list[ImpactRows] = []

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Keep one step."""
        moving = until_s > before.time_s
        some = np.flatnonzero(moving | (before.time_s == self.worlds.time_s))  # an impact at the very alert
        rows = advance(before.take(some), command_mps2[some], until_s=until_s[some], record=True)[1].rows
        assert rows is not None  # they were asked for
        self._rows.append(replace(rows, world=some[rows.world]))
        if self._keeps_steps:
            self.steps.append((before, command_mps2, until_s))

    def impacts(self) -> ImpactRows:
        """Every impact so far, by world and then by time."""
        columns = {f.name: np.concatenate([getattr(rows, f.name) for rows in self._rows]) for f in fields(ImpactRows)}
        order = np.argsort(columns["world"], kind="stable")
        return ImpactRows(**{name: column[order] for name, column in columns.items()})

    def measured(self) -> dict[str, Values]:
        """The registered measures of these episodes, as ``metric_columns``."""
        return metric_columns(_read_only(self.worlds.take(np.arange(self.worlds.n)), self.impacts()))


# The proven bounds of a list of worlds, beside the least harm known there.
#
# *Contact proven* is not *impact proven*: in the worlds between, every command leads to contact, and it is open whether
# to an impact. Either vehicles get away with leaning on each other there, or the proof is loose. The harm of the best
# known profiles in these very worlds tells which: next to none, or much.


@dataclass(frozen=True, slots=True)
class Proven:
    """What is proven about a list of worlds."""

    proven_harm: float  # mean harm (m2/s2) that no command undercuts, under either count
    contact_proven_rate: float | None  # None where contact is not decided
    impact_proven_rate: float
    between: Between | None  # None where contact is not decided


def proven_of(worlds: Worlds, task: Task, first: Floats, total: Floats) -> Proven | None:
    """What is proven about worlds at the alert, ``first`` and ``total`` [n] being the least harms known; or None."""
    proof = prove(worlds, task)
    if isinstance(proof, Unproven):
        return None
    contact, impact = proof.contact, proof.impact
    told = (None, None) if contact is None else (float(contact.mean()), between(contact, impact, first, total))
    return Proven(float(proof.harm.mean()), told[0], float(impact.mean()), told[1])


def proven_of_table(worlds: Worlds, task: Task, table: BestHarmTable) -> Proven | None:
    """``proven_of`` the worlds of a list with the least harms of a table, without those that cannot be advanced."""

    def of(rows: Ints) -> Proven | None:
        some = worlds.take(rows)
        identity = world_identity(some, task)
        return proven_of(some, task, table.harm(identity, "first"), table.harm(identity, "total"))

    return leaving_out_failed(of, np.arange(worlds.n))[0]


@dataclass(frozen=True, slots=True)
class ShippedBounds:
    """One shipped table: the least harm known, the proven one, and the gap."""

    scenario: str
    vehicles: tuple[str, ...]
    list_seed: int
    worlds: int
    best_known_first: float | None  # mean, m2/s2; None: the table does not hold this count
    best_known_total: float | None
    proven: Proven | None
    nothing_proven_because: str | None
    identity: dict[str, Any]  # hashes of worlds and scenario, versions

    def gap(self, best_known: float | None) -> float | None:
        """Best known minus proven harm, as a share of the best known."""
        if self.proven is None or best_known is None:
            return None
        return 1.0 - self.proven.proven_harm / best_known if best_known > 0.0 else 0.0

    def to_json(self) -> dict[str, Any]:
        """Plain data; what does not exist is null."""
        gaps = {"gap_first": self.gap(self.best_known_first), "gap_total": self.gap(self.best_known_total)}
        own = asdict(self)
        return {**own.pop("identity"), **own, **gaps}


def shipped_bounds() -> Iterator[ShippedBounds]:
    """The bounds of every shipped table, by name of its file."""
    for table in shipped_tables():
        yield bounds_of(table)


def bounds_of(table: BestHarmTable) -> ShippedBounds:
    """The bounds of a table whose header names a shipped scenario and a list of it.

    Every world is compared in the list that the header names; raises ``InvalidInput`` if the table does not hold it.
    """
    header = table.header
    scenario = load_scenario(header["scenario"])
    names, seed, episodes = tuple(header["vehicles"]), int(header["list_seed"]), int(header["episodes"])
    task = Task(scenario, tuple(scenario.vehicle_names.index(name) for name in names))
    sample = scenario.sample(episodes, seed)
    worlds = sample.worlds
    table.check_holds_any(world_identity(worlds, task))
    first, total = (
        float(table.best[harm_count].harm.mean()) if harm_count in table.best else None for harm_count in HARM_COUNTS
    )
    why = unproven_because(worlds, task)
    proven = None if why is not None else proven_of_table(worlds, task, table)
    return ShippedBounds(
        scenario.name,
        names,
        seed,
        len(table.identity),
        first,
        total,
        proven,
        why,
        result_identity("best-harm", scenario, sample),
    )


def shipped_lines(found: Sequence[ShippedBounds]) -> list[str]:
    """The table of all of them, in markdown; harms are means over the worlds, m2/s2."""
    harm, share = partial(Column, digits=3, sign="-"), partial(Column, digits=1, scale=100.0, unit=" %", sign="-")
    columns = (
        "list", Column("worlds"), harm("proven"), harm("best known, first"), share("gap"), harm("best known, total"),
        share("gap"), share("contact proven"), share("impact proven"), share("between"),
        harm("best known there, first"), share("next to none there"),
    )  # fmt: skip
    rows = []
    for one in found:
        proven, inside = one.proven, None if one.proven is None else one.proven.between
        why = f": {one.nothing_proven_because}" if one.nothing_proven_because else ""
        row: list[Cell] = [f"{one.scenario} (seed {one.list_seed}){why}", f"{one.worlds:,}"]
        row += [getattr(proven, "proven_harm", None)]
        for best in (one.best_known_first, one.best_known_total):
            row += [best, one.gap(best)]
        row += [getattr(proven, "contact_proven_rate", None), getattr(proven, "impact_proven_rate", None)]
        row += [
            getattr(inside, "rate", None),
            getattr(inside, "mean_first", None),
            getattr(inside, "harmless_rate", None),
        ]
        rows.append(row)
    return Sheet("", columns, rows).markdown().splitlines()
