"""Conditions of a result: the scenario, the worlds and the vehicles behind a table, a figure or a report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ethbrake_marl.errors import count_of
from ethbrake_marl.physics.state import Worlds
from ethbrake_marl.scenario.fields import QUANTITY
from ethbrake_marl.scenario.task import Task

_SYMBOLS = {
    "gaps_m": ("d", "m"),
    "speeds_mps": ("v", "m/s"),
    "braking_capacity_mps2": ("braking capacity", "m/s²"),
    "driving_capacity_mps2": ("driving capacity", "m/s²"),
    "latency_s": ("τ", "s"),
    "mass_t": ("m", "t"),
    "restitution": ("e", ""),
    "obstacle_gap_m": ("obstacle at", "m"),
    "friction": ("friction", ""),
    "brake_rate_mps3": ("brake rate", "m/s³"),
    "release_rate_mps3": ("release rate", "m/s³"),
}

_STAY = "\u00a0"  # a non-breaking space


class Conditions(dict[str, Any]):
    """Conditions of a result as plain data: scenario, controlled vehicles, scripts, and quantities of the worlds."""

    @classmethod
    def of(cls, worlds: Worlds) -> Conditions:
        """Return every quantity of the worlds: a list by vehicle or pair, or a single entry for the whole world.

        An entry is a number if all worlds agree, else ``[smallest, largest]``.
        """
        return cls.of_ranges({key: rule.of(worlds).T for key, rule in QUANTITY.of(worlds).items()})

    @classmethod
    def of_ranges(cls, ranges: Mapping[str, Iterable[Any]]) -> Conditions:
        """Return the conditions of quantities from all their values, or from their smallest and largest values."""
        found = {
            key: [(float(np.nanmin(each)), float(np.nanmax(each))) for each in entries]
            for key, entries in ranges.items()
        }
        told = {key: [low if low == high else [low, high] for low, high in ends] for key, ends in found.items()}
        return cls({key: ends[0] if QUANTITY.declared[key].per == "world" else ends for key, ends in told.items()})

    @classmethod
    def of_test(
        cls, task: Task, seed: int | None, count: int, because: Mapping[str, str | None], quantities: Mapping[str, Any]
    ) -> Conditions:
        """Return the conditions of a test.

        Args:
            task: the scenario and the controlled vehicles.
            seed: seed of the list; None for worlds that the caller passed.
            count: number of worlds.
            because: by key, why sets of measures do not apply to these worlds; None where they do.
            quantities: quantities of the worlds.

        """
        scenario = task.scenario
        driven = [scenario.vehicle_names[i] for i in task.vehicles]
        scripts = {scenario.vehicle_names[i]: script for i, script in scenario.scripts.items()}
        return cls(
            scenario=scenario.name,
            seed=seed,
            count=count,
            **({"controlled_vehicle": driven[0]} if len(driven) == 1 else {"controlled_vehicles": driven}),
            scripts={name: script for name, script in scripts.items() if name not in driven},
            time_step_s=scenario.time_step_s,
            horizon_s=scenario.horizon_s,
            **because,
            **quantities,
        )

    @property
    def line(self) -> str:
        """One-line caption: scenario, number of worlds, seed, then ``quantities``."""
        seed = "" if self["seed"] is None else f", seed {self['seed']}"
        return f"{self['scenario']}: {count_of(self['count'], 'world')}{seed}; {self.quantities}"

    @property
    def quantities(self) -> str:
        """The quantities in one line, each with symbol and unit: ``d = 7 m; v = (20, 18, 20) m/s; ...``.

        Entries that look the same are written once.
        """
        parts = []
        for key, (symbol, unit) in _SYMBOLS.items():
            if key in self:
                entries = [self[key]] if QUANTITY.declared[key].per == "world" else self[key]
                texts = [f"{e[0]:.3g}–{e[1]:.3g}" if isinstance(e, list) else f"{e:.4g}" for e in entries]
                told = texts[0] if len(set(texts)) == 1 else f"({f',{_STAY}'.join(texts)})"
                parts.append(f"{symbol}{_STAY}={_STAY}{told}{f'{_STAY}{unit}' if unit else ''}")
        return "; ".join(parts)
