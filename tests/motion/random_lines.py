"""Random worlds for the physics: everything that a scenario can declare, and the cases between."""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from ethbrake_marl.motion import layout as at
from ethbrake_marl.motion.interval import FAILED
from ethbrake_marl.motion.layout import Floats
from tests.motion.lines import driven, lines
from tests.reference import exact_simulator as exact
from tests.reference.stepped import Line, infinite_where_far, simulate


class Runs(NamedTuple):
    """Worlds, and what their vehicles command in the intervals between the ``times``."""

    line: Floats  # [n, LINE_ROWS, N + 1]
    car: Floats  # [n, CAR_ROWS, N + 1]
    times: list[float]  # [T + 1] s
    commands: Floats  # [T, n, N] m/s2

    def take(self, rows: np.ndarray) -> Runs:
        return Runs(self.line[rows], self.car[rows], self.times, self.commands[:, rows])


def random_runs(rng: np.random.Generator, n: int, N: int, *, builds_up: bool, obstacle: bool) -> Runs:
    """Worlds with masses from 0.5 to 40 t, any latency, vehicles that touch, rest, drive at the limit."""

    def some(share: float, these: Floats, others: Floats) -> Floats:
        return np.where(rng.random(these.shape) < share, these, others)

    def per_vehicle(low: float, high: float) -> Floats:
        return rng.uniform(low, high, (n, N))

    gaps = some(0.2, np.zeros((n, N - 1)), rng.uniform(0.05, 12.0, (n, N - 1)))
    speeds = some(0.6, np.broadcast_to(rng.uniform(0.0, 25.0, (n, 1)), (n, N)), per_vehicle(0.0, 25.0))
    speeds = some(0.1, np.zeros((n, N)), speeds)
    mass = np.exp(per_vehicle(np.log(0.5), np.log(40.0)))
    limit = some(0.3, np.maximum(speeds, 1.0), per_vehicle(5.0, 40.0))
    latency = some(0.2, np.zeros((n, N)), per_vehicle(0.0, 1.5))
    latency = some(0.1, per_vehicle(2.0, 6.0), latency)
    latency = some(0.2, np.round(latency, 1), latency)  # at a decision
    rates = [some(0.3, np.full((n, N), np.inf), 10.0 ** per_vehicle(0.3, 2.0)) for _ in range(2)]
    ahead = rng.uniform(0.0, 60.0, n)
    ahead[rng.random(n) < 0.1] = 0.0
    times = [0.0, *np.round(np.cumsum(rng.choice([0.1, 0.3, 0.7], 9)), 1).tolist(), 6.0]
    commands = rng.uniform(-9.0, 7.0, (len(times) - 1, n, N))
    commands = some(0.4, np.full(commands.shape, -8.0), commands)
    commands = some(0.1, np.zeros(commands.shape), commands)
    line, car = lines(
        gaps, speeds, restitution=some(0.3, np.zeros(n), rng.uniform(0.0, 0.9, n)),
        obstacle_gap_m=ahead if obstacle else at.FAR_M, mass_t=mass, latency_s=latency, speed_limit_mps=limit,
        **(dict(zip(("brake_rate_mps3", "release_rate_mps3"), rates, strict=True)) if builds_up else {}),
    )  # fmt: skip
    return Runs(line, car, times, commands)


def played(runs: Runs) -> Floats:
    line = runs.line
    for start, end, command in zip(runs.times[:-1], runs.times[1:], runs.commands, strict=True):
        line, met, _ = driven(line, runs.car, command, start, end)
        assert (met != FAILED).all()
    return line


def stepped(runs: Runs, step_s: float) -> Floats:
    """Lines at the end by small steps; NaN where these do not come to an end."""
    out = runs.line.copy()
    for k, (line, car) in enumerate(zip(runs.line, runs.car, strict=True)):
        gaps = [infinite_where_far(line[at.GAP, 0]), *line[at.GAP, 1:-1]]
        rows = [car[row, 1:] for row in (at.MASS, at.LIMIT, at.LATENCY, at.BRAKE_RATE, at.RELEASE_RATE)]
        world = Line(gaps, line[at.SPEED, 1:], line[at.FORCE, 1:], *rows, car[at.RESTITUTION, 0])
        end = simulate(world, runs.times, runs.commands[:, k], step_s)
        out[k, at.SPEED, 1:], out[k, at.FORCE, 1:] = end.speeds, end.forces
        out[k, at.GAP, 1:-1] = end.gaps[1:]
        out[k, at.GAP, 0] = min(end.gaps[0], at.FAR_M)
        out[k, [at.HIT, at.FIRST, at.TOTAL, at.IMPACTS, at.PUSHED], :-1] = end.book[:5]
        if not end.finished:
            out[k] = np.nan
    return out


def differences(one: Floats, other: Floats) -> Floats:
    """Largest relative difference of each world in speeds, forces, gaps and both counts of harm, [n]."""
    rows = [at.SPEED, at.FORCE, at.GAP, at.FIRST, at.TOTAL]
    return largest(one, other, rows)


def push_differences(one: Floats, other: Floats) -> Floats:
    return largest(one, other, [at.PUSHED])


def passed_differences(one: Floats, other: Floats) -> Floats:
    return largest(one, other, [at.PASSED])


def pushes_off(runs: Runs, close: float) -> tuple[Floats, np.ndarray]:
    """How far pushes are from those by small steps, and in which worlds these have the same impacts, [n].

    Steps are 1e-4 s. Worlds further off than ``close`` have an event within a step, whose error falls with the length
    of the step: they are extrapolated from two lengths. Small steps miss the last of many impacts.
    """
    end, steps = played(runs), stepped(runs, 1e-4)
    off, same = push_differences(end, steps), (end[:, at.IMPACTS] == steps[:, at.IMPACTS]).all(axis=1)
    for step_s in (1e-5, 1e-6):
        far = same & ~(off <= close)
        finer = stepped(runs.take(far), step_s)
        zero = steps[far]
        zero[:, at.PUSHED] = (10.0 * finer[:, at.PUSHED] - zero[:, at.PUSHED]) / 9.0
        off[far], same[far] = (
            push_differences(end[far], zero),
            (end[far, at.IMPACTS] == finer[:, at.IMPACTS]).all(axis=1),
        )
        steps[far] = finer
    return off, same


def largest(one: Floats, other: Floats, rows: list[int]) -> Floats:
    a, b = (np.minimum(line[:, rows, :-1], 1e9) for line in (one, other))  # no obstacle: beyond 1e9 m
    return np.asarray((np.abs(a - b) / (1.0 + np.abs(a))).max(axis=(1, 2)))


def exactly(runs: Runs, k: int) -> Floats:
    """Line of world k, whose brakes act at once, at the end in rational arithmetic."""
    line, car = runs.line[k].copy(), runs.car[k]
    mass, limit = (rationals(car[row, 1:]) for row in (at.MASS, at.LIMIT))
    gaps, speeds = rationals(line[at.GAP, 1:-1]), rationals(line[at.SPEED, 1:])
    obstacle = Fraction(float(line[at.GAP, 0])) if line[at.GAP, 0] < at.FAR_M else None
    by_forces, struck = None, set()
    for start, end, command in zip(runs.times[:-1], runs.times[1:], runs.commands[:, k], strict=True):
        left = rationals(np.maximum(car[at.LATENCY, 1:] - start, 0.0))
        world = exact.Line(
            gaps, speeds, rationals(command), left, mass, limit, Fraction(float(car[at.RESTITUTION, 0])), obstacle,
            by_forces, frozenset(struck),
        )  # fmt: skip
        gaps, speeds, hits, obstacle, pushed, by_forces, passed = exact.Run(world).to(Fraction(end - start))
        line[at.PUSHED, :-1] += [float(pushed[-1]), *map(float, pushed[:-1])]
        line[at.PASSED, :-1] += [float(passed[-1]), *map(float, passed[:-1])]
        struck |= {pair for pair, _ in hits}
        for pair, closing in hits:
            harm, p = float(closing) ** 2, pair + 1
            line[at.FIRST, p] += 0.0 if line[at.HIT, p] else harm
            line[at.HIT, p] = 1.0
            line[at.TOTAL, p] += harm
            line[at.IMPACTS, p] += 1.0
    line[at.SPEED, 1:], line[at.GAP, 1:-1] = speeds, gaps
    line[at.GAP, 0] = at.FAR_M if obstacle is None else obstacle
    line[at.FORCE, 1:] = np.where(car[at.LATENCY, 1:] < runs.times[-1] - 1e-9, runs.commands[-1, k], 0.0)
    return line


def rationals(numbers: Floats) -> tuple[Fraction, ...]:
    return tuple(Fraction(float(x)) for x in numbers)
