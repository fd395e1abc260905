"""The exact verdict against a linear programme, and the programme where nothing exact is known."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl import load_scenario
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.limits.lower_bound import avoidability
from ethbrake_marl.physics import Worlds, advance, make_worlds
from tests.limits.avoidability_worlds import wide_worlds
from tests.reference.avoidability_lp import avoidable_by_lp, default_horizon_s

LINES = [(3, 1), (2, 1), (2, 0)]  # vehicles, controlled one


def drawn(n, vehicles, controlled, seed):
    """n worlds that do not meet early; for three vehicles a third for each verdict, and some of the paper's."""
    worlds = wide_worlds(40 * n, vehicles, seed)
    reason = avoidability(worlds, controlled).reason
    if vehicles == 2:
        return worlds.take(np.flatnonzero(reason != 1)[:n])
    rows = np.concatenate([np.flatnonzero(reason == code)[: n // 4 + 1] for code in (0, 2, 3)])
    paper = load_scenario("paper-random-early").sample(n - 3 * (n // 4), seed=seed).worlds
    return Worlds.concatenate([worlds.take(rows), paper])


def compare(worlds, controlled, steps):
    """How often the programme is certain; it must then agree."""
    exact = avoidability(worlds, controlled)
    certain = 0
    for k in range(worlds.n):
        world = worlds.take([k])
        linear = avoidable_by_lp(world, (controlled,), default_horizon_s(world, (controlled,)) / steps)
        if linear.certain:
            assert linear.avoidable == exact.avoidable[k], (k, linear.margin_m, exact.margin_m[k])
            certain += 1
    return certain / worlds.n


@pytest.mark.parametrize(("vehicles", "controlled", "n"), [(3, 1, 80), (2, 1, 20), (2, 0, 20)])
def test_exact_verdict__agrees_with_a_linear_programme(vehicles, controlled, n):
    assert compare(drawn(n, vehicles, controlled, seed=31), controlled, steps=120) > 0.9


@pytest.mark.long
@pytest.mark.parametrize(("vehicles", "controlled", "n"), [(3, 1, 2000), (2, 1, 500), (2, 0, 500)])
def test_exact_verdict__agrees_with_a_fine_linear_programme(vehicles, controlled, n):
    assert compare(drawn(n, vehicles, controlled, seed=32), controlled, steps=500) > 0.97


def paper_line(gaps, speeds, latency):
    capacity = np.resize([6.0, 7.0], len(speeds))
    return make_worlds(
        [gaps],
        [speeds],
        braking_capacity_mps2=capacity,
        driving_capacity_mps2=capacity,
        latency_s=latency,
        mass_t=5,
        restitution=0.1,
    )


def test_margin__comes_close_to_the_exact_one_as_steps_shrink():
    # 20 m + 40 m to stop against 40 m and the gap of 21 m: 1 m is left.
    world = make_worlds(
        [[21]],
        [[20, 20]],
        braking_capacity_mps2=5,
        driving_capacity_mps2=0,
        latency_s=[0, 1],
        mass_t=5,
        restitution=0.1,
    )
    errors = [abs(avoidable_by_lp(world, (1,), step).margin_m - 1.0) for step in (0.3, 0.03)]
    assert errors[0] < avoidable_by_lp(world, (1,), 0.3).tolerance_m
    assert errors[1] < 1e-6 or errors[1] < 0.1 * errors[0]


def test_profile__of_a_certain_margin_avoids_collision_in_the_physics():
    worlds = load_scenario("paper-random").sample(20, seed=5).worlds
    played = 0
    for k in np.flatnonzero(avoidability(worlds).avoidable):
        world = worlds.take([k])
        linear = avoidable_by_lp(world, (1,), 0.08)
        if not linear.certain:
            continue
        count = 0
        for start, command in zip(linear.time_s, linear.command_mps2, strict=True):
            everyone = -world.vehicles.braking_capacity_mps2
            everyone[:, 1] = command
            world, impacts = advance(world, everyone, until_s=start + 0.08)
            count += impacts.count.sum()
        assert count == 0
        played += 1
    assert played > 3


def test_more_controlled_vehicles__avoid_more():
    # Vehicle 3 lacks 2 m behind a vehicle 1 that brakes fully; it gets them if vehicle 1 brakes a little less.
    world = paper_line([7, 7], [20, 18, 20], [0, 0.5, 0.8])
    alone, together = (avoidable_by_lp(world, controlled, 0.05) for controlled in ((1,), (0, 1)))
    assert (alone.avoidable, alone.certain) == (False, True)
    assert (together.avoidable, together.certain) == (True, True)
    assert together.command_mps2.shape == (together.time_s.size, 2)


def test_five_vehicles__every_further_controlled_one_helps_or_does_nothing():
    world = paper_line([9, 9, 9, 9], [20, 20, 20, 20, 20], [0, 0.2, 0.3, 0.4, 0.5])
    found = [avoidable_by_lp(world, controlled, 0.1) for controlled in ((1,), (1, 2), (1, 2, 3), (0, 1, 2, 3))]
    margins = np.array([linear.margin_m for linear in found])
    assert np.all(np.diff(margins) > -found[0].tolerance_m)
    # Vehicle 2 alone: vehicle 3 needs 6 m + 400 / 12 m to stop, vehicle 1 gives 400 / 12 m: of 18 m, 12 m are to share.
    assert margins[0] == pytest.approx(6, abs=found[0].tolerance_m)


def test_scripted_pair_that_meets__is_unavoidable_whatever_the_others_do():
    world = paper_line([20, 1, 20], [20, 15, 20, 20], [0, 1, 1, 1])
    linear = avoidable_by_lp(world, (0,), 0.1)
    assert not linear.avoidable
    assert linear.margin_m < -1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: avoidable_by_lp(Worlds.concatenate([w, w]), (1,), 0.1), "2 worlds"),
        (lambda w: avoidable_by_lp(w, (), 0.1), "controlled"),
        (lambda w: avoidable_by_lp(w, (1, 1), 0.1), "controlled"),
        (lambda w: avoidable_by_lp(w, (3,), 0.1), "controlled"),
        (lambda w: avoidable_by_lp(w, (1,), 0.0), "step_s 0.0"),
        (lambda w: avoidable_by_lp(w, (1,), float("nan")), "step_s nan"),
        (lambda w: avoidable_by_lp(w, (1,), 0.1, horizon_s=0.4), "latencies must lie below"),
        (lambda w: avoidable_by_lp(w, (1,), 0.1, horizon_s=float("inf")), "horizon_s inf"),
        (lambda w: avoidable_by_lp(w, (1,), 0.1, horizon_s=1.0), "long enough to come to rest"),
    ],
)
def test_bad_input__is_refused(call, message):
    with pytest.raises(InvalidInput, match=message):
        call(paper_line([7, 7], [20, 18, 20], [0, 0.5, 0.8]))
