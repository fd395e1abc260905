"""``team_bound``: a proven lower bound on the harm of every world, whatever several controlled vehicles do.

If Vehicle 2 is controlled and Vehicle 1 is not, one bound covers the harm of the first three vehicles together. If
Vehicle 1 is controlled and an obstacle is ahead, the obstacle is treated as an immovable first vehicle of the line.
docs/internals/proofs/team-bound.md has the proofs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.closing import (
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
from ethbrake_marl.extensions.proofs.front_three import bound_threes
from ethbrake_marl.extensions.proofs.ramped_meetings import at_onset_of, check_asked, onset_states, rounding
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.physics.motion import stopping_distances
from ethbrake_marl.physics.state import Bools, Floats, Ints, Vehicles, Worlds

_MIDDLE, _REAR = 1, 2

_UNMOVED_T = 1e30  # mass of an obstacle, t; the other mass is negligible


def _combined_bound_of_line(
    now: Worlds, onset: Floats, counts: Bools, chosen: Ints, until: Floats, pairs: Floats, time_step_s: float | None
) -> Floats:
    """Return the combined bound: a lower bound on the harm of the first two pairs together, [n] m2/s2, or 0 if nothing
    is proven.

    The combined bound is 0 in worlds in which the first vehicle of the line does not brake yet. The second vehicle of
    the line is treated as if it may act now.

    Args:
        now: the worlds in their present state.
        onset: [n, N] time from now at which each vehicle may act, s.
        counts: [n, P] True for pairs whose next impact counts and whose vehicles move forward.
        chosen: indices of the controlled vehicles; they include the second vehicle.
        until: [n] horizon, s from now.
        pairs: [n, 2] lower bounds on the harm of each of the first two pairs alone, m2/s2.
        time_step_s: time between two decisions, s; None if commands may change at any time.

    """
    v = now.vehicles
    stops = (
        stopping_distances(now.speeds_mps[:, 0], onset[:, 0], v.braking_capacity_mps2[:, 0], v.brake_rate_mps3[:, 0])
        < now.obstacle_gap_m
    )
    rows = np.flatnonzero((onset[:, 0] <= 0.0) & counts[:, 0] & counts[:, 1] & stops & ~now.obstacle_hit)
    # the first three vehicles of these worlds; Vehicle 2 may act at once
    some = now.take(rows)
    vehicles_ = some.vehicles
    braking, driving, latency, mass, limit = (
        np.ascontiguousarray(each[:, :3])
        for each in (
            vehicles_.braking_capacity_mps2,
            vehicles_.driving_capacity_mps2,
            vehicles_.latency_s,
            vehicles_.mass_t,
            vehicles_.speed_limit_mps,
        )
    )
    latency[:, _MIDDLE] = np.minimum(latency[:, _MIDDLE], some.time_s)
    three = replace(
        some,
        vehicles=Vehicles.at_once(braking, driving, latency, mass, limit, vehicles_.restitution),
        gaps_m=some.gaps_m[:, :2].copy(),
        speeds_mps=some.speeds_mps[:, :3].copy(),
        pair_hit=some.pair_hit[:, :2].copy(),
        command_mps2=some.command_mps2[:, :3].copy(),
        messages=np.zeros((some.n, 0)),
    )
    if not len(rows):
        return np.zeros(now.n)
    unavoidable = avoidability(three, _MIDDLE).reason >= 2
    rows, three = rows[unavoidable], three.take(np.flatnonzero(unavoidable))
    steps = np.where(onset[rows, _MIDDLE] <= 0.0, 0.0 if time_step_s is None else time_step_s, 0.0)
    since, power = np.zeros(len(rows)), np.full(len(rows), np.inf)
    if now.N == 3:  # no vehicle pushes the last vehicle
        full = v.braking_capacity_mps2[rows, _REAR] + v.driving_capacity_mps2[rows, _REAR]
        since, power = onset[rows, _REAR], full if _REAR in chosen else np.zeros(len(rows))
    bounds, out = np.zeros(now.n), np.empty(len(rows))
    bound_threes(onset_states(three, _MIDDLE, steps), until[rows], pairs[rows], since, power, out)
    bounds[rows] = out
    return bounds


@dataclass(frozen=True, slots=True)
class TeamBound:
    """Proven lower bounds on the harm of each world, in m2/s2; ``pairs`` is [n, P], every other array [n]."""

    harm: Floats  # lower bound on the harm, whatever the controlled vehicles do
    early: Floats  # harm before any controlled vehicle may act
    obstacle: Floats  # bound on the harm of Vehicle 1 and the obstacle ahead, after the early harm
    pairs: Floats  # [n, P] bound on the harm of each pair alone, after the early harm
    combined: Floats  # bound on the harm of the first two pairs together (see ``team_bound``); 0 if nothing is proven

    @property
    def impact_proven(self) -> Bools:
        """Boolean mask [n]: True for worlds in which an impact is certain whatever the controlled vehicles do.

        False means that no impact is proven; an impact may be unavoidable nevertheless.
        """
        return np.asarray(self.harm > 0.0, np.bool_)


def team_bound(
    worlds: Worlds,
    vehicles: Iterable[int],
    *,
    harm_count: HarmCount = "first",
    horizon_s: float = 8.0,
    scripts: Mapping[int, str] | None = None,
    time_step_s: float | None = None,
) -> TeamBound:
    """Return a proven lower bound on the harm of every world, whatever several controlled vehicles do together.

    The fields of the result satisfy ``harm = early + obstacle + max((pairs[:, 0] + pairs[:, 1]), combined) + pairs[:,
    2:].sum(axis=1)``. Each term of this formula is lowered by the largest possible rounding error. If Vehicle 1 is
    controlled, ``combined`` covers the obstacle, Vehicle 1 and Vehicle 2: ``harm = early + max((obstacle + pairs[:,
    0]), combined) + pairs[:, 1:].sum(axis=1)``. Harm that may come only after ``horizon_s`` counts as 0.

    All other vehicles brake fully from their latencies on. For a single controlled vehicle, ``lower_bound`` returns
    larger bounds for the lines that it covers.

    Args:
        worlds: the ``n`` worlds in their present state.
        vehicles: indices of the controlled vehicles, from 0.
        harm_count: ``first`` or ``total``. With ``first``, only the first impact of each pair counts: if a pair has had
            an impact before now, no later impact of this pair counts.
        horizon_s: time until which harm counts, s after the alert.
        scripts: script of each vehicle that is not controlled, by index; only full_brake is allowed. None: all of them
            brake fully.
        time_step_s: time between two decisions, s. With a number, the bound holds only for commands that change at
            decisions: when the first controlled vehicle may act, and every ``time_step_s`` after that. If Vehicle 2 is
            the first controlled vehicle that may act, the bound is larger than with None. None: commands may change at
            any time.

    Raises ``InvalidInput`` if ``vehicles`` is empty, or has an unknown or repeated index. The function also raises
    ``InvalidInput`` for brakes that build up, a script other than full_brake, an unknown harm count, a time step below
    ``LEAST_TIME_STEP_S``, and a horizon that is not finite or lies before the first of the vehicles may act.

    """
    check_asked("team_bound", harm_count, horizon_s, time_step_s)
    # refuse vehicles that the bound does not cover
    if not isinstance(vehicles, Iterable):
        raise InvalidInput(f"team_bound: vehicles = {vehicles!r}: must be a list of indices, for instance (1, 2)")
    team = tuple(vehicles)
    for vehicle in team:
        check_whole_number("team_bound: an entry of vehicles", vehicle, 0, worlds.N - 1)
    if not team or len(set(team)) != len(team):
        raise InvalidInput(f"team_bound: vehicles = {team}: must have at least one vehicle and no vehicle twice")
    for index, script in (scripts or {}).items():
        check_whole_number("team_bound: a key of scripts", index, 0, worlds.N - 1)
        if index not in team and script != "full_brake":
            raise InvalidInput(f"team_bound: vehicle_{index + 1} follows the script {script!r}; must be 'full_brake'")
    chosen = np.array(sorted(team), np.int64)
    worlds.refuse_build_up("team_bound")
    now, start, early, counts = at_onset_of("team_bound", worlds, chosen, harm_count, horizon_s)
    onset = np.maximum(worlds.vehicles.latency_s - start[:, np.newaxis], 0.0)
    until, v = horizon_s - start, now.vehicles
    each: list[dict[int, Floats | float]] = [
        {
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
        for p in range(worlds.N - 1)
    ]
    pairs = np.stack([_pair_bound(columns, until, counts[:, p]) for p, columns in enumerate(each)], axis=1)
    ahead = np.isfinite(now.obstacle_gap_m) & ~(now.obstacle_hit & (harm_count == "first"))
    ahead &= now.speeds_mps[:, 0] >= 0.0
    standing: dict[int, Floats | float] = {  # the obstacle as the front vehicle of a pair
        PAIR_GAP: np.where(ahead, now.obstacle_gap_m, 0.0),
        LEADER_A: 1.0,
        FOLLOWER_V: now.speeds_mps[:, 0],
        FOLLOWER_ONSET: onset[:, 0],
        FOLLOWER_A: v.braking_capacity_mps2[:, 0],
    }
    obstacle = _pair_bound(standing, until, ahead)
    combined, walled = np.zeros(worlds.n), bool(chosen[0] == 0)
    if walled and ahead.any():
        # the line with its obstacle as a standing first vehicle that nothing moves
        line = now.with_obstacle()
        braking, mass = line.vehicles.braking_capacity_mps2.copy(), line.vehicles.mass_t.copy()
        braking[:, 0], mass[:, 0] = 1.0, _UNMOVED_T
        behind = replace(line.vehicles, braking_capacity_mps2=braking, mass_t=mass)
        line = replace(
            line, vehicles=behind, obstacle_gap_m=np.ones(line.n)
        )  # a finite obstacle_gap_m switches off the bounds by the centre of mass
        onsets, counted = np.column_stack([np.zeros(line.n), onset]), np.column_stack([ahead, counts])
        both = np.stack([obstacle, pairs[:, 0]], axis=1)
        combined = _combined_bound_of_line(line, onsets, counted, chosen + 1, until, both, time_step_s)
    elif worlds.N >= 3 and chosen[0] == 1:
        combined = _combined_bound_of_line(now, onset, counts, chosen, until, pairs[:, :2], time_step_s)
    outward = rounding(worlds, chosen, np.where(np.isfinite(worlds.obstacle_gap_m), worlds.obstacle_gap_m, 0.0))
    early, obstacle, combined = (np.maximum(part - outward, 0.0) for part in (early, obstacle, combined))
    pairs = np.maximum(pairs - outward[:, np.newaxis], 0.0)
    alone = np.column_stack([obstacle, pairs])
    together = alone[:, :2] if walled else alone[:, 1:3]
    harm = early + alone.sum(axis=1) + np.maximum(combined - together.sum(axis=1), 0.0)
    return TeamBound(harm, early, obstacle, pairs, combined)


def _pair_bound(columns: Mapping[int, Floats | float], until: Floats, counts: Bools) -> Floats:
    """Return a lower bound on the harm of one pair alone, [n] m2/s2; 0 in worlds where the pair's next impact does not
    count.

    ``columns`` maps columns of the array of pairs (``PAIR_GAP`` to ``FOLLOWER_A``) to their values; columns that are
    left out are 0. ``until`` [n] is the horizon, s. ``counts`` [n] is True for worlds in which the next impact of the
    pair counts.
    """
    at, bounds, out = np.zeros((len(until), PAIR_WIDTH)), np.zeros(len(until)), np.empty(int(counts.sum()))
    for column, values in columns.items():
        at[:, column] = values
    bound_pairs(at[counts], until[counts], out)
    bounds[counts] = out
    return bounds
