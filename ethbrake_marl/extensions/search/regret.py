"""Regret: an agent's harm minus the best known harm of the same world.

The best known harm is the smaller one of two values: the best harm known before the evaluation (module ``limits``), and
the least harm of the agents in this evaluation.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.extensions.search.limits import IncompleteTable, Limits, Unproven, known_limits
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.outcome import Outcome, Values
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.state import Bools, Floats

NO_HARM = 1e-3  # m2/s2; less harm (an impact at 0.03 m/s) is treated as 0

TOLERANCE = 1e-6  # m2/s2; a harm below the best known by less than this is rounding


@dataclass(frozen=True)
class Regrets:
    """Best known harm of each world, as arrays [n], after all agents of an evaluation have driven the worlds."""

    limits: Limits  # proofs and best known harm before any agent drove
    first_impact_harm: Floats  # best known first-impact harm, including the agents of this evaluation, m2/s2
    total_harm: Floats  # best known total harm, including the agents of this evaluation, m2/s2
    # origin of the best known harm: witness (contact proven avoidable), table, agents (in no table), below_table (an
    # agent beat the table)
    source: NDArray[np.str_]

    def best(self, harm_count: HarmCount) -> Floats:
        """Return the best known harm under ``harm_count`` (``first`` or ``total``), [n] m2/s2."""
        return self.first_impact_harm if harm_count == "first" else self.total_harm

    def regret(self, outcome: Outcome, harm_count: HarmCount) -> Floats:
        """Return an agent's harm minus the best known harm, [n] m2/s2; the result is never negative."""
        return outcome.ledger.world_harm(harm_count) - self.best(harm_count)

    def below(self, outcome: Outcome) -> Bools:
        """Return a mask [n]: True where an agent does less harm than the best harm known before the evaluation.

        Less means: by more than ``TOLERANCE``, under at least one of the two harm counts.
        """
        first, total = self.limits.first_impact_harm, self.limits.total_harm
        return (outcome.first_impact_harm < first - TOLERANCE) | (outcome.total_harm < total - TOLERANCE)

    @property
    def avoidable(self) -> Bools | None:
        """True for worlds in which contact can be avoided, [n]; None if that is not known."""
        return self.limits.proof.avoidable

    @property
    def between(self) -> Between | None:
        """Summary of the worlds with unavoidable contact but no proven impact; None if one of both is not proven."""
        if self.avoidable is None or self.limits.proof.impact is None:
            return None
        return Between.of(~self.avoidable, self.limits.proof.impact, self.first_impact_harm, self.total_harm)

    def above_proven(self, best: Floats) -> Floats | None:
        """Return best known harm minus the proven lower bound, [n] m2/s2; None if no bound is proven."""
        return None if self.limits.proof.harm is None else best - self.limits.proof.harm


@dataclass(frozen=True, slots=True)
class Between:
    """Summary of the worlds in which contact is proven unavoidable, but an impact is not proven unavoidable."""

    rate: float  # share of all worlds
    mean_first: float | None  # mean best known first-impact harm; None if unknown in all of them
    mean_total: float | None  # mean best known total harm
    harmless_rate: float | None  # share of these worlds whose best known total harm is below NO_HARM

    @property
    def text(self) -> str:
        """Sentence about the worlds with unavoidable contact but no proven impact; empty if no such world exists."""
        if self.rate == 0.0:
            return ""
        text = f" In {100 * self.rate:.1f} % of the worlds, contact is proven unavoidable but an impact is not."
        if self.mean_first is None or self.harmless_rate is None:
            return text
        return (
            f"{text} The mean best known harm of these worlds is {self.mean_first:.2f}; in"
            f" {100 * self.harmless_rate:.0f} % of these worlds it is practically 0."
        )

    @classmethod
    def of(cls, contact: Bools, impact: Bools, first: Floats, total: Floats) -> Between:
        """Return the summary of the worlds in which ``contact`` [n] is proven unavoidable, but not ``impact`` [n].

        ``first`` and ``total`` [n] are the best known harm, m2/s2; NaN if unknown.
        """
        there = contact & ~impact
        known = there & np.isfinite(first) & np.isfinite(total)
        if not known.any():
            return cls(float(there.mean()), None, None, None)
        harmless = float((total[known] < NO_HARM).mean())
        return cls(float(there.mean()), float(first[known].mean()), float(total[known].mean()), harmless)


# Columns of ``--per-world`` on avoidability and best known harm.
KNOWN_OF_WORLDS: dict[str, Callable[[Outcome, Regrets], Values | None]] = {
    "avoidable": lambda _, r: None if r.avoidable is None else r.avoidable + 0,
    "unavoidable_reason": lambda _, r: r.limits.proof.reason,
    "best_known_first_impact_harm": lambda _, r: r.first_impact_harm,
    "best_known_total_harm": lambda _, r: r.total_harm,
    "best_known_source": lambda _, r: r.source,
    "impact_proven": lambda _, r: None if r.limits.proof.impact is None else r.limits.proof.impact + 0,
    "proven_harm": lambda _, r: r.limits.proof.harm,
    "regret_first_impact_harm": lambda o, r: r.regret(o, "first"),
    "regret_total_harm": lambda o, r: r.regret(o, "total"),
}


def limits_of(evaluation: Evaluation) -> Limits | Unproven:
    """Return what is proven about each world, and the best harm known before the agents of this evaluation drive.

    Returns ``Unproven`` if the proofs do not cover the evaluation. Warns with ``IncompleteTable`` if a table contains
    the best known harm of only some of the worlds.
    """
    return evaluation.once(_limits)


def _limits(evaluation: Evaluation) -> Limits | Unproven:
    limits = known_limits(evaluation.worlds, evaluation.task)
    if isinstance(limits, Limits) and limits.warning:
        warnings.warn(limits.warning, IncompleteTable, stacklevel=4)
    return limits


def regrets_of(evaluation: Evaluation) -> Regrets | None:
    """Return the best known harm of every world after all agents of this evaluation; None if nothing is proven."""
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
