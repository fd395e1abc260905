"""The proven bounds of a list of worlds, beside the least harm known there.

*Contact proven* is not *impact proven*: in the worlds between, every command leads to contact, and it is open whether
to an impact. Either vehicles get away with leaning on each other there, or the proof is loose. The harm of the best
known profiles in these very worlds tells which: next to none, or much.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ethbrake_marl.evaluation.identity import result_identity
from ethbrake_marl.evaluation.regret import Between, between
from ethbrake_marl.harm import HARM_COUNTS
from ethbrake_marl.limits.best_harm import world_identity
from ethbrake_marl.limits.best_harm_table import BestHarmTable
from ethbrake_marl.limits.limits import Unproven, prove, unproven_because
from ethbrake_marl.limits.shipped import shipped_tables
from ethbrake_marl.physics import Floats, Ints, Worlds, leaving_out_failed
from ethbrake_marl.scenario import Task, load_scenario


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
