"""Expected number of injuries if the same impacts happened in 1,000 lines of vehicles."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ethbrake_marl.episode.objectives import Harm
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.record import simulate_again
from ethbrake_marl.motion.elementary import exp_each, log_each, logistic
from ethbrake_marl.motion.layout import FRONT_CHANGE, IMPACTS, MASS, REAR_CHANGE, RESTITUTION, Floats
from ethbrake_marl.registry import Part


class InjuryCurve(NamedTuple):
    """Probability of an injury in a rear-end impact, as a function of the vehicle's change of speed dv (m/s)."""

    severity: str  # on the abbreviated injury scale
    formula: str
    source: str
    front: Callable[[Floats], Floats]  # in the striking vehicle, which is hit at its front
    rear: Callable[[Floats], Floats]  # in the struck vehicle


def _power(share: Floats) -> Floats:
    """``min(share^1.531, 1)``, with the same bits on every processor."""
    positive = share > 0.0
    return np.where(positive, np.minimum(exp_each(1.531 * log_each(np.where(positive, share, 1.0))), 1.0), 0.0)


_GEISSLINGER = "Geisslinger, Poszler and Lienkamp 2023, doi:10.1038/s42256-022-00607-z, parameters of its code"
CURVES = {
    "lr4s": InjuryCurve(
        "MAIS3+", "1 / (1 + exp(4.457 - 0.177 dv - c)), with c = 0 if the front is hit, c = -0.431 if the rear is hit",
        _GEISSLINGER, lambda dv: logistic(-4.457 + 0.177 * dv), lambda dv: logistic(-4.888 + 0.177 * dv),
    ),
    "reference": InjuryCurve(
        "MAIS3+", "min((dv / s)^1.531, 1), with s = 51.287 m/s if the front is hit, s = 66.956 m/s if the rear is hit",
        _GEISSLINGER, lambda dv: _power(dv / 51.287), lambda dv: _power(dv / 66.956),
    ),
    "gidas": InjuryCurve(
        "MAIS2+", "1 / (1 + exp(5.820 - 0.292 dv))", "GIDAS, from the code of Geisslinger et al. 2023",
        lambda dv: logistic(-5.820 + 0.292 * dv), lambda dv: logistic(-5.820 + 0.292 * dv),
    ),
}  # fmt: skip


def risks(changes: Floats, curve: str) -> Floats:
    """Probability of an injury in each vehicle by an impact at its front, and at its rear, [n, 2, N]; 0 if not hit.

    ``changes`` [n, 2, N]: change of speed by each (m/s). ``curve``: a name in ``CURVES``.
    """
    side_risks = [CURVES[curve].front(changes[:, 0].copy()), CURVES[curve].rear(changes[:, 1].copy())]
    return np.where(changes > 0.0, np.stack(side_risks, axis=1), 0.0)


def expected_injuries_by_harm(harm: Harm, vehicle: int, curve: str) -> Floats:
    """Expected injuries in 1,000 lines, [n], as if a single impact had done the whole harm of each pair.

    Of two sides the larger risk counts. Exact for first impacts of two vehicles, too large if several impacts add up.
    """
    rebound = (1.0 + harm.car[:, RESTITUTION, :-1]) * np.sqrt(harm.pairs[:, :-1])
    mass = harm.car[:, MASS, 1:]
    pair_mass = mass[:, :-1] + mass[:, 1:]
    changes = np.stack([rebound, np.zeros(mass.shape)], axis=1)  # front, rear
    changes[:, 1, :-1] = mass[:, 1:] / pair_mass * rebound[:, 1:]
    changes[:, 0, 1:] *= mass[:, :-1] / pair_mass
    return np.asarray(np.cumsum(1_000.0 * risks(changes, curve).max(axis=1), axis=1)[:, -1])


def speed_changes(before: State, after: State) -> Floats:
    """Largest change of each vehicle's speed by one impact at its front, and at its rear, [n, 2, N] m/s.

    There must be no decision between the two states. Pushing in contact is not an impact.
    """
    out = np.zeros((after.n, 2, after.vehicles))
    struck = np.asarray((after.line[:, IMPACTS] > before.line[:, IMPACTS]).any(axis=1))
    for k, scratch in simulate_again(before, after, struck):
        out[k] = scratch[[FRONT_CHANGE, REAR_CHANGE], 1:]
    return out


def expected_injuries(changes: Floats, curve: str) -> Floats:
    """Expected injuries of each vehicle in 1,000 lines, [n, N]; the larger ``changes`` [n, 2, N] (m/s) counts."""
    front, rear = np.moveaxis(risks(changes, curve), 1, 0)
    return np.asarray(1_000.0 * np.where(changes[:, 1] >= changes[:, 0], rear, front))


INJURY_OBJECTIVE = Part(expected_injuries_by_harm, arguments=tuple(CURVES))
