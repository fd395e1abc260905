"""A proven lower bound on the harm of every world, whatever several controlled vehicles do together.

docs/avoidability.md, "Teams", has the proofs, under both counting rules:

* each pair alone: its front vehicle as far ahead as it can be (full drive where it is controlled, else full braking),
  its rear vehicle as far behind (full braking); pushes from outside the pair only make it worse;
* the front three together, where Vehicle 1 brakes fully, Vehicle 2 is controlled, and contact is unavoidable; where
  Vehicle 1 is controlled, the obstacle ahead is the first of the three.

Bounds of different pairs add up, as each holds for every joint command. All parts are rounded outward.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.harm import HarmCount, empty_ledger
from ethbrake_marl.limits.front_three import Line, behind_wall, combined_bound
from ethbrake_marl.limits.lower_bound import BOUND_EPS, EPS, check_asked
from ethbrake_marl.limits.pair_kernel import (
    FOLLOWER_A,
    FOLLOWER_ONSET,
    FOLLOWER_V,
    LEADER_A,
    LEADER_FREE,
    LEADER_LIMIT,
    LEADER_ONSET,
    LEADER_U,
    LEADER_V,
    PAIR_GAP,
    PAIR_WIDTH,
    bound_pairs,
)
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, advance


@dataclass(frozen=True, slots=True)
class TeamBound:
    """What is proven about each world [n], in m2/s2."""

    harm: Floats  # no joint command does less harm than this
    early: Floats  # done before any controlled vehicle may act
    obstacle: Floats  # Vehicle 1 and the obstacle ahead
    pairs: Floats  # [n, P] of each pair alone, from then on
    combined: Floats  # of the front two pairs together (see ``team_bound``); 0 where nothing is proven

    @property
    def impact_proven(self) -> Bools:
        """Whether every joint command has an impact, [n]; elsewhere none is proven."""
        yes: Bools = self.harm > 0.0
        return yes


def team_bound(
    worlds: Worlds,
    vehicles: Iterable[int],
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    scripts: Mapping[int, str] | None = None,
    time_step_s: float | None = None,
) -> TeamBound:
    """Proven lower bound on the harm from now to ``horizon_s`` (absolute), over all joint commands of ``vehicles``.

    ``harm = early + obstacle + max(pairs[:, 0] + pairs[:, 1], combined) + pairs[:, 2:]``, each part rounded outward;
    where Vehicle 1 is controlled, ``combined`` is that of the obstacle and Vehicles 1 and 2: ``early + max(obstacle +
    pairs[:, 0], combined) + pairs[:, 1:]``.
    All other vehicles brake with their whole capacity from their latencies on; ``scripts`` (index -> name) is only
    checked to say the same. What may come only after the horizon counts as 0, and so does the next impact of a pair
    that was hit before where ``harm_count`` is "first". One controlled vehicle is allowed; ``lower_bound`` is sharper
    where it covers the line.

    With ``time_step_s`` it is proven only for commands that change at decisions, the first one when the first of the
    vehicles may act, one every ``time_step_s`` after it. That is sharper where Vehicle 2 is the first.

    Raises ``InvalidInput`` for vehicles that are none, not there or given twice, another script, an unknown count, a
    time step below ``LEAST_TIME_STEP_S``, and a horizon that is not finite or lies before any of them may act.
    """
    check_asked("team_bound", harm_count, horizon_s, time_step_s)
    chosen = _checked(worlds, vehicles, scripts or {})
    latency = worlds.vehicles.latency_s
    start = np.maximum(latency[:, chosen].min(axis=1), worlds.time_s)
    if not (np.all(start <= horizon_s) and horizon_s < np.inf):
        raise InvalidInput(f"team_bound: horizon_s {horizon_s!r}: must be finite and at least {start.max():g} s")
    now, impacts = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=start)
    early = empty_ledger(worlds).add(impacts).world_harm(harm_count)
    onset = np.maximum(latency - start[:, np.newaxis], 0.0)
    until = horizon_s - start
    forward = now.speeds_mps >= 0.0
    counts = (~now.pair_hit if harm_count == "first" else True) & forward[:, 1:] & forward[:, :-1]
    pairs = np.stack([_pair(now, p, onset, chosen, until, counts[:, p]) for p in range(worlds.N - 1)], axis=1)
    ahead = forward[:, 0] & np.isfinite(now.obstacle_gap_m) & ~(now.obstacle_hit & (harm_count == "first"))
    obstacle = _obstacle(now, onset, until, ahead)
    combined, walled = np.zeros(worlds.n), bool(chosen[0] == 0)
    if walled and ahead.any():
        wall = behind_wall(Line(now, onset, counts), ahead)
        both = np.stack([obstacle, pairs[:, 0]], axis=1)
        combined = combined_bound(wall, chosen + 1, until, both, time_step_s)
    elif worlds.N >= 3 and chosen[0] == 1:
        combined = combined_bound(Line(now, onset, counts), chosen, until, pairs[:, :2], time_step_s)
    outward = _rounding(worlds, chosen)
    early, obstacle, combined = (np.maximum(part - outward, 0.0) for part in (early, obstacle, combined))
    pairs = np.maximum(pairs - outward[:, np.newaxis], 0.0)
    alone = np.column_stack([obstacle, pairs])
    together = alone[:, :2] if walled else alone[:, 1:3]
    harm = early + alone.sum(axis=1) + np.maximum(combined - together.sum(axis=1), 0.0)
    return TeamBound(harm, early, obstacle, pairs, combined)


def _pair(now: Worlds, p: int, onset: Floats, chosen: Ints, until: Floats, counts: Bools) -> Floats:
    """The bound of pair ``p`` alone, [n]."""
    v, at = now.vehicles, np.zeros((now.n, PAIR_WIDTH))
    columns: dict[int, Floats | float] = {
        PAIR_GAP: now.gaps_m[:, p],
        LEADER_V: now.speeds_mps[:, p],
        LEADER_ONSET: onset[:, p],
        LEADER_A: v.braking_capacity_mps2[:, p],
        LEADER_FREE: float(p in chosen),
        LEADER_U: v.driving_capacity_mps2[:, p],
        LEADER_LIMIT: v.speed_limit_mps[:, p],
        FOLLOWER_V: now.speeds_mps[:, p + 1],
        FOLLOWER_ONSET: onset[:, p + 1],
        FOLLOWER_A: v.braking_capacity_mps2[:, p + 1],
    }
    return _bound(at, columns, until, counts)


def _obstacle(now: Worlds, onset: Floats, until: Floats, counts: Bools) -> Floats:
    """The bound of Vehicle 1 and the obstacle ahead, [n]: a pair whose front vehicle stands."""
    at = np.zeros((now.n, PAIR_WIDTH))
    columns: dict[int, Floats | float] = {
        PAIR_GAP: np.where(counts, now.obstacle_gap_m, 0.0),
        LEADER_A: 1.0,
        FOLLOWER_V: now.speeds_mps[:, 0],
        FOLLOWER_ONSET: onset[:, 0],
        FOLLOWER_A: now.vehicles.braking_capacity_mps2[:, 0],
    }
    return _bound(at, columns, until, counts)


def _bound(at: Floats, columns: Mapping[int, Floats | float], until: Floats, counts: Bools) -> Floats:
    for column, values in columns.items():
        at[:, column] = values
    found, out = np.zeros(len(at)), np.empty(int(counts.sum()))
    bound_pairs(at[counts], until[counts], out)
    found[counts] = out
    return found


def _checked(worlds: Worlds, vehicles: Iterable[int], scripts: Mapping[int, str]) -> Ints:
    """The controlled vehicles in order; refuse what the bound does not cover."""
    if not isinstance(vehicles, Iterable):
        raise InvalidInput(f"team_bound: vehicles {vehicles!r}: must be a list of vehicles, for instance (1, 2)")
    given = tuple(vehicles)
    for vehicle in given:
        check_whole_number("team_bound: a vehicle", vehicle, 0, worlds.N - 1)
    if not given or len(set(given)) != len(given):
        raise InvalidInput(f"team_bound: vehicles {given}: at least one is needed, each once")
    for index, script in scripts.items():
        check_whole_number("team_bound: a vehicle of scripts", index, 0, worlds.N - 1)
        if index not in given and script != "full_brake":
            raise InvalidInput(f"team_bound: vehicle_{index + 1} follows {script!r}; must be 'full_brake'")
    return np.array(sorted(given), np.int64)


def _rounding(worlds: Worlds, chosen: Ints) -> Floats:
    """How far arithmetic can move a bound and a realised harm apart, at most; [n] m2/s2: see ``lower_bound.rounding``.

    The largest speed is a speed limit where any controlled vehicle may drive, the largest closing acceleration that of
    the strongest drive.
    """
    v = worlds.vehicles
    driving = v.driving_capacity_mps2[:, chosen]
    limits = np.where(driving > 0.0, v.speed_limit_mps[:, chosen], 0.0)
    fastest = np.maximum(worlds.speeds_mps.max(axis=1), limits.max(axis=1))
    closing = v.braking_capacity_mps2.max(axis=1) + driving.max(axis=1)
    weakest = v.braking_capacity_mps2.min(axis=1)
    way = worlds.gaps_m.sum(axis=1) + np.where(np.isfinite(worlds.obstacle_gap_m), worlds.obstacle_gap_m, 0.0)
    scale = fastest * fastest * (1.0 + closing / weakest) + 2.0 * closing * way
    outward: Floats = BOUND_EPS * EPS * scale
    return outward
