"""The distance of each agent from the best that is known: unavoidable collisions, and regret world by world.

The least harm known is that of the limits (``limits.limits``), or what an agent of the same evaluation achieved,
whichever is less.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.evaluation.outcome import Evaluation, Outcome
from ethbrake_marl.evaluation.statistics import Estimate, mean, rate, relative_decrease
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.limits.limits import Limits, Unproven
from ethbrake_marl.physics import Bools, Floats

NO_HARM = 1e-3  # m2/s2: nobody is hurt by 0.03 m/s
TOLERANCE = 1e-6  # m2/s2; less than this below the best known harm is rounding
Source = Literal["witness", "table", "agents", "below_table"]


@dataclass(frozen=True, slots=True)
class Regrets:
    """The limits after all agents of one evaluation drove, [n] each."""

    limits: Limits
    first_impact_harm: Floats  # best known, the agents of this evaluation among them (m2/s2)
    total_harm: Floats
    source: NDArray[np.str_]  # where these come from; see ``Source``

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


@dataclass(frozen=True, slots=True)
class Between:
    """The worlds with proven contact in which no impact is proven, and the least harm known there (m2/s2)."""

    rate: float  # share of all worlds
    mean_first: float | None  # None where there is no such world, or the least harm of none of them is known
    mean_total: float | None
    harmless_rate: float | None  # share of them whose best known total harm is below 1e-3


@dataclass(frozen=True, slots=True)
class Distance:
    """One agent's summary: what was avoidable, and how far it stayed from the best known; all None if unknown."""

    unavoidable_rate: Estimate | None = None  # worlds without any command that avoids contact, whoever drives
    impact_proven_rate: Estimate | None = None  # worlds without any command that avoids an impact
    between: Between | None = None  # the worlds in which contact is proven and no impact
    avoidable_collision_rate: Estimate | None = None  # worlds that collided and need not have
    best_known_first: Estimate | None = None  # mean best known harm (m2/s2)
    best_known_total: Estimate | None = None
    proven_harm: Estimate | None = None  # mean harm that no command undercuts (m2/s2)
    gap_first: Estimate | None = None  # mean best known harm above the proven one (m2/s2)
    gap_total: Estimate | None = None
    regret_first: Estimate | None = None  # mean harm above the best known (m2/s2)
    regret_total: Estimate | None = None
    realised_first: Estimate | None = None  # (full_brake - agent) / (full_brake - best known)
    realised_total: Estimate | None = None
    known_best_share: float | None = None  # worlds whose best is known without the agents of this evaluation
    below_best_known: int | None = None  # worlds in which the agent is below it
    warning: str = ""  # a table holds some of the worlds, and not the others

    def estimates(self) -> dict[str, Estimate | None]:
        """The estimates by their names in JSON; ``mean_regret`` and ``realised_share`` are of first-impact harm."""
        return {
            "unavoidable_rate": self.unavoidable_rate,
            "impact_proven_rate": self.impact_proven_rate,
            "avoidable_collision_rate": self.avoidable_collision_rate,
            "best_known_first_impact_harm": self.best_known_first,
            "best_known_total_harm": self.best_known_total,
            "proven_harm": self.proven_harm,
            "best_known_minus_proven_first": self.gap_first,
            "best_known_minus_proven_total": self.gap_total,
            "mean_regret": self.regret_first,
            "mean_regret_first": self.regret_first,
            "mean_regret_total": self.regret_total,
            "realised_share": self.realised_first,
            "realised_share_first": self.realised_first,
            "realised_share_total": self.realised_total,
        }


def between(contact: Bools, impact: Bools, first: Floats, total: Floats) -> Between:
    """The worlds between the two proofs; ``first`` and ``total`` [n] are the least harms known, NaN where none is."""
    there = contact & ~impact
    known = there & np.isfinite(first) & np.isfinite(total)
    if not known.any():
        return Between(float(there.mean()), None, None, None)
    harmless = float((total[known] < NO_HARM).mean())
    return Between(float(there.mean()), float(first[known].mean()), float(total[known].mean()), harmless)


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


def distance(regrets: Regrets | None, outcome: Outcome, full_brake: Outcome | None) -> Distance:
    """One agent's distance to the best known, against ``full_brake`` in the same worlds.

    ``1 - regret / regret of full braking`` is the share of the achievable reduction of harm that the agent realised; it
    is None without full braking, when that has no regret, or when the best of some world is not known beforehand.
    """
    if regrets is None:
        return Distance()
    limits = regrets.limits
    avoidable, known, proven, certain = limits.proof.avoidable, limits.known, limits.proof.harm, limits.proof.impact
    worlds = len(known)
    first, total = regrets.regret(outcome, "first"), regrets.regret(outcome, "total")
    reference = full_brake if bool(known.all()) else None
    return Distance(
        unavoidable_rate=None if avoidable is None else rate(int((~avoidable).sum()), worlds),
        impact_proven_rate=rate(int(certain.sum()), worlds),
        between=None
        if avoidable is None
        else between(~avoidable, certain, regrets.first_impact_harm, regrets.total_harm),
        avoidable_collision_rate=None if avoidable is None else rate(int((outcome.collided & avoidable).sum()), worlds),
        best_known_first=mean(regrets.first_impact_harm),
        best_known_total=mean(regrets.total_harm),
        proven_harm=mean(proven),
        gap_first=mean(regrets.first_impact_harm - proven),
        gap_total=mean(regrets.total_harm - proven),
        regret_first=mean(first),
        regret_total=mean(total),
        realised_first=relative_decrease(first, regrets.regret(reference, "first")) if reference else None,
        realised_total=relative_decrease(total, regrets.regret(reference, "total")) if reference else None,
        known_best_share=float(known.mean()),
        below_best_known=int(regrets.below(outcome).sum()),
        warning=limits.warning,
    )
