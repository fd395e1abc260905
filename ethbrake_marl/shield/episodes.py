"""Drivers behind a shield, in evaluations: what they did, and what the shield did to them, world by world."""

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

    harm: Floats  # [n] of the count that is guarded (m2/s2)
    vehicle_harm: Floats  # [n, N] what each vehicle bears of it
    bound: Floats  # [n] that was told at the alert, with the allowance
    baseline: Floats  # [n, N] what each vehicle bears under the baseline plan
    replaced: Ints  # [n, K] decisions of each shielded vehicle that were replaced
    decisions: Ints  # [n] of each of them
    moving: Bools  # [n] the horizon cut the episode off

    @staticmethod
    def of(episodes: Episodes, task: Task) -> Shielded:
        """What a step shield did in these episodes."""
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
    def driven(driver: Driver, worlds: Worlds, task: Task, **settings: Any) -> Shielded:
        """A copy of the ``driver`` drives every world behind a step shield, ``CHUNK`` at a time; as ``around``."""
        parts = []
        for first in range(0, worlds.n, CHUNK):
            rows = np.arange(first, min(first + CHUNK, worlds.n))
            with renumbered(rows):
                episodes = drive(worlds.take(rows), ShieldedDriver.around(driver, task, **settings), task.scenario)
            parts.append(Shielded.of(episodes, task))
        return Shielded.join(parts)

    @staticmethod
    def join(parts: Sequence[Shielded]) -> Shielded:
        """Consecutive worlds as one."""
        return Shielded(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    @staticmethod
    def stack(parts: Sequence[Shielded]) -> Shielded:
        """Several drivers in the same worlds, on an axis in front."""
        return Shielded(*(np.stack(columns) for columns in zip(*parts, strict=True)))
