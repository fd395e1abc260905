"""The findings of an ablation as CSV: one row per level, algorithm and seed."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.shield.behind import Shielded
from ethbrake_marl.studies.ablation.run import Measured

_SUMS = ("", "full_brake_", "searched_", "searched_full_brake_", "searched_best_known_")  # columns of each count
_BEHIND = ("shielded_", "bound_", "actions_replaced_")  # likewise, empty without a shield


def levels_csv(measured: Sequence[Measured], searched: int) -> str:
    """One row per level, algorithm and seed: means over the worlds (m2/s2).

    ``searched``: over the worlds in which the joint optimum was searched.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    vehicles = measured[0].reached.vehicle["first"].shape[2]
    harms = [f"{_column(harm_count)}_{i + 1}" for harm_count in HARM_COUNTS for i in range(vehicles)]
    sums = [f"{name}{_column(harm_count)}" for harm_count in HARM_COUNTS for name in _SUMS]
    behind = [f"{name}{_column(harm_count)}" for harm_count in HARM_COUNTS for name in _BEHIND]
    writer.writerow(["level", "algorithm", "seed", "worlds", "collision_rate", *sums, *harms, *behind])
    for one in measured:
        for seed in range(len(one.reached.collided)):
            row: list[object] = [one.level.name, one.algorithm or "", seed if one.algorithm else ""]
            row += [one.reached.collided.shape[1], float(one.reached.collided[seed].mean())]
            for harm_count in HARM_COUNTS:
                best = "" if one.best is None else float(one.best[harm_count].mean())
                reached, braking = one.reached.world[harm_count][seed], one.full_brake.world[harm_count]
                row += [float(reached.mean()), float(braking.mean())]
                row += [float(reached[:searched].mean()), float(braking[:, :searched].mean()), best]
            for harm_count in HARM_COUNTS:
                row += [float(harm) for harm in one.reached.vehicle[harm_count][seed].mean(axis=0)]
            for harm_count in HARM_COUNTS:
                row += [""] * len(_BEHIND) if one.shielded is None else _of_seed(one.shielded[harm_count], seed)
            writer.writerow(row)
    return text.getvalue()


def _of_seed(shielded: Shielded, seed: int) -> list[object]:
    """The columns ``_BEHIND`` of one training."""
    replaced = shielded.replaced[seed].sum() / (shielded.decisions[seed].sum() * shielded.replaced.shape[2])
    return [float(shielded.harm[seed].mean()), float(shielded.bound[seed].mean()), float(replaced)]


def _column(harm_count: HarmCount) -> str:
    return "first_impact_harm" if harm_count == "first" else "total_harm"
