"""The harm ledger: the harm of every vehicle, under both counting rules.

The harm of an impact of pair (i, i + 1) with closing speed ``w`` is ``w^2`` (m2/s2). It is shared by mass (the paper's
eq. harm): ``H_i = m_{i+1} / (m_i + m_{i+1}) w^2`` and ``H_{i+1} = w^2 - H_i``, so the shares add up exactly.

An impact of Vehicle 1 with an immovable obstacle ahead (``obstacle_gap_m``) has harm ``v_1^2``, all borne by Vehicle 1.

*First-impact harm* counts each pair's first impact only (the paper's rule); *total harm* counts every impact. The first
can be gamed, because a light early touch makes the later, harder impact free. So both are always kept.
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
    """Raise ``InvalidInput`` unless ``harm_count`` is ``"first"`` or ``"total"``."""
    if harm_count not in HARM_COUNTS:
        raise InvalidInput(f"harm_count {harm_count!r}: must be {' or '.join(repr(known) for known in HARM_COUNTS)}")


@dataclass(frozen=True, slots=True)
class Ledger:
    """Harm and number of impacts of ``n`` worlds since the start of the episode, by pair."""

    first_impact_harm: Floats  # [n, P] harm of each pair's first impact (m2/s2)
    total_harm: Floats  # [n, P] harm of all impacts of each pair (m2/s2)
    count: Ints  # [n, P] number of impacts
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
        """Return the ledger with the ``impacts`` of the next segment of the same episodes added."""
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
        """Return the harm that was added after ``before``, an earlier ledger of the same episodes.

        The difference is exact to the last rounding. Raises ``InvalidInput`` if ``before`` has another shape or more
        impacts, for example because a row holds a new episode.
        """
        names = [column.name for column in fields(self) if column.name not in ("mass_t", "restitution", "harm_weight")]
        if before.count.shape != self.count.shape or (before.count > self.count).any():
            raise InvalidInput("since: these are not the same worlds; ask before a row is renewed")
        return replace(self, **{name: getattr(self, name) - getattr(before, name) for name in names})

    def take(self, rows: Ints | Bools | Sequence[int]) -> Ledger:
        """Return the ledger of the worlds selected by ``rows`` (indices or a mask [n])."""
        return Ledger(*(getattr(self, column.name)[rows] for column in fields(self)))

    def pair_harm(self, harm_count: HarmCount) -> Floats:
        """Return the harm of each pair, [n, P] m2/s2: of its ``"first"`` impact, or of all impacts (``"total"``).

        Raises ``InvalidInput`` for another ``harm_count``.
        """
        check_harm_count(harm_count)
        return self.first_impact_harm if harm_count == "first" else self.total_harm

    def obstacle_harm(self, harm_count: HarmCount) -> Floats:
        """Return the harm of Vehicle 1 with the obstacle ahead, [n] m2/s2: of the ``"first"`` impact, or ``"total"``.

        Raises ``InvalidInput`` for another ``harm_count``.
        """
        check_harm_count(harm_count)
        return self.obstacle_first_harm if harm_count == "first" else self.obstacle_total_harm

    def vehicle_harm(self, harm_count: HarmCount) -> Floats:
        """Return the harm that each vehicle bears, [n, N] m2/s2: its shares (``split``) of the harm of both its pairs.

        Vehicle 1 also bears the harm with the obstacle. ``harm_count``: ``"first"`` impact of each pair, or
        ``"total"``.
        """
        harm = split(self.pair_harm(harm_count), self.mass_t)
        harm[:, 0] += self.obstacle_harm(harm_count)
        return harm

    def speed_changes(self, harm_count: HarmCount) -> tuple[Floats, Floats]:
        """Return two changes of speed of each vehicle, [n, N] m/s each: by impacts in front, and at the rear.

        They are computed from the harm of the pair, as if it came from one single impact of these two vehicles alone.
        This is exact for a first impact in which no third vehicle takes part. If ``"total"`` counts several impacts of
        a pair, the result exceeds the change in the hardest one. ``harm_count``: ``"first"`` impact of each pair, or
        ``"total"``.
        """
        with_obstacle = np.concatenate([self.obstacle_harm(harm_count)[:, np.newaxis], self.pair_harm(harm_count)], 1)
        rebound = (1.0 + self.restitution[:, np.newaxis]) * np.sqrt(with_obstacle)
        pair_mass = self.mass_t[:, :-1] + self.mass_t[:, 1:]
        front, rear = rebound, np.zeros(self.mass_t.shape)
        rear[:, :-1] = self.mass_t[:, 1:] / pair_mass * rebound[:, 1:]
        front[:, 1:] *= self.mass_t[:, :-1] / pair_mass
        return front, rear

    def world_harm(self, harm_count: HarmCount) -> Floats:
        """Return the harm of all vehicles of a world together, [n] m2/s2.

        It is summed in a fixed order: obstacle, then pairs front to rear. ``harm_count``: ``"first"`` impact of each
        pair, or ``"total"``.
        """
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
    """Return the sum over obstacle and pairs of each world, [n], in a fixed order: the same bits in any batch.

    ``pair_values`` is [n, P], ``obstacle_values`` [n]; the obstacle comes first, then the pairs front to rear.
    """
    n, pairs = pair_values.shape
    total = np.zeros(n)
    for k in range(n):
        total[k] += obstacle_values[k]
        for p in range(pairs):
            total[k] += pair_values[k, p]
    return total


def empty_ledger(worlds: Worlds) -> Ledger:
    """Return the ledger of ``worlds`` at the alert (time 0), without harm."""
    shape = worlds.gaps_m.shape
    pairs = np.zeros(shape), np.zeros(shape), np.zeros(shape, np.int64)
    of_worlds = worlds.vehicles.mass_t, worlds.vehicles.restitution, worlds.vehicles.harm_weight
    return Ledger(*pairs, *Impacts.no_obstacle(worlds.n), *of_worlds)


@compiled
def split(pair_harm: Floats, mass_t: Floats) -> Floats:
    """Share the harm of each pair between its two vehicles by mass; return the harm of each vehicle, [n, N] m2/s2.

    The lighter vehicle bears more. ``pair_harm`` is [n, P] in m2/s2, ``mass_t`` [n, N] in t.
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
    """Return the front vehicle's share of a pair's ``harm``: ``m_rear / (m_front + m_rear) harm``.

    The larger share is computed and the smaller one is the rest, an exact subtraction: the two add up to the last bit.
    Masses must have the same unit; the result has the unit of ``harm``.
    """
    if front_mass <= rear_mass:
        return rear_mass / (front_mass + rear_mass) * harm
    return harm - front_mass / (front_mass + rear_mass) * harm


@compiled
def _powers(shares: Floats, exponent: float) -> Floats:
    """Return ``x^exponent`` of each x >= 0 in ``shares`` [k], limited to 1, [k]; the same bits on every processor."""
    result = np.zeros(len(shares))
    for i in range(len(shares)):
        if shares[i] > 0.0:
            result[i] = min(exp(exponent * log(shares[i])), 1.0)
    return result


class InjuryCurve(NamedTuple):
    """Probability of an injury in a rear-end collision, as a function of the vehicle's change of speed dv (m/s)."""

    injury: str  # least severity, on the abbreviated injury scale
    formula: str  # the probability as a formula in dv
    source: str  # where the curve comes from
    front: Callable[[Floats], Floats]  # probability in the striking vehicle, which is hit in front
    rear: Callable[[Floats], Floats]  # probability in the struck vehicle, which is hit at the rear


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
    """Return the probability that a vehicle's occupant is injured in a rear-end impact, [k].

    Logistic curves give about 1 % for no change of speed; do not use them for a vehicle that was not hit.

    Args:
        speed_change_mps: change of the vehicle's speed in the impact, [k] m/s; its sign is ignored.
        side: side that is hit: ``"front"`` of the striking vehicle, ``"rear"`` of the struck one.
        curve: key of ``INJURY_CURVES``, which give formula and source.

    Raises ``UnknownName`` for another side or curve.

    """
    if curve not in INJURY_CURVES:
        raise unknown_name("injury curve", curve, INJURY_CURVES)
    if side not in ("front", "rear"):
        raise unknown_name("side", side, ("front", "rear"))
    points = INJURY_CURVES[curve]
    return (points.front if side == "front" else points.rear)(np.abs(np.asarray(speed_change_mps, np.float64)))
