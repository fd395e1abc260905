"""``Outcome``: the results of one agent in several worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import count_of
from ethbrake_marl.first_edition.agents.protocol import Knowledge, Source
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount, Ledger
from ethbrake_marl.first_edition.game.objectives import Declared, scored
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds

_NAMED = 10  # largest number of left-out worlds that a note lists; JSON lists all of them

COLUMN = "metric_"  # prefix of a registered measure's name, in JSON and in files with one row per world

Values = NDArray[Any]  # values of a measure in n worlds, [n]

# Knowledge of an agent that does not state what it knows.
UNSTATED = Knowledge((Source.UNSTATED,))

_COLUMNS = ("at_rest", "predicted_harm", "chosen_policy", "shoved_m", "sampled_harm")  # fields of shape [n]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Results of one agent in each of n worlds: harm, final state and measures.

    >>> import ethbrake_marl.first_edition as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> outcome = eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario).outcome("full_brake")
    >>> outcome.total_harm.round(2), outcome.collided
    (array([33.79, 77.19,  0.  ]), array([ True,  True, False]))

    """

    ledger: Ledger  # harm of all impacts in each world, by pair and vehicle
    final: Worlds  # each world at the end of its episode
    at_rest: Bools  # [n] whether the line came to rest before the horizon
    predicted_harm: Floats | None  # [n] harm that the agent predicted at the alert (m2/s2); None: no prediction
    # [n] whether the policy behind a shield drove the whole episode: episode mode chose the policy at the alert, or
    # step mode replaced none of its actions. None without a shield.
    chosen_policy: Bools | None
    knows: Knowledge = UNSTATED  # what the agent says that it knows about the line
    # [n] distance (m) by which Vehicle 1 was shoved beyond the place where it would stop; None: not measured.
    shoved_m: Floats | None = None
    # [n] the paper's sampled harm of the same commands (m2/s2); None: not measured.
    sampled_harm: Floats | None = None
    policies: Mapping[str, str] = field(default_factory=dict)  # vehicle's name -> SHA-256 of its policy's manifest
    metrics: Mapping[str, Floats] = field(default_factory=dict)  # column name of a registered measure -> values [n]

    def __repr__(self) -> str:
        n, means = len(self.collided), "no harm"
        if n:
            means = f"harm {self.first_impact_harm.mean():.2f} first-impact, {self.total_harm.mean():.2f} total"
        return f"Outcome({count_of(n, 'world')}, {int(self.collided.sum()):,} collided, {means})"

    def take(self, rows: Ints | Bools) -> Outcome:
        """Return the outcome restricted to the worlds ``rows`` (row numbers, or a mask [n])."""
        every = {name: getattr(self, name) for name in _COLUMNS}
        columns: dict[str, Any] = {name: None if column is None else column[rows] for name, column in every.items()}
        metrics = {name: column[rows] for name, column in self.metrics.items()}
        return replace(self, ledger=self.ledger.take(rows), final=self.final.take(rows), metrics=metrics, **columns)

    @classmethod
    def join(cls, parts: Sequence[Outcome]) -> Outcome:
        """Join the outcomes of one agent in consecutive chunks of worlds.

        A field that is None in one of ``parts`` is None in the result.
        """
        first, columns = parts[0], dict[str, Any]()
        for name in _COLUMNS:
            values = [getattr(part, name) for part in parts]
            columns[name] = None if any(each is None for each in values) else np.concatenate(values)
        ledger = Ledger(*(np.concatenate([getattr(part.ledger, f.name) for part in parts]) for f in fields(Ledger)))
        final = Worlds.concatenate([part.final for part in parts])
        metrics = {name: np.concatenate([part.metrics[name] for part in parts]) for name in first.metrics}
        return replace(first, ledger=ledger, final=final, metrics=metrics, **columns)

    @property
    def collided(self) -> Bools:
        """For each world: whether at least one impact happened, [n]."""
        return self.ledger.collided

    @property
    def impacts(self) -> Ints:
        """Number of impacts in each world, between vehicles and with an obstacle, [n]."""
        return self.ledger.impacts

    def world_harm(self, harm_count: HarmCount) -> Floats:
        """Return the harm of the whole line in each world, [n] m2/s2: ``first``-impact harm or ``total`` harm."""
        return self.ledger.world_harm(harm_count)

    @property
    def first_impact_harm(self) -> Floats:
        """First-impact harm of the whole line in each world, [n] m2/s2."""
        return self.ledger.world_harm("first")

    @property
    def total_harm(self) -> Floats:
        """Total harm of the whole line in each world, [n] m2/s2."""
        return self.ledger.world_harm("total")

    def vehicle_harm(self, harm_count: HarmCount) -> Floats:
        """Return each vehicle's part of the ``first``-impact or ``total`` harm in each world, [n, N] m2/s2."""
        return self.ledger.vehicle_harm(harm_count)

    @property
    def ended(self) -> NDArray[np.str_]:
        """For each world: how the episode ended (``at_rest`` or ``horizon``), [n]."""
        return np.where(self.at_rest, "at_rest", "horizon")

    def borne(self, objectives: Sequence[Declared] = ()) -> dict[str, Floats]:
        """Return, for each vehicle, the harm that it bears and the value of each of ``objectives`` (m2/s2).

        The result maps the name of a column to its values [n]. For instance, the columns of Vehicle 2 are
        ``first_impact_harm_2``, ``total_harm_2`` and, with ``objectives=["social:45"]``, ``social:45_first_2`` and
        ``social:45_total_2``.
        """
        by_vehicle = {"first_impact_harm": self.vehicle_harm("first"), "total_harm": self.vehicle_harm("total")}
        for objective in objectives:
            for harm_count in HARM_COUNTS:
                (values,) = scored(self.ledger, harm_count, [objective]).values()
                by_vehicle[f"{objective}_{harm_count}"] = values
        return {f"{name}_{i + 1}": each[:, i] for name, each in by_vehicle.items() for i in range(each.shape[1])}

    def columns(self) -> dict[str, Values | None]:
        """Return a table with one row per world: name of a column -> values [n] (None: not measured)."""
        final, obstacle = self.final, {}
        if (ahead := final.obstacle_ahead).any():
            obstacle = {
                "obstacle_first_impact_harm": np.where(ahead, self.ledger.obstacle_harm("first"), np.nan),
                "obstacle_total_harm": np.where(ahead, self.ledger.obstacle_harm("total"), np.nan),
                "final_obstacle_gap_m": np.where(ahead, final.obstacle_gap_m, np.nan),
            }
        return {
            "collided": self.collided + 0,
            "impacts": self.impacts,
            **self.borne(),
            "first_impact_harm": self.first_impact_harm,
            "total_harm": self.total_harm,
            "sampled_harm": self.sampled_harm,
            "vehicle_1_shoved_m": self.shoved_m,
            **obstacle,
            **{f"final_gap_{p + 1}_m": final.gaps_m[:, p] for p in range(final.N - 1)},
            **{f"final_speed_{i + 1}_mps": final.speeds_mps[:, i] for i in range(final.N)},
            "end_s": final.time_s,
            "ended": self.ended,
            "predicted_harm": self.predicted_harm,
            "chosen_policy": None if self.chosen_policy is None else self.chosen_policy + 0,
            **{COLUMN + name: column + 0 for name, column in self.metrics.items()},  # true/false as 1 and 0
        }


def none_for_nan(column: Values) -> list[Any]:
    """Return ``column`` as a list, with None instead of NaN."""
    return [None if value != value else value for value in column.tolist()]


class LeftOut(NamedTuple):
    """A world that is missing in the results of all agents, because its simulation with one agent failed."""

    world: int  # number in its evaluation list, from 0
    seed: int | None  # seed of the evaluation list; None for worlds that the caller passed
    agent: str  # name of the first agent with which the simulation failed
    reason: str  # message of the error

    def __str__(self) -> str:
        of = "" if self.seed is None else f" of seed {self.seed}"
        return f"world {self.world}{of} ({self.agent}: {self.reason})"

    @staticmethod
    def line(worlds: Sequence[str], whole: int) -> str:
        """Return a note for the user that lists at most ten of the left-out ``worlds``.

        ``worlds`` describes each left-out world, with the reason; ``whole`` is the number of all worlds, with these.
        """
        named = [*worlds[:_NAMED], *(["and so on"] if len(worlds) > _NAMED else [])]
        return (
            f"LEFT OUT for every agent: {len(worlds):,} of {whole:,} worlds, because the simulation failed"
            f" (please report this error): {'; '.join(named)}."
        )
