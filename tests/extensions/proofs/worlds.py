"""Lines for the proofs: one by hand, random ones far beyond the paper's ranges, and commands played in the physics."""

from __future__ import annotations

from typing import Any

import numpy as np

from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import at_alert
from ethbrake_marl.evaluation.record import advance_worlds
from ethbrake_marl.extensions.proofs import line as row
from ethbrake_marl.motion.layout import FAR_M, LIMIT, Floats, scratch_for
from tests.motion.lines import lines


def worlds(gaps: Any, speeds: Any, braking: Any, latency: Any = 0.0, **settings: Any) -> State:
    """Worlds at the alert, [n]; ``drive``, ``mass``, ``limit``, ``restitution``, ``obstacle`` as given."""
    rows = {"drive": 0.0, "mass": 5.0, "limit": 40.0, "restitution": 0.1, "obstacle": FAR_M} | settings
    line, car = lines(
        gaps, speeds, restitution=rows["restitution"], obstacle_gap_m=rows["obstacle"], mass_t=rows["mass"],
        speed_limit_mps=rows["limit"], braking_capacity_mps2=braking, driving_capacity_mps2=rows["drive"],
        latency_s=latency,
    )  # fmt: skip
    n, bodies = len(line), line.shape[2]
    return at_alert(line, car, np.zeros((n, bodies, bodies)), np.zeros((n, bodies)), np.arange(n))


def paper_line(gaps: Any, speeds: Any, latency: Any) -> State:
    return worlds(gaps, speeds, [6, 7, 6], latency, drive=[6, 7, 6], mass=[4.5, 5.5, 5.9])


def at(**given: float) -> Floats:
    """One world as the proofs see it: its columns by name, 0 where none is given."""
    values = np.zeros(row.LINE_COLUMNS)
    for name, value in given.items():
        values[getattr(row, name)] = value
    return values


def opening(gap: float) -> State:
    """World in which Vehicle 1 drives away from one that is 4 m/s faster and brakes less."""
    return worlds(gap, [10, 14], [5, 2], drive=[2, 0])


def wide_worlds(n: int, N: int, seed: int) -> State:
    """Lines with any capacities, masses and restitution, low limits, slow and touching ones, exact zeros."""
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(0, 40, (n, N - 1)) * rng.choice([0.1, 0.4, 1.0], (n, N - 1))
    speeds = rng.uniform(0, 35, (n, 1)) + rng.normal(0, 1, (n, N)) * rng.choice([0.5, 3, 10], (n, 1))
    speeds = np.clip(speeds, 0, 35)
    braking, drive = rng.uniform(1, 10, (n, N)), rng.uniform(0, 8, (n, N)) * rng.choice([0.2, 1, 3], (n, 1))
    alike = rng.random(n) < 0.15
    braking[alike] = braking[alike, :1]
    latency = rng.uniform(0, 1.5, (n, N))
    latency[:, 0] = 0
    for part in (gaps, speeds, drive, latency):
        part[rng.random(part.shape) < 0.05] = 0
    together = rng.random(n) < 0.05  # neighbours that touch are equally fast
    gaps[together], speeds[together] = 0, speeds[together, :1]
    mass = np.exp(rng.uniform(0, 3, (n, N))) * rng.choice([0.1, 1, 5], (n, N), p=[0.1, 0.8, 0.1])
    above = rng.exponential(5, (n, N)) * rng.choice([0, 1], (n, N), p=[0.2, 0.8])
    restitution = rng.uniform(0, 0.5, n) * rng.choice([1, 2], n, p=[0.8, 0.2])
    return worlds(
        gaps, speeds, braking, latency, drive=drive, mass=mass, restitution=restitution,
        limit=np.maximum(speeds + above, 1e-3),
    )  # fmt: skip


def play(state: State, body: int, switch_s: Floats, command_mps2: Floats) -> State:
    """Play ``command_mps2`` [n, K], each from its ``switch_s`` [n, K] to the next, while all others brake fully.

    Ends when everything stands, or never will: after the last onset or switch, and ``limit / a`` of each vehicle.
    """
    last = np.max(np.where(np.isfinite(switch_s), switch_s, 0.0), axis=1)
    stopping = np.maximum(state.car[:, LIMIT, 1:], state.speeds_mps) / state.braking_capacity_mps2
    end = np.maximum(state.latency_s.max(axis=1), last) + stopping.sum(axis=1)
    line, now, wanted = state.line.copy(), state.time_s.copy(), np.zeros(state.wanted.shape)
    wanted[:, 1:] = -state.braking_capacity_mps2
    for k, until in enumerate([*switch_s.T[1:], end]):
        wanted[:, body], until = command_mps2[:, k], np.maximum(np.minimum(until, end), now)
        assert advance_worlds(line, state.car, now, until, wanted, scratch_for(wanted.shape[1])) == -1
        now = until
    return state._replace(line=line)


def random_commands(state: State, body: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Switch times and commands [n, 5]: most commands extreme, most switches soon after the latency."""
    n, low, high = state.n, -state.braking_capacity_mps2[:, [body - 1]], state.driving_capacity_mps2[:, [body - 1]]
    span = np.max(state.latency_s + state.speeds_mps / state.braking_capacity_mps2, axis=1, keepdims=True)
    part = np.sort(rng.uniform(0, 1, (n, 4)) ** rng.choice([1, 2, 4], (n, 1)), axis=1)
    switch = np.column_stack([state.time_s, state.latency_s[:, [body - 1]] + part * span])
    share = rng.uniform(0, 1, (n, 5))
    share = np.where(rng.random((n, 5)) < 0.6, np.round(share), share)
    return np.maximum.accumulate(switch, axis=1), np.clip(low + (high - low) * share, low, high)


def searched_harm(state: State, rounds: int, seed: int) -> dict[str, Floats]:
    """Least harm of random commands of Vehicle 2, and of changes to the best of them, in both counts."""
    rng = np.random.default_rng(seed)
    switch, command = random_commands(state, 2, rng)
    least = {count: np.full(state.n, np.inf) for count in ("first", "total")}
    low, high = -state.braking_capacity_mps2[:, [1]], state.driving_capacity_mps2[:, [1]]
    for k in range(rounds):
        new_switch, new_command = random_commands(state, 2, rng)
        if k >= rounds // 4:
            scale = 10.0 ** rng.uniform(-5, 0, (state.n, 1))
            moved = switch + 3 * scale * rng.normal(size=switch.shape) * (rng.random(switch.shape) < 0.5)
            moved[:, 0] = state.time_s
            new_switch = np.maximum.accumulate(np.maximum(moved, state.time_s[:, np.newaxis]), axis=1)
            changed = command + 7 * scale * rng.normal(size=command.shape) * (rng.random(command.shape) < 0.3)
            new_command = np.clip(changed, low, high)
        end = play(state, 2, new_switch, new_command)
        better = end.harm("first") < least["first"]
        switch[better], command[better] = new_switch[better], new_command[better]
        least = {count: np.minimum(least[count], end.harm(count)) for count in least}
    return least
