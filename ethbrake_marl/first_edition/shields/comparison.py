"""Compare the observed worlds with the shield's prediction: bit by bit, including the harm so far."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds
from ethbrake_marl.first_edition.shields.certify import ends_of_plans
from ethbrake_marl.first_edition.shields.running import Running

SLACK = 1e-9  # tolerance (m, m/s) around the range of several predicted worlds; a single one must match exactly

# quantities of each pair in a state: name and unit
GROUPS = (("gap", " m"), ("hit flag", ""), ("first-impact harm", " m2/s2"), ("total harm", " m2/s2"))


def seen_columns(packed: Packed) -> Floats:
    """Return the states of an engine's running worlds, [n, S], in the layout of ``Running.states``.

    Each row consists of five groups of columns: speeds, gaps, hit flags (1 after an impact of the pair), first-impact
    harms and total harms. If any world has an obstacle ahead, each group of columns begins with a column for the
    obstacle.
    """
    state, column = packed.state, packed.column
    speeds, first, pairs, at = state[:, column.speed : column.command], column.gap, column.vehicles - 1, column.obstacle
    if packed.has_obstacle:
        groups = [state[:, first + g * pairs : first + (g + 1) * pairs] for g in range(len(GROUPS))]
        whole = [part for g, group in enumerate(groups) for part in (state[:, at + g : at + g + 1], group)]
        return np.concatenate([np.zeros((len(state), 1)), speeds, *whole], axis=1)
    return np.concatenate([speeds, state[:, first : first + len(GROUPS) * pairs]], axis=1)


def worlds_at(worlds: Worlds, states: Floats) -> Worlds:
    """Return a copy of ``worlds`` with the speeds, gaps and hit flags (1: the pair had an impact) of ``states``.

    ``states`` [n, S] has the layout of ``Running.states``. The gap to an obstacle ahead and the obstacle's hit flag
    also come from ``states``.
    """
    added = (states.shape[1] + 4) // 6 - worlds.N  # 1 if each group starts with the column of an obstacle, else 0
    N = worlds.N + added
    gaps, hit = states[:, N : 2 * N - 1], states[:, 2 * N - 1 : 3 * N - 2] == 1.0
    return replace(
        worlds,
        speeds_mps=states[:, added:N].copy(),
        gaps_m=gaps[:, added:].copy(),
        pair_hit=hit[:, added:].copy(),
        obstacle_gap_m=np.where(worlds.obstacle_ahead, gaps[:, 0], np.inf) if added else worlds.obstacle_gap_m,
        obstacle_hit=hit[:, 0].copy() if added else worlds.obstacle_hit,
    )


def difference(predicted: Floats, seen: Floats) -> str:
    """Describe the first number in which an observed world differs from its prediction; "nothing" if all numbers are
    equal.

    ``predicted`` and ``seen`` are rows [S] in the layout of ``Running.states``; ``seen`` may lack the last columns.
    """
    vehicles = (len(predicted) + 4) // 6
    for column in np.flatnonzero(~(seen == predicted[: len(seen)])).tolist():
        if column < vehicles:
            what, unit = f"the speed of vehicle {column + 1} of the line", " m/s"
        else:
            group, pair = divmod(column - vehicles, vehicles - 1)
            what, unit = f"the {GROUPS[group][0]} of pair {pair + 1}", GROUPS[group][1]
        return f"{what} is {seen[column]:.17g}{unit}, but the shield predicted {predicted[column]:.17g}{unit}"
    return "nothing"


def ends_under(running: Running, plan: Floats) -> tuple[Bools, Floats]:
    """Return whether all vehicles come to rest, and each vehicle's harm, if the plans are executed from now on.

    ``plan`` is [n, L], or [n, L, K] for K shielded vehicles. The first result is True for the worlds in which all
    vehicles are at rest at the horizon in every possible world, [n]. The second result is the harm of the whole episode
    that each vehicle bears, [n * M, N] m2/s2, equal, to the bit, to the harm in the engine's ledger at the end of the
    episode. With an obstacle ahead, the first of the N columns belongs to the obstacle and is 0.
    """
    rests, borne = np.empty(running.n, np.bool_), np.empty(running.problem.mass.shape)
    plans = np.ascontiguousarray(plan).reshape(*plan.shape[:2], len(running.problem.vehicles))
    ends_of_plans(running.uncapped, plans, rests, borne)
    return rests, borne
