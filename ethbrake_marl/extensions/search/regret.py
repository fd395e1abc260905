"""Regret: an agent's harm minus the best known harm of the same world.

The best known is the least of what ``limits`` knows beforehand and what the agents of the same evaluation achieved.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.outcome import Outcome, Values
from ethbrake_marl.extensions.search.limits import IncompleteTable, Limits, Unproven, known_limits
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.state import Bools, Floats

NO_HARM = 1e-3  # m2/s2: nobody is hurt by 0.03 m/s

TOLERANCE = 1e-6  # m2/s2; less than this below the best known harm is rounding


@dataclass(frozen=True)
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

    @property
    def avoidable(self) -> Bools | None:
        """Where contact can be avoided, [n]; None where that is not decided."""
        return self.limits.proof.avoidable

    @property
    def between(self) -> Between | None:
        """The worlds with proven contact and no proven impact; None where contact is not decided."""
        if self.avoidable is None:
            return None
        return Between.of(~self.avoidable, self.limits.proof.impact, self.first_impact_harm, self.total_harm)


@dataclass(frozen=True, slots=True)
class Between:
    """The worlds with proven contact in which no impact is proven, and the least harm known there (m2/s2)."""

    rate: float  # share of all worlds
    mean_first: float | None  # None where there is no such world, or the least harm of none of them is known
    mean_total: float | None
    harmless_rate: float | None  # share of them whose best known total harm is below 1e-3

    @property
    def text(self) -> str:
        """What is known of them, as a sentence after another; empty without such a world."""
        if self.rate == 0.0:
            return ""
        text = f" In {100 * self.rate:.1f} % contact is certain, but perhaps no impact"
        if self.mean_first is None or self.harmless_rate is None:
            return f"{text}."
        return (
            f"{text}: the least harm known there is {self.mean_first:.2f} on average, and practically none in"
            f" {100 * self.harmless_rate:.0f} % of these."
        )

    @classmethod
    def of(cls, contact: Bools, impact: Bools, first: Floats, total: Floats) -> Between:
        """Those of worlds with these proofs; ``first`` and ``total`` [n] are the least harms known, NaN: none is."""
        there = contact & ~impact
        known = there & np.isfinite(first) & np.isfinite(total)
        if not known.any():
            return cls(float(there.mean()), None, None, None)
        harmless = float((total[known] < NO_HARM).mean())
        return cls(float(there.mean()), float(first[known].mean()), float(total[known].mean()), harmless)


# What was avoidable and the best known in each world, by the names of ``--per-world``.
KNOWN_OF_WORLDS: dict[str, Callable[[Outcome, Regrets], Values | None]] = {
    "avoidable": lambda _, r: None if r.avoidable is None else r.avoidable + 0,
    "unavoidable_reason": lambda _, r: r.limits.proof.reason,
    "best_known_first_impact_harm": lambda _, r: r.first_impact_harm,
    "best_known_total_harm": lambda _, r: r.total_harm,
    "best_known_source": lambda _, r: r.source,
    "impact_proven": lambda _, r: r.limits.proof.impact + 0,
    "proven_harm": lambda _, r: r.limits.proof.harm,
    "regret_first_impact_harm": lambda o, r: r.regret(o, "first"),
    "regret_total_harm": lambda o, r: r.regret(o, "total"),
}


def limits_of(evaluation: Evaluation) -> Limits | Unproven:
    """What is known of each world whoever drives, computed once for an evaluation.

    Warns (``IncompleteTable``) where a table of best known harm holds some of the worlds, and not the others.
    """
    return evaluation.once(_limits)


def _limits(evaluation: Evaluation) -> Limits | Unproven:
    if evaluation.host:
        return Unproven(f"{evaluation.host} moved these worlds, and what is proven is of the physics here")
    found = known_limits(evaluation.worlds, evaluation.task)
    if isinstance(found, Limits) and found.warning:
        warnings.warn(found.warning, IncompleteTable, stacklevel=4)
    return found


def regrets_of(evaluation: Evaluation) -> Regrets | None:
    """Best known harm of every world, the agents of this evaluation included; None where nothing is proven."""
    return evaluation.once(_regrets)


def _regrets(evaluation: Evaluation) -> Regrets | None:
    limits = limits_of(evaluation)
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
    return replace(regrets, source=source)
