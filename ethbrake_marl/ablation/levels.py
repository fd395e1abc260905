"""Levels of cooperation that belong together: the same lines; what differs is who learns, knows and cares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.lineup import load_runnable
from ethbrake_marl.scenario import Sample, Scenario

LADDER = (
    "cooperation-0-sensors",
    "cooperation-1-front",
    "cooperation-2-paper",
    "cooperation-3-pair",
    "cooperation-4-all",
)
STANDARD = (*LADDER, "cooperation-2-blocked")

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
    """The list of each level: world k has the same gaps and speeds in all of them.

    Raises ``InvalidInput`` naming the level whose line is another.
    """
    samples = [level.scenario.sample(episodes, seed) for level in levels]
    first = samples[0].worlds
    for level, sample in zip(levels, samples, strict=True):
        worlds = sample.worlds
        if not (np.array_equal(worlds.gaps_m, first.gaps_m) and np.array_equal(worlds.speeds_mps, first.speeds_mps)):
            raise InvalidInput(
                f"level {level.name!r}: its worlds are not those of {levels[0].name!r} ({worlds.N} and {first.N}"
                " vehicles); levels are compared on the same gaps and speeds, so leave one of them out"
            )
    return samples


def _but_channel(one: Scenario, other: Scenario) -> bool:
    """Whether two scenarios differ in their channel, and in nothing else that matters."""
    first, second = (scenario.model_dump(mode="json", exclude=_ABOUT | {"v2x"}) for scenario in (one, other))
    return first == second and one.v2x != other.v2x
