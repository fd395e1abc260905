"""A comparison of what happened with what was predicted: to the last bit, the harm so far included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ethbrake_marl.physics.columns import Packed
from ethbrake_marl.physics.state import Bools, Floats, Worlds
from ethbrake_marl.shield.certify import ends_of_plans
from ethbrake_marl.shield.running import Running

SLACK = 1e-9  # by more than this (m, m/s) a world lies outside what several members predict; one member is exact

GROUPS = (("gap", " m"), ("hit flag", ""), ("first-impact harm", " m2/s2"), ("total harm", " m2/s2"))  # of each pair


def seen_columns(packed: Packed) -> Floats:
    """Running worlds and their harm so far in the columns of ``Running.states``, [n, S], to compare the two.

    These are speeds, gaps, hit flags and both harms, with the obstacle first in each group where there is one. Raises
    ``InvalidInput`` where only some of the worlds have one.
    """
    state, column = packed.state, packed.column
    speeds, first, pairs, at = state[:, column.speed : column.command], column.gap, column.vehicles - 1, column.obstacle
    if packed.has_obstacle:
        groups = [state[:, first + g * pairs : first + (g + 1) * pairs] for g in range(len(GROUPS))]
        whole = [part for g, group in enumerate(groups) for part in (state[:, at + g : at + g + 1], group)]
        return np.concatenate([np.zeros((len(state), 1)), speeds, *whole], axis=1)
    return np.concatenate([speeds, state[:, first : first + len(GROUPS) * pairs]], axis=1)


def worlds_at(worlds: Worlds, states: Floats) -> Worlds:
    """The worlds with speeds, gaps and hit flags (the obstacle's too) from the states [n, S] of their problem."""
    added = (states.shape[1] + 4) // 6 - worlds.N  # 1: columns of an obstacle, or of a post, in front of each group
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
    """The first number in which a world as seen [S] is not as predicted [S], in words; "nothing" where all are."""
    vehicles = (len(predicted) + 4) // 6
    for column in np.flatnonzero(~(seen == predicted[: len(seen)])).tolist():
        if column < vehicles:
            what, unit = f"speed of vehicle {column + 1} of the line", " m/s"
        else:
            group, pair = divmod(column - vehicles, vehicles - 1)
            what, unit = f"{GROUPS[group][0]} of pair {pair + 1}", GROUPS[group][1]
        return f"{what} is {seen[column]:.17g}{unit}, certified was {predicted[column]:.17g}{unit}"
    return "nothing"


def ends_under(running: Running, plan: Floats) -> tuple[Bools, Floats]:
    """How the episodes end if the plans are executed from here.

    Where everything rests at the horizon, in every member, [n]; and the harm of the whole episode that each vehicle
    bears, split by mass as in the ledger, to the same bits, [n * M, N] m2/s2. With an obstacle ahead its column comes
    first, and is 0.
    """
    rests, borne = np.empty(running.n, np.bool_), np.empty(running.problem.mass.shape)
    plans = np.ascontiguousarray(plan).reshape(*plan.shape[:2], len(running.problem.vehicles))
    ends_of_plans(running.uncapped, plans, rests, borne)
    return rests, borne
