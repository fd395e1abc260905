"""What the infos of every face say, computed once for all vehicles of all worlds.

After a reset: ``time_s``, ``applied_command_mps2`` (in force now; 0 until the latency has elapsed), the vehicle's share
of the harm so far under both counts, the same for the whole world, and whether anything has collided. After a step
also ``applied_action`` (the vehicle's command as an action, whoever chose it), ``wanted_command_mps2``, and the reward
terms before their weights.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.engine import Engine, Step
from ethbrake_marl.physics import Bools

Table = dict[str, Any]  # name -> [n, N]; applied_action [n, N, 1]; reward_terms: another table


def state_table(engine: Engine) -> Table:
    """What is known at any time, each [n, N]."""
    worlds, ledger = engine.worlds, engine.ledger
    table = {
        "time_s": worlds.time_s,
        "applied_command_mps2": worlds.command_mps2,
        "first_impact_harm": ledger.vehicle_harm("first"),
        "total_harm": ledger.vehicle_harm("total"),
        "world_first_impact_harm": ledger.world_harm("first"),
        "world_total_harm": ledger.world_harm("total"),
        "collided": ledger.collided,
    }
    return {name: value if value.ndim == 2 else _every_vehicle(value, worlds.N) for name, value in table.items()}


def step_table(engine: Engine, step: Step) -> Table:
    """What the last step adds, before any of its rows is renewed; each [n, N].

    The applied action reads 0 where the capacity on that side is 0.
    """
    vehicles = engine.worlds.vehicles
    actions = [command_to_action(step.command_mps2[:, i], vehicles, i) for i in range(engine.worlds.N)]
    return {
        "applied_action": np.stack(actions, axis=1).astype(np.float32)[:, :, np.newaxis],
        "wanted_command_mps2": step.command_mps2,
        "reward_terms": step.terms,
    }


def row_info(table: Table, row: int, vehicle: int) -> dict[str, Any]:
    """One vehicle of one world as plain numbers; arrays are copies."""
    info: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, dict):
            info[name] = row_info(value, row, vehicle)
        else:
            entry = value[row, vehicle]
            info[name] = entry.copy() if entry.ndim else entry.item()
    return info


def batch_info(table: Table, vehicle: int, rows: Bools) -> dict[str, Any]:
    """One vehicle in the worlds marked by ``rows``, as Gymnasium's vector infos: ``name`` [n], mask ``_name`` [n]."""
    info: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, dict):
            info[name] = batch_info(value, vehicle, rows)
        else:
            column = np.zeros_like(value[:, vehicle])
            column[rows] = value[rows, vehicle]
            info[name] = column
        info[f"_{name}"] = rows.copy()
    return info


def _every_vehicle(value: NDArray[Any], vehicles: int) -> NDArray[Any]:
    return np.repeat(value[:, np.newaxis], vehicles, axis=1)
