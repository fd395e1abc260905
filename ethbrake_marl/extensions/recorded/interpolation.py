"""Interpolate the states of vehicles without a row at the moment that is read, for instance because clocks differ."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from ethbrake_marl.motion.layout import Bools, Floats, Ints

NEAR_S = 0.5  # longest time between two rows that are interpolated: braking at 3 m/s2 displaces a front by 0.09 m
GONE_S = 60.0  # a vehicle without a row for longer has left the road


class Between(NamedTuple):
    """Vehicles that are on the road at a moment, but have no row there, [k]."""

    moment: Floats  # number of the moment
    before: Ints  # place of the row before it; of the nearest row if the vehicle has rows on one side only
    after: Ints  # place of the row after it; equal to ``before`` if the vehicle has rows on one side only
    since_s: Floats  # time from the row ``before`` to the moment
    apart_s: Floats  # time between the two rows

    @property
    def near(self) -> Bools:
        return (self.apart_s > 0.0) & (self.apart_s <= NEAR_S + 1e-6)


def rows_between(recorded: Floats, at: Ints, vehicle: Ints, numbers: Ints, read: Ints, step: float) -> Between:
    """Vehicles without a row at a moment.

    Args:
        recorded: all recorded times, ascending (s).
        at: index in ``recorded`` of each row of the file.
        vehicle: vehicle of each row.
        numbers: numbers of the moments, ascending.
        read: index in ``recorded`` of each moment.
        step: recording step (s). A vehicle is on the road for ``NEAR_S``, or one step, beyond its rows.

    """
    order = np.lexsort((at, vehicle))
    at, vehicle = at[order], vehicle[order]
    time, moment_time, reach = recorded[at], recorded[read], max(NEAR_S, step) + 1e-6
    starts = np.ones(len(order), bool)
    starts[1:] = (vehicle[1:] != vehicle[:-1]) | (np.diff(time) > GONE_S)
    stay, first = np.cumsum(starts) - 1, np.flatnonzero(starts)
    last = np.append(first[1:], len(order)) - 1
    earliest = np.searchsorted(moment_time, time[first] - reach)
    count = np.searchsorted(moment_time, time[last] + reach, side="right") - earliest
    stays = np.repeat(np.arange(len(first)), count)
    moments = np.arange(len(stays)) - np.repeat(np.cumsum(count) - count - earliest, count)
    keys, wanted = stay * len(recorded) + at, stays * len(recorded) + read[moments]
    absent = ~np.isin(wanted, keys)
    stays, moments = stays[absent], moments[absent]
    after = np.searchsorted(keys, wanted[absent])
    before = np.clip(after - 1, first[stays], last[stays])
    after = np.clip(after, first[stays], last[stays])
    since_s = moment_time[moments] - time[before]
    return Between(numbers[moments].astype(float), order[before], order[after], since_s, time[after] - time[before])


def interpolated(states: Any, between: Between) -> tuple[Any, Any]:
    """States of the vehicles ``between`` rows that are near each other, and of all others, whose place is a guess.

    A vehicle that changes its lane, or the vehicle it follows, between the two rows is among the others, in both lanes.
    """
    early, late = states.loc[between.before].reset_index(drop=True), states.loc[between.after].reset_index(drop=True)
    part = between.since_s / np.where(between.apart_s > 0.0, between.apart_s, np.inf)
    now = early.assign(moment=between.moment, row=between.before)
    for column in ("front", "side", "dx", "dy", "length", "speed"):
        now[column] += part * (late[column] - early[column])
    now["front"] += np.where(between.apart_s > 0.0, 0.0, early["speed"] * between.since_s)
    same = (early["lane"] == late["lane"]) & (early["ahead"] == late["ahead"])
    others = now[~(between.near & same)]
    elsewhere = others.assign(lane=late["lane"])
    return now[between.near & same], pd.concat([others, elsewhere]).drop_duplicates(["moment", "vehicle", "lane"])
