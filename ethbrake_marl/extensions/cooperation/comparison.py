"""Compare levels of cooperation: harm at each level, change from level to level, and distance to the joint optimum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from ethbrake_marl.extensions.cooperation.measured import HARM, Measured
from ethbrake_marl.extensions.cooperation.seeds import mean_over_seeds, share_over_seeds

TOLERANCE = 1e-6  # m2/s2; a vehicle counts as worse off if its harm rises by more than this

Json = dict[str, Any]


def compare(measured: Sequence[Measured], searched: int) -> Json:
    """Return the comparison as plain data.

    - ``levels``: results of each level and algorithm;
    - ``steps``: for each algorithm, the change of harm from each level of the ladder to the next;
    - ``channels``: change from a level to the same level with a worse V2X channel;
    - ``undertrained``: one sentence that names the levels whose trained policies do worse than full braking, or none.

    The joint optimum was searched in the first ``searched`` worlds; comparisons with it use only these.
    """
    steps, channels = [], []
    for algorithm in dict.fromkeys(each.algorithm for each in measured if each.algorithm is not None):
        own = [each for each in measured if each.algorithm in (None, algorithm)]
        by_name = {each.level.name: each for each in own}
        ladder = [each for each in own if each.level.clear is None]
        steps += [_change(before, after, algorithm) for before, after in pairwise(ladder)]
        channels += [_change(by_name[each.level.clear], each, algorithm) for each in own if each.level.clear]
    goals = [
        each for each in measured if each.goal and each.reached["goal"].mean() > each.braking["goal"].mean() + TOLERANCE
    ]
    named = [
        f"{each.level.name} ({each.algorithm}), {each.goal} {each.reached['goal'].mean():.2f}"
        f" ({each.braking['goal'].mean():.2f} if everybody brakes fully)"
        for each in goals
    ]
    return {
        "kind": "ablate",
        "levels": [_level(each, searched) for each in measured],
        "steps": steps,
        "channels": channels,
        "undertrained": [f"Not trained enough to say anything: {'; '.join(named)}."] if named else [],
    }


def columns_of(one: Measured) -> Json:
    """Return the swept key and its value; nothing if there is no sweep."""
    swept = one.level.swept
    if swept is None:
        return {}
    return {"swept_key": swept.key, "swept_value": f"{swept.word}{swept.text}", "swept_number": swept.number}


def _level(one: Measured, searched: int) -> Json:
    """Return the results of one level with one algorithm, as means over seeds and worlds."""
    scenario, first = one.level.scenario, None if one.clusters is None else one.clusters[:searched]
    mean, mean_searched = (partial(mean_over_seeds, clusters=each) for each in (one.clusters, first))
    entry: Json = {
        **one.about,
        "level": one.level.name,
        **columns_of(one),
        "title": scenario.title,
        "algorithm": one.algorithm,
        "clear": one.level.clear,
        "learners": [scenario.vehicle_names[body - 1] for body in scenario.learners],
        "seeds": len(one.reached["collided"]),
        "worlds": one.reached["collided"].shape[1],
        "collision_rate": mean(one.reached["collided"]).to_json(),
        "goal": one.goal or None,
    }
    for count, column in HARM.items():
        reached, braking = one.reached[column], one.braking[column]
        best = None if one.best is None else one.best[count]
        share = None
        if best is not None:
            share = share_over_seeds(reached[:, :searched], braking[:, :searched], best, first)
        entry[count] = {
            "full_brake": mean(braking).to_json(),
            "harm": mean(reached).to_json(),
            "each_seed": reached.mean(axis=1).tolist(),
            "vehicles": [mean(each).to_json() for each in _vehicles(one.reached, column, scenario.vehicles)],
            "searched": {
                "worlds": min(searched, reached.shape[1]),
                "full_brake": mean_searched(braking[:, :searched]).to_json(),
                "harm": mean_searched(reached[:, :searched]).to_json(),
                "each_seed": reached[:, :searched].mean(axis=1).tolist(),
                "best_known": None if best is None else mean_searched(best).to_json(),
                "share_of_possible_reduction": None if share is None else share.to_json(),
            },
            "shielded": _behind(one, count, column, searched) if count in one.shielded else None,
        }
    return entry


def _behind(one: Measured, count: str, column: str, searched: int) -> Json:
    """Return the results behind the shield that bounds this count of harm, beside those without."""
    after, before = one.shielded[count], one.reached[column]
    mean = partial(mean_over_seeds, clusters=one.clusters)
    first = None if one.clusters is None else one.clusters[:searched]
    learners = len(one.level.scenario.learners)
    return {
        "harm": mean(after[column]).to_json(),
        "each_seed": after[column].mean(axis=1).tolist(),
        "bound": mean(after["bound"]).to_json(),
        "above_bound": int((after[column] > after["bound"]).sum()),
        "difference": mean(after[column] - before).to_json(),
        "replaced": float(after["replaced_actions"].sum() / (after["decisions"].sum() * learners)),
        "searched": {"harm": mean_over_seeds(after[column][:, :searched], clusters=first).to_json()},
    }


def _change(before: Measured, after: Measured, algorithm: str) -> Json:
    """Return the change of harm between two levels, of the line and of each vehicle.

    Seed k of one level is compared with seed k of the other, or with its only seed.
    """
    entry: Json = {"from": before.level.name, "to": after.level.name, "algorithm": algorithm}
    if before.level.swept is not None and after.level.swept is not None:
        entry |= {"swept_key": after.level.swept.key}
        entry |= {"from_number": before.level.swept.number, "to_number": after.level.swept.number}
    mean, vehicles = partial(mean_over_seeds, clusters=after.clusters), after.level.scenario.vehicles
    for count, column in HARM.items():
        new, old = (np.stack(_vehicles(each.reached, column, vehicles), axis=2) for each in (after, before))
        worse = new > old + TOLERANCE
        entry[count] = {
            "difference": mean(after.reached[column], before.reached[column]).to_json(),
            "vehicles": [mean(new[:, :, i], old[:, :, i]).to_json() for i in range(vehicles)],
            "worse_off": mean(worse.any(axis=2)).to_json(),
            "worse_off_vehicles": worse.mean(axis=(0, 1)).tolist(),
        }
    return entry


def _vehicles(columns: Mapping[str, Any], column: str, vehicles: int) -> list[Any]:
    """Return the harm that each vehicle bears, [seeds, n] each, front to rear."""
    return [columns[f"{column}_{i}"] for i in range(1, vehicles + 1)]
