"""Episodes of a driver behind a step shield: harm, bound, and replaced decisions, world by world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.driving import Episodes, drive
from ethbrake_marl.agents.protocol import Driver
from ethbrake_marl.errors import renumbered
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.task import Task
from ethbrake_marl.shield.drivers import ShieldedDriver
from ethbrake_marl.shield.step import StepShield

CHUNK = 500  # worlds advanced together: bounds memory, changes no result


class Shielded(NamedTuple):
    """Episodes behind a step shield: n worlds (any axes before), N vehicles, K of them shielded."""

    harm: Floats  # [n] under the guarded count (m2/s2)
    vehicle_harm: Floats  # [n, N] the share of it that each vehicle bears
    bound: Floats  # [n] at the alert, with the allowance
    baseline: Floats  # [n, N] harm that each vehicle bears under the baseline plan
    replaced: Ints  # [n, K] replaced decisions of each shielded vehicle
    decisions: Ints  # [n] decisions of each shielded vehicle
    moving: Bools  # [n] the horizon cut the episode off

    @staticmethod
    def of(episodes: Episodes, task: Task) -> Shielded:
        """The episodes of a driver behind a step shield, once they have ended."""
        shield: StepShield = episodes.guarded.shield
        assert shield.running is not None
        return Shielded(
            episodes.ledger.world_harm(task.harm_count),
            episodes.ledger.vehicle_harm(task.harm_count),
            shield.predicted_harm,
            shield.baseline_shares,
            shield.replaced.reshape(len(shield.replaced), -1),
            shield.running.steps.copy(),
            ~episodes.at_rest,
        )

    @staticmethod
    def join(parts: Sequence[Shielded]) -> Shielded:
        """The worlds of all parts, one after the other."""
        return Shielded(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    @staticmethod
    def stack(parts: Sequence[Shielded]) -> Shielded:
        """Several drivers in the same worlds, on a new first axis."""
        return Shielded(*(np.stack(columns) for columns in zip(*parts, strict=True)))


def drive_shielded(driver: Driver, worlds: Worlds, task: Task, **settings: Any) -> Shielded:
    """Drive a copy of the ``driver`` behind a step shield through every world, ``CHUNK`` worlds at a time.

    ``settings`` are those of ``ShieldedDriver``.
    """
    parts = []
    for first in range(0, worlds.n, CHUNK):
        rows = np.arange(first, min(first + CHUNK, worlds.n))
        with renumbered(rows):
            episodes = drive(worlds.take(rows), ShieldedDriver.around(driver, task, **settings), task.scenario)
        parts.append(Shielded.of(episodes, task))
    return Shielded.join(parts)
