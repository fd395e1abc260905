"""Form chains of vehicles that follow each other.

A *queue* is a sequence of vehicles, each of which follows the next, at one moment of a recording. A queue is cut into
*chains* of a fixed number of vehicles. The gaps and speeds in a chain become one row of a scenario's table.
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


class Chains(NamedTuple):
    numbers: Floats  # [chains, 2 N - 1] gaps (m) and speeds (m/s) from front to rear
    vehicles: list[str]  # the vehicles of each chain, such as ``2-3-4``
    longest: int  # number of vehicles in the longest queue
    left_out: Counter[str]  # description of data that were left out -> their number
    interpolated: int  # number of states between two rows of a vehicle


def cut_chains(recording: Recording, vehicles: int) -> Chains:
    """Chains in a recording, by time and front vehicle of the queue. Each begins directly behind the chain before.

    Raises ``InvalidInput`` if too many vehicles have faulty data.
    """
    left_out = Counter[str]()
    states = recording.states[~recording.states.duplicated(["moment", "vehicle"])].reset_index(drop=True)
    links = _links(recording, states, left_out)
    behind = np.full(len(states) + 1, -1)  # index of the follower of each state; -1 if there is none, and of -1
    behind[links["front_car"]] = links.index
    gaps = np.zeros(len(states))
    gaps[links.index] = links["gap"]
    fronts = starts = np.setdiff1d(np.arange(len(states)), links.index)
    longest, chains, queues = 0, [np.empty((0, vehicles), int)], [starts[:0]]
    while len(starts):
        chain = [starts]
        for _ in range(vehicles - 1):
            chain.append(behind[chain[-1]])
        members = np.column_stack(chain)
        counts = (members >= 0).sum(axis=1)
        longest = max(longest, (len(chains) - 1) * vehicles + int(counts.max()))
        is_complete = counts == vehicles
        left_out["vehicles that were too few, or left over, at the end of a queue"] += int(counts[~is_complete].sum())
        chains.append(members[is_complete])
        queues.append(fronts[is_complete])
        starts, more = behind[members[:, -1]], behind[members[:, -1]] >= 0
        starts, fronts = starts[more], fronts[more]
    members = np.concatenate(chains)[np.argsort(np.concatenate(queues), kind="stable")]
    numbers = np.column_stack([gaps[members[:, 1:]], states["speed"].to_numpy()[members]])
    name_of = {number: recording.name(number) for number in states["vehicle"].unique()}
    names = states["vehicle"].map(name_of).to_numpy()[members]
    chain_names = ["-".join(of_chain) for of_chain in names]
    return Chains(numbers, chain_names, longest, left_out, recording.interpolated)


def _links(recording: Recording, states: Any, left_out: Counter[str]) -> Any:
    """Rows of ``states`` in which a vehicle follows another one, with ``gap`` (m) and ``front_car`` (row of the vehicle
    ahead).

    Of several followers of one vehicle, only the nearest is kept. ``left_out`` counts the others.
    """
    entry, unread = recording.entry, recording.unread
    if entry.by_lane:
        on_road = pd.concat([states, unread], ignore_index=True)
        states["odd"] = on_road.groupby(["moment", "lane"])["odd"].transform("any")  # who is ahead of whom?
        ordered = on_road.sort_values(["moment", "lane", "front"], ascending=[True, True, False], kind="stable")
        states["ahead"] = ordered.groupby(["moment", "lane"])["vehicle"].shift(1).fillna(-1.0)
    is_unread = pd.MultiIndex.from_frame(states[["moment", "ahead"]]).isin(
        pd.MultiIndex.from_frame(unread[["moment", "vehicle"]])
    )
    left_out["links to a vehicle that has no row near this time"] += int(is_unread.sum())
    states.loc[is_unread, "ahead"] = -1.0
    ahead_states = states[["moment", "vehicle", "lane", "front", "side", "dx", "dy", "length", "speed", "odd"]]
    ahead_states = ahead_states.add_suffix("_ahead").assign(front_car=states.index)
    pairs = states.merge(ahead_states, "left", left_on=["moment", "ahead"], right_on=["moment_ahead", "vehicle_ahead"])
    along = pairs["front_ahead"] - pairs["length_ahead"] * pairs["dx_ahead"] - pairs["front"]
    across = pairs["side_ahead"] - pairs["length_ahead"] * pairs["dy_ahead"] - pairs["side"]
    gap = pairs["gap"] = along * pairs["dx"] + across * pairs["dy"]
    slowest = np.minimum(pairs["speed_ahead"], pairs["speed"])
    noise = (gap <= 0.0) & (slowest < entry.standing_mps)
    same_lane = pairs["lane_ahead"] == pairs["lane"]
    odd = pairs["odd"] | (pairs["odd_ahead"] == True)  # noqa: E712  # NaN without a vehicle ahead
    missing, overlap = (pairs["ahead"] >= 0.0) & gap.isna(), (gap <= 0.0) & same_lane & ~noise & ~odd
    _check_faults(recording, pairs[missing | overlap], left_out)
    is_valid = gap.notna() & ~overlap
    for what, unfit in (
        ("links in a lane where the place of a vehicle contradicts its other places", odd),
        ("links of standing cars whose gap was recorded as 0 or less", noise),
        ("links to another lane, or of a vehicle that rolls backwards", ~same_lane | (slowest < 0.0)),
        (f"links of more than {FARTHEST_M:,.0f} m", gap > FARTHEST_M),
    ):
        left_out[what] += int((is_valid & unfit).sum())
        is_valid &= ~unfit
    links = pairs[is_valid].sort_values("gap", kind="stable")
    return links.drop_duplicates("front_car").astype({"front_car": int})


def _check_faults(recording: Recording, faulty: Any, left_out: Counter[str]) -> None:
    """Count odd places, and vehicles that overlap the one ahead or follow one that is not recorded.

    Raises ``InvalidInput`` if their share exceeds the format's limit.
    """
    states = recording.states
    twice = states[states.duplicated(["moment", "vehicle"])]
    odd = states[states["odd"]]
    number = len(faulty) + len(twice) + len(odd)
    if number > recording.entry.impossible * len(states):
        all_faults = pd.concat([faulty, twice.assign(gap=math.inf), odd.assign(gap=-math.inf)])
        first = all_faults.sort_values(["moment", "vehicle"], kind="stable").iloc[0]
        ahead = f"vehicle {recording.name(first['ahead'])}"
        fault = f"follows {ahead}, which is not recorded at this time"
        if first["gap"] == math.inf:
            fault = "is recorded twice for this time"
        elif first["gap"] == -math.inf:
            fault = "is at a place that contradicts its other places and its speed"
        elif first["gap"] <= 0.0:
            fault = f"overlaps {ahead} ahead by {-first['gap']:.2f} m"
        raise InvalidInput(
            f"{recording.cells.place(int(first['row']))}: vehicle {recording.name(first['vehicle'])} {fault};"
            f" {number:,} of {len(states):,} positions of vehicles are faulty (recorded twice, contradicting the"
            f" vehicle's other positions, overlapping, or behind a vehicle that is not recorded), but at most"
            f" {recording.entry.impossible:.0%} may be faulty"
        )
    left_out["vehicles that overlap, jump, are recorded twice, or follow one that is not recorded"] += number
