"""``StepOutcome``, the result of one step, and the paper's reward terms that are computed from a step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ethbrake_marl.first_edition.physics.elementary import logistic
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """Result of one step in n worlds of N vehicles (P pairs), from which measures can be computed.

    Do not change the arrays of this object. Column 0 belongs to the front vehicle in arrays [n, N], and to the front
    vehicle and the vehicle behind it in arrays [n, P].
    """

    first_impact_harm: Floats  # [n] first-impact harm of the line in this step, m2/s2
    total_harm: Floats  # [n] total harm of the line in this step, m2/s2
    safe_end: Bools  # [n] whether the episode ended with this step without any collision
    gaps_m: Floats  # [n, P] gaps after the step, m
    speeds_mps: Floats  # [n, N] speeds after the step, m/s
    command_mps2: Floats  # [n, N] acceleration in force after the step, m/s2
    previous_mps2: Floats  # [n, N] acceleration in force before the step, m/s2
    time_step_s: float  # time between two decisions, s
    time_s: Floats  # [n] time since the alert, after the step, s
    braking_capacity_mps2: Floats  # [n, N] largest deceleration of each vehicle, m/s2
    driving_capacity_mps2: Floats  # [n, N] largest forward acceleration of each vehicle, m/s2
    latency_s: Floats  # [n, N] time from the alert until commands take effect, s
    mass_t: Floats  # [n, N] mass of each vehicle, t
    learners: Ints  # [L] indices of the learners; in an evaluation, of the controlled vehicles

    def protect(self) -> None:
        """Make the arrays of this object read-only."""
        for name in StepOutcome.__slots__:
            if isinstance(array := getattr(self, name), np.ndarray):
                array.flags.writeable = False


def collision(step: StepOutcome, k_energy: float) -> Floats:
    """Return the collision term of a reward, [n] m2/s2: minus ``k_energy`` times the total harm of the step."""
    return -k_energy * step.total_harm


def jerk(step: StepOutcome) -> Floats:
    """Return the jerk term of a reward, [n, N] m2/s6: minus the squared rate of change of a vehicle's acceleration."""
    rate = (step.command_mps2 - step.previous_mps2) / step.time_step_s
    return -rate * rate


def risk(
    step: StepOutcome, ttc_scale_s: float, safety_buffer_m: float, target_gap_m: float, distance_slope_per_m: float
) -> Floats:
    """Return the risk term of a reward, [n, N]: minus the sum of the collision risks of each vehicle's pairs.

    The risk of a pair is ``sigma(-TTC / tau) + sigma(k_d (d_target - d))``, where sigma is the logistic function, d the
    gap and TTC the time to collision: ``TTC = max(d - d_safe, 0) / closing speed``. If the vehicles of the pair do not
    approach each other, the first summand of the risk is 0.

    The arguments are tau (``ttc_scale_s``, s), d_safe (``safety_buffer_m``, m), d_target (``target_gap_m``, m) and k_d
    (``distance_slope_per_m``, 1/m). At the gap d_target the second summand is 1/2.
    """
    closing = step.speeds_mps[:, 1:] - step.speeds_mps[:, :-1]
    room = np.maximum(step.gaps_m - safety_buffer_m, 0.0)
    approaching = closing > 0.0
    time_to_collision = room / np.where(approaching, closing, 1.0)
    urgency = np.where(approaching, logistic(-time_to_collision / ttc_scale_s), 0.0)
    nearness = logistic(distance_slope_per_m * (target_gap_m - step.gaps_m))
    pair_risk = -(urgency + nearness)
    total = np.zeros(step.speeds_mps.shape)
    total[:, :-1] += pair_risk
    total[:, 1:] += pair_risk
    return total
