"""The proven bound on the honest cost (docs/studies/honest_bound.py): by hand, and against plans that attack it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.proofs import line as row
from ethbrake_marl.extensions.proofs.avoidability import FRONT, avoidability
from ethbrake_marl.extensions.search.pricing import with_braking
from ethbrake_marl.extensions.search.tables import TABLE_FOLDER, BestHarmTable
from ethbrake_marl.motion.impact import TOUCH_MPS
from ethbrake_marl.motion.layout import Floats
from tests.docs.site import load
from tests.extensions.proofs.worlds import at, worlds

study = load("honest_bound")
HORIZON_S, STEP_S = 12.0, 0.1


def costs(state: State, plans: Floats) -> Floats:
    """Honest cost of episodes in which Vehicle 2 follows ``plans`` [n, T] (m/s2) and then brakes fully, [n] m2/s2."""
    game = eb.open_game(eb.load_scenario("paper-random").replace(horizon_s=HORIZON_S))[1]
    state, full = game.reset(with_braking(state, [1, 2, 3])), state.braking_capacity_mps2[:, 1]
    for command in np.pad(plans.T, ((0, round(HORIZON_S / STEP_S) - plans.shape[1]), (0, 0)), constant_values=-np.inf):
        drive = np.maximum(state.driving_capacity_mps2[:, 1], 1e-9)
        actions = np.where(command < 0.0, np.maximum(command, -full) / full, command / drive)
        state, _ = game.step(state, actions[:, np.newaxis])
    return state.harm("honest")


def test_pieces__by_hand() -> None:
    world = at(BOUNCE=0.1, FRONT_SHARE=0.4, REAR_SHARE=0.5, V_L=1, A_L=1, V_F=1, A_F=1, LIMIT_F=1, V_R=1, ONSET_R=1)
    # 6 m/s of closing, of which an impact from behind threw 2: 36 + 10 * 1.1 * 4; below 0.05 m/s nothing bounces
    assert study.third_cost(world, 6.0, 2.0) == pytest.approx(36 + 44 - 11 * TOUCH_MPS, rel=1e-12)
    assert study.third_cost(world, 0.04, 0.0) == pytest.approx(0.0016 + 0.4 - 10 * TOUCH_MPS, rel=1e-12)
    # 5 m/s faster, 9 / 8 m behind, 4 m/s2: 25 - 9 = 4^2; driving 2 m/s away at once avoids it for 20
    world[row.A_R], world[row.LIMIT_F], world[row.U_F] = 4.0, 40.0, 0.0
    assert study.third_at_rear(world, 1.125, 10.0, 15.0, 0.0, 9.0, 0.0) == pytest.approx(60 - 11 * TOUCH_MPS)
    world[row.U_F] = 1000.0
    assert 12 < study.third_at_rear(world, 1.125, 10.0, 15.0, 0.0, 9.0, 0.0) <= 20
    # after a touch an impact of 3 m/s pushes 3.3 m/s for 9; beyond 5.5 m/s of impact the push is cheaper
    assert [study.price_of(world, 3.3, w) for w in (0.0, 1.0)] == pytest.approx([9, 33])
    assert study.price_of(world, 10.0, 0.0) == pytest.approx(5.5**2 + 10 * (10 - 1.1 * 5.5))
    assert study.most_push(world, True, 9.0) == pytest.approx(3.3) and study.most_push(world, False, 33.0) == 3.3
    assert study.slowing(0.5, 0.1, 1.0, 2.0) == pytest.approx(0.9)
    # from 10 to 10 m/s in 2 s over 16 m: down to 6 at 4 m/s2 and up again: 2 * (10 * 1 - 4 / 2)
    assert study.cruise(10.0, 10.0, 2.0, 4.0, 4.0, 16.0) == pytest.approx(6.0)
    assert study.cruise(10.0, 10.0, 2.0, 4.0, 4.0, 15.9) == -math.inf
    # all three at once, 4 and 2 m/s: (4 + 0.55 * 2)^2 + (2 + 0.44 * 4)^2; the front pair closes with at least 4
    exact = (4 + 0.55 * 2) ** 2 + (2 + 0.44 * 4) ** 2
    assert 0.95 * exact < study.triple_contact(world, 4.0, 6.0) <= exact


def test_bound__is_just_below_a_plan_by_hand_and_the_best_known_costs() -> None:
    state = worlds(
        [0.258, 0.342], [21.623, 26.969, 24.376], [5.166, 6.106, 6.106], [0, 0, 0.626], drive=[0, 2.773, 0],
        mass=[11.38, 5.69, 4.173], limit=[60, 27.817, 60], restitution=0.5,
    )  # fmt: skip
    plan = np.array([[-6.106, 0.0, -6.106, -5.879, -1.376, -4.482, -4.978, -4.11]])
    cost, bound = costs(state, plan)[0], study.honest_bound(state, HORIZON_S, STEP_S)[0]
    assert 36.0 < bound <= cost == pytest.approx(39.104, abs=1e-3)
    scenario, table = eb.load_scenario("paper-random"), BestHarmTable.load(TABLE_FOLDER / "paper-random.npz")
    bounds, best = study.honest_bound(scenario.sample(30, seed=7), 8.0, STEP_S), table.harm["honest"][:30]
    assert (bounds <= best + 1e-9).all() and bounds.mean() > 0.94 * best.mean()


@pytest.mark.nightly
def test_bound__no_plan_is_below_it_in_random_worlds(size: int) -> None:
    """Random plans, and changes to the best of them: 1 to 40 t, e from 0 to 1, gaps down to 1 mm, low speed limits."""
    rng, n, decisions = np.random.default_rng(4), 400 * size, 24
    braking, mass = rng.uniform(2, 9, (n, 3)), np.exp(rng.uniform(0, 3.7, (n, 3)))
    braking[:, 1] = braking[:, [0, 2]].max(axis=1) + rng.choice([0, 0.5, 1, 2], n)
    speeds = np.clip(rng.uniform(3, 30, (n, 1)) + rng.normal(0, 1, (n, 3)) * rng.choice([0.5, 2, 6], (n, 1)), 0, None)
    drive, limit, latency = np.zeros((n, 3)), np.full((n, 3), 60.0), np.zeros((n, 3))
    drive[:, 1] = rng.uniform(0, 9, n) * rng.choice([0, 1], n)
    limit[:, 1] = speeds[:, 1] + rng.exponential(6, n) * rng.choice([0, 0.2, 1, 5], n)
    latency[:, 2] = rng.uniform(0, 2, n) * rng.choice([0, 1], n)
    bounce = np.minimum(mass[:, 1] / mass[:, 0], mass[:, 2] / mass[:, 1])
    bounce = np.minimum(rng.uniform(0, 1, n) * rng.choice([0, 0.1, 0.3, 1], n), bounce)
    gaps = rng.uniform(0.01, 12, (n, 2)) * rng.choice([0.1, 0.4, 1, 2], (n, 2))
    state = worlds(gaps, speeds, braking, latency, drive=drive, limit=limit, mass=mass, restitution=bounce)
    state = state.take(np.flatnonzero(avoidability(state).reason >= FRONT))
    low, high = -state.braking_capacity_mps2[:, [1]], state.driving_capacity_mps2[:, [1]]

    def random_plans() -> Any:
        share = rng.choice([0, 1, 2], (state.n, decisions)) / 2
        share = np.where(rng.random(share.shape) < 0.3, rng.random(share.shape), share)
        phase = np.sort(rng.integers(0, decisions, (state.n, decisions)) // rng.integers(1, 9, (state.n, 1)))
        return low + (high - low) * np.take_along_axis(share, phase, axis=1)

    best = random_plans()
    least, bound = costs(state, best), study.honest_bound(state, HORIZON_S, STEP_S)
    for k in range(100):
        begin, much = rng.integers(0, decisions, (state.n, 1)), 8.0 * 10.0 ** rng.uniform(-3, 0, (state.n, 1))
        changed = (np.arange(decisions) >= begin) & (np.arange(decisions) < begin + rng.integers(1, 8, (state.n, 1)))
        plans = random_plans() if k < 20 else np.clip(best + changed * much * rng.normal(size=much.shape), low, high)
        cost = costs(state, plans)
        best, least = np.where((cost < least)[:, np.newaxis], plans, best), np.minimum(least, cost)
    print(f"{state.n} worlds; {np.mean(bound > 0.9 * least):.1%} of the bounds are near the least cost of 101 plans")
    assert (bound > 1).sum() > 50 and (least >= bound).all()
