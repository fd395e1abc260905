"""Form chains of vehicles that follow each other; check that recorded gaps and positions agree with recorded speeds.

A *queue* is a sequence of vehicles, each of which follows the vehicle in front of it, at one moment of a recording. A
queue is cut into *chains* of a fixed number of vehicles. Each chain is one row of gaps and speeds.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.recorded.states import FARTHEST_M, Recording
from ethbrake_marl.motion.layout import Floats

# Allowed ratio: recorded change of gaps or positions / change that follows from the speeds. It is 3.28 if a file mixes
# feet and metres. Gaps are checked only if the two changes have at least the correlation CORRELATED.
SLOPE, CORRELATED = (0.5, 2.0), 0.7

LEAST_M2 = 100.0  # positions are checked if the squared distances driven in a lane sum up to this: one drive of 10 m


class Chains(NamedTuple):
    """The chains of a recording."""

    numbers: Floats  # [chains, 2 N - 1] gaps (m) and speeds (m/s) from front to rear
    vehicles: list[str]  # the vehicles of each chain, such as ``2-3-4``
    longest: int  # number of vehicles in the longest queue
    left_out: Counter[str]  # description of data that were left out -> their number


def cut_chains(recording: Recording, vehicles: int) -> Chains:
    """Return the chains of a recording, in order of time and of the vehicle at the front of the queue.

    The first chain of a queue begins with its front vehicle, the next chain directly behind the first, and so on. At
    one moment, a vehicle belongs to at most one chain.

    Raises ``InvalidInput`` if too many vehicles have faulty data, or if the recorded gaps or positions do not change
    as the recorded speeds require.
    """
    left_out = Counter[str]()
    states = recording.states[~recording.states.duplicated(["tick", "vehicle"])].reset_index(drop=True)
    links = _links(recording, states, left_out)
    _check_units(recording, states, links)
    links = links[links["tick"] % recording.stride == 0]
    behind = np.full(len(states) + 1, -1)  # index of the follower of each state; -1 if there is none, and of -1
    behind[links["front_car"]] = links.index
    gaps = np.zeros(len(states))
    gaps[links.index] = links["gap"]
    at_front = states["tick"] % recording.stride == 0
    at_front[links.index] = False
    fronts = starts = np.flatnonzero(at_front)
    longest, chains, queues = 0, [np.empty((0, vehicles), int)], [starts[:0]]
    while len(starts):
        chain = [starts]
        for _ in range(vehicles - 1):
            chain.append(behind[chain[-1]])
        members = np.column_stack(chain)
        counts = (members >= 0).sum(axis=1)
        longest = max(longest, (len(chains) - 1) * vehicles + int(counts.max()))
        whole = counts == vehicles
        left_out["vehicles that were too few, or left over, at the end of a queue"] += int(counts[~whole].sum())
        chains.append(members[whole])
        queues.append(fronts[whole])
        starts, more = behind[members[:, -1]], behind[members[:, -1]] >= 0
        starts, fronts = starts[more], fronts[more]
    members = np.concatenate(chains)[np.argsort(np.concatenate(queues), kind="stable")]
    numbers = np.column_stack([gaps[members[:, 1:]], states["speed"].to_numpy()[members]])
    name_of = {number: recording.name(number) for number in states["vehicle"].unique()}
    names = states["vehicle"].map(name_of).to_numpy()[members]
    return Chains(numbers, ["-".join(each) for each in names], longest, left_out)


def _links(recording: Recording, states: Any, left_out: Counter[str]) -> Any:
    """Return the states of vehicles that follow another one, with ``gap`` (m) and ``opens`` (its rate of change, m/s).

    ``front_car`` is the index of the vehicle ahead in ``states``, which has each vehicle once per moment. Data that are
    left out are added to ``left_out``. Raises ``InvalidInput`` if too many vehicles have faulty data.
    """
    entry = recording.entry
    if entry.by_lane:
        ordered = states.sort_values(["tick", "lane", "front"], ascending=[True, True, False], kind="stable")
        states["ahead"] = ordered.groupby(["tick", "lane"])["vehicle"].shift(1).fillna(-1.0)
    others = states[["tick", "vehicle", "lane", "front", "side", "dx", "dy", "length", "speed"]]
    others = others.add_suffix("_ahead").assign(front_car=states.index)
    pairs = states.merge(others, "left", left_on=["tick", "ahead"], right_on=["tick_ahead", "vehicle_ahead"])
    along = pairs["front_ahead"] - pairs["length_ahead"] * pairs["dx_ahead"] - pairs["front"]
    across = pairs["side_ahead"] - pairs["length_ahead"] * pairs["dy_ahead"] - pairs["side"]
    gap = pairs["gap"] = along * pairs["dx"] + across * pairs["dy"]
    slowest = np.minimum(pairs["speed_ahead"], pairs["speed"])
    noise = (gap <= 0.0) & (slowest < entry.standing_mps)
    same_lane = pairs["lane_ahead"] == pairs["lane"]
    missing, overlap = (pairs["ahead"] >= 0.0) & gap.isna(), (gap <= 0.0) & same_lane & ~noise
    is_row = pairs["tick"] % recording.stride == 0
    _check_faults(recording, pairs[(missing | overlap) & is_row], left_out)
    used = gap.notna() & ~overlap
    for what, odd in (
        ("links of standing cars whose gap was recorded as 0 or less", noise),
        ("links to another lane, or of a vehicle that rolls backwards", ~same_lane | (slowest < 0.0)),
        (f"links of more than {FARTHEST_M:,.0f} m", gap > FARTHEST_M),
    ):
        left_out[what] += int((used & odd & is_row).sum())
        used &= ~odd
    links = pairs.assign(opens=pairs["speed_ahead"] - pairs["speed"])[used]
    return links.sort_values("gap", kind="stable").drop_duplicates("front_car").astype({"front_car": int})


def _check_faults(recording: Recording, faulty: Any, left_out: Counter[str]) -> None:
    """Count the ``faulty`` vehicles and those that are recorded twice; raise ``InvalidInput`` if they are too many."""
    states = recording.states[recording.states["tick"] % recording.stride == 0]
    twice = states[states.duplicated(["tick", "vehicle"])]
    number = len(faulty) + len(twice)
    if number > recording.entry.impossible * len(states):
        both = pd.concat([faulty, twice.assign(gap=math.inf)])
        first = both.sort_values(["tick", "vehicle"], kind="stable").iloc[0]
        ahead = f"vehicle {recording.name(first['ahead'])}"
        fault = f"follows {ahead}, which is not recorded at this time"
        if first["gap"] == math.inf:
            fault = "is recorded twice for this time"
        elif first["gap"] <= 0.0:
            fault = f"overlaps {ahead} ahead by {-first['gap']:.2f} m"
        raise InvalidInput(
            f"{recording.source.place(int(first['row']))}: vehicle {recording.name(first['vehicle'])} {fault};"
            f" {number:,} of {len(states):,} positions of vehicles are faulty (recorded twice, overlapping, or behind a"
            f" vehicle that is not recorded), but at most {recording.entry.impossible:.0%} may be faulty"
        )
    left_out["vehicles that overlap, are recorded twice, or follow one that is not recorded"] += number


def _check_units(recording: Recording, states: Any, links: Any) -> None:
    """Raise ``InvalidInput`` if gaps or positions change otherwise than the speeds say."""
    file, entry = recording.source.file, recording.entry
    passed_s = recording.near / entry.hertz

    def changes(now: Any, same: list[str], place: str, speed: str) -> Any:
        """Return the squares and the product of the recorded change and of that by the speeds; and the latter."""
        then = now[["tick", *same, place, speed]].assign(tick=now["tick"] + recording.near)
        both = now.merge(then, on=["tick", *same], suffixes=("", "_then"))
        moved = both[place] - both[f"{place}_then"]
        said = (both[speed] + both[f"{speed}_then"]) / 2.0 * passed_s
        return both.assign(moved2=moved * moved, said2=said * said, product=moved * said, said=said)

    if entry.by_lane:
        ways = (
            changes(states, ["vehicle", "lane"], "front", "speed").groupby("lane")[["said2", "product", "said"]].sum()
        )
        for lane, said2, product, way in ways[ways["said2"] >= LEAST_M2].itertuples():
            if not (SLOPE[0] < product / said2 < SLOPE[1] and way > 0.0):
                raise InvalidInput(
                    f"{file}: in lane {recording.name(lane)}, positions (column front) change by {product / said2:.2f}"
                    f" times the distance that the speeds imply{'' if way > 0.0 else ', and the speeds are negative'};"
                    " front must increase in the direction of travel, speeds must be above 0, and both columns must be"
                    f" in {entry.units}"
                )
    gaps = changes(links, ["vehicle", "ahead"], "gap", "opens")
    moved2, said2, product = gaps[["moved2", "said2", "product"]].sum()
    if product > CORRELATED * math.sqrt(moved2 * said2) > 0.0 and not SLOPE[0] < product / said2 < SLOPE[1]:
        raise InvalidInput(
            f"{file}: the recorded gaps change by {product / said2:.2f} times the amount that the speeds imply (3.28"
            " means gaps in feet and speeds in m/s; 0.28 means gaps in m and speeds in km/h); the file must be in"
            f" {entry.units}"
        )
