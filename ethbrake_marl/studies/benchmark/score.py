"""The score of an agent on a list: how much of what is possible it realises, and how it does where it does worst."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import Estimate, mean, relative_decrease
from ethbrake_marl.physics import Floats

WORST = 0.1  # share of the worlds that the worst ones are
TOLERANCE = 1e-6  # m2/s2; an agent that is less than this below the best known is not below it


def realised_share(harm: Floats, full_brake: Floats, best_known: Floats) -> Estimate:
    """``(full braking - agent) / (full braking - best known)`` of the mean harms, [n] m2/s2 each, paired by world.

    0: no better than full braking; below 0: worse. 1: as good as the best known; above 1: better. The interval is that
    of ``relative_decrease`` of the regret. Raises ``InvalidInput`` where nothing is possible: the best known is full
    braking.
    """
    share = relative_decrease(harm - best_known, full_brake - best_known)
    if share is None:
        raise InvalidInput("realised share: full braking is the best known everywhere, so there is nothing to realise")
    return share


def worst_mean(regret: Floats, share: float = WORST) -> Estimate:
    """Mean regret of the ``share`` of worlds where it is greatest (m2/s2), with its interval.

    With q the quantile at ``1 - share``, that mean is the mean over all worlds of ``q + max(regret - q, 0) / share``
    (the conditional value at risk); the interval is the t interval of this mean, which holds for many worlds.
    """
    q = float(np.quantile(regret, 1.0 - share, method="inverted_cdf"))
    return mean(q + np.maximum(regret - q, 0.0) / share)


def mean_of_lists(shares: Sequence[Estimate]) -> Estimate:
    """Mean over lists, each with the same weight. The lists share no world, so half-widths add as squares.

    No interval where one of them has none. Raises ``InvalidInput`` for no list.
    """
    if not shares:
        raise InvalidInput("mean over lists: there is none")
    value = math.fsum(share.value for share in shares) / len(shares)
    halves = [0.5 * (share.interval[1] - share.interval[0]) for share in shares if share.interval is not None]
    if len(halves) < len(shares):
        return Estimate(value, None)
    half = math.sqrt(math.fsum(half * half for half in halves)) / len(shares)
    return Estimate(value, (value - half, value + half))
