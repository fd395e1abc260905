"""Compare levels of cooperation: harm at each level, change from level to level, and distance to the joint optimum."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from ethbrake_marl.episode.counts import COLUMN
from ethbrake_marl.extensions.cooperation.ablation import Measured
from ethbrake_marl.extensions.cooperation.seeds import mean_over_seeds, share_over_seeds
from ethbrake_marl.motion.layout import Floats

TOLERANCE = 1e-6  # m2/s2; a vehicle counts as worse off if its harm rises by more than this

Json = dict[str, Any]


def compare(measured: Sequence[Measured], searched: int) -> Json:
    """Return the comparison as plain data.

    - ``levels``: results of each level and algorithm;
    - ``steps``: for each algorithm, the change of harm from each level's ``before`` to the level;
    - ``undertrained``: a sentence that names the levels whose trained policies do worse than full braking, if any.

    The joint optimum is known only in the first ``searched`` worlds; comparisons with it use only these.
    """
    steps = []
    for algorithm in dict.fromkeys(each.algorithm for each in measured if each.algorithm is not None):
        own = {each.level.name: each for each in measured if each.algorithm in (None, algorithm)}
        steps += [_change(own[each.level.before], each, algorithm) for each in own.values() if each.level.before]
    goals = [
        (each, *(own["goal"].mean() for own in (each.reached, each.braking))) for each in measured if each.algorithm
    ]
    named = [
        f"{each.level.name} ({each.algorithm}) with {reached:.2f} ({braking:.2f} with full braking)"
        for each, reached, braking in goals
        if reached > braking + TOLERANCE
    ]
    return {
        "kind": "ablate",
        "levels": [_level(each, searched) for each in measured],
        "steps": steps,
        "undertrained": [f"Not trained enough to say anything: {'; '.join(named)}."] if named else [],
    }


def place_of(one: Measured) -> Json:
    swept = one.level.swept
    return {"level": one.level.name} | ({} if swept is None else {"swept_number": swept.number})


def _level(one: Measured, searched: int) -> Json:
    scenario = one.level.scenario
    mean = partial(mean_over_seeds, clusters=one.clusters)
    entry: Json = {
        **one.about,
        **place_of(one),
        "title": scenario.title,
        "algorithm": one.algorithm,
        "before": one.level.before,
        "learners": [scenario.vehicle_names[body - 1] for body in scenario.learners],
        "seeds": len(one.reached["collided"]),
        "worlds": one.reached["collided"].shape[1],
        "collision_rate": mean(one.reached["collided"]).to_json(),
    }
    for count, column in COLUMN.items():
        reached, braking = one.reached[column], one.braking[column]
        entry[count] = {
            "full_brake": mean(braking).to_json(),
            "harm": mean(reached).to_json(),
            "each_seed": reached.mean(axis=1).tolist(),
            "vehicles": [mean(each).to_json() for each in _borne(one, column)],
            "searched": _beside_optimum(one, count, searched),
        }
    return entry


def _beside_optimum(one: Measured, count: str, searched: int) -> Json:
    first = None if one.clusters is None else one.clusters[:searched]
    reached, braking = one.reached[COLUMN[count]][:, :searched], one.braking[COLUMN[count]][:, :searched]
    best = None if one.best is None else one.best[count]
    mean = partial(mean_over_seeds, clusters=first)
    share = None if best is None else share_over_seeds(reached, braking, best, first)
    return {
        "worlds": reached.shape[1],
        "full_brake": mean(braking).to_json(),
        "harm": mean(reached).to_json(),
        "each_seed": reached.mean(axis=1).tolist(),
        "best_known": None if best is None else mean(best).to_json(),
        "share_of_possible_reduction": None if share is None else share.to_json(),
    }


def _change(before: Measured, after: Measured, algorithm: str) -> Json:
    """Return how harm differs between two levels. Seed k is compared with seed k, or with an only seed."""
    entry: Json = {"algorithm": algorithm}
    for word, one in (("from", before), ("to", after)):
        entry |= {f"{word}_{key}" if key != "level" else word: value for key, value in place_of(one).items()}
    mean = partial(mean_over_seeds, clusters=after.clusters)
    for count, column in COLUMN.items():
        new, old = (np.stack(_borne(each, column), axis=2) for each in (after, before))
        worse = new > old + TOLERANCE
        entry[count] = {
            "difference": mean(after.reached[column], before.reached[column]).to_json(),
            "vehicles": [mean(new[:, :, i], old[:, :, i]).to_json() for i in range(new.shape[2])],
            "worse_off": mean(worse.any(axis=2)).to_json(),
            "worse_off_vehicles": worse.mean(axis=(0, 1)).tolist(),
        }
    return entry


def _borne(one: Measured, column: str) -> list[Floats]:
    return [one.reached[f"{column}_{i}"] for i in range(1, one.level.scenario.vehicles + 1)]
