"""The harm ledger: who was hurt how much, under both counting rules.

Harm of an impact of pair (i, i + 1) with closing speed ``w`` is ``w^2`` (m2/s2), shared by mass (the paper's
eq. harm): ``H_i = m_{i+1} / (m_i + m_{i+1}) w^2`` and ``H_{i+1} = w^2 - H_i``, so the shares add up exactly.

An impact of Vehicle 1 with an obstacle ahead (``obstacle_gap_m``), which nothing moves, does harm ``v_1^2``, all to
Vehicle 1.

*First-impact harm* counts each pair's first impact only (the paper's protocol); *total harm* counts every impact.
The first can be gamed (a light early touch makes the later, harder impact free), so both are always kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of, unknown_name
from ethbrake_marl.physics.elementary import exp, log, logistic
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.physics.left_out import Impacts
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds

HarmCount = Literal["first", "total"]

HARM_COUNTS: tuple[HarmCount, ...] = get_args(HarmCount)


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
    restitution: Floats  # [n]

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
            self.restitution,
        )

    def since(self, before: Ledger) -> Ledger:
        """What came to the same worlds after ``before``, as the harm of one step, to the last rounding.

        Raises ``InvalidInput`` where there were more worlds, vehicles or impacts before, as in a row that was renewed.
        """
        names = [column.name for column in fields(self) if column.name not in ("mass_t", "restitution")]
        if before.count.shape != self.count.shape or (before.count > self.count).any():
            raise InvalidInput("since: these are not the same worlds; ask before a row is renewed")
        return replace(self, **{name: getattr(self, name) - getattr(before, name) for name in names})

    def take(self, rows: Ints | Bools | Sequence[int]) -> Ledger:
        """That of some of the worlds."""
        return Ledger(*(getattr(self, column.name)[rows] for column in fields(self)))

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

    def speed_changes(self, harm_count: HarmCount) -> tuple[Floats, Floats]:
        """Change of speed of each vehicle, hit in front and at the rear, each [n, N] (m/s).

        That of the one impact between two vehicles which does the counted harm of their pair: exact for first impacts
        of one pair at a time; of several impacts of a pair, counted by ``total``, more than the hardest one had.
        """
        with_obstacle = np.concatenate([self.obstacle_harm(harm_count)[:, np.newaxis], self.pair_harm(harm_count)], 1)
        rebound = (1.0 + self.restitution[:, np.newaxis]) * np.sqrt(with_obstacle)
        pair_mass = self.mass_t[:, :-1] + self.mass_t[:, 1:]
        front, rear = rebound, np.zeros(self.mass_t.shape)
        rear[:, :-1] = self.mass_t[:, 1:] / pair_mass * rebound[:, 1:]
        front[:, 1:] *= self.mass_t[:, :-1] / pair_mass
        return front, rear

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
    of_worlds = worlds.vehicles.mass_t, worlds.vehicles.restitution
    return Ledger(*pairs, *Impacts.no_obstacle(worlds.n), *of_worlds)


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


@compiled
def _powers(shares: Floats, exponent: float) -> Floats:
    """``x^exponent`` of each of ``shares`` [k] from 0 on, at most 1; the same bits on every processor."""
    found = np.zeros(len(shares))
    for i in range(len(shares)):
        if shares[i] > 0.0:
            found[i] = min(exp(exponent * log(shares[i])), 1.0)
    return found


class InjuryCurve(NamedTuple):
    """Probability of an injury in a rear-end collision from the change of speed dv (m/s) of the vehicle."""

    injury: str  # at least this one, of the abbreviated injury scale
    formula: str
    source: str
    front: Callable[[Floats], Floats]  # of the striking vehicle, which is hit in front
    rear: Callable[[Floats], Floats]  # of the struck one


_GEISSLINGER = "Geisslinger, Poszler and Lienkamp 2023, doi:10.1038/s42256-022-00607-z, parameters of its code"

INJURY_CURVES = {
    "lr4s": InjuryCurve(
        "MAIS3+", "1 / (1 + exp(4.457 - 0.177 dv - c)), c = 0 in front, -0.431 at the rear", _GEISSLINGER,
        lambda dv: logistic(-4.457 + 0.177 * dv), lambda dv: logistic(-4.888 + 0.177 * dv),
    ),
    "reference": InjuryCurve(
        "MAIS3+", "(dv / s)^1.531, at most 1, s = 51.287 m/s in front, 66.956 m/s at the rear", _GEISSLINGER,
        lambda dv: _powers(dv / 51.287, 1.531), lambda dv: _powers(dv / 66.956, 1.531),
    ),
    "gidas": InjuryCurve(
        "MAIS2+", "1 / (1 + exp(5.820 - 0.292 dv))", "GIDAS, as the same code has it",
        lambda dv: logistic(-5.820 + 0.292 * dv), lambda dv: logistic(-5.820 + 0.292 * dv),
    ),
}  # fmt: skip


def injury_probability(speed_change_mps: Floats, side: Literal["front", "rear"], curve: str = "lr4s") -> Floats:
    """Probability of an injury of one vehicle's occupant from its change of speed in a rear-end impact, [k].

    ``side`` is the one that is hit: the front of the striking vehicle, the rear of the struck one. ``curve`` is one of
    ``INJURY_CURVES``, whose entries tell formula and source. Logistic curves give about 1 % at 0: of a vehicle that was
    not hit there is no probability.
    """
    if curve not in INJURY_CURVES:
        raise unknown_name("injury curve", curve, INJURY_CURVES)
    if side not in ("front", "rear"):
        raise unknown_name("side", side, ("front", "rear"))
    found = INJURY_CURVES[curve]
    return (found.front if side == "front" else found.rear)(np.abs(np.asarray(speed_change_mps, np.float64)))
