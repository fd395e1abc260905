"""The cost of a step over the numbers of worlds and vehicles: the figure of docs/performance.md, and its numbers.

.venv/bin/python docs/studies/scaling.py docs/figures/speed-scaling.png
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from speed import SEED, STEP_S, Effort, Work, braking, rates, stepping, until_rest

from ethbrake_marl.figures import GREY, add_caption, new_figure, series_style, style_axes, write_picture
from ethbrake_marl.physics import Floats, Worlds, advance, make_worlds
from ethbrake_marl.studies.machine import this_machine

WORLDS = (1, 4, 16, 64, 256, 1024, 4096, 16_384, 65_536)
VEHICLES = (2, 3, 5, 8, 12, 20, 30, 50)
EFFORT = Effort(5, 0.1)
LINES = 2048  # worlds, where the number of vehicles varies
REPEATED = 20
EMERGENCY, ENGINE, APART = "whole emergency, impacts included", "engine step", "first step, all vehicles apart"


class Cost(NamedTuple):
    """Median processor time of one step of one world."""

    what: str
    worlds: int
    vehicles: int
    nanoseconds: float

    def __str__(self) -> str:
        batch = f"{self.what:33} n = {self.worlds:6,}  N = {self.vehicles:2}"
        share = self.nanoseconds / self.vehicles
        return f"{batch} {self.nanoseconds:10,.1f} ns per world-step {share:9,.1f} ns per vehicle-step"


def by_worlds(effort: Effort = EFFORT, counts: Sequence[int] = WORLDS) -> Iterator[Cost]:
    """Two costs for each number of worlds of three vehicles."""
    for n in counts:
        yield cost(EMERGENCY, n, 3, braking(n, 1.0), effort)
        yield cost(ENGINE, n, 3, stepping(n, steps=max(10, 20_000 // n)), effort)


def by_vehicles(effort: Effort = EFFORT, counts: Sequence[int] = VEHICLES) -> Iterator[Cost]:
    """Two costs for each number of vehicles in a world."""
    for vehicles in counts:
        worlds = make_lines(LINES, vehicles)
        command = -worlds.vehicles.braking_capacity_mps2
        yield cost(EMERGENCY, LINES, vehicles, until_rest(worlds, command), effort)
        yield cost(APART, LINES, vehicles, first_step(worlds, command), effort)


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


def first_step(worlds: Worlds, command_mps2: Floats) -> Work:
    """The work of one step, repeated, so that its clock is no part of it."""

    def work() -> int:
        for _ in range(REPEATED):
            advance(worlds, command_mps2, STEP_S)
        return REPEATED * worlds.n

    return work


def cost(what: str, n: int, vehicles: int, work: Work, effort: Effort) -> Cost:
    """The median cost of this work."""
    return Cost(what, n, vehicles, 1e9 / float(np.median(rates(work, effort))))


def draw(batches: Sequence[Cost], single: Sequence[Cost], caption: str) -> Figure:
    """Cost of a step of the whole batch over n, and of one world over N; logarithmic axes, with lines of slope 1."""
    figure = new_figure(7.4, 3.9)
    left, right = figure.subplots(1, 2)
    draw_lines(left, [(c.what, c.worlds, c.nanoseconds * c.worlds * 1e-3) for c in batches])
    left.set_xlabel("Worlds n, of three vehicles", fontsize=9)
    left.set_ylabel("One step of all n worlds (µs)", fontsize=9)
    draw_lines(right, [(c.what, c.vehicles, c.nanoseconds) for c in single])
    right.set_xlabel("Vehicles N in a world", fontsize=9)
    right.set_ylabel("One step of one world (ns)", fontsize=9)
    right.set_xticks(VEHICLES, [str(each) for each in VEHICLES])
    right.minorticks_off()
    add_caption(figure, caption)
    return figure


def draw_lines(axes: Axes, points: Sequence[tuple[str, int, float]]) -> None:
    """A line for each series, and through the last point of each a line of slope 1."""
    style_axes(axes)
    series = dict.fromkeys(name for name, _, _ in points)
    lines = {what: np.array([point[1:] for point in points if point[0] == what]).T for what in series}
    for number, (what, (counts, costs)) in enumerate(lines.items()):
        axes.loglog(counts, costs, label=what, **series_style(number))
    for number, (counts, costs) in enumerate(lines.values()):
        label = "proportional" if number == 0 else None
        axes.loglog(counts, costs[-1] / counts[-1] * counts, color=GREY, linewidth=0.8, label=label, zorder=1)
    axes.legend(frameon=False, fontsize=8, loc="upper left")


if __name__ == "__main__":
    batches, single = list(by_worlds()), list(by_vehicles())
    caption = f"Processor time, one core, medians. {this_machine()}."
    write_picture(sys.argv[1], draw(batches, single, caption), force=True)
    print("\n".join(map(str, [*batches, *single])))
