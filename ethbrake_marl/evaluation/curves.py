"""Harm of one agent over both gaps, and where worlds become avoidable: what a criticality map shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents import Agent, optimise_coupled, optimise_pairwise, pairwise_harm
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.measures import Evaluation, Outcome
from ethbrake_marl.evaluation.rollout import controlled_vehicle, evaluate
from ethbrake_marl.limits import Limits, Unproven, avoidability, known_limits, scripted_commands, undecided_because
from ethbrake_marl.physics import Bools, Floats, Worlds, advance, forecast, make_worlds
from ethbrake_marl.scenario import Scenario, Task

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
    bounds = scenario.bounds("gaps_m")[:2]
    drawn = [(low, high) if low < high else (FIXED_GAP[0] * low, FIXED_GAP[1] * high) for low, high in bounds]
    ranges = [gap_range_m] * 2 if gap_range_m else drawn
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


def _worlds_at(scenario: Scenario, gap_1_m: Floats, gap_2_m: Floats) -> Worlds:
    """Worlds with these first two gaps; everything else as the scenario fixes it."""
    columns = {"gap_1_m": gap_1_m, "gap_2_m": gap_2_m}
    for name, (field, i) in scenario.table_columns.items():
        if name not in columns and field != "obstacle_gap_m":
            low, high = scenario.bounds(field, dry=True)[i]
            if low != high:
                raise InvalidInput(
                    f"scenario {scenario.name!r}: {name} is random, from {low:g} to {high:g}; a criticality map needs"
                    " everything but the first two gaps fixed (paper-distance is such a scenario)"
                )
            if field in ("gaps_m", "speeds_mps"):  # a table needs those; the rest it takes from the scenario
                columns[name] = np.full(gap_1_m.size, low)
    return scenario.worlds_from_table(columns)


# Harm against the constant deceleration of one vehicle in one world: predicted, realised, and the best known.
#
# The prediction is the closed form of E-V2X-BM, which treats the pairs as independent; the realised curves are the same
# decelerations in the engine, where the other vehicles follow their scripts.

POINTS = 2001  # evenly spaced decelerations; the breakpoints of the closed form come on top
_LONG_S = 1e4  # whoever still coasts has met or will never meet


@dataclass(frozen=True, slots=True)
class Choice:
    """A constant deceleration that E-V2X-BM takes in the world, and the harm that it minimises there (m2/s2)."""

    deceleration_mps2: float
    harm: float


@dataclass(frozen=True, slots=True)
class DecelerationCurve:
    """Harm (m2/s2) of one world at K constant decelerations of one vehicle, in rising order."""

    task: Task  # its one vehicle has the deceleration
    world: Worlds  # n = 1, at the alert
    deceleration_mps2: Floats  # [K] from 0 to the braking capacity
    predicted: Floats  # [K] pairwise, in closed form
    first_impact_harm: Floats  # [K] realised
    total_harm: Floats  # [K] realised
    regimes: dict[str, NDArray[np.str_]]  # per pair of the vehicle ("front pair", "rear pair"): [K] how it first meets
    closed_form: Choice  # its harm is the predicted one
    coupled: Mapping[HarmCount, Choice]  # minimising either count in the simulation
    limits: Limits | Unproven  # what is known of the world over all time-varying commands

    def harm(self, harm_count: HarmCount) -> Floats:
        """The realised harm under a counting rule, [K] m2/s2."""
        return self.first_impact_harm if harm_count == "first" else self.total_harm


def deceleration_curve(world: Worlds, task: Task, *, points: int = POINTS) -> DecelerationCurve:
    """The three harms of one world at evenly spaced decelerations of the vehicle, and at those of the closed form.

    The prediction lets all others brake fully; in the simulation they follow the scenario's scripts. Raises
    ``InvalidInput`` unless there is exactly one world, ``points`` is at least 2 and every script is fixed at the alert.
    """
    if world.n != 1:
        raise InvalidInput(f"deceleration curve: {world.n} worlds given; exactly one is drawn")
    if not points >= 2:
        raise InvalidInput(f"deceleration curve: points = {points}; at least 2 are needed")
    scenario, vehicle = task.scenario, task.vehicle
    capacity = float(world.vehicles.braking_capacity_mps2[0, vehicle])
    pairwise = optimise_pairwise(world, vehicle)
    chosen = pairwise.deceleration_mps2
    special = np.append(pairwise.breakpoints_mps2[0], chosen)
    at = np.union1d(np.linspace(0.0, capacity, points), special)
    others = scripted_commands(world, task)
    first, total = forecast(world, others, vehicle, -at[None, :], scenario.horizon_s)
    deceleration = np.repeat(world.vehicles.braking_capacity_mps2, at.size, axis=0)
    deceleration[:, vehicle] = at
    copies = world.take(np.zeros(at.size, np.int64))
    contacts = pairwise_harm(copies, deceleration)
    pairs = {"front pair": vehicle - 1, "rear pair": vehicle}
    own = {name: p for name, p in pairs.items() if 0 <= p < world.N - 1}
    regimes = {name: regimes_of(copies, p, deceleration) for name, p in own.items()}
    predicted = contacts[:, list(own.values())].sum(axis=1)
    coupled = {}
    for rule in HARM_COUNTS:
        best = optimise_coupled(world, vehicle, harm_count=rule, horizon_s=scenario.horizon_s, others_mps2=others)
        coupled[rule] = Choice(float(best.deceleration_mps2[0]), float(best.harm[0]))
    closed_form = Choice(float(chosen[0]), float(predicted[np.searchsorted(at, chosen[0])]))
    return DecelerationCurve(
        task, world, at, predicted, first[0], total[0], regimes, closed_form,
        coupled, known_limits(world, task),
    )  # fmt: skip


def regimes_of(worlds: Worlds, pair: int, deceleration_mps2: Floats) -> NDArray[np.str_]:
    """How one pair, alone, first meets under constant decelerations [n, N] from now (t = 0) on, [n].

    ``A``, ``A'``, ``B`` or ``C`` as in docs/proofs/constant-deceleration.md, ``early``: before the pair's leader
    brakes, or ``none``.
    """
    own = slice(pair, pair + 2)
    v = worlds.vehicles
    alone = make_worlds(
        worlds.gaps_m[:, [pair]], worlds.speeds_mps[:, own], braking_capacity_mps2=v.braking_capacity_mps2[:, own],
        driving_capacity_mps2=0.0, latency_s=v.latency_s[:, own], mass_t=1.0, restitution=0.0,
        speed_limit_mps=v.speed_limit_mps[:, own],
    )  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):  # when each would stand; inf without braking
        speed = worlds.speeds_mps[:, own]
        stop_s = np.where(speed > 0.0, v.latency_s[:, own] + speed / deceleration_mps2[:, own], 0.0)
    rows = advance(alone, -deceleration_mps2[:, own], until_s=_LONG_S, record=True)[1].rows
    assert rows is not None
    meets_s = np.full(worlds.n, np.inf)
    meets_s[rows.world[rows.first]] = rows.time_s[rows.first]
    coasting, stands = meets_s <= v.latency_s[:, pair + 1], meets_s >= stop_s[:, 0]
    cases = [np.isinf(meets_s), meets_s < v.latency_s[:, pair], coasting & stands, coasting, stands]
    return np.select(cases, ["none", "early", "A'", "A", "C"], "B")
