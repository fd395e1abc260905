"""Measured errors of an impact, in units of the published tolerances' ``eps``; sums in extended precision."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.physics import Floats, Impacts, Worlds
from ethbrake_marl.physics.kernel import BOUND
from tests.reference.tolerances import EPS

Wide = np.longdouble


def rounds(impacts: Impacts) -> Floats:
    """How many rounds of impacts each world had at one instant, at least 1, [n]."""
    return np.maximum(impacts.count.max(axis=1), 1).astype(np.float64)


def momentum_eps(before: Worlds, after: Worlds) -> Floats:
    """Change of momentum in eps of ``sum m max(|v|, |v+|)``, [n]."""
    mass = before.vehicles.mass_t.astype(Wide)
    change = mass * (after.speeds_mps.astype(Wide) - before.speeds_mps)
    scale = mass * np.maximum(np.abs(before.speeds_mps), np.abs(after.speeds_mps))
    return np.asarray(np.abs(change.sum(axis=1)) / scale.sum(axis=1) / EPS, np.float64)


def energy_rise_eps(before: Worlds, after: Worlds) -> Floats:
    """Rise of kinetic energy (over ground) in eps of the energy before, [n]; negative where energy was lost."""
    mass = before.vehicles.mass_t.astype(Wide)
    was = (mass * before.speeds_mps.astype(Wide) ** 2).sum(axis=1)
    now = (mass * after.speeds_mps.astype(Wide) ** 2).sum(axis=1)
    return np.asarray((now - was) / np.where(was > 0, was, 1) / EPS, np.float64)


def restitution_eps(before: Worlds, after: Worlds) -> Floats:
    """Two vehicles: error of the speed at which they separate, in eps of the larger speed, for those that met, [k]."""
    front, rear = before.speeds_mps[:, 0].astype(Wide), before.speeds_mps[:, 1].astype(Wide)
    closing = rear - front
    e = np.where(closing >= BOUND.PLASTIC_SPEED_MPS, before.vehicles.restitution, 0.0)
    separation = after.speeds_mps[:, 0].astype(Wide) - after.speeds_mps[:, 1]
    largest = np.maximum(np.abs(before.speeds_mps).max(axis=1), np.abs(after.speeds_mps).max(axis=1))
    met = (closing > 0) & (before.gaps_m[:, 0] == 0.0)
    return np.asarray((np.abs(separation - e * closing) / largest / EPS)[met], np.float64)
