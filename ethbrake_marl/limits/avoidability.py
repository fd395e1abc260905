"""Contacts that nobody could have avoided: exact, world by world, with a witness or the reason.

One vehicle is controlled, its neighbours brake with their whole capacity from their latencies on. Let z be the
pointwise largest trajectory behind the vehicle in front: coast to the own latency, drive as long as possible, brake at
capacity so as to just touch the front vehicle (or stop behind it), then follow it. Contact is avoidable if and only if
full braking avoids the front vehicle and z stays ahead of the rear one. docs/avoidability.md has the proof, says what a
touch is, and what the claim does not cover.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.limits.avoidability_kernel import (
    DRIVE,
    FOLLOW,
    MARGIN,
    REASON,
    RESULT_WIDTH,
    TOUCH,
    decide_worlds,
)
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.events import stopping_distances

REASONS = ("", "early", "front", "rear")  # the name of each code; "" where contact is avoidable


@dataclass(frozen=True, slots=True)
class Avoidability:
    """The verdict on each world [n].

    ``reason``: 0 avoidable; 1 early, a pair meets before the controlled vehicle may act; 2 front, even full braking
    meets the front vehicle; 3 rear, the rear vehicle meets the largest trajectory that spares the front one.

    ``margin_m``: the smallest gap between that trajectory and the rear vehicle (of two vehicles with the rear one
    controlled: what full braking leaves of the gap). Where contact is unavoidable it is negative and says by how much:
    for *front* the gap that full braking lacks, for *early* the overlap before the vehicle may act.

    ``switch_s``, ``command_mps2``: the witness, a profile of the controlled vehicle: each command from its absolute
    time to the next (infinite: never). Played in the physics it has no impact. NaN where contact is unavoidable.
    """

    reason: Ints
    margin_m: Floats
    switch_s: Floats  # [n, 3]
    command_mps2: Floats  # [n, 3]

    @property
    def avoidable(self) -> Bools:
        """Whether some profile avoids all contact, hence every impact, [n]."""
        yes: Bools = self.reason == 0
        return yes

    @property
    def reason_name(self) -> NDArray[np.str_]:
        """The reason in words, [n]: one of ``REASONS``."""
        return np.array(REASONS)[self.reason]


def avoidability(worlds: Worlds, vehicle: int = 1, *, scripts: Mapping[int, str] | None = None) -> Avoidability:
    """Decide in every world whether ``vehicle`` (index from 0) could have avoided all contact from now on.

    Elsewhere every profile leads to contact, but not always to an impact: see ``LowerBound.impact_proven``.
    Three vehicles with the middle one controlled, or two with either. The others brake with their whole capacity from
    their latencies on. ``scripts`` (index -> name, as ``scenario.roles``) is only checked to say the same. An overlap
    of the deciding trajectories of up to 1e-12 m counts as a touch, hence as avoided.

    Raises ``InvalidInput`` for another line, another script than full_brake, a front vehicle that may brake only after
    the controlled one acts, a vehicle that moves backward, or an obstacle (``obstacle_gap_m``) that vehicle_1 could
    reach before any contact.
    """
    _check(worlds, vehicle, scripts or {})
    v = worlds.vehicles
    onset = np.maximum(v.latency_s - worlds.time_s[:, None], 0.0)
    out = np.empty((worlds.n, RESULT_WIDTH))
    decide_worlds(
        worlds.gaps_m, worlds.speeds_mps, onset, v.braking_capacity_mps2, v.driving_capacity_mps2, v.speed_limit_mps,
        vehicle, out,
    )  # fmt: skip
    reason = out[:, REASON].astype(np.int64)
    start = worlds.time_s + onset[:, vehicle]
    switch = np.column_stack([worlds.time_s, start + out[:, DRIVE], start + out[:, TOUCH]])
    braking = -v.braking_capacity_mps2[:, vehicle]
    command = np.column_stack([v.driving_capacity_mps2[:, vehicle], braking, out[:, FOLLOW]])
    switch[reason > 0] = np.nan
    command[reason > 0] = np.nan
    return Avoidability(reason, out[:, MARGIN].copy(), switch, command)


def _check(worlds: Worlds, vehicle: int, scripts: Mapping[int, str]) -> None:
    """Refuse what the theorem does not cover.

    An obstacle that Vehicle 1 cannot reach by braking fully changes nothing: only a push could bring it there, and that
    is an impact already.
    """
    check_whole_number("avoidability: vehicle", vehicle, 0, worlds.N - 1)
    own = np.maximum(worlds.vehicles.latency_s[:, 0] - worlds.time_s, 0.0)
    way = stopping_distances(worlds.speeds_mps[:, 0], own, worlds.vehicles.braking_capacity_mps2[:, 0])
    _refuse(
        ~(way < worlds.obstacle_gap_m),
        worlds.obstacle_gap_m,
        "obstacle_gap_m",
        None,
        "beyond full braking of vehicle_1",
    )
    if vehicle == 0 and np.isfinite(worlds.obstacle_gap_m).any():
        raise InvalidInput("avoidability: vehicle_1 controlled, with an obstacle ahead (obstacle_gap_m): not decided")
    if (worlds.N, vehicle) not in ((3, 1), (2, 0), (2, 1)):
        raise InvalidInput(
            f"avoidability: vehicle_{vehicle + 1} of {worlds.N} vehicles; it is decided exactly for vehicle_2 of 3 and"
            " for either vehicle of 2, otherwise use avoidable_by_lp"
        )
    for index, script in scripts.items():
        if index != vehicle and script != "full_brake":
            raise InvalidInput(f"avoidability: vehicle_{index + 1} follows {script!r}; must be 'full_brake'")
    if vehicle == 1:
        latency = np.maximum(worlds.vehicles.latency_s, worlds.time_s[:, None])
        _refuse(latency[:, 0] > latency[:, 1], worlds.vehicles.latency_s[:, 0], "latency_s", 0, "not above vehicle_2's")
    for i in range(worlds.N):
        _refuse(~(worlds.speeds_mps[:, i] >= 0.0), worlds.speeds_mps[:, i], "speeds_mps", i, ">= 0")


def _refuse(bad: Bools, values: Floats, name: str, i: int | None, right: str) -> None:
    if bad.any():
        k = int(np.argmax(bad))
        place = f"{k}" if i is None else f"{k}, {i}"
        raise InvalidInput(f"avoidability: {name}[{place}] = {values[k]:g}: must be {right}")
