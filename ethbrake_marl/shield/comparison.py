"""The comparison of what happened with what was predicted: to the last bit, the harm so far included."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.physics.rows import Packed, command_at, gap_at, has_obstacle, speed_at, state_width, vehicles_in
from ethbrake_marl.shield.certify import Running

SLACK = 1e-9  # by more than this (m, m/s) a world lies outside what several members predict; one member is exact
GROUPS = (("gap", " m"), ("hit flag", ""), ("first-impact harm", " m2/s2"), ("total harm", " m2/s2"))  # of each pair


def seen_columns(packed: Packed) -> Floats:
    """Running worlds and their harm so far in the columns of ``Running.states``, [n, S]: to be compared with them.

    Those are speeds, gaps, hit flags and both harms, with the obstacle first in each group where there is one. Raises
    ``InvalidInput`` where only some of the worlds have one.
    """
    state = packed.state
    N = vehicles_in(state)
    speeds, first, pairs = state[:, speed_at(N) : command_at(N)], gap_at(N), N - 1
    if has_obstacle(state, N) and (ahead := np.isfinite(state[:, state_width(N)])).any():
        if not ahead.all():
            raise InvalidInput("shield: only some of the worlds have an obstacle ahead (obstacle_gap_m), not all")
        groups = [state[:, first + g * pairs : first + (g + 1) * pairs] for g in range(len(GROUPS))]
        at = state_width(N)
        whole = [part for g, group in enumerate(groups) for part in (state[:, at + g : at + g + 1], group)]
        return np.concatenate([np.zeros((len(state), 1)), speeds, *whole], axis=1)
    return np.concatenate([speeds, state[:, first : first + len(GROUPS) * pairs]], axis=1)


def as_predicted(running: Running, seen: Floats) -> Bools:
    """Where what is seen [n, columns] does not contradict the prediction, [n].

    One member: where it is what was predicted, to the bit. Several: where it lies within the range of their
    predictions, by column; once one of them has had an impact, worlds between the corners may leave that range, and any
    finite numbers will do.
    """
    columns, N = seen.shape[1], (running.states.shape[1] + 4) // 5
    predicted = running.states.reshape(running.n, running.members, -1)
    slack = 0.0 if running.members == 1 else SLACK
    low, high = predicted[:, :, :columns].min(axis=1) - slack, predicted[:, :, :columns].max(axis=1) + slack
    within: Bools = ((seen >= low) & (seen <= high)).all(axis=1)
    if running.members > 1:
        had_impact = (predicted[:, :, 2 * N - 1 : 3 * N - 2] == 1.0).any(axis=(1, 2))
        within |= had_impact & np.isfinite(seen).all(axis=1)
    return within


def difference(predicted: Floats, seen: Floats) -> str:
    """The first number in which a world as seen [S] is not as predicted [S], in words; "nothing" where all are."""
    vehicles = (len(predicted) + 4) // 5
    for column in np.flatnonzero(~(seen == predicted)).tolist():
        if column < vehicles:
            what, unit = f"speed of vehicle {column + 1} of the line", " m/s"
        else:
            group, pair = divmod(column - vehicles, vehicles - 1)
            what, unit = f"{GROUPS[group][0]} of pair {pair + 1}", GROUPS[group][1]
        return f"{what} is {seen[column]:.17g}{unit}, certified was {predicted[column]:.17g}{unit}"
    return "nothing"
