"""Measures of injury: how many injuries the impacts of 1,000 lines would cause."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Literal

import numpy as np

from ethbrake_marl.game.harm import INJURY_CURVES, injury_probability
from ethbrake_marl.game.impacts import EpisodeImpacts
from ethbrake_marl.game.measures import MeasureFunction
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.registry import Part


def _injury(curve: str, rule: Literal["", "_vehicle", "_every"]) -> MeasureFunction:
    def measure(episodes: EpisodeImpacts) -> Floats:
        rows, harm = episodes.rows, np.zeros(episodes.worlds.speeds_mps.shape)
        struck = rows.pair >= 0  # an obstacle ahead is no vehicle
        world = np.concatenate([rows.world, rows.world[struck]])
        vehicle = np.concatenate([rows.pair + 1, rows.pair[struck]])
        front, rear = np.abs(rows.rear_speed_change_mps), np.abs(rows.front_speed_change_mps[struck])
        p = np.concatenate([injury_probability(front, "front", curve), injury_probability(rear, "rear", curve)])
        if rule == "_every":
            np.add.at(harm, (world, vehicle), p)
        else:  # of several entries for one vehicle the last one stays, which is that of the largest change
            order = np.argsort(np.concatenate([front, rear]), kind="stable")
            harm[world[order], vehicle[order]] = p[order]
        return 1_000.0 * (harm if rule == "_vehicle" else harm.sum(axis=1))

    each = {
        "": "summed over the vehicles, each by its largest change of speed",
        "_vehicle": "by its largest change of speed",
        "_every": "summed over every impact, as if each met other people",
    }
    about = INJURY_CURVES[curve]
    measure.__doc__ = (
        f"Injuries of {about.injury} in 1,000 lines, {each[rule]}: {about.formula}; dv in m/s ({about.source})."
    )
    return measure


_RULES: tuple[Literal["", "_vehicle", "_every"], ...] = ("", "_vehicle", "_every")

# The injuries in 1,000 lines, by each of ``harm.INJURY_CURVES``; names of the entry points stand in pyproject.toml.
#
# ``injury_CURVE`` is the sum over the vehicles of a line, each by its largest change of speed, as the literature takes
# it; ``injury_CURVE_vehicle`` is the injuries of each; ``injury_CURVE_every`` sums over every impact, as if each met
# other people. A vehicle that was not hit has none, nor has one pushed by a vehicle that touches it already.
INJURY = {
    f"injury_{curve}{rule}": Part(_injury(curve, rule), unit="per 1,000 lines")
    for curve in INJURY_CURVES
    for rule in _RULES
}

ONE = SimpleNamespace(**INJURY)  # ``ONE.injury_lr4s``: an entry point cannot name what stands in a mapping
