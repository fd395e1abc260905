"""What all lower bounds share: the state in which the controlled vehicle may act, and how much rounding can matter."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.proofs.avoidability import Avoidability
from ethbrake_marl.extensions.proofs.line import LINE
from ethbrake_marl.first_edition.game.harm import HarmCount, check_harm_count, empty_ledger
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds

EPS = 2.0**-52  # the spacing of doubles at 1

# Bounds are lowered by this many EPS times the largest squared speed of a world. A segment of motion or a round of
# impacts changes a squared closing speed by at most 8 EPS of this, and an episode has at most 500 of them.
BOUND_EPS = 2.0**12

LEAST_TIME_STEP_S = 1e-3  # shortest time between decisions; shorter steps would take too long

LEAST_PART = 100  # smallest number of worlds for which another thread is started


@dataclass(frozen=True, slots=True)
class LowerBound:
    """Proven lower bounds on the harm of each world; every array is [n], in m2/s2."""

    harm: Floats  # lower bound on the harm: no command does less
    early: Floats  # harm before the controlled vehicle may act
    front_pair: Floats  # bound on the harm of the front pair alone, after the early harm
    rear_pair: Floats  # bound on the harm of the rear pair alone, after the early harm
    combined: Floats  # bound on the harm of both pairs together; 0 if nothing is proven
    contact: Avoidability  # verdict on avoidable contact, which the combined bound uses

    @property
    def impact_proven(self) -> Bools:
        """Boolean mask [n]: True for worlds in which every command of the controlled vehicle certainly leads to an
        impact.

        False means that no impact is proven; an impact may be unavoidable nevertheless.
        """
        return np.asarray(self.harm > 0.0, np.bool_)


def at_onset_of(
    worlds: Worlds, vehicle: int, harm_count: HarmCount, horizon_s: float
) -> tuple[Worlds, Floats, Floats, Bools]:
    """Simulate worlds until the *start*, the moment when the controlled ``vehicle`` may act.

    Returns the worlds at the start, the time of the start ([n], s after the alert), the harm before the start ([n],
    m2/s2), and a boolean mask [n, P]. The mask is True for each pair whose next impact counts and whose vehicles move
    forward. Raises ``InvalidInput`` if the horizon is not finite, or lies before the vehicle may act.
    """
    start = np.maximum(worlds.vehicles.latency_s[:, vehicle], worlds.time_s)
    if not (np.all(start <= horizon_s) and horizon_s < np.inf):
        raise InvalidInput(
            f"lower_bound: horizon_s = {horizon_s!r}: the horizon must be finite and at least {start.max():g} s; by"
            " then the controlled vehicle may act in every world"
        )
    now, impacts = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=start)
    early = empty_ledger(worlds).add(impacts).world_harm(harm_count)
    forward = now.speeds_mps >= 0.0
    counts = (~now.pair_hit if harm_count == "first" else True) & forward[:, 1:] & forward[:, :-1]
    return now, start, early, counts


def check_asked(harm_count: str, horizon_s: object, time_step_s: object) -> None:
    """Raise ``InvalidInput`` for an unknown harm count, a horizon that is not a number, or a time step that is neither
    None nor a finite number of at least ``LEAST_TIME_STEP_S``.
    """
    check_harm_count(harm_count)
    if not _is_number(horizon_s):
        raise InvalidInput(f"lower_bound: horizon_s = {horizon_s!r}: the horizon must be a number (time in s)")
    if time_step_s is not None and not (_is_number(time_step_s) and LEAST_TIME_STEP_S <= time_step_s < np.inf):  # type: ignore[operator]  # a number
        raise InvalidInput(
            f"lower_bound: time_step_s = {time_step_s!r}: must be a finite number of at least"
            f" {LEAST_TIME_STEP_S:g} (time in s), or None"
        )


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def rounding(worlds: Worlds, vehicle: int) -> Floats:
    """Return the largest difference between a bound and the simulated harm that floating-point rounding can cause, [n]
    m2/s2.

    A squared closing speed is ``D = w^2 + 2 b g``, with closing speed w, closing acceleration b and gap g. Let ``V`` be
    the largest speed in the line, ``G`` the sum of its gaps, ``A`` the largest closing acceleration and ``a`` the
    weakest brakes. The term ``w^2`` of D is at most ``V^2``. No gap grows beyond ``G + V^2 / (2 a)``. Therefore all
    terms of D stay below ``S = V^2 (1 + A / a) + 2 A G``.

    In a segment of motion, the computation rounds each speed twice and each gap five times. In a round of impacts,
    rounding changes each speed by up to 8 eps of the largest speed. Rounding in one segment, or in one round of
    impacts, changes D by at most 8 eps S (eps = 2^-52). These errors add up and do not multiply, because the proofs
    compare a motion only with the formulas for this same motion. ``BOUND_EPS`` allows for 500 segments and rounds of
    impacts. This number is enough: an episode of 8 s has 80 steps, and the computation of the bound itself rounds a few
    hundred times.

    If the controlled vehicle may drive, the largest speed V is at least its speed limit, and the largest closing
    acceleration A includes its driving capacity.
    """
    v = worlds.vehicles
    driving = v.driving_capacity_mps2[:, vehicle]
    limits = np.where(driving > 0.0, v.speed_limit_mps[:, vehicle], 0.0)
    fastest = np.maximum(worlds.speeds_mps.max(axis=1), limits)
    closing = v.braking_capacity_mps2.max(axis=1) + driving
    weakest = v.braking_capacity_mps2.min(axis=1)
    scale = fastest * fastest * (1.0 + closing / weakest) + 2.0 * closing * worlds.gaps_m.sum(axis=1)
    return np.asarray(BOUND_EPS * EPS * scale, np.float64)


def onset_states(worlds: Worlds, i: int, time_step_s: float | None) -> Floats:
    """Return the worlds as an array with the columns of ``line.LINE``, [n, LINE.WIDTH].

    The worlds are in their state at the moment when the controlled vehicle ``i`` may act. If this vehicle has no front
    or no rear vehicle, the columns of this neighbour are 0. ``time_step_s`` is the time between two decisions, s;
    None: commands may change at any time.
    """
    v = worlds.vehicles
    at = np.zeros((worlds.n, LINE.WIDTH))
    columns: dict[int, Floats | float] = {
        LINE.V_F: worlds.speeds_mps[:, i],
        LINE.A_F: v.braking_capacity_mps2[:, i],
        LINE.U_F: v.driving_capacity_mps2[:, i],
        LINE.LIMIT_F: v.speed_limit_mps[:, i],
        LINE.RESTITUTION: v.restitution,
        LINE.TIME_STEP: 0.0 if time_step_s is None else time_step_s,
    }
    if i > 0:
        columns |= {
            LINE.GAP_L: worlds.gaps_m[:, i - 1],
            LINE.V_L: worlds.speeds_mps[:, i - 1],
            LINE.A_L: v.braking_capacity_mps2[:, i - 1],
            LINE.FRONT_SHARE: v.mass_t[:, i - 1] / (v.mass_t[:, i - 1] + v.mass_t[:, i]),
        }
    if i < worlds.N - 1:
        columns |= {
            LINE.GAP_R: worlds.gaps_m[:, i],
            LINE.V_R: worlds.speeds_mps[:, i + 1],
            LINE.A_R: v.braking_capacity_mps2[:, i + 1],
            LINE.ONSET_R: np.maximum(v.latency_s[:, i + 1] - worlds.time_s, 0.0),
            LINE.REAR_SHARE: v.mass_t[:, i + 1] / (v.mass_t[:, i + 1] + v.mass_t[:, i]),
        }
    for column, values in columns.items():
        at[:, column] = values
    return at
