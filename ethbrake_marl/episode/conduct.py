"""Conduct that causes no harm by itself: pushing, driving before the first impact, still moving at the horizon."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.episode.state import State, check_exact
from ethbrake_marl.episode.step import TRUNCATED, Step, driven_again
from ethbrake_marl.motion.layout import COUNT, DROVE, NEXT_TIME, PUSHED, Floats


def push(before: State, step: Step, after: State) -> Floats:
    """Term push of rewards (``episode.terms``), [n]: minus the push (m/s) of all contacts in the step.

    It includes the contact with the obstacle. Formula: ``motion.push``.
    """
    check_exact(before, "the term push")
    return 0.0 - (after.line[:, PUSHED] - before.line[:, PUSHED]).sum(axis=1)


def drove(before: State, step: Step, after: State) -> Floats:
    """Term drove of rewards (``episode.terms``), [n, N]: minus the speed that commands ask for by driving (m/s).

    That is a positive command times its duration, until the line's first impact.
    """
    check_exact(before, "the term drove")
    return 0.0 - (after.line[:, DROVE, :-1] - before.line[:, DROVE, :-1])


def still_moving(before: State, step: Step, after: State) -> Floats:
    """Term still_moving of rewards (``episode.terms``), [n]: -1 if a vehicle moves at the horizon, otherwise 0."""
    check_exact(before, "the term still_moving")
    return 0.0 - step.out[TRUNCATED]


def first_impact_s(before: State, after: State) -> Floats:
    """Time of the line's first impact, [n] s; ``before.time_s`` if it was earlier, ``after.time_s`` if later or never.

    There must be no decision between the two states.
    """
    until: Floats = np.where(before.collided, before.time_s, after.time_s)
    for k, scratch in driven_again(before, after, ~before.collided & after.collided):
        struck = after.line[k, COUNT] > 0.0
        until[k] = before.time_s[k] + scratch[NEXT_TIME, struck].min()
    return until


def driving_s(before: State, after: State) -> Floats:
    """Time between the states, before the line's first impact, with a positive command in force, [n, N] s."""
    asked_mps, commands = after.line[:, DROVE, :-1] - before.line[:, DROVE, :-1], after.commands_mps2
    return asked_mps / np.where(commands > 0.0, commands, 1.0)
