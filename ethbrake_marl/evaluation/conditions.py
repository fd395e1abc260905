"""The conditions behind a result: what stands beside every table, figure and report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ethbrake_marl.errors import count_of
from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.limits.limits import Unproven
from ethbrake_marl.physics import Floats, Worlds
from ethbrake_marl.scenario import Task
from ethbrake_marl.scenario.quantities import DECLARED
from ethbrake_marl.scenario.sample import quantity, quantity_rules

_SYMBOLS = {
    "gaps_m": ("d", "m"),
    "speeds_mps": ("v", "m/s"),
    "braking_capacity_mps2": ("braking capacity", "m/s²"),
    "driving_capacity_mps2": ("driving capacity", "m/s²"),
    "latency_s": ("τ", "s"),
    "mass_t": ("m", "t"),
    "restitution": ("e", ""),
    "obstacle_gap_m": ("obstacle at", "m"),
}
_STAY = "\u00a0"  # a blank at which no line is broken


def quantities(worlds: Worlds) -> dict[str, Any]:
    """Every quantity of the worlds as plain data: a list per vehicle or pair, one entry for the whole world.

    An entry is a number where all worlds agree, else its ``[least, largest]`` value.
    """
    found: dict[str, Any] = {}
    for field, rule in quantity_rules(worlds).items():
        entries = [_entry(column) for column in quantity(worlds, field).T]
        found[field] = entries[0] if rule.per == "world" else entries
    return found


def parameters(evaluation: Evaluation) -> dict[str, Any]:
    """Conditions of an evaluation as plain data: scenario, seed, count, who drove what, and all ``quantities``."""
    because = evaluation.limits.because if isinstance(evaluation.limits, Unproven) else None
    found = quantities(evaluation.worlds)
    return parameters_of(evaluation.task, evaluation.seed, evaluation.worlds.n, because, found)


def parameters_of(
    task: Task, seed: int | None, count: int, because: str | None, found: Mapping[str, Any]
) -> dict[str, Any]:
    """``parameters`` from their parts.

    Args:
        task: scenario, and who was driven.
        seed: of the list; None for worlds that were given.
        count: number of worlds.
        because: why nothing is proven for these worlds; None where it is.
        found: ``quantities`` of the worlds.

    """
    scenario = task.scenario
    driven = [scenario.vehicle_names[i] for i in task.vehicles]
    scripts = {scenario.vehicle_names[i]: script for i, script in scenario.scripts.items()}
    scripts = {name: script for name, script in scripts.items() if name not in driven}
    return {
        "scenario": scenario.name,
        "seed": seed,
        "count": count,
        **({"controlled_vehicle": driven[0]} if len(driven) == 1 else {"controlled_vehicles": driven}),
        "scripts": scripts,
        "time_step_s": scenario.time_step_s,
        "horizon_s": scenario.horizon_s,
        "no_limits_because": because,
        **found,
    }


def parameter_line(found: Mapping[str, Any]) -> str:
    """The ``parameters`` in one line, for captions: scenario, number of worlds, seed, then ``quantity_line``."""
    seed = "" if found["seed"] is None else f", seed {found['seed']}"
    return f"{found['scenario']}: {count_of(found['count'], 'world')}{seed}; {quantity_line(found)}"


def quantity_line(found: Mapping[str, Any]) -> str:
    """The ``quantities`` in one line, each with its symbol and unit: ``d = 7 m; v = (20, 18, 20) m/s; ...``."""
    parts = []
    for field, (symbol, unit) in _SYMBOLS.items():
        if field not in found:
            continue
        entries = [found[field]] if DECLARED[field].per == "world" else found[field]
        parts.append(f"{symbol}{_STAY}={_STAY}{_entries(entries)}{f'{_STAY}{unit}' if unit else ''}")
    return "; ".join(parts)


def _entry(column: Floats) -> float | list[float]:
    low, high = float(np.min(column)), float(np.max(column))
    return low if low == high else [low, high]


def _entries(entries: list[float | list[float]]) -> str:
    """``20``, ``(6, 7, 6)`` or ``5–10``; entries that read alike are written once."""
    texts = [f"{e[0]:.3g}–{e[1]:.3g}" if isinstance(e, list) else f"{e:.4g}" for e in entries]
    return texts[0] if len(set(texts)) == 1 else f"({f',{_STAY}'.join(texts)})"
