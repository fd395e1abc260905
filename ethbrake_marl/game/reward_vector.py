"""Vector rewards: instead of one number, a reward has a component for each vehicle's harm, or others by name.

Components, of one step:

==========  ========================================================================================
harm_K      minus the harm that vehicle_K bears, m2/s2
pair_J_K    minus the harm of the pair of vehicle_J and vehicle_K behind it, m2/s2
obstacle    minus the harm of Vehicle 1 with an obstacle ahead, m2/s2
a term      a term that the reward weighs (``game.rewards``), before its weight, for instance ``jerk``
==========  ========================================================================================

Harm counts as the reward's ``harm_count`` says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.game.harm import HarmCount, Ledger
from ethbrake_marl.game.rewards import RewardParams
from ethbrake_marl.physics.state import Floats

RewardVector = str | Sequence[str]  # "vehicles", or names of components

VEHICLES = "vehicles"  # the harm of each vehicle, front to rear


def components_of(vector: RewardVector, params: RewardParams, vehicles: int) -> tuple[str, ...]:
    """Return the names of the components of a vector reward.

    Args:
        vector: ``vehicles``, or a list of names of components, each once.
        params: the reward, whose terms may be components.
        vehicles: number of vehicles in the line.

    Raises ``InvalidInput`` for no name or a name given twice, ``UnknownName`` for another name.

    """
    each = [f"harm_{k + 1}" for k in range(vehicles)]
    if isinstance(vector, str) and vector == VEHICLES:
        return tuple(each)
    listed = isinstance(vector, Sequence) and not isinstance(vector, str) and all(isinstance(n, str) for n in vector)
    if not listed or not vector or len(set(vector)) < len(vector):
        raise InvalidInput(
            f"reward_vector = {vector!r}: must be {VEHICLES!r}, or a list of components, each once, for instance"
            " ['harm_1', 'harm_2', 'harm_3']"
        )
    known = [*each, *(f"pair_{k + 1}_{k + 2}" for k in range(vehicles - 1)), "obstacle", *params.counted]
    for name in vector:
        if name not in known:
            raise unknown_name("component of a reward", name, known)
    return tuple(vector)


def vector_of(names: Sequence[str], harm: Ledger, harm_count: HarmCount, terms: Mapping[str, Floats]) -> Floats:
    """Return the vector reward of every vehicle in one step, [n, N, K].

    Args:
        names: names of the K components.
        harm: harm of the step, of n worlds of N vehicles.
        harm_count: impacts that count, ``first`` of each pair or ``total``.
        terms: terms of the reward before their weights, by name, [n] or [n, N].

    """
    borne, pairs = harm.vehicle_harm(harm_count), harm.pair_harm(harm_count)
    parts = {f"harm_{k + 1}": 0.0 - borne[:, k] for k in range(borne.shape[1])}
    parts |= {f"pair_{k + 1}_{k + 2}": 0.0 - pairs[:, k] for k in range(pairs.shape[1])}
    parts |= {"obstacle": 0.0 - harm.obstacle_harm(harm_count), **terms}
    columns = (parts[name] for name in names)
    return np.stack([np.broadcast_to(each.T, borne.T.shape).T for each in columns], axis=2)
