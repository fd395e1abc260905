"""Harm of one agent over both gaps, and where worlds become avoidable: what a criticality map shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.outcome import Evaluation, Outcome
from ethbrake_marl.evaluation.rollout import controlled_vehicle, evaluate
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.limits.avoidability import avoidability
from ethbrake_marl.limits.limits import Unproven, undecided_because
from ethbrake_marl.physics import Bools, Floats, Worlds
from ethbrake_marl.scenario import Scenario, Task, worlds_from_table
from ethbrake_marl.scenario.quantities import QUANTITIES

CELLS = 81  # along each gap
CHUNK = 500  # worlds between two reports of progress
COLUMNS = 401  # first gaps at which the boundary is found
HALVINGS = 40  # of the range of the second gap, there
FIXED_GAP = (0.5, 1.5)  # a gap that the scenario fixes is drawn over this multiple of it

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class CriticalityMap:
    """Harm over a grid of both gaps, and where worlds become avoidable."""

    gap_1_m: Floats  # [G] centres of the cells
    gap_2_m: Floats  # [G]
    evaluation: Evaluation  # of the G x G worlds; gap 1 varies fastest
    avoidable: Bools | None  # [G (gap 2), G (gap 1)]; None where nothing is proven for this line-up
    boundary_gap_1_m: Floats | None  # [B] None where nothing is proven for this line-up
    boundary_gap_2_m: Floats | None  # [B] above it worlds are avoidable; NaN where it leaves the range

    def harm(self, harm_count: HarmCount) -> Floats:
        """Harm of the agent in each cell, [G (gap 2), G (gap 1)] m2/s2."""
        outcome: Outcome = next(iter(self.evaluation.outcomes.values()))
        return outcome.world_harm(harm_count).reshape(self.gap_2_m.size, self.gap_1_m.size)


def criticality_map(
    scenario: Scenario,
    agents: dict[str, Agent],
    *,
    cells: int = CELLS,
    gap_range_m: Range | None = None,
    on_progress: Callable[[str, int, int], None] | None = None,
) -> CriticalityMap:
    """Let one agent drive a grid of worlds that differ in the first two gaps only.

    Args:
        scenario: of the worlds; everything but the first two gaps must be a fixed number there.
        agents: exactly one, by its name.
        cells: worlds along each gap, at least 2.
        gap_range_m: least and largest value of both gaps; None: the scenario's, and of a fixed gap half to one and a
            half of it.
        on_progress: is told agent, worlds done, and all.

    Raises ``InvalidInput`` for what is random, fewer than three vehicles, fewer than 2 cells, more or less than one
    agent, or a range that is empty or below 0.

    """
    if len(agents) != 1:
        raise InvalidInput(f"criticality map: {len(agents)} agents given; exactly one is drawn")
    if scenario.vehicles < 3:
        raise InvalidInput(f"criticality map: scenario {scenario.name!r} has one gap; at least two are needed")
    if not cells >= 2:
        raise InvalidInput(f"criticality map: cells = {cells}; at least 2 are needed")
    ranges = [gap_range_m or _range_of(scenario, pair) for pair in (0, 1)]
    for low, high in ranges:
        if not 0.0 <= low < high < np.inf:
            raise InvalidInput(f"criticality map: gaps from {low:g} to {high:g} m; must be 0 <= low < high")
    first, second = (np.linspace(*ends, cells) for ends in ranges)
    across, up = np.meshgrid(first, second)
    worlds = _worlds_at(scenario, across.ravel(), up.ravel())
    tell = on_progress or (lambda agent, done, total: None)
    evaluation = evaluate(
        worlds, agents, scenario=scenario, chunk=CHUNK, on_progress=lambda agent, done: tell(agent, done, worlds.n)
    ).complete()
    limits = evaluation.limits
    verdict = None if isinstance(limits, Unproven) else limits.proof.avoidable
    avoidable = None if verdict is None else verdict.reshape(cells, cells)
    boundary = avoidability_boundary(scenario, *ranges)
    return CriticalityMap(first, second, evaluation, avoidable, *(boundary or (None, None)))


def avoidability_boundary(scenario: Scenario, range_1_m: Range, range_2_m: Range) -> tuple[Floats, Floats] | None:
    """Smallest second gap at which worlds are avoidable, for first gaps over a range: (gap 1 [B], gap 2 [B]).

    A larger gap to Vehicle 3 never makes contact unavoidable, so the boundary is found by halving. NaN where it is
    outside the range. None where nothing is proven.
    """
    vehicle = controlled_vehicle(scenario, None)
    corners = _worlds_at(scenario, *np.array([range_1_m, range_2_m]))
    if undecided_because(corners, Task(scenario, (vehicle,))) is not None:
        return None

    def avoidable(gap_1_m: Floats, gap_2_m: Floats) -> Bools:
        return avoidability(_worlds_at(scenario, gap_1_m, gap_2_m), vehicle).avoidable

    return _halve(avoidable, np.linspace(*range_1_m, COLUMNS), range_2_m)


def _halve(avoidable: Callable[[Floats, Floats], Bools], gap_1_m: Floats, ends: Range) -> tuple[Floats, Floats]:
    """The smallest avoidable second gap between ``ends`` for each first gap.

    Where all or none is avoidable, the boundary runs along that end; of such a stretch only the points beside the rest
    of the boundary are kept (they show where it leaves the range, or jumps), the others are NaN.
    """
    low, high = np.full(gap_1_m.size, ends[0]), np.full(gap_1_m.size, ends[1])
    none, every = ~avoidable(gap_1_m, high), avoidable(gap_1_m, low)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        good = avoidable(gap_1_m, middle)
        low, high = np.where(good, low, middle), np.where(good, middle, high)
    at = np.select([none, every], [ends[1], ends[0]], high)
    alike = (at[1:] == at[:-1]) & (none | every)[1:] & (none | every)[:-1]
    inside = np.append(alike, True) & np.append(True, alike)
    return gap_1_m, np.where(inside, np.nan, at)


def _range_of(scenario: Scenario, pair: int) -> Range:
    """Over which a gap is drawn: what the scenario draws from, or around its fixed number."""
    low, high = scenario.bounds("gaps_m")[pair]
    return (low, high) if low < high else (FIXED_GAP[0] * low, FIXED_GAP[1] * high)


def _worlds_at(scenario: Scenario, gap_1_m: Floats, gap_2_m: Floats) -> Worlds:
    """Worlds with these first two gaps; everything else as the scenario fixes it."""
    columns = {"gap_1_m": gap_1_m, "gap_2_m": gap_2_m}
    for field, rule in QUANTITIES.items():
        for i in range(2 if field == "gaps_m" else 0, rule.count(scenario.vehicles)):
            low, high = scenario.bounds(field)[i]
            name = QUANTITIES[field].column_of(i)
            if low != high:
                raise InvalidInput(
                    f"scenario {scenario.name!r}: {name} is random, from {low:g} to {high:g}; a criticality map needs"
                    " everything but the first two gaps fixed (paper-distance is such a scenario)"
                )
            if field in ("gaps_m", "speeds_mps"):  # a table needs those; the rest it takes from the scenario
                columns[name] = np.full(gap_1_m.size, low)
    return worlds_from_table(columns, scenario)
