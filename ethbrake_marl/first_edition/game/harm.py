"""The harm ledger: a record of the harm of each pair of vehicles, as first-impact harm and as total harm.

The harm of an impact of pair (i, i + 1) with closing speed ``w`` is ``w^2`` (m2/s2). The two vehicles, with masses
``m_i`` and ``m_{i+1}``, bear this harm in inverse proportion to their masses (the paper's eq. harm):
``H_i = w^2 * m_{i+1} / (m_i + m_{i+1})`` and ``H_{i+1} = w^2 - H_i``.

An impact of Vehicle 1 with an immovable obstacle ahead has the harm ``v_1^2``, where ``v_1`` is the speed of Vehicle 1.
Vehicle 1 bears all of this harm.

*First-impact harm* counts only the first impact of each pair, as the paper does. *Total harm* counts every impact. An
agent can exploit first-impact harm: after a light early impact, a harder impact of the same pair costs nothing. The
argument ``harm_count`` of several functions selects the harm: ``"first"`` or ``"total"``; any other value raises
``InvalidInput``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of, unknown_name
from ethbrake_marl.first_edition.physics.elementary import exp, log, logistic
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds

HarmCount = Literal["first", "total"]

HARM_COUNTS: tuple[HarmCount, ...] = get_args(HarmCount)


def check_harm_count(harm_count: str) -> None:
    """Raise ``InvalidInput`` unless ``harm_count`` is ``"first"`` or ``"total"``."""
    if harm_count not in HARM_COUNTS:
        raise InvalidInput(f"harm_count = {harm_count!r}: must be {' or '.join(repr(known) for known in HARM_COUNTS)}")


@dataclass(frozen=True, slots=True)
class Ledger:
    """Harm and number of impacts of each pair of vehicles since the start of the episode, in ``n`` worlds."""

    first_impact_harm: Floats  # [n, P] harm of each pair's first impact (m2/s2)
    total_harm: Floats  # [n, P] harm of all impacts of each pair (m2/s2)
    count: Ints  # [n, P] number of impacts of each pair
    obstacle_first_harm: Floats  # [n] first-impact harm of Vehicle 1 with the obstacle ahead (m2/s2)
    obstacle_total_harm: Floats  # [n] total harm of Vehicle 1 with the obstacle (m2/s2)
    obstacle_count: Ints  # [n] number of impacts with the obstacle
    mass_t: Floats  # [n, N] mass of each vehicle (t)
    restitution: Floats  # [n] coefficient of restitution
    harm_weight: Floats  # [n, N] weight of each vehicle's harm in the objective ``preference``

    def __repr__(self) -> str:
        return (
            f"Ledger({count_of(len(self.mass_t), 'world')}, {self.count.sum() + self.obstacle_count.sum():,} impacts)"
        )

    def add(self, impacts: Impacts) -> Ledger:
        """Return the sum of this ledger and ``impacts``, the impacts of the same episodes in the next time interval."""
        return Ledger(
            self.first_impact_harm + impacts.first_impact_harm,
            self.total_harm + impacts.total_harm,
            self.count + impacts.count,
            self.obstacle_first_harm + impacts.obstacle_first_harm,
            self.obstacle_total_harm + impacts.obstacle_total_harm,
            self.obstacle_count + impacts.obstacle_count,
            self.mass_t,
            self.restitution,
            self.harm_weight,
        )

    def since(self, before: Ledger) -> Ledger:
        """Return the harm and impacts since ``before``, an earlier ledger of the same episodes.

        Raises ``InvalidInput`` if ``before`` has another shape or more impacts than this ledger, for example because a
        new episode has begun in one of the worlds.
        """
        names = [column.name for column in fields(self) if column.name not in ("mass_t", "restitution", "harm_weight")]
        if before.count.shape != self.count.shape or (before.count > self.count).any():
            raise InvalidInput(
                "since: the argument before must be an earlier ledger (record of harm) of the same episodes; call since"
                " before a new episode begins"
            )
        return replace(self, **{name: getattr(self, name) - getattr(before, name) for name in names})

    def take(self, rows: Ints | Bools | Sequence[int]) -> Ledger:
        """Return a ledger of only the worlds ``rows`` (indices, or a mask [n])."""
        return Ledger(*(getattr(self, column.name)[rows] for column in fields(self)))

    def pair_harm(self, harm_count: HarmCount) -> Floats:
        """Return the harm of each pair of vehicles, [n, P] m2/s2."""
        check_harm_count(harm_count)
        return self.first_impact_harm if harm_count == "first" else self.total_harm

    def obstacle_harm(self, harm_count: HarmCount) -> Floats:
        """Return the harm of impacts of Vehicle 1 with the obstacle ahead, [n] m2/s2."""
        check_harm_count(harm_count)
        return self.obstacle_first_harm if harm_count == "first" else self.obstacle_total_harm

    def vehicle_harm(self, harm_count: HarmCount) -> Floats:
        """Return the harm that each vehicle bears, [n, N] m2/s2: its parts (``split``) of the harm of its pairs.

        Vehicle 1 also bears the harm of impacts with the obstacle.
        """
        harm = split(self.pair_harm(harm_count), self.mass_t)
        harm[:, 0] += self.obstacle_harm(harm_count)
        return harm

    def speed_changes(self, harm_count: HarmCount) -> tuple[Floats, Floats]:
        """Return two arrays: each vehicle's change of speed by impacts at its front, and at its rear, [n, N] m/s each.

        The changes of speed are computed from each pair's harm, as if a single impact of the pair had caused all of its
        harm. The result is exact for a first impact in which no third vehicle takes part. If the harm comes from
        several impacts of the pair, the result is larger than the change of speed in the hardest impact.
        """
        with_obstacle = np.concatenate([self.obstacle_harm(harm_count)[:, np.newaxis], self.pair_harm(harm_count)], 1)
        rebound = (1.0 + self.restitution[:, np.newaxis]) * np.sqrt(with_obstacle)
        pair_mass = self.mass_t[:, :-1] + self.mass_t[:, 1:]
        front, rear = rebound, np.zeros(self.mass_t.shape)
        rear[:, :-1] = self.mass_t[:, 1:] / pair_mass * rebound[:, 1:]
        front[:, 1:] *= self.mass_t[:, :-1] / pair_mass
        return front, rear

    def world_harm(self, harm_count: HarmCount) -> Floats:
        """Return the harm of each world, summed over the obstacle and all pairs (``line_sum``), [n] m2/s2."""
        return line_sum(self.pair_harm(harm_count), self.obstacle_harm(harm_count))

    @property
    def impacts(self) -> Ints:
        """Number of impacts in each world, between vehicles and with the obstacle, [n]."""
        number: Ints = self.count.sum(axis=1) + self.obstacle_count
        return number

    @property
    def collided(self) -> Bools:
        """Whether each world has had at least one impact, [n]."""
        return self.impacts > 0


@compiled
def line_sum(pair_values: Floats, obstacle_values: Floats) -> Floats:
    """Return the sum of ``obstacle_values`` [n] and all pairs of ``pair_values`` [n, P] in each world, [n].

    The order of summation is fixed: first the obstacle, then the pairs from front to rear. This order makes the sum of
    a world independent of the other worlds, to the last bit.
    """
    n, pairs = pair_values.shape
    total = np.zeros(n)
    for k in range(n):
        total[k] += obstacle_values[k]
        for p in range(pairs):
            total[k] += pair_values[k, p]
    return total


def empty_ledger(worlds: Worlds) -> Ledger:
    """Return a ledger for ``worlds`` without any harm or impact."""
    shape = worlds.gaps_m.shape
    pairs = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.int64)
    of_worlds = worlds.vehicles.mass_t, worlds.vehicles.restitution, worlds.vehicles.harm_weight
    return Ledger(*pairs, *Impacts.no_obstacle(worlds.n), *of_worlds)


@compiled
def split(pair_harm: Floats, mass_t: Floats) -> Floats:
    """Divide the harm of each pair between its two vehicles; return the harm that each vehicle bears, [n, N] m2/s2.

    The lighter vehicle of a pair bears the larger part. ``pair_harm`` is the harm of each pair, [n, P] m2/s2.
    """
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
    """Return the part of a pair's ``harm`` that the front vehicle bears:
    ``harm * rear_mass / (front_mass + rear_mass)``.

    If the rear vehicle bears the larger part, the function computes the rear vehicle's part and subtracts it from
    ``harm``. The subtraction is exact, so the parts of the two vehicles add up to ``harm`` without rounding error. The
    two masses must have the same unit. The result has the unit of ``harm``.
    """
    if front_mass <= rear_mass:
        return rear_mass / (front_mass + rear_mass) * harm
    return harm - front_mass / (front_mass + rear_mass) * harm


@compiled
def _powers(shares: Floats, exponent: float) -> Floats:
    """Return ``min(x^exponent, 1)`` for each x >= 0 in ``shares``, [k]; every processor computes the same bits."""
    result = np.zeros(len(shares))
    for i in range(len(shares)):
        if shares[i] > 0.0:
            result[i] = min(exp(exponent * log(shares[i])), 1.0)
    return result


class InjuryCurve(NamedTuple):
    """Probability of an injury in a rear-end impact, as a function of the vehicle's change of speed dv (m/s)."""

    injury: str  # least severity of the injury, on the abbreviated injury scale
    formula: str  # formula of the probability in terms of dv
    source: str  # publication that the curve is taken from
    front: Callable[[Floats], Floats]  # probability in the striking vehicle, which is hit at its front
    rear: Callable[[Floats], Floats]  # probability in the struck vehicle, which is hit at its rear


_GEISSLINGER = "Geisslinger, Poszler and Lienkamp 2023, doi:10.1038/s42256-022-00607-z, parameters of its code"

INJURY_CURVES = {
    "lr4s": InjuryCurve(
        "MAIS3+", "1 / (1 + exp(4.457 - 0.177 dv - c)), with c = 0 if the front is hit, c = -0.431 if the rear is hit",
        _GEISSLINGER,
        lambda dv: logistic(-4.457 + 0.177 * dv), lambda dv: logistic(-4.888 + 0.177 * dv),
    ),
    "reference": InjuryCurve(
        "MAIS3+",
        "min((dv / s)^1.531, 1), with s = 51.287 m/s if the front is hit, s = 66.956 m/s if the rear is hit",
        _GEISSLINGER,
        lambda dv: _powers(dv / 51.287, 1.531), lambda dv: _powers(dv / 66.956, 1.531),
    ),
    "gidas": InjuryCurve(
        "MAIS2+", "1 / (1 + exp(5.820 - 0.292 dv))", "GIDAS, from the code of Geisslinger et al. 2023",
        lambda dv: logistic(-5.820 + 0.292 * dv), lambda dv: logistic(-5.820 + 0.292 * dv),
    ),
}  # fmt: skip


def injury_probability(speed_change_mps: Floats, side: Literal["front", "rear"], curve: str = "lr4s") -> Floats:
    """Return the probability that an occupant of a vehicle is injured in a rear-end impact, for k impacts, [k].

    For the logistic curves ``lr4s`` and ``gidas`` this probability is above 0 even if the change of speed is 0, so do
    not use them for a vehicle that was not hit.

    ``speed_change_mps`` is the change of the vehicle's speed in each impact, [k] m/s; the sign is ignored. ``side`` is
    the side at which the vehicle is hit: ``"front"`` for the striking vehicle, ``"rear"`` for the struck vehicle.
    ``curve`` is a key of ``INJURY_CURVES``. Raises ``UnknownName`` for an unknown side or curve.
    """
    if curve not in INJURY_CURVES:
        raise unknown_name("injury curve", curve, INJURY_CURVES)
    if side not in ("front", "rear"):
        raise unknown_name("side", side, ("front", "rear"))
    points = INJURY_CURVES[curve]
    return (points.front if side == "front" else points.rear)(np.abs(np.asarray(speed_change_mps, np.float64)))
