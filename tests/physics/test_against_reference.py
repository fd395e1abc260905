"""The event-exact kernel against the separately written tiny-step reference, on 180 random worlds.

A world may differ only where a discontinuity decides (a graze, a bounce at the plastic threshold) and the reference,
run again at half its step, disagrees with itself. Such worlds are counted, not skipped.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from ethbrake_marl.physics.batch import Impacts, advance
from ethbrake_marl.physics.worlds import Worlds, make_worlds
from tests.reference.tiny_steps import Outcome, simulate

Floats = NDArray[np.float64]

WORLDS = 60  # per line, of three restitutions: a step of the reference costs much the same for one world
STEP_S = 1e-4
HARM_M2PS2 = 0.05  # per pair, each count
STATE = 0.01  # m and m/s at the horizon
AMBIGUOUS_SHARE = 0.01


class Case(NamedTuple):
    """Random worlds as both sides need them."""

    worlds: Worlds
    command_mps2: Floats
    horizon_s: Floats


def random_case(seed: int, n: int, N: int, e: float | Floats, command_mps2: float = 7.0) -> Case:
    """Draw ``n`` worlds; commands are constant, uniform in [-command_mps2, command_mps2]."""
    rng = np.random.default_rng([seed, N])
    worlds = make_worlds(
        rng.uniform(1.0, 8.0, (n, N - 1)),
        rng.uniform(5.0, 25.0, (n, N)),
        braking_capacity_mps2=7.0,
        driving_capacity_mps2=7.0,
        latency_s=rng.uniform(0.0, 1.0, (n, N)),
        mass_t=rng.uniform(1.0, 8.0, (n, N)),
        speed_limit_mps=rng.uniform(25.0, 40.0, (n, N)),
        restitution=e,
    )
    command = rng.uniform(-1.0, 1.0, (n, N)) * command_mps2
    return Case(worlds, command, rng.uniform(4.0, 5.0, n))


def refer(case: Case, rows: NDArray[np.int64], step_s: float) -> Outcome:
    """Run the reference on these rows of a case."""
    worlds = case.worlds.take(rows)
    return simulate(
        worlds.gaps_m,
        worlds.speeds_mps,
        case.command_mps2[rows],
        latency_s=worlds.vehicles.latency_s,
        mass_t=worlds.vehicles.mass_t,
        speed_limit_mps=worlds.vehicles.speed_limit_mps,
        restitution=worlds.vehicles.restitution,
        horizon_s=case.horizon_s[rows],
        step_s=step_s,
    )


def disagreements(outcome: Outcome, end: Worlds, impacts: Impacts, horizon_s: Floats) -> NDArray[np.bool_]:
    """Worlds [n] in which the kernel and the reference differ: pairs hit, a pair's harm, the state at the horizon."""
    hit = outcome.count > 0
    apart = np.any((impacts.count > 0) != hit, axis=1) | np.any(end.pair_hit != hit, axis=1)
    for ours, theirs, tolerance in (
        (impacts.first_impact_harm, outcome.first_impact_harm, HARM_M2PS2),
        (impacts.total_harm, outcome.total_harm, HARM_M2PS2),
        (end.gaps_m, outcome.gaps_m, STATE),
        (end.speeds_mps, outcome.speeds_mps, STATE),
        (end.time_s[:, None], horizon_s[:, None], 1e-9),
    ):
        apart |= ~np.all(np.abs(ours - theirs) <= tolerance, axis=1)
    return apart


def refers_to_itself(coarse: Outcome, fine: Outcome) -> NDArray[np.bool_]:
    """Worlds [n] in which halving the step changes neither the pairs hit nor any harm by a fifth of the tolerance."""
    same = np.all((coarse.count > 0) == (fine.count > 0), axis=1)
    same &= np.all(np.abs(coarse.first_impact_harm - fine.first_impact_harm) <= HARM_M2PS2 / 5, axis=1)
    return same & np.all(np.abs(coarse.total_harm - fine.total_harm) <= HARM_M2PS2 / 5, axis=1)


@pytest.mark.parametrize("N", [2, 3, 5])
def test_advance__agrees_with_the_tiny_step_reference(N: int) -> None:
    case = random_case(20, WORLDS, N, np.resize([0.0, 0.1, 0.3], WORLDS))
    end, impacts = advance(case.worlds, case.command_mps2, until_s=case.horizon_s)
    outcome = refer(case, np.arange(WORLDS), STEP_S)
    assert np.mean(np.any(outcome.count > 0, axis=1)) > 0.3  # the worlds have something to say about impacts

    apart = np.flatnonzero(disagreements(outcome, end, impacts, case.horizon_s))
    certain = refers_to_itself(Outcome(*(column[apart] for column in outcome)), refer(case, apart, STEP_S / 2))
    assert apart[certain].tolist() == []
    assert np.sum(~certain) < AMBIGUOUS_SHARE * WORLDS

    agreed = np.setdiff1d(np.arange(WORLDS), apart)
    gained = np.sum(case.worlds.vehicles.mass_t * (end.speeds_mps - case.worlds.speeds_mps), axis=1)
    assert gained[agreed] == pytest.approx(outcome.driven_impulse[agreed], abs=STATE)
    assert outcome.momentum_error.max() < 1e-12


POST_T, POST_BRAKES_MPS2 = 1e12, 1e6  # a vehicle that an impact moves by less than doubles can tell, and brakes at once


@pytest.mark.parametrize("N", [2, 3])
def test_obstacle__is_what_a_braked_vehicle_becomes_that_is_far_too_heavy_to_move(N: int) -> None:
    n = 40
    case = random_case(24, n, N, 0.1)
    gap = np.random.default_rng([25, N]).uniform(5.0, 40.0, n)
    end, impacts = advance(replace(case.worlds, obstacle_gap_m=gap), case.command_mps2, until_s=case.horizon_s)
    vehicles = case.worlds.vehicles
    outcome = simulate(
        _in_front(gap, case.worlds.gaps_m),
        _in_front(0.0, case.worlds.speeds_mps),
        _in_front(-POST_BRAKES_MPS2, case.command_mps2),
        latency_s=_in_front(0.0, vehicles.latency_s),
        mass_t=_in_front(POST_T, vehicles.mass_t),
        speed_limit_mps=_in_front(1.0, vehicles.speed_limit_mps),
        restitution=vehicles.restitution,
        horizon_s=case.horizon_s,
        step_s=STEP_S,
    )
    apart = np.abs(impacts.obstacle_first_harm - outcome.first_impact_harm[:, 0]) > HARM_M2PS2
    apart |= np.abs(impacts.obstacle_total_harm - outcome.total_harm[:, 0]) > HARM_M2PS2
    apart |= (impacts.obstacle_count > 0) != (outcome.count[:, 0] > 0)
    apart |= np.any(np.abs(impacts.total_harm - outcome.total_harm[:, 1:]) > HARM_M2PS2, axis=1)
    apart |= np.abs(end.obstacle_gap_m - outcome.gaps_m[:, 0]) > STATE
    apart |= np.any(np.abs(end.gaps_m - outcome.gaps_m[:, 1:]) > STATE, axis=1)
    apart |= np.any(np.abs(end.speeds_mps - outcome.speeds_mps[:, 1:]) > STATE, axis=1)
    assert not apart.any() and (impacts.obstacle_count > 0).sum() > n / 2


def _in_front(value: float | Floats, columns: Floats) -> Floats:
    """One more column, in front."""
    first = np.broadcast_to(np.asarray(value, np.float64), len(columns))
    return np.column_stack([first, columns])


def test_disagreements__finds_a_planted_error_of_which_the_reference_is_certain() -> None:
    case = random_case(22, 40, 3, 0.1)
    end, impacts = advance(case.worlds, case.command_mps2, until_s=case.horizon_s)
    vehicles = replace(case.worlds.vehicles, mass_t=case.worlds.vehicles.mass_t * [1.0, 1.02, 1.0])
    planted = case._replace(worlds=replace(case.worlds, vehicles=vehicles))
    coarse, fine = (refer(planted, np.arange(40), h) for h in (2 * STEP_S, STEP_S))
    apart = disagreements(coarse, end, impacts, case.horizon_s)
    assert np.mean(apart) > 0.2
    assert np.all(refers_to_itself(coarse, fine))


@pytest.mark.parametrize("e", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("N", [2, 3, 5])
def test_advance__conserves_momentum_when_nobody_brakes_or_drives(N: int, e: float) -> None:
    case = random_case(21, 500, N, e, command_mps2=0.0)
    end, impacts = advance(case.worlds, case.command_mps2, until_s=case.horizon_s)
    assert np.sum(impacts.count) > 200
    before, after = (np.sum(case.worlds.vehicles.mass_t * w.speeds_mps, axis=1) for w in (case.worlds, end))
    assert after == pytest.approx(before, rel=1e-13)


@pytest.mark.parametrize("e", [0.0, 0.1, 0.3])
def test_advance__conserves_momentum_in_every_impact_of_a_pair(e: float) -> None:
    case = random_case(23, 500, 2, e)
    _, impacts = advance(case.worlds, case.command_mps2, until_s=case.horizon_s, record=True)
    rows = impacts.rows
    assert rows is not None
    assert rows.world.size > 200
    mass = case.worlds.vehicles.mass_t[rows.world]
    impulse = mass * np.column_stack([rows.front_speed_change_mps, rows.rear_speed_change_mps])
    assert impulse[:, 0] == pytest.approx(-impulse[:, 1], abs=1e-12)
    assert np.all(impulse[:, 0] > 0.0)
