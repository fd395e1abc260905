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
``harm("first")``, ``harm("total")``     [n] m2/s2 of the line so far: first impact of each pair, all impacts
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

Every evaluation has the measures in DEFAULT. Costly ones are chosen by name: ``evaluation.named_measures``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import EthBrakeError, InvalidInput, describe_error
from ethbrake_marl.motion.layout import FIRST, IMPACTS

MeasureValues = NDArray[Any]
MeasureValue = MeasureValues | Mapping[str, MeasureValues] | None

AT_REST, HORIZON = "at_rest", "horizon"  # how an episode ended


class Watch(Protocol):
    """A measure that is computed from every step of the episodes."""

    def see(self, before: State, step: Step | None, after: State) -> None:
        """Process one step from ``before`` to ``after``. ``step`` is None for the motion from the alert to the first
        decision.
        """

    def result(self, last: State) -> MeasureValue:
        """Value of the measure after the episodes, in a form that a measure's function may return."""


class Statistic(NamedTuple):
    """Statistic of a measure's column, for tables and JSON.

    The kind ``rate`` is the share of worlds in which the column is true, ``worst`` the mean of its largest 5 %,
    ``difference`` the mean difference from the baseline, ``decrease`` 1 - (mean) / (mean of the baseline).
    """

    key: str  # name in JSON
    kind: Literal["mean", "worst", "rate", "difference", "decrease"] = "mean"
    heading: str = ""  # in tables; "": left out of tables
    short: str = ""  # heading in a terminal
    ending: str = ""  # what follows the measure's name in the column's name
    meaning: str = ""  # "": the measure's meaning


class Measure(NamedTuple):
    name: str
    of: Callable[[Game, State, State], MeasureValue] | None = None
    meaning: str = ""
    unit: str = "1"
    statistics: tuple[Statistic, ...] = ()  # of its columns; a column without any gets its mean or rate
    watch: Callable[[Game, State], Watch | None] | None = None  # makes a `Watch` from (game, alert)


def measure_columns(measure: Measure, measurement: MeasureValue, last: State) -> dict[str, MeasureValues]:
    """Columns of a measure, name -> [n], from the value that the measure returned.

    ``last``: last states of the episodes. Raises ``InvalidInput`` for a wrong shape or type, and for numbers that are
    not finite.
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


# ---- built-in measures


def collided(game: Game, alert: State, last: State) -> MeasureValue:
    """Whether each world had an impact. The interval of the rate is Wilson's."""
    return last.collided


def harm(count: str, game: Game, alert: State, last: State) -> MeasureValue:
    """Harm at the end, [n] m2/s2: key ``""`` for the line, ``"1"`` to ``"N"`` for what each vehicle bears.

    None for the honest cost if the physics has no exact impacts.
    """
    if count == "honest" and not last.is_exact:
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


def predicted_harm(game: Game, alert: State, last: State) -> MeasureValue:
    """Harm that an agent or a shield predicted at the alert, in the count of harm that it minimises. Defined if exactly
    one agent or shield predicts.
    """
    memories: list[Any] = [last.memories.get(who) for who in ("shield", *game.settings.learners.tolist())]
    predictions = [memory.predicted_harm for memory in memories if hasattr(memory, "predicted_harm")]
    return predictions[0] if len(predictions) == 1 and np.isfinite(predictions[0]).all() else None


def replaced(game: Game, alert: State, last: State) -> MeasureValue:
    """actions: number of actions that the shield replaced; none: whether it replaced no action. A shield that chooses
    once per episode (Algorithm 1) has only none: whether it chose the policy.
    """
    memory: Any = last.memories.get("shield")
    if hasattr(memory, "chosen"):
        return {"none": memory.chosen}
    if hasattr(memory, "replaced"):
        return {"actions": memory.replaced, "none": memory.replaced == 0}
    return None


def outside(game: Game, alert: State, last: State) -> MeasureValue:
    """Share of a trained policy's decisions outside the range of what it observed in training; for several learners
    with such policies, their mean.
    """
    shield: Any = last.memories.get("shield")
    memories: Any = [last.memories.get(body) for body in game.settings.learners.tolist()]
    if shield is not None:
        memories = getattr(shield, "agents", [getattr(shield, "agent", None)])
    outside = [memory.outside for memory in memories if hasattr(memory, "outside")]
    return np.asarray(np.mean(outside, axis=0) / np.maximum(last.steps, 1)) if outside else None


def _built_in(of: Callable[[Game, State, State], MeasureValue], unit: str, *statistics: Statistic) -> Measure:
    return Measure(of.__name__, of, of.__doc__ or "", unit, statistics)


DEFAULT = (
    _built_in(collided, "", Statistic("collision_rate", "rate", "Collisions")),
    Measure(
        "first_impact_harm", partial(harm, "first"),
        "Squared closing speed of each pair's first impact, summed over the pairs, as the paper counts harm. With the"
        " number of a vehicle: what it bears.", "m2/s2",
        (
            Statistic("first_impact_harm", "mean", "First-impact harm", "First-impact\nharm"),
            Statistic("first_impact_harm_difference", "difference"),
            Statistic("harm_decrease_first", "decrease", "Decrease, first-impact", "Decrease\nfirst"),
        ),
    ),
    Measure(
        "total_harm", partial(harm, "total"),
        "Squared closing speed of every impact, summed. After a light first impact, first-impact harm does not count a"
        " hard second one of the same pair; total harm does.", "m2/s2",
        (
            Statistic("total_harm", "mean", "Total harm", "Total\nharm"),
            Statistic("total_harm_difference", "difference"),
            Statistic("harm_decrease_total", "decrease", "Decrease, total", "Decrease\ntotal"),
        ),
    ),
    Measure(
        "honest_cost", partial(harm, "honest"),
        "Total harm, harm that contacts pass on, and a price for pushes, for driving and for"
        " motion at the horizon (docs/game.md).", "m2/s2",
        (
            Statistic("honest_cost", "mean", "Honest cost", "Honest\ncost"),
            Statistic("honest_cost_difference", "difference"),
            Statistic("harm_decrease_honest", "decrease"),
        ),
    ),
    _built_in(impacts, "1"),
    _built_in(hardest_impact_mps, "m/s"),
    _built_in(end_s, "s"),
    _built_in(ended, ""),
    _built_in(predicted_harm, "m2/s2", Statistic("predicted_harm", "mean", "Predicted harm", "Pre-\ndicted")),
    _built_in(outside, "1"),
    _built_in(replaced, "1", Statistic("policy_share", "rate", ending="none")),
)  # fmt: skip


@contextmanager
def naming(measure: Measure) -> Iterator[None]:
    """Turn an exception in the block into an ``InvalidInput`` that names the measure; errors of this package pass."""
    try:
        yield
    except EthBrakeError:
        raise
    except Exception as error:
        raise InvalidInput(f"measure {measure.name!r}: its function fails: {describe_error(error)}") from error
