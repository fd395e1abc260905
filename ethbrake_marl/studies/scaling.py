"""The cost of a step over the numbers of worlds and vehicles: the figure of ``ethbrake bench --scaling``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.figures.curves import draw_costs
from ethbrake_marl.figures.style import Figure
from ethbrake_marl.physics import Floats, Worlds, advance, make_worlds
from ethbrake_marl.studies.speed import SEED, STEP_S, Effort, Work, braking, rates, stepping, until_rest

WORLDS = (1, 4, 16, 64, 256, 1024, 4096, 16_384, 65_536)
VEHICLES = (2, 3, 5, 8, 12, 20, 30, 50)
EFFORT = Effort(5, 0.1)

_LINES = 2048  # worlds, where the number of vehicles varies
_REPEATED = 20
EMERGENCY, ENGINE, APART = "whole emergency, impacts included", "engine step", "first step, all vehicles apart"


@dataclass(frozen=True, slots=True)
class Cost:
    """Median processor time of one step of one world."""

    what: str
    worlds: int
    vehicles: int
    nanoseconds: float


def costs_by_worlds(effort: Effort = EFFORT, counts: Sequence[int] = WORLDS) -> Iterator[Cost]:
    """Two costs for each number of worlds of three vehicles."""
    for n in counts:
        yield _cost(EMERGENCY, n, 3, braking(n, 1.0), effort)
        yield _cost(ENGINE, n, 3, stepping(n, steps=max(10, 20_000 // n)), effort)


def costs_by_vehicles(effort: Effort = EFFORT, counts: Sequence[int] = VEHICLES) -> Iterator[Cost]:
    """Two costs for each number of vehicles in a world."""
    for vehicles in counts:
        worlds = make_lines(_LINES, vehicles)
        command = -worlds.vehicles.braking_capacity_mps2
        yield _cost(EMERGENCY, _LINES, vehicles, until_rest(worlds, command), effort)
        yield _cost(APART, _LINES, vehicles, _first_step(worlds, command), effort)


def make_lines(n: int, vehicles: int) -> Worlds:
    """Worlds with any number of vehicles, gaps and speeds drawn as in the paper's random test; always the same."""
    random = np.random.Generator(np.random.Philox(SEED))
    latency = random.uniform(0.5, 0.8, (n, vehicles))
    latency[:, 0] = 0.0
    return make_worlds(
        random.uniform(5.0, 10.0, (n, vehicles - 1)),
        random.uniform(18.0, 22.0, (n, vehicles)),
        braking_capacity_mps2=random.uniform(6.0, 7.0, (n, vehicles)),
        driving_capacity_mps2=0.0,
        latency_s=latency,
        mass_t=random.uniform(4.5, 5.9, (n, vehicles)),
        restitution=0.1,
    )


def _first_step(worlds: Worlds, command_mps2: Floats) -> Work:
    def work() -> int:
        for _ in range(_REPEATED):
            advance(worlds, command_mps2, STEP_S)
        return _REPEATED * worlds.n

    return work


def _cost(what: str, n: int, vehicles: int, work: Work, effort: Effort) -> Cost:
    return Cost(what, n, vehicles, 1e9 / float(np.median(rates(work, effort))))


def scaling_figure(by_worlds: Sequence[Cost], by_vehicles: Sequence[Cost], caption: str) -> Figure:
    """Cost of a step of the whole batch over n, and of one world over N."""
    batches = [(c.what, c.worlds, c.nanoseconds * c.worlds * 1e-3) for c in by_worlds]
    single = [(c.what, c.vehicles, c.nanoseconds) for c in by_vehicles]
    return draw_costs(batches, single, vehicles=VEHICLES, caption=caption)
