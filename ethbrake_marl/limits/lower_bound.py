"""A proven lower bound on the harm of every world, whatever the controlled vehicle does.

Three bounds, each proven in docs/avoidability.md, under both counting rules and with velocity exchange, bounces and
pushing as the physics has them:

* front pair alone: the closing speed of full braking, since a push from behind only makes it worse;
* rear pair alone: the closing speed of full drive;
* both together, where contact is unavoidable: whichever neighbour is met first, whenever and however softly, what
  follows at the other one is bounded by the motion of the centre of mass.

To these comes what has happened, for certain, before the vehicle may act.

The proofs are about exact arithmetic; the bound and the harm that it is compared with are made of doubles. So every
part is rounded outward: lowered by ``rounding``, more than both can be off together.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount, check_harm_count, empty_ledger
from ethbrake_marl.limits.avoidability import Avoidability, avoidability
from ethbrake_marl.limits.lower_bound_kernel import BOUNDS, COMBINED_BOUND, FRONT_BOUND, REAR_BOUND, bound_worlds
from ethbrake_marl.limits.meetings import (
    A_F,
    A_L,
    A_R,
    FRONT_SHARE,
    GAP_L,
    GAP_R,
    LIMIT_F,
    OBSTACLE,
    ONSET_R,
    REAR_SHARE,
    RESTITUTION,
    TIME_STEP,
    U_F,
    V_F,
    V_L,
    V_R,
    WIDTH,
)
from ethbrake_marl.physics import Bools, Floats, Worlds, advance
from ethbrake_marl.physics.compiled import by_parts

EPS = 2.0**-52  # the spacing of doubles at 1
# Bounds are lowered by so many eps of the squared speeds that a world can hold: a segment or a round of impacts moves a
# squared closing speed by at most 8 eps of these, and an episode has up to 500 of them.
BOUND_EPS = 2.0**12

LEAST_TIME_STEP_S = 1e-3  # between decisions: work grows as they come closer
_LEAST_PART = 100  # worlds of a thread: fewer are done before another one has begun


@dataclass(frozen=True, slots=True)
class LowerBound:
    """What is proven about each world [n], in m2/s2."""

    harm: Floats  # no profile does less harm than this
    early: Floats  # done before the controlled vehicle may act
    front_pair: Floats  # of the front pair alone, from then on
    rear_pair: Floats  # of the rear pair alone
    combined: Floats  # of both together; 0 where nothing is proven
    contact: Avoidability  # the verdict on contact that the bound of both together rests on

    @property
    def impact_proven(self) -> Bools:
        """Whether every profile has an impact, [n]; elsewhere none is proven, which need not mean that one can."""
        yes: Bools = self.harm > 0.0
        return yes


def lower_bound(
    worlds: Worlds,
    vehicle: int = 1,
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    scripts: Mapping[int, str] | None = None,
    time_step_s: float | None = None,
) -> LowerBound:
    """Proven lower bound on the harm from now to ``horizon_s`` (absolute), over all commands of ``vehicle``.

    ``harm = early + max(front_pair + rear_pair, combined)``, each part rounded outward (``rounding``). The combined
    bound is 0 where contact can be avoided. What may come only after the horizon counts as 0, and so does the next
    impact of a pair that was hit before where ``harm_count`` is "first".

    With ``time_step_s`` it is proven only for commands that change at decisions, the first one when the vehicle may
    act, one every ``time_step_s`` after it: what every agent drives. That is sharper, and takes ten times as long.

    Covers the same lines as ``avoidability``, and raises ``InvalidInput`` for others, for an unknown ``harm_count``, a
    time step below ``LEAST_TIME_STEP_S``, and a horizon that is not finite or lies before the vehicle may act.
    """
    check_asked("lower_bound", harm_count, horizon_s, time_step_s)
    verdict = avoidability(worlds, vehicle, scripts=scripts)
    start = np.maximum(worlds.vehicles.latency_s[:, vehicle], worlds.time_s)
    if not (np.all(start <= horizon_s) and horizon_s < np.inf):
        raise InvalidInput(f"lower_bound: horizon_s {horizon_s!r}: must be finite and at least {start.max():g} s")
    at_onset, impacts = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=start)
    early = empty_ledger(worlds).add(impacts).world_harm(harm_count)
    counts = ~at_onset.pair_hit if harm_count == "first" else np.ones_like(at_onset.pair_hit)
    forward = at_onset.speeds_mps >= 0.0
    open_pair = counts & forward[:, 1:] & forward[:, :-1]
    none = np.zeros(worlds.n, dtype=np.bool_)
    has_front = open_pair[:, vehicle - 1] if vehicle > 0 else none
    has_rear = open_pair[:, vehicle] if vehicle < worlds.N - 1 else none
    struck = at_onset.obstacle_hit & (harm_count == "first")  # whoever is pushed there is not charged for it again
    unavoidable = has_front & has_rear & (verdict.reason >= 2) & ~struck
    out = np.empty((worlds.n, BOUNDS))
    given: tuple[Any, ...] = (
        onset_states(at_onset, vehicle, time_step_s),
        horizon_s - start,
        has_front,
        has_rear,
        unavoidable,
        out,
    )
    threads = min(os.cpu_count() or 1, worlds.n // _LEAST_PART + 1)
    by_parts(lambda part: bound_worlds(*(array[part] for array in given)), worlds.n, threads)
    parts = (early, *(out[:, column] for column in (FRONT_BOUND, REAR_BOUND, COMBINED_BOUND)))
    early, front, rear, combined = (np.maximum(part - rounding(worlds, vehicle), 0.0) for part in parts)
    return LowerBound(early + np.maximum(front + rear, combined), early, front, rear, combined, verdict)


def check_asked(where: str, harm_count: str, horizon_s: object, time_step_s: object) -> None:
    """Raise ``InvalidInput`` for an unknown count, a horizon that is no number, or a time step that cannot be."""
    check_harm_count(harm_count)
    if not _is_number(horizon_s):
        raise InvalidInput(f"{where}: horizon_s {horizon_s!r}: must be a number of seconds")
    if time_step_s is not None and not (_is_number(time_step_s) and LEAST_TIME_STEP_S <= time_step_s < np.inf):  # type: ignore[operator]  # a number
        raise InvalidInput(
            f"{where}: time_step_s {time_step_s!r}: must be a number of seconds from {LEAST_TIME_STEP_S:g} on, or None"
        )


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def rounding(worlds: Worlds, vehicle: int) -> Floats:
    """How far arithmetic can move a bound and a realised harm apart, at most; [n] m2/s2.

    A squared closing speed is ``D = w^2 + 2 b g``. With ``V`` the largest speed in the line, ``G`` its gaps, ``A`` the
    largest closing acceleration and ``a`` the weakest brakes, every ``w^2`` is at most ``V^2`` and no gap grows beyond
    ``G + V^2 / 2a``, so all terms of D stay below ``S = V^2 (1 + A / a) + 2 A G``. A segment of motion rounds each
    speed twice and each gap five times, a round of impacts each speed by ``CLUSTER_EPS``: either moves D by at most
    8 eps S. These add up and are not multiplied, for the proofs compare a run with itself, not with another one.
    ``BOUND_EPS`` grants 500 of them; the steps of an episode of 8 s are 80, and the bound's own arithmetic, a few
    hundred roundings, is among them too.
    """
    v = worlds.vehicles
    drives = v.driving_capacity_mps2[:, vehicle] > 0.0
    fastest = np.maximum(worlds.speeds_mps.max(axis=1), np.where(drives, v.speed_limit_mps[:, vehicle], 0.0))
    closing = v.braking_capacity_mps2.max(axis=1) + v.driving_capacity_mps2[:, vehicle]
    weakest = v.braking_capacity_mps2.min(axis=1)
    scale = fastest * fastest * (1.0 + closing / weakest) + 2.0 * closing * worlds.gaps_m.sum(axis=1)
    outward: Floats = BOUND_EPS * EPS * scale
    return outward


def onset_states(worlds: Worlds, i: int, time_step_s: float | Floats | None) -> Floats:
    """The worlds, in which vehicle ``i`` may act, as the compiled bounds take them [n, WIDTH] (``limits.meetings``).

    Columns of a neighbour that is not there stay 0, as does the time step where there is none.
    """
    v = worlds.vehicles
    at = np.zeros((worlds.n, WIDTH))
    columns = {
        V_F: worlds.speeds_mps[:, i],
        A_F: v.braking_capacity_mps2[:, i],
        U_F: v.driving_capacity_mps2[:, i],
        LIMIT_F: v.speed_limit_mps[:, i],
        RESTITUTION: v.restitution,
        OBSTACLE: worlds.obstacle_gap_m if i == 1 else np.inf,
        TIME_STEP: 0.0 if time_step_s is None else time_step_s,
    }
    if i > 0:
        columns[GAP_L] = worlds.gaps_m[:, i - 1]
        columns[V_L] = worlds.speeds_mps[:, i - 1]
        columns[A_L] = v.braking_capacity_mps2[:, i - 1]
        columns[FRONT_SHARE] = v.mass_t[:, i - 1] / (v.mass_t[:, i - 1] + v.mass_t[:, i])
    if i < worlds.N - 1:
        columns[GAP_R] = worlds.gaps_m[:, i]
        columns[V_R] = worlds.speeds_mps[:, i + 1]
        columns[A_R] = v.braking_capacity_mps2[:, i + 1]
        columns[ONSET_R] = np.maximum(v.latency_s[:, i + 1] - worlds.time_s, 0.0)
        columns[REAR_SHARE] = v.mass_t[:, i + 1] / (v.mass_t[:, i + 1] + v.mass_t[:, i])
    for column, values in columns.items():
        at[:, column] = values
    return at
