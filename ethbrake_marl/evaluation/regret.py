"""The distance of each agent from the best that is known: unavoidable collisions, and regret world by world.

The least harm known is that of the limits (``limits.limits``), or what an agent of the same evaluation achieved,
whichever is less.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.evaluation.inputs import result_identity
from ethbrake_marl.evaluation.outcome import Evaluation, Outcome
from ethbrake_marl.evaluation.statistics import Estimate, mean, rate, relative_decrease
from ethbrake_marl.limits.best_harm import BestHarmTable, shipped_tables, world_identity
from ethbrake_marl.limits.limits import Limits, Unproven, prove, unproven_because
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, leaving_out_failed
from ethbrake_marl.scenario import Task, load_scenario

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
    harm, impact_rate = float(proof.harm.mean()), float(impact.mean())
    if contact is None:
        return Proven(harm, None, impact_rate, None)
    return Proven(harm, float(contact.mean()), impact_rate, between(contact, impact, first, total))


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
    head = (
        "list", "worlds", "proven", "best known, first", "gap", "best known, total", "gap", "contact proven",
        "impact proven", "between", "best known there, first", "next to none there",
    )  # fmt: skip
    return ["| " + " | ".join(head) + " |", "|" + "---|" * len(head), *(_shipped_line(one) for one in found)]


def _shipped_line(one: ShippedBounds) -> str:
    cells = [f"{one.scenario} (seed {one.list_seed})", f"{one.worlds:,}"]
    proven, inside = one.proven, None if one.proven is None else one.proven.between
    cells += [_number(None if proven is None else proven.proven_harm)]
    for best in (one.best_known_first, one.best_known_total):
        cells += [_number(best), _percent(one.gap(best))]
    cells += [_percent(rate) for rate in _rates(proven)]
    cells += [_number(None if inside is None else inside.mean_first)]
    cells += [_percent(None if inside is None else inside.harmless_rate)]
    return "| " + " | ".join(cells) + (f" | {one.nothing_proven_because}" if one.nothing_proven_because else "") + " |"


def _rates(proven: Proven | None) -> tuple[float | None, ...]:
    if proven is None:
        return (None, None, None)
    inside = proven.between
    return proven.contact_proven_rate, proven.impact_proven_rate, None if inside is None else inside.rate


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.1f} %"
