"""``StepOutcome``: what one step brought, and the paper's reward terms that are computed from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ethbrake_marl.physics.elementary import logistic
from ethbrake_marl.physics.state import Bools, Floats, Ints


@dataclass(frozen=True, slots=True)
class StepOutcome:
    """What measures by step are computed from, for n worlds of N vehicles (P pairs); read it, do not change it.

    Vehicles are counted from 0, the front one.
    """

    first_impact_harm: Floats  # [n] of the whole line in this step, m2/s2
    total_harm: Floats  # [n] likewise, every impact counted
    safe_end: Bools  # [n] the episode ended with this step without any collision
    gaps_m: Floats  # [n, P] after the step
    speeds_mps: Floats  # [n, N] after the step
    command_mps2: Floats  # [n, N] in force after the step
    previous_mps2: Floats  # [n, N] in force before it
    time_step_s: float
    time_s: Floats  # [n] since the alert, after the step
    braking_capacity_mps2: Floats  # [n, N] largest deceleration
    driving_capacity_mps2: Floats  # [n, N] largest forward acceleration
    latency_s: Floats  # [n, N] from when on commands take effect
    mass_t: Floats  # [n, N]
    learners: Ints  # [L] the vehicles that learn, or that an evaluated agent controls

    def protect(self) -> None:
        """Make its arrays read-only."""
        for name in StepOutcome.__slots__:
            if isinstance(array := getattr(self, name), np.ndarray):
                array.flags.writeable = False


def collision(step: StepOutcome, k_energy: float) -> Floats:
    """Minus the energy of every impact of the step, [n]."""
    return -k_energy * step.total_harm


def jerk(step: StepOutcome) -> Floats:
    """Minus the squared rate of change of each command, [n, N]."""
    rate = (step.command_mps2 - step.previous_mps2) / step.time_step_s
    return -rate * rate


def risk(
    step: StepOutcome, ttc_scale_s: float, safety_buffer_m: float, target_gap_m: float, distance_slope_per_m: float
) -> Floats:
    """Minus how near and how soon a collision of each vehicle's own pairs is, [n, N]."""
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
