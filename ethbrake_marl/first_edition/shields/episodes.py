"""Results of whole episodes with a step shield: harm, bound and number of replaced actions in every world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.errors import renumbered
from ethbrake_marl.first_edition.agents.driving import Episodes, drive
from ethbrake_marl.first_edition.agents.protocol import Driver
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.step import StepShield

CHUNK = 500  # number of worlds simulated together; limits memory, and does not change results


class Shielded(NamedTuple):
    """Results of whole episodes with a step shield in n worlds: N vehicles, of which K are shielded.

    ``stack`` adds a first axis for several drivers: for instance, the shape of ``harm`` becomes [drivers, n].
    """

    harm: Floats  # [n] harm of the episode, first-impact or total harm, whichever the shield bounds (m2/s2)
    vehicle_harm: Floats  # [n, N] harm that each vehicle bears; its sum over the vehicles is ``harm`` (m2/s2)
    bound: Floats  # [n] bound of the shield at the alert, including the allowance (m2/s2)
    baseline: Floats  # [n, N] harm that each vehicle bears under the constant actions of least harm (m2/s2)
    replaced: Ints  # [n, K] number of replaced actions of each shielded vehicle
    decisions: Ints  # [n] number of decisions of each shielded vehicle
    moving: Bools  # [n] whether something still moved at the horizon

    @staticmethod
    def of(episodes: Episodes, task: Task) -> Shielded:
        """Return the results of finished ``episodes`` with a step shield."""
        shield: StepShield = episodes.guarded.shield
        assert shield.memory.running is not None
        return Shielded(
            episodes.ledger.world_harm(task.harm_count),
            episodes.ledger.vehicle_harm(task.harm_count),
            shield.predicted_harm,
            shield.memory.baseline_shares,
            shield.memory.replaced.reshape(len(shield.memory.replaced), -1),
            shield.memory.running.steps.copy(),
            ~episodes.at_rest,
        )

    @staticmethod
    def join(parts: Sequence[Shielded]) -> Shielded:
        """Concatenate the results along the axis of worlds."""
        return Shielded(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    @staticmethod
    def stack(parts: Sequence[Shielded]) -> Shielded:
        """Stack the results of several drivers in the same worlds along a new first axis."""
        return Shielded(*(np.stack(columns) for columns in zip(*parts, strict=True)))


def drive_shielded(driver: Driver, worlds: Worlds, task: Task, **settings: Any) -> Shielded:
    """Drive in every world with a copy of ``driver`` behind a step shield, and return the results.

    ``task`` contains the scenario, the shielded vehicles and the harm count. ``settings`` are further keywords of
    ``ShieldedDriver``.
    """
    parts = []
    for first in range(0, worlds.n, CHUNK):
        rows = np.arange(first, min(first + CHUNK, worlds.n))
        with renumbered(rows):
            episodes = drive(worlds.take(rows), ShieldedDriver.around(driver, task, **settings), task.scenario)
        parts.append(Shielded.of(episodes, task))
    return Shielded.join(parts)
