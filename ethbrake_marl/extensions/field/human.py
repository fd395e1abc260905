"""The agent ``human``: a driver who sees late, brakes as hard as what was seen makes necessary, and lets go again.

The model is ours, because published car-following models first widen a short gap. Its parts are published: the reaction
time, the response to a difference of speed, to what is expected instead of what is seen late (Treiber, Kesting and
Helbing 2006, doi:10.1016/j.physa.2005.05.001), and the growth of the deceleration.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.layer import MESSAGES, check_seen
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.field.controllers import (
    LEAST_GAP_M,
    SAME_S,
    Controller,
    KnownMotion,
    read_parameters,
    step_of,
    within_capacities,
)
from ethbrake_marl.motion.elementary import exp_each, log, normal_quantile_each
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.registry import Part

CREEPING_MPS = 1.0  # a slower driver behind a standing vehicle brakes to rest with this number of m/s2
LONGEST_SDS = 3.0  # standard deviations above the mean: the longest reaction time
DEFAULTS = {
    "reaction": 1.21, "sd": 0.63,  # s; unalerted drivers behind brake lights ("Radar-measured reaction times ...")
    "sensitivity": 0.37,  # 1/s; Chandler, Herman and Montroll 1958, doi:10.1287/opre.6.2.165
    "reach": 30.0,  # m; beyond, the sensitivity falls as 1 / gap; ours
    "margin": 2.0,  # m; that of UN R157's fuzzy model
    "foresight": 0.75,  # share of the seen speed that is expected to be lost meanwhile, at most; ours
    "jerk": 12.65,  # m/s3; UN R157's driver
}  # fmt: skip


class Sight(NamedTuple):
    """Memory of one driver in n worlds."""

    reaction_s: Floats  # [n] reaction time
    alert_mps: Floats  # [n] speed at the alert; the driver does not drive faster
    way_m: Floats  # [n] way since the alert
    speed_mps: Floats  # [n] speed at the last decision
    views: Floats  # [n, K, 4] last views, oldest first: time (s), place (m), speed and acceleration of what is ahead


def required_deceleration(gap_m: Floats, speed_mps: Floats, front_mps: Floats, front_braking_mps2: Floats) -> Floats:
    """Least constant deceleration that avoids contact with a vehicle ahead that brakes to rest, [n] m/s2.

    Gap d, speeds v and w, closing speed c = v - w > 0, braking b ahead: ``b + c^2 / (2 d)`` if the closest point comes
    before the vehicle ahead stands (``2 d / c <= w / b``), otherwise ``v^2 / (2 (d + w^2 / (2 b)))``.
    """
    closing = np.maximum(speed_mps - front_mps, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        front_way = np.where(front_mps > 0.0, np.square(front_mps) / (2.0 * front_braking_mps2), 0.0)
        is_moving = (closing > 0.0) & (2.0 * gap_m * front_braking_mps2 <= closing * front_mps)
    beside_moving = front_braking_mps2 + np.square(closing) / (2.0 * gap_m)
    return np.where(is_moving, beside_moving, np.square(speed_mps) / (2.0 * (gap_m + front_way)))


class Human(Controller):
    """A driver behind, whose reaction time is drawn once a world.

    The driver sees the vehicle ahead as it was one reaction time ago, expects it to go on so (but to lose at most the
    share ``foresight`` of its speed), and knows the own motion. With the expected gap d and speed w, and the own speed
    v, the command is the smaller one of ``k min(1, reach / d) (w - v)``, with the sensitivity k, and minus the
    ``required_deceleration`` for a gap that is shorter by ``margin`` (at most by a half). The first never leads beyond
    the speed at the alert, the second never below the speed ahead. Decelerations grow by at most ``jerk``.

    The reaction time is lognormal, at most ``LONGEST_SDS`` standard deviations above its mean.
    """

    def begin(self, alert: State, body: int) -> Sight:
        p, motion = self.parameters, KnownMotion.of(alert, body, self.step_s)
        variance = log(1.0 + (p.sd / max(p.reaction, SAME_S)) ** 2)  # of the logarithm
        drawn = normal_quantile_each(np.array([generator.random() for generator in alert.generators(body)]))
        longest_s = p.reaction + LONGEST_SDS * p.sd
        reaction = np.minimum(p.reaction * exp_each(math.sqrt(variance) * drawn - 0.5 * variance), longest_s)
        times = -self.step_s * np.arange(math.ceil(longest_s / self.step_s) + 1, -1, -1)
        places = motion.gap_m[:, np.newaxis] + motion.front_mps[:, np.newaxis] * times
        views = np.zeros((*places.shape, 4))
        views[:, :, 0], views[:, :, 1], views[:, :, 2] = times, places, motion.front_mps[:, np.newaxis]
        return Sight(reaction, motion.speed_mps.copy(), np.zeros(alert.n), motion.speed_mps.copy(), views)

    def act(self, state: State, memory: Sight, body: int) -> tuple[Floats, Sight]:
        check_seen(self, state, body)
        p, motion, time = self.parameters, KnownMotion.of(state, body, self.step_s), state.time_s
        way = memory.way_m + 0.5 * (memory.speed_mps + motion.speed_mps) * (time - memory.views[:, -1, 0])
        view = np.stack([time, way + motion.gap_m, motion.front_mps, motion.front_mps2], axis=1)
        views = np.concatenate([memory.views[:, 1:], view[:, np.newaxis]], axis=1)
        memory = memory._replace(way_m=way, speed_mps=motion.speed_mps.copy(), views=views)
        seen_until = (time - memory.reaction_s + SAME_S)[:, np.newaxis]
        last = np.maximum((views[:, :, 0] <= seen_until).sum(axis=1) - 1, 0)
        seen_s, place, front, force = views[np.arange(state.n), last].T
        braking, age = np.maximum(-force, 0.0), time - seen_s
        slower = np.minimum(braking * age, p.foresight * front)
        slowing_s = np.where(slower > 0.0, slower / np.where(slower > 0.0, braking, 1.0), 0.0)
        expected = front - slower
        gap = place + front * age - slower * (age - 0.5 * slowing_s) - way
        sensitivity = p.sensitivity * np.minimum(1.0, p.reach / np.maximum(gap, LEAST_GAP_M))
        follow = sensitivity * (np.minimum(expected, memory.alert_mps) - motion.speed_mps)
        stops = (expected == 0.0) & (gap < p.reach) & (motion.speed_mps < CREEPING_MPS)
        follow = np.where(stops, np.minimum(follow, -CREEPING_MPS), follow)
        room = np.maximum(np.maximum(gap - p.margin, 0.5 * gap), LEAST_GAP_M)
        required = required_deceleration(room, motion.speed_mps, expected, braking)
        evens = braking + np.maximum(motion.speed_mps - expected, 0.0) / self.step_s  # to the speed ahead, in one step
        command = np.where(required > 0.0, np.minimum(follow, -np.minimum(required, evens)), follow)
        return within_capacities(motion.built_up(command, p.jerk), state, body), memory


def make_human(argument: str | None, settings: Any) -> Human:
    parameters = read_parameters(argument, f"agent {settings.spec!r}", DEFAULTS)
    return Human(settings.spec, parameters, step_of(settings))


HUMAN = Part(
    make_human,
    form="human[:reaction=1.21]",
    about="a driver who sees late, and brakes as hard as necessary",
    knows=MESSAGES,
)
