"""Items of a reproduction: the paper's figures and tables in order, and last a table of what the paper leaves open."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from ethbrake_marl.extensions.reproduction.delay_curves import ALL_CURVES, HIGH, LOW, reproduce_curves
from ethbrake_marl.extensions.reproduction.folder import RESULT, Item, Result, checked_result
from ethbrake_marl.extensions.reproduction.groups import reproduce_delays, reproduce_distance
from ethbrake_marl.extensions.reproduction.hybrid import (
    reproduce_hybrid_table,
    reproduce_illustration,
    reproduce_random_table,
)
from ethbrake_marl.extensions.reproduction.open_quantities import reproduce_gaps
from ethbrake_marl.extensions.reproduction.trainings import OPEN, STOPPED
from ethbrake_marl.extensions.reproduction.trajectories import play, reproduce_accelerations, reproduce_trajectories
from ethbrake_marl.files.plain import read_object

ITEMS = (  # in the order of the paper
    Item(
        "learning-high",
        ("fig:ppo_sac_high_latency",),
        "Learning curves at high delay",
        "Returns of PPO and SAC in training under large communication delays.",
        partial(reproduce_curves, HIGH),
        10,
        ALL_CURVES,
    ),
    Item(
        "learning-low",
        ("fig:ppo_sac_low_latency",),
        "Learning curves at low delay",
        "Returns of PPO and SAC in training under small communication delays.",
        partial(reproduce_curves, LOW),
        10,
        ALL_CURVES,
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
        play=play,
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


def read_results(folder: Path) -> list[Result]:
    """Return the results that are stored in ``folder``, in the order of the paper.

    Raises ``InvalidInput`` if a result file is damaged, or lies in the folder of a different item.
    """
    files = {item.name: folder / item.name / RESULT for item in ITEMS}
    return [checked_result(read_object(file), file, name) for name, file in files.items() if file.is_file()]
