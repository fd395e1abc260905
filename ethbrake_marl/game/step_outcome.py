"""``StepOutcome``: the result of one step, and the paper's reward terms that are computed from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ethbrake_marl.physics.elementary import logistic
from ethbrake_marl.physics.state import Bools, Floats, Ints


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """Result of one step in n worlds of N vehicles (P pairs): the input of measures by step. Do not change it.

    Vehicles are counted from 0, the front one.
    """

    first_impact_harm: Floats  # [n] harm of the line's first impacts (of each pair) in this step, m2/s2
    total_harm: Floats  # [n] harm of all impacts of the line in this step, m2/s2
    safe_end: Bools  # [n] whether the episode ended with this step without any collision
    gaps_m: Floats  # [n, P] gaps after the step, m
    speeds_mps: Floats  # [n, N] speeds after the step, m/s
    command_mps2: Floats  # [n, N] acceleration in force after the step, m/s2
    previous_mps2: Floats  # [n, N] acceleration in force before the step, m/s2
    time_step_s: float  # time between two decisions, s
    time_s: Floats  # [n] time since the alert, after the step, s
    braking_capacity_mps2: Floats  # [n, N] largest deceleration, m/s2
    driving_capacity_mps2: Floats  # [n, N] largest forward acceleration, m/s2
    latency_s: Floats  # [n, N] time before which commands have no effect, s
    mass_t: Floats  # [n, N] mass, t
    learners: Ints  # [L] indices of the vehicles that learn, or that an evaluated agent controls

    def protect(self) -> None:
        """Make the arrays of this object read-only."""
        for name in StepOutcome.__slots__:
            if isinstance(array := getattr(self, name), np.ndarray):
                array.flags.writeable = False


def collision(step: StepOutcome, k_energy: float) -> Floats:
    """Return the collision term of a reward, [n]: minus ``k_energy`` times the harm of every impact of the step."""
    return -k_energy * step.total_harm


def jerk(step: StepOutcome) -> Floats:
    """Return the jerk term of a reward, [n, N]: minus the squared rate of change of each command (m2/s6)."""
    rate = (step.command_mps2 - step.previous_mps2) / step.time_step_s
    return -rate * rate


def risk(
    step: StepOutcome, ttc_scale_s: float, safety_buffer_m: float, target_gap_m: float, distance_slope_per_m: float
) -> Floats:
    """Return the risk term of a reward, [n, N]: minus how near and how soon a collision of each vehicle's pairs is.

    Each pair contributes 0 to 2: ``sigma(-TTC / tau) + sigma(k_d (d_target - d))``, sigma the logistic function.

    Args:
        step: the step.
        ttc_scale_s: tau, time to collision at which the first part falls, s.
        safety_buffer_m: distance that the time to collision TTC keeps free, m.
        target_gap_m: d_target, gap below which the second part rises, m.
        distance_slope_per_m: k_d, steepness of the second part, 1/m.

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
