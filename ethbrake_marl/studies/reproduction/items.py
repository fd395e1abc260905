"""The table of everything that ``ethbrake reproduce`` makes: one entry per figure and table of the paper."""

from __future__ import annotations

from collections.abc import Sequence

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.studies.reproduction.curves import reproduce_high, reproduce_low
from ethbrake_marl.studies.reproduction.delays import reproduce_delays
from ethbrake_marl.studies.reproduction.distance import reproduce_distance
from ethbrake_marl.studies.reproduction.gaps import reproduce_gaps
from ethbrake_marl.studies.reproduction.hybrid import reproduce_hybrid_table, reproduce_illustration
from ethbrake_marl.studies.reproduction.item import Item
from ethbrake_marl.studies.reproduction.random_table import reproduce_random_table
from ethbrake_marl.studies.reproduction.trainings import CURVES, OPEN, STOPPED
from ethbrake_marl.studies.reproduction.two_scenarios import reproduce_accelerations, reproduce_trajectories

_CURVES = tuple(group for groups in CURVES.values() for group in groups)

ITEMS = (
    Item(
        "learning-high",
        ("fig:ppo_sac_high_latency",),
        "Learning curves at high delay",
        "Returns of PPO and SAC in training under large communication delays.",
        reproduce_high,
        10,
        _CURVES,
    ),
    Item(
        "learning-low",
        ("fig:ppo_sac_low_latency",),
        "Learning curves at low delay",
        "Returns of PPO and SAC in training under small communication delays.",
        reproduce_low,
        10,
        _CURVES,
    ),
    Item(
        "harm-distance",
        ("Fig:Harm-ivds",),
        "Harm over total distance",
        "Harm of the non-ethical strategy, E-V2X-BM, SAC and PPO against the sum of both gaps.",
        reproduce_distance,
        15,
    ),
    Item(
        "harm-delays",
        ("Fig:harm-delay",),
        "Harm at three delays",
        "Harm of the four strategies at three communication delays, gaps of 7 m.",
        reproduce_delays,
        15,
    ),
    Item(
        "trajectories",
        ("Fig:pic5sim",),
        "Trajectories of Scenarios 1 and 2",
        "Positions of the three vehicles under PPO and SAC, against the vehicle and against time.",
        reproduce_trajectories,
        5,
    ),
    Item(
        "accelerations",
        ("Fig:pic5act",),
        "Acceleration profiles of Scenarios 1 and 2",
        "Commands of Vehicle 2 under PPO and SAC.",
        reproduce_accelerations,
        5,
    ),
    Item(
        "hybrid-illustration",
        ("Fig:hybrid illu",),
        "Illustration of the hybrid",
        "Harm of E-V2X-BM, of a policy that has not converged, and of the hybrid of both, against total distance.",
        reproduce_illustration,
        20,
        (STOPPED,),
    ),
    Item(
        "hybrid-table",
        ("Table:hybrid",),
        "E-V2X-BM, DRL and hybrid in 5,000 episodes",
        "Collisions and harm of E-V2X-BM, of a policy that has not converged, and of the hybrid.",
        reproduce_hybrid_table,
        20,
        (STOPPED,),
    ),
    Item(
        "random-table",
        ("Table:Random",),
        "Four strategies in 10,000 random episodes",
        "Collisions, harm and its decrease of the non-ethical strategy, E-V2X-BM and the hybrids of SAC and PPO.",
        reproduce_random_table,
        60,
    ),
    Item(
        "gaps",
        (),
        "What the paper leaves open",
        "Every quantity that the paper leaves open, our default, and how far the headline moves when it changes.",
        reproduce_gaps,
        40,
        (OPEN,),
    ),
)


def choose_items(names: Sequence[str]) -> list[Item]:
    """The items of these names in the order of the paper, all of them for none.

    Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for one that is given twice.
    """
    known = {item.name: item for item in ITEMS}
    for k, name in enumerate(names):
        if name not in known:
            raise unknown_name("item", name, known)
        if name in names[:k]:
            raise InvalidInput(f"item {name!r} is given twice")
    return [item for item in ITEMS if not names or item.name in names]
