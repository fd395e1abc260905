"""Measures ``injury_CURVE``: expected injuries if the same impacts happened in 1,000 lines of vehicles.

Injuries are added over the vehicles, each with its largest change of speed; ``injury_CURVE_2`` counts Vehicle 2 alone.
A vehicle without an impact has no injury, even if it is pushed.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.evaluation.measures import MeasureValue
from ethbrake_marl.extensions.injuries.curves import CURVES, expected_injuries, speed_changes
from ethbrake_marl.registry import Part


class Injuries:
    def __init__(self, curve: str, game: Game, alert: State) -> None:
        self.curve, self.changes = curve, np.zeros((alert.n, 2, alert.vehicles))

    def see(self, before: State, step: Step | None, after: State) -> None:
        self.changes = np.maximum(self.changes, speed_changes(before, after))

    def result(self, last: State) -> MeasureValue:
        """Expected injuries in 1,000 lines: of the whole line, and of each vehicle, [n] each."""
        injuries = expected_injuries(self.changes, self.curve)
        return {"": injuries.sum(axis=1), **{f"{i + 1}": column for i, column in enumerate(injuries.T)}}


def _part(curve: str) -> Part:
    about, watch = CURVES[curve], partial(Injuries, curve)
    watch.__doc__ = (
        f"Expected injuries of severity {about.severity} in 1,000 lines, each vehicle with its largest change of speed."
        f" Probability at a change of dv m/s: {about.formula} ({about.source})."
    )
    return Part(watch=watch, unit="per 1,000 lines")


INJURY = {f"injury_{curve}": _part(curve) for curve in CURVES}
LR4S, REFERENCE, GIDAS = INJURY["injury_lr4s"], INJURY["injury_reference"], INJURY["injury_gidas"]
