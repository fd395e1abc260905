"""Injuries that would be expected if the same impacts happened in 1,000 lines of vehicles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import unknown_name
from ethbrake_marl.motion.drive import drive
from ethbrake_marl.motion.elementary import exp_each, log_each, logistic
from ethbrake_marl.motion.layout import COUNT, FRONT_CHANGE, MASS, REAR_CHANGE, RESTITUTION, Floats, scratch_for


class Curve(NamedTuple):
    """Probability of an injury in a rear-end impact, as a function of the vehicle's change of speed dv (m/s)."""

    severity: str  # on the abbreviated injury scale
    formula: str
    source: str
    front: Callable[[Floats], Floats]  # in the striking vehicle, which is hit at its front
    rear: Callable[[Floats], Floats]  # in the struck vehicle


def _power(share: Floats) -> Floats:
    """Return ``min(share^1.531, 1)``, with the same bits on every processor."""
    positive = share > 0.0
    return np.where(positive, np.minimum(exp_each(1.531 * log_each(np.where(positive, share, 1.0))), 1.0), 0.0)


_GEISSLINGER = "Geisslinger, Poszler and Lienkamp 2023, doi:10.1038/s42256-022-00607-z, parameters of its code"
CURVES = {
    "lr4s": Curve(
        "MAIS3+", "1 / (1 + exp(4.457 - 0.177 dv - c)), with c = 0 if the front is hit, c = -0.431 if the rear is hit",
        _GEISSLINGER, lambda dv: logistic(-4.457 + 0.177 * dv), lambda dv: logistic(-4.888 + 0.177 * dv),
    ),
    "reference": Curve(
        "MAIS3+", "min((dv / s)^1.531, 1), with s = 51.287 m/s if the front is hit, s = 66.956 m/s if the rear is hit",
        _GEISSLINGER, lambda dv: _power(dv / 51.287), lambda dv: _power(dv / 66.956),
    ),
    "gidas": Curve(
        "MAIS2+", "1 / (1 + exp(5.820 - 0.292 dv))", "GIDAS, from the code of Geisslinger et al. 2023",
        lambda dv: logistic(-5.820 + 0.292 * dv), lambda dv: logistic(-5.820 + 0.292 * dv),
    ),
}  # fmt: skip


def injury_probability(speed_change_mps: Floats, side: Literal["front", "rear"], curve: str = "lr4s") -> Floats:
    """Return the probability of an injury in impacts that change a vehicle's speed by ``speed_change_mps`` (m/s).

    ``side`` is where it is hit. At a change of 0 the logistic curves are above 0: do not ask for a vehicle that was not
    hit. Raises ``UnknownName``.
    """
    if curve not in CURVES:
        raise unknown_name("injury curve", curve, CURVES)
    if side not in ("front", "rear"):
        raise unknown_name("side", side, ("front", "rear"))
    return getattr(CURVES[curve], side)(np.abs(np.asarray(speed_change_mps, np.float64)))


def injured_by_harm(pairs: Floats, car: Floats, curve: str) -> Floats:
    """Return expected injuries in 1,000 lines, [n], as if one impact had done each pair's harm [n, N + 1] (m2/s2).

    A vehicle that is hit on both sides counts with the larger of its two risks. Exact for first impacts of two
    vehicles; too large where several impacts of a pair add up.
    """
    rebound = (1.0 + car[:, RESTITUTION, :-1]) * np.sqrt(pairs[:, :-1])
    mass = car[:, MASS, 1:]
    both = mass[:, :-1] + mass[:, 1:]
    front, rear = rebound.copy(), np.zeros(mass.shape)
    rear[:, :-1] = mass[:, 1:] / both * rebound[:, 1:]
    front[:, 1:] *= mass[:, :-1] / both
    injured = np.zeros(len(front))
    for j in range(front.shape[1]):
        by_front = np.where(front[:, j] > 0.0, injury_probability(front[:, j], "front", curve), 0.0)
        by_rear = np.where(rear[:, j] > 0.0, injury_probability(rear[:, j], "rear", curve), 0.0)
        injured = injured + 1_000.0 * np.maximum(by_front, by_rear)
    return injured


def speed_changes(before: State, after: State) -> Floats:
    """Return each vehicle's largest change of speed by one impact between two states, at its front and rear.

    [n, 2, N] m/s. No decision lies between the states. A push by a vehicle in contact is no impact.
    """
    out, scratch = np.zeros((after.n, 2, after.vehicles)), scratch_for(after.vehicles + 1)
    for k in np.flatnonzero((after.line[:, COUNT] > before.line[:, COUNT]).any(axis=1)):
        line, car, wanted = (array[k].copy() for array in (before.line, before.car, after.wanted))
        drive(line, car, wanted, scratch, before.time_s[k], after.time_s[k])
        out[k] = scratch[[FRONT_CHANGE, REAR_CHANGE], 1:]
    return out


def injured(changes: Floats, curve: str) -> Floats:
    """Return expected injuries of each vehicle in 1,000 lines, [n, N], from its largest changes [n, 2, N] (m/s).

    The side with the larger change counts.
    """
    front, rear = changes[:, 0].ravel(), changes[:, 1].ravel()
    by_front, by_rear = injury_probability(front, "front", curve), injury_probability(rear, "rear", curve)
    probability = np.where(rear >= front, by_rear, by_front) * ((front > 0.0) | (rear > 0.0))
    return 1_000.0 * probability.reshape(changes.shape[0], changes.shape[2])
