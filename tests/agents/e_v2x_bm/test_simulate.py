"""Simulations of one world that end early and share their start: the harm is that of ``advance``, to the bit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.agents.e_v2x_bm import Line, Samples, make_line, share_start, simulate, will_stay_apart
from ethbrake_marl.physics import Floats, Worlds, advance, make_worlds
from ethbrake_marl.physics.compiling import compiled
from ethbrake_marl.physics.kernel import FLAG, ROW
from tests.agents.e_v2x_bm.recorded import line_worlds

HORIZON_S = 7.0


def line(worlds: Worlds, k: int, vehicle: int, command: Floats, *, total: bool = False) -> Line:
    v = worlds.vehicles
    made = make_line(
        worlds.gaps_m[k], worlds.speeds_mps[k], worlds.pair_hit[k], worlds.obstacle_gap_m[k], worlds.obstacle_hit[k],
        command[k], v.latency_s[k], v.mass_t[k], v.speed_limit_mps[k], worlds.time_s[k], v.restitution[k], HORIZON_S,
        vehicle, total,
    )  # fmt: skip
    assert share_start(made) == FLAG.DONE
    return made


def harms(made: Line, decelerations: Floats, bound: float = math.inf) -> Samples:
    n = len(decelerations)
    found = Samples(decelerations.copy(), np.full(n, np.nan), np.full(n, np.nan), np.full(n, np.nan))
    assert simulate(made, found, 0, n, bound) == FLAG.DONE
    return found


def worlds_of(kind: str, vehicles: int) -> tuple[Worlds, Floats]:
    """Worlds, and what their vehicles are told."""
    n = 25
    rng, worlds = np.random.default_rng([vehicles, len(kind)]), line_worlds(n, vehicles, seed=100 + vehicles)
    braking = worlds.vehicles.braking_capacity_mps2
    command = -braking * rng.uniform(0.2, 1, braking.shape)
    match kind:
        case "driving":
            command = np.clip(rng.uniform(-1, 0.4, braking.shape) * braking, -braking, 3)
        case "coasting":
            command[rng.random(command.shape) < 0.4] = 0.0
        case "later":
            worlds, _ = advance(worlds, command, until_s=rng.uniform(0, 3, n))
        case "obstacle":
            worlds = replace(worlds, obstacle_gap_m=np.where(rng.random(n) < 0.7, rng.uniform(2, 120, n), np.inf))
    return worlds, command


@pytest.mark.parametrize("vehicles", [2, 3, 5, 10, 18])  # NumPy adds up a row of 8 or more pairs in another order
@pytest.mark.parametrize("kind", ["braking", "driving", "coasting", "later", "obstacle"])
def test_simulate__does_the_harm_of_advance(kind, vehicles):
    worlds, command = worlds_of(kind, vehicles)
    harmed = 0
    for vehicle in sorted({0, vehicles // 2, vehicles - 1}):
        capacity = worlds.vehicles.braking_capacity_mps2[:, vehicle]
        for k in range(0, worlds.n, 1 + vehicles // 5):
            at = capacity[k] * np.array([0.0, 0.0, 0.31, 0.77, 1.0])
            same = np.full(len(at), k)
            told = command[same]
            told[:, vehicle] = -at
            _, impacts = advance(worlds.take(same), told, until_s=HORIZON_S)
            first = impacts.first_impact_harm.sum(axis=1) + impacts.obstacle_first_harm
            total = impacts.total_harm.sum(axis=1) + impacts.obstacle_total_harm
            for counts_all, expected in ((False, (first, total)), (True, (total, first))):
                found = harms(line(worlds, k, vehicle, command, total=counts_all), at)
                assert np.array_equal((found.harm, found.other), expected)
            impacts_of = np.column_stack([impacts.count, impacts.obstacle_count])
            if vehicles <= 5:
                assert len(np.unique(found.course)) == len(np.unique(impacts_of, axis=0))
            harmed += int((total > 0).sum())
    assert harmed > 20


def test_simulate__gives_up_at_a_bound_and_tells_no_less():
    worlds, command = worlds_of("braking", 4)
    given_up = 0
    for k in range(worlds.n):
        at = np.linspace(0.0, worlds.vehicles.braking_capacity_mps2[k, 1], 23)
        whole = harms(line(worlds, k, 1, command), at)
        bound = float(np.median(whole.harm))
        cut = harms(line(worlds, k, 1, command), at, bound)
        below = whole.harm < bound
        assert np.array_equal(cut.harm[below], whole.harm[below])
        assert np.array_equal(cut.other[below], whole.other[below])
        assert np.all(cut.harm[~below] >= bound)
        given_up += int((cut.other[~below] < whole.other[~below]).sum())
    assert given_up > 0


@compiled
def _will_stay_apart(table: Floats) -> bool:
    return will_stay_apart(table)


def stays_apart(speeds, commands, gaps, *, active=True) -> bool:
    worlds = make_worlds(
        np.array(gaps, float), np.array(speeds, float), braking_capacity_mps2=9, driving_capacity_mps2=3, latency_s=0,
        mass_t=1, restitution=0.1,
    )  # fmt: skip
    table = line(worlds, 0, 0, np.array([commands], float)).table
    table[ROW.ACTIVE], table[ROW.COMMAND] = float(active), commands
    table[ROW.SPEED], table[ROW.GAP, :-1] = speeds, gaps
    return bool(_will_stay_apart(table))


@pytest.mark.parametrize(
    ("speeds", "commands", "gaps", "apart"),
    [
        ([10, 9], [-5, -6], [0.0], True),  # separates, and the rear brakes harder
        ([10, 9.5], [-6, -5], [0.0], False),  # separates, and meets again: 8.33 m to stop, and 9.03 m
        ([10, 8], [-6, -5], [0.0], True),  # separates, and stops behind: 8.33 m, and 6.4 m
        ([10, 10], [-6, -5], [0.0], True),  # one body: the rear presses
        ([10, 10], [-5, -6], [0.0], True),  # comes apart
        ([0, 10], [-5, -5], [10.1], True),  # stops 0.1 m behind one that stands
        ([0, 10], [-5, -5], [9.9], False),
        ([10, 14], [-4, -8], [1.9], False),  # stops behind (14.4 m, 12.25 m), but 16 > 2 * 4 * 1.9
        ([10, 14], [-4, -8], [2.1], True),
        ([10, 14], [-4, 0], [99.0], False),  # coasts
        ([10, 10], [-5, 1], [99.0], False),  # drives
        ([0, 0], [-5, -5], [0.0], True),  # stand
        ([10, 9, 9], [-5, -6, -5], [1.0, 0.0], True),  # the last two, as one body, brake by 5.5
        ([10, 9, 9], [-5, -5.2, -3], [1.0, 0.0], True),  # ... by 4.1: 10 m + 1 m, and 9.88 m
        ([10, 9, 9], [-5, -5.2, -2], [1.0, 0.0], False),  # ... by 3.6: 11 m, and 11.25 m; each alone would keep apart
    ],
)
def test_will_stay_apart__by_hand(speeds, commands, gaps, apart):
    assert stays_apart(speeds, commands, gaps) is apart


def test_will_stay_apart__waits_for_every_command():
    assert not stays_apart([10, 9], [-5, -6], [0.0], active=False)
