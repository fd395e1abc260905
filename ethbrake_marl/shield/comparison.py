"""What happened, beside what was predicted: to the last bit, the harm so far included."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agents.profile_problem import state_columns
from ethbrake_marl.harm import COUNTS, Ledger
from ethbrake_marl.physics import Bools, Floats, Worlds
from ethbrake_marl.physics.obstacle import obstacle_ahead
from ethbrake_marl.shield.certify import Running

SLACK = 1e-9  # by more than this (m, m/s) a world lies outside what several members predict; one member is exact
GROUPS = (("gap", " m"), ("hit flag", ""), ("first-impact harm", " m2/s2"), ("total harm", " m2/s2"))  # of each pair


def seen_columns(worlds: Worlds, ledger: Ledger) -> Floats:
    """The worlds and their harm so far in the columns of ``Running.states``, [n, S]: to be compared with them."""
    harm = [ledger.first_impact_harm, ledger.total_harm]
    if obstacle_ahead(worlds).any():
        harm = [np.column_stack([ledger.hazard_harm(c), ledger.pair_harm(c)]) for c in COUNTS]
    return np.concatenate([state_columns(worlds), *harm], axis=1)


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
