"""Vector rewards: a reward has several named components, such as the harm of each vehicle, instead of one number.

You can choose from the components in this table, which shows the value of each component in one step:

==========  ========================================================================================
component   value
==========  ========================================================================================
harm_K      minus the harm that vehicle_K bears, m2/s2
pair_J_K    minus the harm of the pair of vehicle_J and vehicle_K behind it, m2/s2
obstacle    minus the harm of impacts of Vehicle 1 with an obstacle ahead, m2/s2
term name   value of a term of the reward before weighting, for instance ``jerk``
==========  ========================================================================================

The setting ``harm_count`` of the reward selects whether the components that are harms use first-impact harm or total
harm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.first_edition.game.harm import HarmCount, Ledger
from ethbrake_marl.first_edition.game.rewards import RewardParams
from ethbrake_marl.first_edition.physics.state import Floats

RewardVector = str | Sequence[str]  # "vehicles", or names of components

VEHICLES = "vehicles"  # stands for the components harm_1 to harm_N


def components_of(vector: RewardVector, params: RewardParams, vehicles: int) -> tuple[str, ...]:
    """Return the names of the components of a vector reward.

    ``vector`` is ``vehicles`` (one component for the harm of each vehicle), or a list of names of components. Each term
    of the reward ``params`` whose weight is not 0 can be a component. Raises ``InvalidInput`` for an empty list or a
    repeated name, and ``UnknownName`` for an unknown name.
    """
    each = [f"harm_{k + 1}" for k in range(vehicles)]
    if isinstance(vector, str) and vector == VEHICLES:
        return tuple(each)
    listed = isinstance(vector, Sequence) and not isinstance(vector, str) and all(isinstance(n, str) for n in vector)
    if not listed or not vector or len(set(vector)) < len(vector):
        raise InvalidInput(
            f"reward_vector = {vector!r}: must be {VEHICLES!r}, or a list of different components of harm, for instance"
            " ['harm_1', 'harm_2', 'harm_3']"
        )
    known = [*each, *(f"pair_{k + 1}_{k + 2}" for k in range(vehicles - 1)), "obstacle", *params.counted]
    for name in vector:
        if name not in known:
            raise unknown_name("component of a reward", name, known)
    return tuple(vector)


def vector_of(names: Sequence[str], harm: Ledger, harm_count: HarmCount, terms: Mapping[str, Floats]) -> Floats:
    """Return the vector reward of every vehicle in one step, [n, N, K].

    ``names`` are the names of the K components, and ``harm`` is the harm of the step. ``terms`` maps the name of a
    reward term to its values before weighting, [n] or [n, N].
    """
    borne, pairs = harm.vehicle_harm(harm_count), harm.pair_harm(harm_count)
    parts = {f"harm_{k + 1}": 0.0 - borne[:, k] for k in range(borne.shape[1])}
    parts |= {f"pair_{k + 1}_{k + 2}": 0.0 - pairs[:, k] for k in range(pairs.shape[1])}
    parts |= {"obstacle": 0.0 - harm.obstacle_harm(harm_count), **terms}
    columns = (parts[name] for name in names)
    return np.stack([np.broadcast_to(each.T, borne.T.shape).T for each in columns], axis=2)
