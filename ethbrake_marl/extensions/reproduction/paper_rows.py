"""The paper's two tables of results, as printed."""

from __future__ import annotations

from typing import NamedTuple


class PaperRow(NamedTuple):
    """One row of a table of results as the paper prints it.

    The paper counts first-impact harm, and gives no confidence intervals.
    """

    agent: str  # name of the strategy in the paper
    episodes: int  # number of worlds
    collisions: int  # number of worlds with a collision
    collision_rate: float  # fraction of worlds with a collision
    average_harm: float  # mean harm, m2/s2
    # decrease of harm as a fraction of the harm of the strategy Non-E; None: the paper prints no value
    harm_decrease: float | None


RANDOM_TEST = (
    PaperRow("Non-E", 10_000, 9391, 0.9391, 33.5878, 0.0),
    PaperRow("E-V2X-BM", 10_000, 8520, 0.852, 9.8772, 0.7059),
    PaperRow("Hybrid SAC", 10_000, 5896, 0.5896, 5.7001, 0.8302),
    PaperRow("Hybrid PPO", 10_000, 5974, 0.5974, 5.6202, 0.8326),
)

HYBRID_TEST = (
    PaperRow("E-V2X-BM", 5_000, 4263, 0.8526, 9.8514, None),
    PaperRow("Standalone DRL", 5_000, 3737, 0.7474, 12.229, None),
    PaperRow("Hybrid", 5_000, 2995, 0.599, 7.3641, None),
)
