"""Drivers behind one step shield: what they did, and what the shield did to them, world by world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.agents.rollout import drive
from ethbrake_marl.agents.team import Driver, team_of
from ethbrake_marl.errors import renumbered
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario import Task
from ethbrake_marl.shield.agents import StepShieldAgent
from ethbrake_marl.shield.step_shield import StepShield
from ethbrake_marl.shield.team_agent import ShieldedTeam

CHUNK = 500  # worlds advanced together: bounds memory, changes no result

Behind = StepShieldAgent | ShieldedTeam


class Shielded(NamedTuple):
    """Episodes behind a step shield: n worlds (any axes before), N vehicles, K of them shielded."""

    harm: Floats  # [n] of the count that is guarded (m2/s2)
    vehicle_harm: Floats  # [n, N] what each vehicle bears of it
    bound: Floats  # [n] that was told at the alert, with the allowance
    baseline: Floats  # [n, N] what each vehicle bears under the baseline plan
    replaced: Ints  # [n, K] decisions of each shielded vehicle that were replaced
    decisions: Ints  # [n] of each of them
    moving: Bools  # [n] the horizon cut the episode off


def put_shield(driver: Driver, task: Task, **settings: Any) -> Behind:
    """A copy of the ``driver`` behind one step shield: around one agent where one vehicle learns, else around a team.

    The settings are those of ``StepShieldAgent`` and ``ShieldedTeam``. Raises what they raise.
    """
    team = team_of(driver, task.vehicles)
    if len(task.vehicles) == 1:
        return StepShieldAgent(team.drivers[task.vehicles[0]], task.scenario, harm_count=task.harm_count, **settings)
    return ShieldedTeam(team, task.scenario, harm_count=task.harm_count, **settings)


def drive_behind(behind: Behind, worlds: Worlds, task: Task) -> Shielded:
    """Let what is behind a shield drive all worlds at once; it then holds the log of these episodes, if it keeps one.

    Raises ``PhysicsError`` naming the worlds that could not be advanced.
    """
    alone = None if isinstance(behind, ShieldedTeam) else task.vehicle
    episodes = drive(worlds, behind, task.scenario, alone)
    shield = behind.shield
    assert shield is not None and shield.running is not None
    return Shielded(
        episodes.ledger.world_harm(task.harm_count),
        episodes.ledger.vehicle_harm(task.harm_count),
        shield.first_bound + shield.allowance,
        shield.baseline_shares,
        shield.replaced.reshape(worlds.n, -1),
        shield.running.steps.copy(),
        ~episodes.at_rest,
    )


def drive_chunks(driver: Driver, worlds: Worlds, task: Task, **settings: Any) -> Shielded:
    """Let a copy of the ``driver`` drive every world behind a step shield, ``CHUNK`` at a time; as ``put_shield``."""
    parts = []
    for first in range(0, worlds.n, CHUNK):
        rows = np.arange(first, min(first + CHUNK, worlds.n))
        with renumbered(rows):
            parts.append(drive_behind(put_shield(driver, task, **settings), worlds.take(rows), task))
    return join(parts)


def join(parts: Sequence[Shielded]) -> Shielded:
    """Consecutive worlds as one."""
    return Shielded(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def stack(parts: Sequence[Shielded]) -> Shielded:
    """Several drivers in the same worlds, on an axis in front."""
    return Shielded(*(np.stack(columns) for columns in zip(*parts, strict=True)))


def shield_of(behind: Behind) -> StepShield:
    """The shield as it is now, after an episode began."""
    assert behind.shield is not None
    return behind.shield
