"""Where a world drawn from a box leaves the enclosure of interior mode: its states, not only its harm.

``follow_paths`` goes the way of ``enclosure.most_harm`` and keeps every path at every piece of time. A state that was
realised must be that of some path with the same pairs hit. What follows a vehicle that may be thrown backwards is told
by its harm alone, and not looked at.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.registry import fixed_commands, script_agents
from ethbrake_marl.physics import Worlds, advance
from ethbrake_marl.shield.enclosure import (
    CLOSING,
    OPENING,
    TOUCHES,
    WIDE,
    Known,
    Path,
    backwards,
    cell_of,
    go_on,
    high,
    may_meet_unseen,
    meet,
    move_alone,
    new_motion,
    new_stack,
    stray,
    wait,
)

ROOM = 1e-7  # for what two ways to compute a state differ by
MOST = 20_000  # states of paths


class Outside(NamedTuple):
    """What was found."""

    states: int  # looked at
    touching: int  # of which a pair was in contact
    outside: list[str]  # those that no path encloses


def follow_paths(cell):
    """Every path at every piece of time, by its number; whether all of them were followed to their end."""
    N, P = cell.speed.shape[0], cell.gap.shape[0]
    stack, motion, found, whole = new_stack(N, cell.drive.shape[0]), new_motion(N, cell.drive.shape[0]), {}, True
    stack.forms[0, :N], stack.forms[0, N : N + P], stack.size[0] = cell.speed, cell.gap, 1
    worst, out = -np.inf, np.zeros(cell.drive.shape[0])
    while stack.size[0] > 0 and sum(map(len, found.values())) < MOST:
        stack.size[0] -= 1
        top = stack.size[0]
        here = Path(stack.forms[top].copy(), stack.touch[top].copy(), stack.marks[top].copy())
        while True:
            piece = int(here.marks[2 * P])
            found.setdefault(piece, []).append(Path(*(part.copy() for part in here)))
            if piece == len(cell.action):
                break
            move_alone(cell, here, piece, motion)
            if may_meet_unseen(cell, here, motion):
                whole = False
                break
            worst = meet(cell, here, stack, motion, worst, out)
            if not go_on(cell, here, motion):
                break
            here.marks[2 * P] += 1
    return found, whole and stack.size[0] == 0


def realised(scenario, truth: Worlds, vehicle: int, plan, times):
    """Worlds at each of the times (s after their first decision) under the plan, and their harm so far."""
    command = fixed_commands(script_agents(scenario, except_for=vehicle), truth, "test", vehicle=vehicle).copy()
    first = np.maximum(truth.vehicles.latency_s[:, vehicle], truth.time_s)
    harm, v = np.zeros((truth.n, truth.N - 1)), truth.vehicles
    for j, at in enumerate(times):
        middle = 0.5 * (times[j - 1] + at) if j > 0 else -1.0
        action = plan[min(int(middle / scenario.time_step_s), len(plan) - 1)] if middle > 0.0 else 0.0
        capacity = v.braking_capacity_mps2 if action < 0.0 else v.driving_capacity_mps2
        command[:, vehicle] = action * capacity[:, vehicle]
        truth, impacts = advance(truth, command, until_s=np.maximum(first + at, truth.time_s))
        harm = harm + impacts.first_impact_harm
        yield truth, harm.sum(axis=1)


def outside(scenario, uncertainty, boxes, worlds, vehicle: int, plan, draws: int, rng) -> Outside:
    """Draw worlds out of the box of one world, and look for states that no path encloses."""
    low, up = boxes.low[0], boxes.high[0]
    free = np.flatnonzero(up > low)
    known = Known(
        vehicle, boxes.constant[0], boxes.limit[0], float(boxes.restitution[0]), float(boxes.begin_s[0]),
        boxes.time_step_s, boxes.horizon_s,
    )  # fmt: skip
    cell, late = cell_of(low, up, free, known, plan)
    assert wait(cell, late)
    paths, whole = follow_paths(cell)
    assert whole
    truth = uncertainty.draw(worlds.take(np.zeros(draws, np.int64)), rng)
    v = truth.vehicles
    numbers = np.concatenate(
        [v.braking_capacity_mps2, v.driving_capacity_mps2, v.latency_s, v.mass_t, truth.speeds_mps, truth.gaps_m], 1
    )
    at = (numbers - 0.5 * (low + up))[:, free] / (0.5 * (up - low))[free]
    found, touching, looked = [], 0, 0
    back = np.array([backwards(cell, p) > 0.0 for p in range(truth.N - 1)])
    for piece, (now, harm) in enumerate(realised(scenario, truth, vehicle, plan, cell.times)):
        for k in range(draws):
            if now.pair_hit[k].all() or (now.pair_hit[k] & back).any() or now.time_s[k] > scenario.horizon_s:
                continue
            looked += 1
            here = [path for path in paths.get(piece, []) if encloses(cell, path, now, harm, k, at[k])]
            touching += any((path.marks[truth.N - 1 : -1] == TOUCHES).any() for path in here)
            if not here:
                found.append(f"piece {piece}, hit {now.pair_hit[k]}, {now.speeds_mps[k]} m/s, {now.gaps_m[k]} m")
    return Outside(looked, touching, found)


def encloses(cell, path: Path, now: Worlds, harm, k: int, at) -> bool:
    """Whether world ``k``, at ``at`` [K] in its box, may have gone this path so far."""
    N, P = now.N, now.N - 1
    if not (path.marks[:P] == now.pair_hit[k]).all():
        return False
    exact, room = path.forms[:, 0] + path.forms[:, 1:-1] @ at, path.forms[:, -1] + ROOM
    for p in range(P):
        if path.marks[P + p] == TOUCHES:
            touch = path.touch[p]
            closing = now.speeds_mps[k, p + 1] - now.speeds_mps[k, p]
            if not -touch[OPENING] - ROOM <= closing <= max(touch[CLOSING], 0.0) + ROOM:
                return False
            if now.gaps_m[k, p] > touch[WIDE] + ROOM:
                return False
            apart = max(touch[OPENING], touch[CLOSING], 0.0)
            for side in range(2):
                room[p + side] += high(cell.share[p, side]) * apart + stray(cell, touch, p)
                if 0 <= p - 1 + 2 * side < P:
                    room[N + p - 1 + 2 * side] += high(cell.share[p, side]) * touch[WIDE]
            room[N + p] = np.inf
    state = np.concatenate([now.speeds_mps[k], now.gaps_m[k], harm[k : k + 1]])
    return bool((np.abs(state - exact) <= room).all())
