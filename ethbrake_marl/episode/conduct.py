"""Conduct that causes no harm by itself: pushing, driving, still moving at the horizon."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.episode.state import State, check_exact
from ethbrake_marl.episode.step import TRUNCATED, Step, driven_again
from ethbrake_marl.motion.layout import COUNT, DROVE, LATENCY, NEXT_TIME, PUSHED, Floats


def push(before: State, step: Step, after: State) -> Floats:
    """Term push of rewards (``episode.terms``), [n]: minus the push (m/s) of all contacts in the step.

    It includes the contact with the obstacle. Formula: ``motion.push``.
    """
    check_exact(before, "the term push")
    return 0.0 - (after.line[:, PUSHED] - before.line[:, PUSHED]).sum(axis=1)


def drove(before: State, step: Step, after: State) -> Floats:
    """Term drove of rewards (``episode.terms``), [n, N]: minus the speed that the engine alone gives (m/s).

    That is the integral of the force where it is positive (``motion.forces``).
    """
    check_exact(before, "the term drove")
    return 0.0 - (after.line[:, DROVE, :-1] - before.line[:, DROVE, :-1])


def still_moving(before: State, step: Step, after: State) -> Floats:
    """Term still_moving of rewards (``episode.terms``), [n]: -1 if a vehicle moves at the horizon, otherwise 0."""
    check_exact(before, "the term still_moving")
    return 0.0 - step.out[TRUNCATED] * after.moving


def first_impact_s(before: State, after: State) -> Floats:
    """Time of the line's first impact, [n] s; ``before.time_s`` if it was earlier, ``after.time_s`` if later or never.

    There must be no decision between the two states.
    """
    until: Floats = np.where(before.collided, before.time_s, after.time_s)
    for k, scratch in driven_again(before, after, ~before.collided & after.collided):
        struck = after.line[k, COUNT] > 0.0
        until[k] = before.time_s[k] + scratch[NEXT_TIME, struck].min()
    return until


def driving_s(before: State, after: State, until_s: Floats) -> Floats:
    """Time from ``before`` to ``until_s`` [n] with a positive command in force, [n, N] s."""
    begun_s = np.maximum(before.car[:, LATENCY, 1:], before.time_s[:, np.newaxis])
    return np.where(after.commands_mps2 > 0.0, np.maximum(until_s[:, np.newaxis] - begun_s, 0.0), 0.0)
