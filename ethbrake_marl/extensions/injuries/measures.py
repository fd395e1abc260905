"""Measures ``delta_v_mps`` and ``injury_CURVE``: changes of speed, and expected injuries in 1,000 lines of vehicles.

``injury`` is the curve ``reference``, the only one without injuries at a change of 0: a logistic curve mostly counts
impacts where these are gentle. Levels of different curves cannot be compared: their severities and data differ.

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


class Changes:
    """Largest change of each vehicle's speed by one impact at its front, and at its rear (a ``Watch``)."""

    def __init__(self, game: Game, alert: State) -> None:
        self.changes = np.zeros((alert.n, 2, alert.vehicles))

    def see(self, before: State, step: Step | None, after: State) -> None:
        self.changes = np.maximum(self.changes, speed_changes(before, after))

    def result(self, last: State) -> MeasureValue:
        """Largest change of speed in the line, and of each vehicle, [n] m/s each."""
        largest = self.changes.max(axis=1)
        return {"": largest.max(axis=1), **{f"{i + 1}": column for i, column in enumerate(largest.T)}}


def delta_v_mps(game: Game, alert: State) -> Changes:
    """Largest change of speed (delta-v) by one impact. Without a number: in the line; with a number: of this vehicle.
    A push is no impact.
    """
    return Changes(game, alert)


class Injuries(Changes):
    def __init__(self, curve: str, game: Game, alert: State) -> None:
        super().__init__(game, alert)
        self.curve = curve

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


DELTA_V = Part(watch=delta_v_mps, unit="m/s")
LR4S, REFERENCE, GIDAS = (_part(curve) for curve in ("lr4s", "reference", "gidas"))
INJURY = {"injury_reference": REFERENCE}  # the measures that ``injury`` stands for
