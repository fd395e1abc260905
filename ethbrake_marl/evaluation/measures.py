"""Measures: what an evaluation reports of each episode, one number per world or per vehicle.

A measure is a function ``of(game, alert, last)`` of the game, the worlds at the alert and the last states of their
episodes. It returns [n], one value per world, or [n, N], one per vehicle: columns ``NAME_1`` to ``NAME_N``. A mapping
ending -> [n] gives the columns ``NAME_ending``, and ``NAME`` for the ending ``""``. None means that the measure is not
defined in this game. Values are finite numbers, truth values (tables show how often they are true) or texts.

=======================================  ===============================================================================
property of a state                      meaning (``episode.state.State``)
=======================================  ===============================================================================
``speeds_mps``, ``gaps_m``               [n, N] m/s; [n, N - 1] m, front to rear
``obstacle_gap_m``                       [n] m; infinite without an obstacle
``harm()``, ``harm("total")``            [n] m2/s2 of the line so far: honest cost, harm of all impacts
``borne_harm(...)``                      [n, N] m2/s2 that each vehicle bears
``pair_harm(...)``                       [n, N - 1] m2/s2 of each pair
``collided``, ``pair_hit``               [n]; [n, N - 1] whether there was an impact
``commands_mps2``, ``forces_mps2``       [n, N] m/s2: last commands; what brakes and engines cause
``mass_t``, ``latency_s``                [n, N] t; s
``restitution``                          [n] of all impacts
``braking_capacity_mps2``, ``driving_``  [n, N] m/s2 on this road
``time_s``, ``steps``, ``ended``         [n] s since the alert; steps taken; whether the episode has ended
``memories``                             body -> memory of its agent; ``"shield"`` -> memory of the shield
``car``, ``line``                        [n, rows, N + 1] all parameters; all changing quantities (``motion.layout``)
=======================================  ===============================================================================

A ``Watch`` also sees each step (``episode.step.Step``): ``first_impact_harm`` and ``total_harm`` of the line, [n]
m2/s2; ``reward`` [n, N] and its ``terms``; ``terminated``, ``truncated`` and ``safe_end``, [n].

An agent, a shield or a layer may report measures of its own (``agents.team.Agent``, ``episode.game.Shield``,
``episode.layer.Layer``): a mapping name -> value, with values of the same form.

Every evaluation has the measures in DEFAULT and one for each registered count of harm. Costly ones are chosen by name:
``evaluation.measure_registry``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.counts import BUILT_IN_COUNTS, IMPACT_COUNTS, HarmCount, all_counts
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import EthBrakeError, InvalidInput, describe_error
from ethbrake_marl.evaluation.record import POST_M, advance_worlds, simulate_again, with_post
from ethbrake_marl.motion.layout import FIRST, GAP, IMPACTS, LATENCY, NEXT_TIME, PUSHED, Floats, scratch_for
from ethbrake_marl.registry import Part

MeasureValues = NDArray[Any]
MeasureValue = MeasureValues | Mapping[str, MeasureValues] | None

AT_REST, HORIZON = "at_rest", "horizon"  # how an episode ended
PUSHED_FAR_M = 5.0  # Vehicle 1 counts as pushed far above this distance; a mean above it is an exploit
HARD_MPS2 = 1.0  # a command above this is hard driving


class Watch(Protocol):
    """A measure that is computed from every step of the episodes."""

    def see(self, before: State, step: Step | None, after: State) -> None:
        """Process one step; ``step`` is None for the motion from the alert to the first decision."""

    def result(self, last: State) -> MeasureValue:
        """Value of the measure after the episodes, in a form that a measure's function may return."""


class Statistic(NamedTuple):
    """Statistic of a measure's column, for tables and JSON.

    ``rate``: share of worlds in which the column is true. ``worst``: mean of its largest 5 %. ``difference``: mean
    difference from the baseline. ``decrease``: 1 - (mean) / (mean of the baseline).
    """

    key: str  # name in JSON
    kind: Literal["mean", "worst", "rate", "difference", "decrease"] = "mean"
    heading: str = ""  # in tables; "": left out of tables
    short: str = ""  # heading in a terminal
    ending: str = ""  # what follows the measure's name in the column's name
    meaning: str = ""  # "": the measure's meaning

    def of_counts(self) -> list[Statistic]:
        """The statistic; or, if ``{count}`` or ``{words}`` is in its texts, one for each count of harm."""
        if "{count}" not in self.key:
            return [self]
        texts = [{"count": count.name, "words": count.words} for count in all_counts()]
        return [
            self._replace(**{field: text.format(**of) for field, text in self._asdict().items() if field != "kind"})
            for of in texts
        ]


class Measure(NamedTuple):
    name: str
    of: Callable[[Game, State, State], MeasureValue] | None = None
    meaning: str = ""
    unit: str = "1"
    statistics: tuple[Statistic, ...] = ()  # of its columns; a column without any gets its mean or rate
    watch: Callable[[Game, State], Watch | None] | None = None  # makes a `Watch` from (game, alert)
    # without `of` and `watch`: a value that agents, shields or layers report by their own method `measures`

    def all_statistics(self) -> list[Statistic]:
        return [each for statistic in self.statistics for each in statistic.of_counts()]


def measure_columns(measure: Measure, measurement: MeasureValue, last: State) -> dict[str, MeasureValues]:
    """Columns of a measure, name -> [n], from the value that it returned. ``last``: last states of the episodes.

    Raises ``InvalidInput`` for a wrong shape or type, and for numbers that are not finite.
    """
    if measurement is None:
        return {}
    parts: Mapping[str, Any] = measurement if isinstance(measurement, Mapping) else {"": measurement}
    columns: dict[str, MeasureValues] = {}
    for ending, value in parts.items():
        name, values = "_".join(filter(None, (measure.name, ending))), np.asarray(value)
        named_columns = (
            {f"{name}_{i + 1}": column for i, column in enumerate(values.T)} if values.ndim == 2 else {name: values}
        )
        right = (last.n,), (last.n, last.vehicles)
        if values.shape not in right or values.dtype.kind not in "fiubU":
            raise InvalidInput(
                f"measure {name!r}: its function returned {values.dtype} of shape {values.shape}; must return numbers,"
                f" truth values or texts of shape {right[0]}, one per world, or {right[1]}, one per vehicle"
            )
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            row = np.argwhere(~np.isfinite(values))[0]
            raise InvalidInput(f"measure {name!r}: its value is {values[tuple(row)]} in row {row[0]}; must be finite")
        columns |= named_columns
    return columns


@contextmanager
def naming(measure: Measure) -> Iterator[None]:
    """Turn an exception into an ``InvalidInput`` that names the measure; errors of this package pass."""
    try:
        yield
    except EthBrakeError:
        raise
    except Exception as error:
        raise InvalidInput(f"measure {measure.name!r}: its function fails: {describe_error(error)}") from error


# ---- measures of every evaluation


def collided(game: Game, alert: State, last: State) -> MeasureValue:
    """Whether each world had an impact. The interval of the rate is Wilson's."""
    return last.collided


def harm(count: HarmCount, game: Game, alert: State, last: State) -> MeasureValue:
    """Harm at the end, [n] m2/s2: key ``""`` for the line, ``"1"`` to ``"N"`` for what each vehicle bears."""
    if not last.defines(count):
        return None
    borne = {f"{i + 1}": column for i, column in enumerate(last.borne_harm(count).T)}
    return {"": last.harm(count), **borne}


def impacts(game: Game, alert: State, last: State) -> MeasureValue:
    """Number of impacts in each world, those with an obstacle included."""
    return np.asarray(last.line[:, IMPACTS].sum(axis=1), np.int64)


def hardest_impact_mps(game: Game, alert: State, last: State) -> MeasureValue:
    """Largest closing speed of a pair's first impact in each world."""
    return np.asarray(np.sqrt(last.line[:, FIRST].max(axis=1)))


def end_s(game: Game, alert: State, last: State) -> MeasureValue:
    """Time from the alert to the end of each episode."""
    return last.time_s


def ended(game: Game, alert: State, last: State) -> MeasureValue:
    """How each episode ended. at_rest: all vehicles stand; horizon: a vehicle still moves at the horizon."""
    return np.where(last.moving, HORIZON, AT_REST)


def _built_in(of: Callable[[Game, State, State], MeasureValue], unit: str, *statistics: Statistic) -> Measure:
    return Measure(of.__name__, of, of.__doc__ or "", unit, statistics)


MEANINGS = {
    "first": "Squared closing speed of each pair's first impact, summed over the pairs, as the paper counts harm. With"
    " the number of a vehicle: what it bears.",
    "total": "Squared closing speed of every impact, summed. After a light first impact, first-impact harm does not"
    " count a hard second one of the same pair; total harm does.",
    "honest": "Total harm, harm that contacts pass on, and a price for pushes, for driving and for motion at the"
    " horizon (docs/game.md).",
}


@cache
def harm_measure(count: HarmCount) -> Measure:
    """Measure of a count of harm, with the column of the count."""
    decrease = f"Decrease, {count.words.removesuffix(' harm')}" if count in IMPACT_COUNTS else ""
    statistics = (
        Statistic(count.column, "mean", count.words.capitalize(), "\n".join(count.words.capitalize().split())),
        Statistic(f"{count.column}_difference", "difference"),
        Statistic(f"harm_decrease_{count.name}", "decrease", decrease, f"Decrease\n{count.name}"),
    )
    meaning = MEANINGS.get(count.name, f"{count.words.capitalize()}, a registered count of harm.")
    return Measure(count.column, partial(harm, count), meaning, "m2/s2", statistics)


DEFAULT = (
    _built_in(collided, "", Statistic("collision_rate", "rate", "Collisions")),
    *map(harm_measure, BUILT_IN_COUNTS),
    _built_in(impacts, "1"),
    _built_in(hardest_impact_mps, "m/s"),
    _built_in(end_s, "s"),
    _built_in(ended, ""),
    Measure(
        "predicted_harm", None,
        "Harm that an agent predicted at the alert, in the count of harm that it minimises. Defined if exactly one"
        " agent predicts.", "m2/s2",
        (Statistic("predicted_harm", "mean", "Predicted harm", "Pre-\ndicted"),),
    ),
    Measure(
        "outside", None,
        "Share of a trained policy's decisions outside the range of what it observed in training; for several learners"
        " with such policies, their mean.",
    ),
    Measure(
        "replaced", None,
        "actions: number of actions that the shield replaced; none: whether it replaced no action. A shield that"
        " chooses once per episode (Algorithm 1) has only none: whether it chose the policy.", "1",
        (Statistic("policy_share", "rate", ending="none"),),
    ),
)  # fmt: skip


def usual_measures() -> tuple[Measure, ...]:
    """Measures of every evaluation: ``DEFAULT`` and all registered counts of harm."""
    return (*DEFAULT, *(harm_measure(count) for count in all_counts() if count not in BUILT_IN_COUNTS))


# ---- measures that are chosen by name


def worst5(game: Game, alert: State, last: State) -> MeasureValue:
    """Mean of the worst 5 % of the worlds, in each count of harm. In rows per world: the harm or cost of the world."""
    return {count.name: last.harm(count) for count in last.counts}


WORST5 = Part(
    worst5, unit="m2/s2",
    statistics=(Statistic("worst5_{count}", "worst", "Worst 5 %, {words}", "Worst 5 %\n{count}", "{count}"),),
)  # fmt: skip


def own_way_m(alert: State, body: int, until_s: float) -> Floats:
    """Distance that a vehicle travels from the alert to ``until_s`` if no other vehicle touches it, [n] m."""
    require(alert, "pushed_m", simulates=True)
    line, wanted = alert.line[:, :, [0, body]], alert.wanted[:, [0, body]]
    line[:, GAP, 0], line[:, GAP, 1] = POST_M, np.inf
    end_s = np.full(alert.n, until_s)
    advance_worlds(line, alert.car[:, :, [0, body]], alert.time_s.copy(), end_s, wanted, scratch_for(2))
    return POST_M - line[:, GAP, 0]


class PushedAway:
    """Measures how far vehicles end beyond the place that they would reach untouched; negative if thrown back."""

    def __init__(self, bodies: list[int], game: Game, alert: State) -> None:
        self.own_way_m = {body: own_way_m(alert, body, game.settings.horizon_s) for body in bodies}
        self.gaps_m, self.way_m = alert.gaps_m.copy(), np.zeros(alert.n)

    def see(self, before: State, step: Step | None, after: State) -> None:
        line = with_post(before)
        from_m = line[:, GAP, 0].copy()
        advance_worlds(line, before.car, before.time_s, after.time_s, after.wanted, scratch_for(line.shape[2]))
        self.way_m += from_m - line[:, GAP, 0]

    def result(self, last: State) -> MeasureValue:
        """Excess distance, vehicle number -> [n] m; ``1_far`` [n]: whether Vehicle 1 exceeds ``PUSHED_FAR_M``."""
        wider_m = np.cumsum(last.gaps_m - self.gaps_m, axis=1)
        metres = {
            f"{body}": self.way_m - (wider_m[:, body - 2] if body > 1 else 0.0) - untouched_m
            for body, untouched_m in self.own_way_m.items()
        }
        return {**metres, **({"1_far": metres["1"] > PUSHED_FAR_M} if "1" in metres else {})}


def pushed_m(game: Game, alert: State) -> PushedAway | None:
    """How far a vehicle ends beyond the place where it would stop untouched, because of impacts and pushes. In reality
    the vehicle brakes for something there, so this is dangerous. Defined for vehicles that neither learn nor observe
    the state.
    """
    bodies = [i for i in range(1, alert.vehicles + 1) if i not in game.settings.learners and i not in game.scripts]
    return PushedAway(bodies, game, alert) if bodies else None


def pushed_mps(game: Game, alert: State, last: State) -> MeasureValue:
    """Push: closing speed that vehicles build up and contacts absorb, while a contact lasts and in the impacts after a
    pair's first. Without a number: sum over the line; with the number of a vehicle: push by the vehicle behind it;
    obstacle: push of Vehicle 1 against the obstacle.
    """
    require(last, "pushed_mps", simulates=True)
    of_pair = last.line[:, PUSHED]
    behind = {f"{i}": of_pair[:, i] for i in range(1, last.vehicles)}
    return {"": of_pair.sum(axis=1), **behind, "obstacle": of_pair[:, 0]}


def first_impact_s(before: State, after: State) -> Floats:
    """Time of the line's first impact if it lies between the two states, [n] s.

    Else ``before.time_s`` after an earlier impact, ``after.time_s`` before any. There must be no decision between the
    two.
    """
    until: Floats = np.where(before.collided, before.time_s, after.time_s)
    for k, scratch in simulate_again(before, after, ~before.collided & after.collided):
        struck = after.line[k, IMPACTS] > 0.0
        until[k] = before.time_s[k] + scratch[NEXT_TIME, struck].min()
    return until


def driving_s(before: State, after: State, until_s: Floats) -> Floats:
    """Time from ``before`` to ``until_s`` [n] with a positive command (of ``after``) in force, [n, N] s."""
    begun_s = np.maximum(before.car[:, LATENCY, 1:], before.time_s[:, np.newaxis])
    return np.where(after.commands_mps2 > 0.0, np.maximum(until_s[:, np.newaxis] - begun_s, 0.0), 0.0)


class DroveTowards:
    def __init__(self, game: Game, alert: State) -> None:
        self.learners, self.time_s = game.settings.learners, np.zeros(alert.n)
        self.driving_s, self.hard = np.zeros((alert.n, alert.vehicles)), np.zeros(alert.n, np.bool_)

    def see(self, before: State, step: Step | None, after: State) -> None:
        until_s = first_impact_s(before, after)
        driving = driving_s(before, after, until_s)
        hard = (driving > 0.0) & (after.commands_mps2 > HARD_MPS2)
        self.time_s += until_s - before.time_s
        self.driving_s += driving
        self.hard |= hard[:, self.learners - 1].any(axis=1)

    def result(self, last: State) -> MeasureValue:
        share = self.driving_s / np.where(self.time_s > 0.0, self.time_s, 1.0)[:, np.newaxis]
        shares = {f"{i + 1}": column for i, column in enumerate(share.T)}
        return {"": share[:, self.learners - 1].max(axis=1, initial=0.0), **shares, "hard": self.hard}


def drove_towards(game: Game, alert: State) -> DroveTowards:
    """Share of the time before the line's first impact (of the whole episode, if there is none) in which a vehicle has
    a positive command (drives). With the number of a vehicle: for this vehicle; without: the largest share of a
    learner; hard: whether a learner drove at more than 1 m/s2.
    """
    return DroveTowards(game, alert)


def still_moving(game: Game, alert: State, last: State) -> MeasureValue:
    """Whether some vehicle still moves when the episode ends, which is then at the horizon."""
    return last.moving


FAR = "Share of worlds in which Vehicle 1 is pushed more than 5 m beyond the point where it would stop by itself."
PUSHED_M = Part(
    watch=pushed_m, unit="m",
    statistics=(
        Statistic("pushed_m_1", "mean", "Vehicle 1 pushed (m)", "Pushed\nm", "1"),
        Statistic("pushed_far_rate", "rate", "Vehicle 1 pushed > 5 m", "Pushed\n> 5 m", "1_far", FAR),
    ),
)  # fmt: skip
PUSHED_MPS = Part(pushed_mps, unit="m/s", statistics=(Statistic("pushed_mps", "mean", "Push (m/s)", "Push\nm/s"),))
DROVE_TOWARDS = Part(
    watch=drove_towards,
    statistics=(
        Statistic("drove_towards", "mean", "Drove before the first impact", "Drove\nshare"),
        Statistic("drove_hard_rate", "rate", "Drove at > 1 m/s2 before the first impact", "Drove\nhard", "hard"),
    ),
)  # fmt: skip
STILL_MOVING = Part(
    still_moving, unit="", statistics=(Statistic("still_moving_rate", "rate", "Still moving", "Still\nmoving"),)
)  # fmt: skip
