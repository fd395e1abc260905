"""The paper's three vehicles until their first collision, in small steps; shares nothing with the package.

Vehicle 1 brakes from t = 0 on, Vehicle 3 from its delay on, both fully and until they stand. Vehicle 2 coasts until it
may act, and then follows commands, one for each decision. Positions and speeds follow the paper's equation of motion
between collisions, in steps of 0.0025 s. A collision is found at the end of a step, and its speeds are interpolated.
"""

from typing import NamedTuple

import numpy as np

STEP_S, DECISION_S, END_S = 0.0025, 0.1, 6.0
STRONGEST_MPS2 = 14.0  # the largest difference of two accelerations


class Worlds(NamedTuple):
    gaps: np.ndarray  # [n, 2] m
    speeds: np.ndarray  # [n, 3] m/s
    braking: np.ndarray  # [3] m/s2
    delays: np.ndarray  # [3] s


def closing_at_contacts(worlds: Worlds, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times (s; infinite: none) and closing speeds (m/s) of both pairs' first contacts as if no collision changed
    anything, [n, 2] each. ``commands``: of Vehicle 2 at each decision, [n, k] m/s2; the last one remains.
    """
    gaps, speeds = worlds.gaps.copy(), worlds.speeds.copy()
    times, closings = np.full(gaps.shape, np.inf), np.zeros(gaps.shape)
    for k in range(round(END_S / STEP_S)):
        now = k * STEP_S
        acting = now >= worlds.delays - 1e-9
        decision = min(max(int((now - worlds.delays[1]) / DECISION_S + 1e-6), 0), commands.shape[1] - 1)
        wanted = np.broadcast_to(-worlds.braking, speeds.shape).copy()
        wanted[:, 1] = commands[:, decision]
        after = np.maximum(speeds + STEP_S * np.where(acting, wanted, 0.0), 0.0)
        ways = 0.5 * STEP_S * (speeds + after)
        closed = gaps + ways[:, :-1] - ways[:, 1:]
        met = (closed <= 0.0) & (gaps > 0.0) & np.isinf(times)
        part = np.where(met, gaps / np.where(met, gaps - closed, 1.0), 0.0)
        closing = (speeds[:, 1:] - speeds[:, :-1]) * (1.0 - part) + (after[:, 1:] - after[:, :-1]) * part
        times, closings = np.where(met, now + part * STEP_S, times), np.where(met, closing, closings)
        gaps, speeds = closed, after
    return times, closings


def harm_of_first(worlds: Worlds, commands: np.ndarray) -> np.ndarray:
    """Squared closing speed of the collision that ends the episode, [n] m2/s2."""
    times, closings = closing_at_contacts(worlds, commands)
    return np.where(times.min(axis=1) < np.inf, closings[np.arange(len(times)), times.argmin(axis=1)] ** 2, 0.0)


def harm_of_both(worlds: Worlds, commands: np.ndarray) -> np.ndarray:
    """Sum of the squared closing speeds of both pairs, each as if alone, [n] m2/s2."""
    return (closing_at_contacts(worlds, commands)[1] ** 2).sum(axis=1)


def step_error(harm: np.ndarray) -> np.ndarray:
    """How much a squared closing speed can change in a step, which a contact can be off, m2/s2."""
    change = STRONGEST_MPS2 * STEP_S
    return 2.0 * np.sqrt(2.0 * harm) * change + change**2
