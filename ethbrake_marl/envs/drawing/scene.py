"""One moment of one world, as plain numbers: what a picture or a text shows of it, and the stretch of road in view."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.physics import Bools, Floats, Worlds

BODY_M = 4.5  # length that vehicles are drawn with; the physics knows none
FLASH_S = 0.3  # how long an impact is shown
# Okabe and Ito's palette without its yellow (invisible on white), which colour-blind readers tell apart.
COLOURS = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_BEHIND_M, _AHEAD_M = 3.0, 5.0  # of free road in view at least
_LEAST_WIDTH_M = 40.0
_LATE_S = 3.0  # of a latency that the view makes room for


class View(NamedTuple):
    """The road in view (m from the front of Vehicle 1 at the alert), the same for a whole episode if possible."""

    left_m: float
    right_m: float


class Struck(NamedTuple):
    """An impact that is being shown."""

    pair: int  # -1: Vehicle 1 and the obstacle
    closing_mps: float
    time_s: float


class Scene(NamedTuple):
    """One world at one moment."""

    title: str  # name of the scenario
    time_s: float  # since the alert
    view: View
    front_m: Floats  # [N] front bumpers, from that of Vehicle 1 at the alert; bodies of BODY_M apart by the true gaps
    gaps_m: Floats  # [P]
    speeds_mps: Floats  # [N]
    command_mps2: Floats  # [N] in force; 0 before the latency has elapsed
    braking_mps2: Floats  # [N] capacities
    driving_mps2: Floats  # [N]
    latency_s: Floats  # [N]
    hit: Bools  # [P] pairs that have had an impact
    struck: tuple[Struck, ...]  # impacts of the last moments
    first_harm: float  # of the line so far, first impacts only (m2/s2)
    total_harm: float  # of every impact
    obstacle_m: float  # its place; infinite: there is none
    learners: tuple[int, ...]
    shield: bool | None  # whether a shield stepped in; None: there is none
    ended: bool  # the episode is over


def vehicle_colour(i: int) -> str:
    """Colour of Vehicle ``i + 1`` in every picture."""
    return COLOURS[(i + 1) % len(COLOURS)]


def first_view(alert: Worlds) -> tuple[Floats, Floats]:
    """Both ends [n] m of the road that holds each line from the alert to rest, if all brake fully as soon as they can.

    A vehicle behind that stops later is taken to push the ones ahead so far.
    """
    v, N = alert.vehicles, alert.N
    behind = np.concatenate([np.zeros((alert.n, 1)), np.cumsum(alert.gaps_m, axis=1)], axis=1)
    way = alert.speeds_mps * np.minimum(v.latency_s, _LATE_S) + alert.speeds_mps**2 / (2.0 * v.braking_capacity_mps2)
    right = np.minimum((way - behind).max(axis=1), alert.obstacle_gap_m) + _AHEAD_M
    left = -behind[:, -1] - N * BODY_M - _BEHIND_M
    return left, np.maximum(right, left + _LEAST_WIDTH_M)


def follow(view: View, front_m: Floats) -> View:
    """The view moved on, and widened where it must be, until the whole line is in it."""
    on = max(float(front_m[0]) + _AHEAD_M - view.right_m, 0.0)
    left = min(view.left_m + on, float(front_m[-1]) - BODY_M - _BEHIND_M)
    return View(left if on else min(left, view.left_m), view.right_m + on)


def fronts_of(front_m: Floats, gaps_m: Floats) -> Floats:
    """Front bumpers [k, N] of lines drawn with bodies, from those of Vehicle 1 [k] and the gaps [k, P]."""
    behind = np.cumsum(gaps_m + BODY_M, axis=1)
    return np.concatenate([front_m[:, np.newaxis], front_m[:, np.newaxis] - behind], axis=1)
