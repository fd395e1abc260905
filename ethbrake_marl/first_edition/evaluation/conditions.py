"""Conditions under which a result was obtained: scenario, worlds and vehicles, for captions and JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ethbrake_marl.errors import count_of
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.scenario.channel import Tells
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task

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
    "harm_weight": ("weight of harm", ""),
}

_STAY = "\u00a0"  # a non-breaking space


class Conditions(dict[str, Any]):
    """Dictionary that says how a result was obtained: scenario, seed, vehicles, scripts, and quantities of the worlds.

    ``of`` and ``of_ranges`` return only the quantities of the worlds, ``of_test`` returns all entries.
    """

    @classmethod
    def of(cls, worlds: Worlds) -> Conditions:
        """Return a dictionary: key of a quantity -> value in ``worlds``, such as ``{"gaps_m": [7.0, [5.0, 9.0]]}``.

        The value of a quantity of vehicles or pairs is a list with one entry per vehicle or pair, front to rear. A
        quantity of the whole world has a single entry. An entry is a number or, if the quantity differs between worlds,
        ``[smallest, largest]``.
        """
        return cls.of_ranges({key: rule.of(worlds).T for key, rule in QUANTITY.of(worlds).items()})

    @classmethod
    def of_ranges(cls, ranges: Mapping[str, Iterable[Any]]) -> Conditions:
        """Return the same dictionary as ``of``.

        ``ranges`` maps a quantity's key to one array per vehicle or pair, or to a single array for the whole world.
        Each array has the values of all worlds, or only the smallest and the largest value.
        """
        ends_of = {
            key: [(float(np.nanmin(each)), float(np.nanmax(each))) for each in entries]
            for key, entries in ranges.items()
        }
        plain = {key: [low if low == high else [low, high] for low, high in ends] for key, ends in ends_of.items()}
        return cls({key: ends[0] if QUANTITY.declared[key].per == "world" else ends for key, ends in plain.items()})

    @classmethod
    def of_test(
        cls,
        task: Task,
        seed: int | None,
        count: int,
        because: Mapping[str, str | None],
        quantities: Mapping[str, Any],
        *,
        recordings: int = 0,
        rejected: int = 0,
    ) -> Conditions:
        """Return all conditions of an evaluation: the object ``parameters`` of JSON results.

        Args:
            task: the scenario and the controlled vehicles.
            seed: seed of the evaluation list; None for worlds that the caller passed.
            count: number of worlds.
            because: result of ``measure_sets.silent_because``.
            quantities: result of ``of`` or ``of_ranges``.
            recordings: number of recordings that the worlds come from, or 0.
            rejected: number of drawn worlds that were rejected because of an early impact. It is listed (as
                ``rejected_draws``) only if it is above 0 and the scenario takes its worlds from a table.

        """
        scenario = task.scenario
        tabled = any(each.table is not None for each in scenario.members or (scenario,))
        controlled = [scenario.vehicle_names[i] for i in task.vehicles]
        scripts = {scenario.vehicle_names[i]: script for i, script in scenario.scripts.items()}
        return cls(
            scenario=scenario.name,
            seed=seed,
            count=count,
            **({"controlled_vehicle": controlled[0]} if len(controlled) == 1 else {"controlled_vehicles": controlled}),
            scripts={name: script for name, script in scripts.items() if name not in controlled},
            time_step_s=scenario.time_step_s,
            horizon_s=scenario.horizon_s,
            **({} if scenario.v2x.channel.tells is None else {"tells": _plain(scenario.v2x.channel.tells)}),
            **({"recordings": recordings} if recordings else {}),
            **({"rejected_draws": rejected} if rejected and tabled else {}),
            **because,
            **quantities,
        )

    @property
    def line(self) -> str:
        """Caption in one line: scenario, number of worlds, seed, recordings, quantities, content of messages."""
        seed = "" if self["seed"] is None else f", seed {self['seed']}"
        messages = f"; {_message_words(self['tells'])}" if "tells" in self else ""
        worlds = f"{count_of(self['count'], 'world')}{seed}{self.by_recording}"
        return f"{self['scenario']}: {worlds}; {self.quantities}{messages}"

    @property
    def by_recording(self) -> str:
        """Part of a caption, such as ``; 95 % intervals by 55 recordings``; "" if the worlds come from no recordings.

        If all worlds come from one recording, the text says that there are no intervals.
        """
        number = self.get("recordings", 0)
        many = f"; 95 % intervals by {number:,} recordings" if number else ""
        return "; no 95 % intervals: all worlds come from one recording" if number == 1 else many

    @property
    def quantities(self) -> str:
        """All quantities in one line: ``d = 7 m; v = (20, 18, 20) m/s`` if all gaps are 7 m."""
        parts = []
        for key, (symbol, unit) in _SYMBOLS.items():
            if key in self:
                entries = [self[key]] if QUANTITY.declared[key].per == "world" else self[key]
                texts = [f"{e[0]:.3g}–{e[1]:.3g}" if isinstance(e, list) else f"{e:.4g}" for e in entries]
                value = texts[0] if len(set(texts)) == 1 else f"({f',{_STAY}'.join(texts)})"
                parts.append(f"{symbol}{_STAY}={_STAY}{value}{f'{_STAY}{unit}' if unit else ''}")
        return "; ".join(parts)


def _plain(tells: Tells) -> Any:
    """Return the contents of messages as plain data for JSON."""
    return {name: [*each] for name, each in tells.items()} if isinstance(tells, Mapping) else [*tells]


def message_words(scenario: Scenario) -> str:
    """Return a text such as ``messages of all contain place``; empty if the scenario does not set the key ``tells``."""
    tells = scenario.v2x.channel.tells
    return "" if tells is None else _message_words(tells)


def _message_words(tells: Tells) -> str:
    each = tells if isinstance(tells, Mapping) else {"all": tells}
    return "; ".join(
        f"messages of {who} contain {', '.join(pieces) or 'the alert alone'}" for who, pieces in each.items()
    )
