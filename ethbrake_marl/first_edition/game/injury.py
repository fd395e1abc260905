"""Measures of injury: how many injuries would be expected if the same impacts happened in 1,000 lines of vehicles."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Literal

import numpy as np

from ethbrake_marl.first_edition.game.harm import INJURY_CURVES, injury_probability
from ethbrake_marl.first_edition.game.impacts import EpisodeImpacts
from ethbrake_marl.first_edition.game.measures import MeasureFunction
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.registry import Part


def _injury(curve: str, rule: Literal["", "_vehicle", "_every"]) -> MeasureFunction:
    def measure(episodes: EpisodeImpacts) -> Floats:
        rows, harm = episodes.rows, np.zeros(episodes.worlds.speeds_mps.shape)
        struck = rows.pair >= 0  # False for an impact with an obstacle
        world = np.concatenate([rows.world, rows.world[struck]])
        vehicle = np.concatenate([rows.pair + 1, rows.pair[struck]])
        front, rear = np.abs(rows.rear_speed_change_mps), np.abs(rows.front_speed_change_mps[struck])
        p = np.concatenate([injury_probability(front, "front", curve), injury_probability(rear, "rear", curve)])
        if rule == "_every":
            np.add.at(harm, (world, vehicle), p)
        else:  # the last assignment to a vehicle counts; it has the largest change of speed
            order = np.argsort(np.concatenate([front, rear]), kind="stable")
            harm[world[order], vehicle[order]] = p[order]
        return 1_000.0 * (harm if rule == "_vehicle" else harm.sum(axis=1))

    each = {
        "": "summed over the vehicles, each with its largest change of speed",
        "_vehicle": "for each vehicle, with its largest change of speed",
        "_every": "summed over all impacts, as if each impact affected different people",
    }
    about = INJURY_CURVES[curve]
    measure.__doc__ = (
        f"Expected injuries of severity {about.injury} in 1,000 lines, {each[rule]}. Probability of an injury at a"
        f" change of speed of dv m/s: {about.formula} ({about.source})."
    )
    return measure


_RULES: tuple[Literal["", "_vehicle", "_every"], ...] = ("", "_vehicle", "_every")

# Expected injuries in 1,000 lines, for each of ``harm.INJURY_CURVES``. The entry points are listed in pyproject.toml.
#
# ``injury_CURVE`` sums over the vehicles of a line, each with its largest change of speed, as in the literature.
# ``injury_CURVE_vehicle`` has one number per vehicle. ``injury_CURVE_every`` sums over all impacts, as if each impact
# affected different people. A vehicle without an impact has no injuries, even if a vehicle in contact pushes it.
INJURY = {
    f"injury_{curve}{rule}": Part(_injury(curve, rule), unit="per 1,000 lines")
    for curve in INJURY_CURVES
    for rule in _RULES
}

ONE = SimpleNamespace(**INJURY)  # an entry point can name an attribute, such as ``ONE.injury_lr4s``, but not a key
