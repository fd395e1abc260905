"""Levels of cooperation that belong together: the same lines; what differs is who learns, knows and cares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.lineup import load_runnable
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario import Sample, Scenario

LADDER = (
    "cooperation-0-sensors",
    "cooperation-1-front",
    "cooperation-2-paper",
    "cooperation-3-pair",
    "cooperation-4-all",
)
STANDARD = (*LADDER, "cooperation-2-blocked")

_LINE = ("vehicles", "time_step_s", "horizon_s")
_WORLD = ("gaps_m", "speeds_mps")
_VEHICLE = ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "speed_limit_mps", "restitution")
_MAY_DIFFER = "roles, objective, hazard_gap_m, v2x and, where v2x differs, latency_s"
_ABOUT = {"name", "title", "description", "source"}


@dataclass(frozen=True, slots=True)
class Level:
    """One scenario of an ablation."""

    scenario: Scenario
    clear: str | None = None  # name of the level that is the same but for ``v2x``; None: a step of the ladder

    @property
    def name(self) -> str:
        """The scenario's name."""
        return self.scenario.name

    @property
    def trained(self) -> bool:
        """Whether anybody learns; else all follow their scripts."""
        return bool(self.scenario.learners)


def read_levels(names: Sequence[str]) -> list[Level]:
    """Load the levels, by name or path, in this order.

    One that differs from an earlier one in ``v2x`` only is that level over another channel; the others are the ladder,
    each compared with the one before. Raises ``InvalidInput`` for fewer than two levels or one given twice, and what
    ``load_runnable`` raises.
    """
    levels: list[Level] = []
    for name in names:
        scenario = load_runnable(name)
        if any(level.name == scenario.name for level in levels):
            raise InvalidInput(f"levels: {scenario.name!r} is given twice")
        same = [level.name for level in levels if level.clear is None and _but_channel(level.scenario, scenario)]
        levels.append(Level(scenario, same[0] if same else None))
    if len(levels) < 2:
        raise InvalidInput(f"levels: {len(levels)} given; at least two are needed to compare")
    return levels


def common_worlds(levels: Sequence[Level], episodes: int, seed: int) -> list[Sample]:
    """The list of each level: world k is the same line in all of them, and the same physics hold in it.

    Latencies may differ where ``v2x`` does, and an obstacle ahead may be there or not. Raises ``InvalidInput`` naming
    the level and what is another there.
    """
    samples = [level.scenario.sample(episodes, seed) for level in levels]
    for k, level in enumerate(levels):
        _check_same(levels[0], samples[0], level, samples[k], (*_LINE, *_WORLD, *_VEHICLE))
        clear = next(j for j in range(k + 1) if levels[j].scenario.v2x == level.scenario.v2x)
        _check_same(levels[clear], samples[clear], level, samples[k], ("latency_s",))
    return samples


def _check_same(one: Level, first: Sample, other: Level, sample: Sample, names: Sequence[str]) -> None:
    for name in names:
        values, others = (_values(name, *pair) for pair in ((one, first), (other, sample)))
        rows = np.flatnonzero((values != others).reshape(len(values), -1).any(axis=1))
        if rows.size:
            here, there = (", ".join(f"{each:g}" for each in np.ravel(v[rows[0]])) for v in (others, values))
            raise InvalidInput(
                f"level {other.name!r}: its {name} differs from that of {one.name!r} ({here}; there {there}); levels"
                f" are compared on the same lines and may differ in {_MAY_DIFFER}, so change or leave out one of them"
            )


def _values(name: str, level: Level, sample: Sample) -> Floats:
    """One row per world of a quantity of the worlds; one row of a number of the scenario."""
    if name in _LINE:
        return np.array([getattr(level.scenario, name)], np.float64)
    values: Floats = getattr(sample.worlds if name in _WORLD else sample.worlds.vehicles, name)
    return values


def _but_channel(one: Scenario, other: Scenario) -> bool:
    """Whether two scenarios differ in their channel, and in nothing else that matters."""
    first, second = (scenario.model_dump(mode="json", exclude=_ABOUT | {"v2x"}) for scenario in (one, other))
    return first == second and one.v2x != other.v2x
