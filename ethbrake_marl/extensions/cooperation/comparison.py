"""Compare levels of cooperation: harm at each level, change of harm between levels, and distance to the joint optimum.

A *level* is a scenario. The *ladder* is a sequence of levels, in which each level is compared with the previous one.
The *joint optimum* is the least known harm that all learners of a level can achieve together.

The confidence intervals come from a bootstrap that resamples both training seeds and worlds (``evaluation.seeds``).
Worlds from the same recording of traffic are resampled together.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from ethbrake_marl.extensions.cooperation.joint_optimum import Harms, Measured
from ethbrake_marl.extensions.cooperation.levels import TOLERANCE, Json
from ethbrake_marl.first_edition.evaluation.seeds import interquartile_mean, mean_over_seeds, share_over_seeds
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.shields.episodes import Shielded


def compare(measured: Sequence[Measured], searched: int) -> Json:
    """Return the comparison of all levels as a mapping for JSON.

    Four keys contain a list:

    - ``levels``: results of each level and algorithm;
    - ``steps``: for each algorithm, the change of harm from each level to the next;
    - ``channels``: change of harm from a level to the same level with a worse V2X channel;
    - ``undertrained``: one sentence that names the levels whose trained policies do worse than full braking; empty if
      there are none.

    The joint optimum was searched in the first ``searched`` worlds of the list; comparisons with it use only these
    worlds.
    """
    algorithms = [m.algorithm for m in measured if m.algorithm is not None]
    steps, channels = [], []
    for algorithm in dict.fromkeys(algorithms):
        own = [m for m in measured if m.algorithm in (None, algorithm)]
        ladder = [m for m in own if m.level.clear is None]
        steps += [_change(before, after, algorithm) for before, after in pairwise(ladder)]
        by_name = {m.level.name: m for m in own}
        channels += [_change(by_name[m.level.clear], m, algorithm) for m in own if m.level.clear is not None]
    return {
        "kind": "ablate",
        "levels": [_level(one, searched) for one in measured],
        "steps": steps,
        "channels": channels,
        "undertrained": _undertrained(measured),
    }


def _undertrained(measured: Sequence[Measured]) -> list[str]:
    named = [
        f"{one.level.name} ({one.algorithm}), {one.goal.name} {one.goal.reached:.2f} ({one.goal.full_brake:.2f} if"
        " everybody brakes fully)"
        for one in measured
        if one.goal is not None and one.goal.missed
    ]
    return [f"Not trained enough to say anything: {'; '.join(named)}."] if named else []


def _level(one: Measured, searched: int) -> Json:
    """Return the results of one level with one algorithm: mean harm (m2/s2) in all worlds and in the searched worlds.

    The joint optimum was searched in the first ``searched`` worlds. For these worlds the result also has the mean joint
    optimum and the share of the possible reduction.
    """
    scenario = one.level.scenario
    of_searched = None if one.clusters is None else one.clusters[:searched]
    mean = partial(mean_over_seeds, clusters=one.clusters)
    mean_searched = partial(mean_over_seeds, clusters=of_searched)
    entry: Json = {
        **one.identity,
        "policy_sha256": [dict(seed) for seed in one.reached.policies],
        "level": one.level.name,
        **one.level.columns,
        "title": scenario.title,
        "algorithm": one.algorithm,
        "clear": one.level.clear,
        "learners": [scenario.vehicle_names[i] for i in scenario.learners],
        "seeds": len(one.reached.collided),
        "worlds": one.reached.collided.shape[1],
        "collision_rate": mean(one.reached.collided).to_json(),
        "goal": None if one.goal is None else {**one.goal._asdict(), "missed": one.goal.missed},
    }
    for harm_count in HARM_COUNTS:
        reached, braking = one.reached.world[harm_count], one.full_brake.world[harm_count]
        best = None if one.best is None else one.best[harm_count]
        share = (
            None
            if best is None
            else share_over_seeds(reached[:, :searched], braking[:, :searched], best, clusters=of_searched)
        )
        entry[harm_count] = {
            "full_brake": mean(braking).to_json(),
            "harm": mean(reached).to_json(),
            "each_seed": reached.mean(axis=1).tolist(),
            "interquartile_mean": interquartile_mean([reached.mean(axis=1)], resamples=2000).to_json(),
            "vehicles": [mean(column).to_json() for column in _columns(one.reached, harm_count)],
            "searched": {
                "worlds": min(searched, reached.shape[1]),
                "full_brake": mean_searched(braking[:, :searched]).to_json(),
                "harm": mean_searched(reached[:, :searched]).to_json(),
                "each_seed": reached[:, :searched].mean(axis=1).tolist(),
                "best_known": None if best is None else mean_searched(best).to_json(),
                "share_of_possible_reduction": None if share is None else share.to_json(),
            },
            "shielded": None if one.shielded is None else _behind(one, one.shielded[harm_count], harm_count, searched),
        }
    return entry


def _behind(one: Measured, shielded: Shielded, harm_count: HarmCount, searched: int) -> Json:
    """Return the results of one level with a shield, and how they differ from the results ``one`` without a shield.

    ``harm_count`` is the harm that the shield bounds. The result also contains the mean harm over the first
    ``searched`` worlds.
    """
    before, after = one.reached.vehicle[harm_count], shielded.vehicle_harm
    mean = partial(mean_over_seeds, clusters=one.clusters)
    of_searched = None if one.clusters is None else one.clusters[:searched]
    actions = shielded.decisions * shielded.replaced.shape[2]
    return {
        "harm": mean(shielded.harm).to_json(),
        "each_seed": shielded.harm.mean(axis=1).tolist(),
        "difference": mean(shielded.harm - one.reached.world[harm_count]).to_json(),
        "bound": mean(shielded.bound).to_json(),
        "above_bound": int((shielded.harm > shielded.bound).sum()),
        "replaced": float(shielded.replaced.sum() / actions.sum()),
        "replaced_vehicles": (shielded.replaced.sum(axis=(0, 1)) / shielded.decisions.sum()).tolist(),
        "stepped_in": mean((shielded.replaced > 0).any(axis=2)).to_json(),
        "vehicles": [mean(column).to_json() for column in np.moveaxis(after - before, 2, 0)],
        "worse_off": mean((after > before + TOLERANCE).any(axis=2)).to_json(),
        "above_baseline": mean((after > shielded.baseline + TOLERANCE).any(axis=2)).to_json(),
        "moving": int(shielded.moving.sum()),
        "searched": {"harm": mean_over_seeds(shielded.harm[:, :searched], clusters=of_searched).to_json()},
    }


def _change(before: Measured, after: Measured, algorithm: str) -> Json:
    """Return (harm at level ``after``) - (harm at level ``before``), averaged over the same worlds.

    The result has the form ``{"from": name, "to": name, "algorithm": name, "first": changes, "total": changes}``.
    ``changes`` has the change of harm of the line and of each vehicle.
    """
    entry: Json = {"from": before.level.name, "to": after.level.name, "algorithm": algorithm}
    if before.level.swept is not None and after.level.swept is not None:
        entry |= {"swept_key": after.level.swept.key}
        entry |= {"from_number": before.level.swept.number, "to_number": after.level.swept.number}
    mean = partial(mean_over_seeds, clusters=after.clusters)
    for harm_count in HARM_COUNTS:
        pairs = zip(_columns(after.reached, harm_count), _columns(before.reached, harm_count), strict=True)
        # seed k of one level is compared with seed k of the other, or with its only seed
        old, new = before.reached.vehicle[harm_count], after.reached.vehicle[harm_count]
        worse = new > old + TOLERANCE
        entry[harm_count] = {
            "difference": mean(after.reached.world[harm_count], before.reached.world[harm_count]).to_json(),
            "vehicles": [mean(new, old).to_json() for new, old in pairs],
            "worse_off": mean(worse.any(axis=2)).to_json(),
            "worse_off_vehicles": [float(share) for share in worse.mean(axis=(0, 1))],
        }
    return entry


def _columns(harms: Harms, harm_count: HarmCount) -> list[Floats]:
    """Return one array [seeds, worlds] for each vehicle, front to rear, with the harm that the vehicle bears."""
    return [harms.vehicle[harm_count][:, :, i] for i in range(harms.vehicle[harm_count].shape[2])]
