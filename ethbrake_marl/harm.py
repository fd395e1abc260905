"""The harm ledger: who was hurt how much, under both counting rules.

Harm of an impact of pair (i, i + 1) with closing speed ``w`` is ``w^2`` (m2/s2), shared by mass (the paper's
eq. harm): ``H_i = m_{i+1} / (m_i + m_{i+1}) w^2`` and ``H_{i+1} = w^2 - H_i``, so the shares add up exactly.

An impact of Vehicle 1 with an obstacle ahead (``obstacle_gap_m``), which nothing moves, does harm ``v_1^2``, all to
Vehicle 1.

*First-impact harm* counts each pair's first impact only (the paper's protocol); *total harm* counts every impact.
The first can be gamed (a light early touch makes the later, harder impact free), so both are always kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ethbrake_marl.defaults import HARM_COUNTS as HARM_COUNTS
from ethbrake_marl.defaults import HarmCount as HarmCount
from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.physics.advance import Impacts, no_obstacle_harm
from ethbrake_marl.physics.compiled import compiled
from ethbrake_marl.physics.elementary import logistic
from ethbrake_marl.physics.worlds import Bools, Floats, Ints, Worlds

_INJURY_SLOPE = 0.177  # per m/s of speed change
_INJURY_OFFSET = {"front": -4.457, "rear": -4.888}  # side of the car that is hit


def check_harm_count(harm_count: str) -> None:
    """Refuse a name that is not a counting rule with ``InvalidInput``."""
    if harm_count not in HARM_COUNTS:
        raise InvalidInput(f"harm_count {harm_count!r}: must be {' or '.join(repr(known) for known in HARM_COUNTS)}")


@dataclass(frozen=True, slots=True)
class Ledger:
    """Harm of ``n`` worlds so far, by pair."""

    first_impact_harm: Floats  # [n, P] m2/s2
    total_harm: Floats  # [n, P] m2/s2
    count: Ints  # [n, P] impacts
    obstacle_first_harm: Floats  # [n] of Vehicle 1's impacts with the obstacle ahead, all its own (m2/s2)
    obstacle_total_harm: Floats  # [n] likewise
    obstacle_count: Ints  # [n] impacts
    mass_t: Floats  # [n, N]

    def __repr__(self) -> str:
        return (
            f"Ledger({count_of(len(self.mass_t), 'world')}, {self.count.sum() + self.obstacle_count.sum():,} impacts)"
        )

    def add(self, impacts: Impacts) -> Ledger:
        """The ledger after a further segment."""
        return Ledger(
            self.first_impact_harm + impacts.first_impact_harm,
            self.total_harm + impacts.total_harm,
            self.count + impacts.count,
            self.obstacle_first_harm + impacts.obstacle_first_harm,
            self.obstacle_total_harm + impacts.obstacle_total_harm,
            self.obstacle_count + impacts.obstacle_count,
            self.mass_t,
        )

    def pair_harm(self, harm_count: HarmCount) -> Floats:
        """Harm of each pair under a counting rule, [n, P]. Raises ``InvalidInput`` for an unknown one."""
        check_harm_count(harm_count)
        return self.first_impact_harm if harm_count == "first" else self.total_harm

    def obstacle_harm(self, harm_count: HarmCount) -> Floats:
        """Harm of Vehicle 1's impacts with the obstacle ahead, [n]. Raises ``InvalidInput`` for an unknown rule."""
        check_harm_count(harm_count)
        return self.obstacle_first_harm if harm_count == "first" else self.obstacle_total_harm

    def vehicle_harm(self, harm_count: HarmCount) -> Floats:
        """Harm of each vehicle, from both its pairs, [n, N]; see ``split``. That of an obstacle is all Vehicle 1's."""
        harm = split(self.pair_harm(harm_count), self.mass_t)
        harm[:, 0] += self.obstacle_harm(harm_count)
        return harm

    def world_harm(self, harm_count: HarmCount) -> Floats:
        """Harm of all vehicles of a world together, [n]: the obstacle's, then the pairs' front to rear."""
        return line_sum(self.pair_harm(harm_count), self.obstacle_harm(harm_count))

    @property
    def impacts(self) -> Ints:
        """Number of impacts of all pairs and with the obstacle, [n]."""
        number: Ints = self.count.sum(axis=1) + self.obstacle_count
        return number

    @property
    def collided(self) -> Bools:
        """Whether any impact happened, [n]."""
        return self.impacts > 0


@compiled
def line_sum(pair_values: Floats, obstacle_values: Floats) -> Floats:
    """Sum of a world's obstacle and its pairs, [n], in this order, front to rear: the same bits in any batch."""
    n, pairs = pair_values.shape
    total = np.zeros(n)
    for k in range(n):
        total[k] += obstacle_values[k]
        for p in range(pairs):
            total[k] += pair_values[k, p]
    return total


def empty_ledger(worlds: Worlds) -> Ledger:
    """The ledger at the alert: no harm yet."""
    shape = worlds.gaps_m.shape
    pairs = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.int64)
    return Ledger(*pairs, *no_obstacle_harm(worlds.n), worlds.vehicles.mass_t)


@compiled
def split(pair_harm: Floats, mass_t: Floats) -> Floats:
    """Share each pair's harm [n, P] between its two vehicles by mass (the lighter one bears more), [n, N]."""
    n, vehicles = mass_t.shape
    harm = np.zeros((n, vehicles))
    for k in range(n):
        for p in range(vehicles - 1):
            front = front_share(pair_harm[k, p], mass_t[k, p], mass_t[k, p + 1])
            harm[k, p] += front
            harm[k, p + 1] += pair_harm[k, p] - front
    return harm


@compiled
def front_share(harm: float, front_mass: float, rear_mass: float) -> float:
    """What the front vehicle of a pair bears: ``m_rear / (m_front + m_rear) harm``.

    The larger share is computed and the smaller one is the rest, an exact subtraction: the two add up to the last bit.
    """
    if front_mass <= rear_mass:
        return rear_mass / (front_mass + rear_mass) * harm
    return harm - front_mass / (front_mass + rear_mass) * harm


def injury_probability(speed_change_mps: Floats, side: Literal["front", "rear"]) -> Floats:
    """Probability of a severe injury (MAIS3+) in a rear-end collision from one occupant's change of speed.

    ``P = 1 / (1 + exp(-c0 - c1 dv))`` with c1 = 0.177 per m/s and c0 = -4.457 where the car is hit in front
    (the striking car), -4.888 at its rear (the struck car). Source: Geisslinger et al. 2023.
    """
    dv = np.abs(speed_change_mps)
    return logistic(_INJURY_OFFSET[side] + _INJURY_SLOPE * dv)
