"""``Outcome``: what one agent achieved in each world of a list."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.protocol import Knowledge, Source
from ethbrake_marl.errors import count_of
from ethbrake_marl.game.harm import HARM_COUNTS, HarmCount, Ledger
from ethbrake_marl.game.objectives import Declared, scored
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds

_NAMED = 10  # worlds left out that are named one by one; all stand in the JSON

COLUMN = "metric_"  # before the name of a registered measure, in JSON and in files with every world

Values = NDArray[Any]  # [n]

# Of an agent that does not say what it knows.
UNSTATED = Knowledge((Source.UNSTATED,))

_COLUMNS = ("at_rest", "predicted_harm", "chosen_policy", "shoved_m", "sampled_harm")  # of an outcome, [n]


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one agent achieved, world by world.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> outcome = eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario).outcome("full_brake")
    >>> outcome.total_harm.round(2), outcome.collided
    (array([33.79, 77.19,  0.  ]), array([ True,  True, False]))

    """

    ledger: Ledger  # of every impact
    final: Worlds  # each world as its episode left it
    at_rest: Bools  # [n] the line came to rest; else the horizon cut the episode off
    predicted_harm: Floats | None  # [n] what the agent expected at the alert, if it predicts and drives alone
    chosen_policy: Bools | None  # [n] a hybrid drove by its policy; else by its backup
    knows: Knowledge = UNSTATED  # what the agent says it knows of the line
    shoved_m: Floats | None = None  # [n] how far Vehicle 1 ends beyond where it would by itself
    sampled_harm: Floats | None = None  # [n] the paper's sum over samples of the same commands
    policies: Mapping[str, str] = field(default_factory=dict)  # vehicle's name -> SHA-256 of its policy's manifest
    metrics: Mapping[str, Floats] = field(default_factory=dict)  # registered measures by column, [n]

    def __repr__(self) -> str:
        n, means = len(self.collided), "no harm"
        if n:
            means = f"harm {self.first_impact_harm.mean():.2f} first-impact, {self.total_harm.mean():.2f} total"
        return f"Outcome({count_of(n, 'world')}, {int(self.collided.sum()):,} collided, {means})"

    def take(self, rows: Ints | Bools) -> Outcome:
        """The outcome restricted to ``rows``."""
        found = {name: getattr(self, name) for name in _COLUMNS}
        columns: dict[str, Any] = {name: None if column is None else column[rows] for name, column in found.items()}
        metrics = {name: column[rows] for name, column in self.metrics.items()}
        return replace(self, ledger=self.ledger.take(rows), final=self.final.take(rows), metrics=metrics, **columns)

    @classmethod
    def join(cls, parts: Sequence[Outcome]) -> Outcome:
        """One outcome of consecutive worlds."""
        first, columns = parts[0], dict[str, Any]()
        for name in _COLUMNS:  # what one part cannot tell is not told of the whole
            told = [getattr(part, name) for part in parts]
            columns[name] = None if any(each is None for each in told) else np.concatenate(told)
        ledger = Ledger(*(np.concatenate([getattr(part.ledger, f.name) for part in parts]) for f in fields(Ledger)))
        final = Worlds.concatenate([part.final for part in parts])
        metrics = {name: np.concatenate([part.metrics[name] for part in parts]) for name in first.metrics}
        return replace(first, ledger=ledger, final=final, metrics=metrics, **columns)

    @property
    def collided(self) -> Bools:
        """Whether any impact happened, [n]."""
        return self.ledger.collided

    @property
    def impacts(self) -> Ints:
        """Number of impacts of all pairs, and with an obstacle ahead, [n]."""
        return self.ledger.impacts

    def world_harm(self, harm_count: HarmCount) -> Floats:
        """Harm of all vehicles under a counting rule, [n] m2/s2."""
        return self.ledger.world_harm(harm_count)

    @property
    def first_impact_harm(self) -> Floats:
        """Harm of all vehicles, each pair's first impact only, [n] m2/s2."""
        return self.ledger.world_harm("first")

    @property
    def total_harm(self) -> Floats:
        """Harm of all vehicles, every impact, [n] m2/s2."""
        return self.ledger.world_harm("total")

    def vehicle_harm(self, harm_count: HarmCount) -> Floats:
        """Harm of each vehicle, [n, N] m2/s2."""
        return self.ledger.vehicle_harm(harm_count)

    @property
    def ended(self) -> NDArray[np.str_]:
        """How each episode ended, [n]: ``at_rest`` or ``horizon``."""
        return np.where(self.at_rest, "at_rest", "horizon")

    def borne(self, objectives: Sequence[Declared] = ()) -> dict[str, Floats]:
        """What each vehicle bears under both counts, ``total_harm_2``, and what each objective makes of it [n] (m2/s2).

        That is ``social:45_first_2``.
        """
        told = {"first_impact_harm": self.vehicle_harm("first"), "total_harm": self.vehicle_harm("total")}
        for objective in objectives:
            for harm_count in HARM_COUNTS:
                (values,) = scored(self.ledger, harm_count, [objective]).values()
                told[f"{objective}_{harm_count}"] = values
        return {f"{name}_{i + 1}": each[:, i] for name, each in told.items() for i in range(each.shape[1])}

    def columns(self) -> dict[str, Values | None]:
        """What happened in each world, by the names of ``--per-world``; None where the agent says nothing."""
        final, obstacle = self.final, {}
        if (ahead := final.obstacle_ahead).any():  # of the harm above, what Vehicle 1's impacts with the obstacle did
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
            **{COLUMN + name: column + 0 for name, column in self.metrics.items()},  # truths as 0 and 1
        }


def none_for_nan(column: Values) -> list[Any]:
    """The values of a column, None where there is no number."""
    return [None if value != value else value for value in column.tolist()]


class LeftOut(NamedTuple):
    """A world that is in no outcome, because it could not be advanced with one of the agents."""

    world: int  # number in its list
    seed: int | None  # of the list; None for worlds that were given
    agent: str  # the first one that met it
    reason: str

    def __str__(self) -> str:
        of = "" if self.seed is None else f" of seed {self.seed}"
        return f"world {self.world}{of} ({self.agent}: {self.reason})"

    @staticmethod
    def line(worlds: Sequence[str], whole: int) -> str:
        """That these of ``whole`` worlds, each named with its reason, count in no figure."""
        named = [*worlds[:_NAMED], *(["and so on"] if len(worlds) > _NAMED else [])]
        return (
            f"LEFT OUT for every agent: {len(worlds):,} of {whole:,} worlds, which the physics could not advance"
            f" (please report them): {'; '.join(named)}."
        )
