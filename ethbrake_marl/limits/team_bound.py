"""A proven lower bound on the harm of every world, whatever several controlled vehicles do together.

docs/avoidability.md, "Teams", has the proofs, under both counting rules:

* each pair alone: its front vehicle as far ahead as it can be (full drive where it is controlled, else full braking),
  its rear vehicle as far behind (full braking); pushes from outside the pair only make it worse;
* the front three together, where Vehicle 1 brakes fully, Vehicle 2 is controlled, and contact is unavoidable.

Bounds of different pairs add up, as each holds for every joint command. All parts are rounded outward.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount, check_harm_count, empty_ledger
from ethbrake_marl.limits.avoidability import avoidability
from ethbrake_marl.limits.lower_bound import BOUND_EPS, EPS, LEAST_TIME_STEP_S
from ethbrake_marl.limits.meetings import (
    A_F,
    A_L,
    A_R,
    FRONT_SHARE,
    GAP_L,
    GAP_R,
    LIMIT_F,
    OBSTACLE,
    ONSET_R,
    REAR_SHARE,
    RESTITUTION,
    TIME_STEP,
    U_F,
    V_F,
    V_L,
    V_R,
    WIDTH,
)
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
from ethbrake_marl.limits.team_kernel import bound_threes
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds, advance
from ethbrake_marl.physics.events import stopping_distances
from ethbrake_marl.physics.worlds import vehicles_at_once

_FRONT, _MIDDLE, _REAR = range(3)


@dataclass(frozen=True, slots=True)
class TeamBound:
    """What is proven about each world [n], in m2/s2."""

    harm: Floats  # no joint command does less harm than this
    early: Floats  # done before any controlled vehicle may act
    obstacle: Floats  # Vehicle 1 and the obstacle ahead
    pairs: Floats  # [n, P] of each pair alone, from then on
    combined: Floats  # of the front two pairs together; 0 where nothing is proven

    @property
    def impact_proven(self) -> Bools:
        """Whether every joint command has an impact, [n]; elsewhere none is proven."""
        yes: Bools = self.harm > 0.0
        return yes


def team_bound(
    worlds: Worlds,
    vehicles: Sequence[int],
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    scripts: Mapping[int, str] | None = None,
    time_step_s: float | None = None,
) -> TeamBound:
    """Proven lower bound on the harm from now to ``horizon_s`` (absolute), over all joint commands of ``vehicles``.

    ``harm = early + obstacle + max(pairs[:, 0] + pairs[:, 1], combined) + pairs[:, 2:]``, each part rounded outward.
    All other vehicles brake with their whole capacity from their latencies on; ``scripts`` (index -> name) is only
    checked to say the same. What may come only after the horizon counts as 0, and so does the next impact of a pair
    that was hit before where ``harm_count`` is "first". One controlled vehicle is allowed; ``lower_bound`` is sharper
    where it covers the line.

    With ``time_step_s`` it is proven only for commands that change at decisions, the first one when the first of the
    vehicles may act, one every ``time_step_s`` after it. That is sharper where Vehicle 2 is the first.

    Raises ``InvalidInput`` for vehicles that are none, not there or given twice, another script, an unknown count, a
    time step below ``LEAST_TIME_STEP_S``, and a horizon that is not finite or lies before any of them may act.
    """
    chosen = _checked(worlds, vehicles, harm_count, scripts or {}, time_step_s)
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
    combined = np.zeros(worlds.n)
    if worlds.N >= 3 and 0 not in chosen and _MIDDLE in chosen:
        combined = _combined(now, onset, chosen, until, pairs, counts, time_step_s)
    outward = _rounding(worlds, chosen)
    early, obstacle, combined = (np.maximum(part - outward, 0.0) for part in (early, obstacle, combined))
    pairs = np.maximum(pairs - outward[:, np.newaxis], 0.0)
    front = np.maximum(pairs[:, :2].sum(axis=1), combined)
    return TeamBound(early + obstacle + front + pairs[:, 2:].sum(axis=1), early, obstacle, pairs, combined)


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


def _combined(
    now: Worlds,
    onset: Floats,
    chosen: Ints,
    until: Floats,
    pairs: Floats,
    counts: Bools,
    time_step_s: float | None,
) -> Floats:
    """The bound of the front two pairs together, [n]: Vehicle 1 brakes by now, Vehicle 2 is taken to act from now."""
    v = now.vehicles
    stops = stopping_distances(now.speeds_mps[:, 0], onset[:, 0], v.braking_capacity_mps2[:, 0]) < now.obstacle_gap_m
    rows = np.flatnonzero((onset[:, 0] <= 0.0) & counts[:, 0] & counts[:, 1] & stops & ~now.obstacle_hit)
    three = _front_three(now, rows)
    if not len(rows):
        return np.zeros(now.n)
    unavoidable = avoidability(three, _MIDDLE).reason >= 2
    rows, three = rows[unavoidable], three.take(np.flatnonzero(unavoidable))
    steps = np.where(onset[rows, _MIDDLE] <= 0.0, 0.0 if time_step_s is None else time_step_s, 0.0)
    last, free = now.N == 3, _REAR in chosen
    since = onset[rows, _REAR] if last else np.zeros(len(rows))
    power = np.full(len(rows), np.inf)
    if last:
        full = v.braking_capacity_mps2[rows, _REAR] + v.driving_capacity_mps2[rows, _REAR]
        power = full if free else np.zeros(len(rows))
    found, out = np.zeros(now.n), np.empty(len(rows))
    bound_threes(_states(three, steps), until[rows], pairs[rows, :2], since, power, out)
    found[rows] = out
    return found


def _front_three(now: Worlds, rows: Ints) -> Worlds:
    """The first three vehicles of these worlds, Vehicle 2 free to act at once."""
    some = now.take(rows)
    v = some.vehicles
    braking, driving, latency, mass, limit = (
        np.ascontiguousarray(each[:, :3])
        for each in (
            v.braking_capacity_mps2,
            v.driving_capacity_mps2,
            v.latency_s,
            v.mass_t,
            v.speed_limit_mps,
        )
    )
    latency[:, _MIDDLE] = np.minimum(latency[:, _MIDDLE], some.time_s)
    return replace(
        some,
        vehicles=vehicles_at_once(braking, driving, latency, mass, limit, v.restitution),
        gaps_m=some.gaps_m[:, :2].copy(),
        speeds_mps=some.speeds_mps[:, :3].copy(),
        pair_hit=some.pair_hit[:, :2].copy(),
        command_mps2=some.command_mps2[:, :3].copy(),
        messages=np.zeros((some.n, 0)),
    )


def _checked(
    worlds: Worlds,
    vehicles: Sequence[int],
    harm_count: HarmCount,
    scripts: Mapping[int, str],
    time_step_s: float | None,
) -> Ints:
    """The controlled vehicles in order; refuse what the bound does not cover."""
    check_harm_count(harm_count)
    number = isinstance(time_step_s, (int, float)) and not isinstance(time_step_s, bool)
    if time_step_s is not None and not (number and LEAST_TIME_STEP_S <= time_step_s < np.inf):
        raise InvalidInput(
            f"team_bound: time_step_s {time_step_s!r}: must be a number of seconds from {LEAST_TIME_STEP_S:g} on, or"
            " None"
        )
    chosen = sorted(set(vehicles))
    if not chosen or len(chosen) != len(vehicles) or not set(chosen) <= set(range(worlds.N)):
        raise InvalidInput(
            f"team_bound: vehicles {tuple(vehicles)}: at least one is needed, each once, from 0 to {worlds.N - 1}"
        )
    for index, script in scripts.items():
        if index not in chosen and script != "full_brake":
            raise InvalidInput(f"team_bound: vehicle_{index + 1} follows {script!r}; must be 'full_brake'")
    return np.array(chosen, np.int64)


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


def _states(three: Worlds, steps: Floats) -> Floats:
    """The rows of the compiled bound [n, WIDTH]."""
    v, at = three.vehicles, np.zeros((three.n, WIDTH))
    mass = v.mass_t
    columns = {
        GAP_L: three.gaps_m[:, 0],
        V_L: three.speeds_mps[:, _FRONT],
        A_L: v.braking_capacity_mps2[:, _FRONT],
        V_F: three.speeds_mps[:, _MIDDLE],
        A_F: v.braking_capacity_mps2[:, _MIDDLE],
        U_F: v.driving_capacity_mps2[:, _MIDDLE],
        LIMIT_F: v.speed_limit_mps[:, _MIDDLE],
        GAP_R: three.gaps_m[:, 1],
        V_R: three.speeds_mps[:, _REAR],
        A_R: v.braking_capacity_mps2[:, _REAR],
        ONSET_R: np.maximum(v.latency_s[:, _REAR] - three.time_s, 0.0),
        FRONT_SHARE: mass[:, _FRONT] / (mass[:, _FRONT] + mass[:, _MIDDLE]),
        REAR_SHARE: mass[:, _REAR] / (mass[:, _REAR] + mass[:, _MIDDLE]),
        RESTITUTION: v.restitution,
        TIME_STEP: steps,
        OBSTACLE: three.obstacle_gap_m,
    }
    for column, values in columns.items():
        at[:, column] = values
    return at
