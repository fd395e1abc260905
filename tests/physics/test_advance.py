"""The exact advance on cases that a person can compute by hand."""

from __future__ import annotations

import importlib
import re
from dataclasses import replace

import numba
import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.physics import Worlds, advance, kernel, make_worlds
from ethbrake_marl.physics.compiling import by_parts


def line(gaps, speeds, *, mass=1.0, e=0.0, latency=0.0, limit=100.0, braking=10.0, driving=10.0) -> Worlds:
    return make_worlds(
        gaps,
        speeds,
        braking_capacity_mps2=braking,
        driving_capacity_mps2=driving,
        latency_s=latency,
        mass_t=mass,
        restitution=e,
        speed_limit_mps=limit,
    )


def test_free_motion__speed_and_gap_are_quadratic_in_time():
    after, impacts = advance(line([10.0], [10.0, 8.0]), [-2.0, -1.0], 2.0)
    assert after.speeds_mps.tolist() == [[6.0, 6.0]]
    assert after.gaps_m.tolist() == [[12.0]]  # 10 - (-2) * 2 - 1 * 2
    assert impacts.count.sum() == 0
    assert after.time_s.tolist() == [2.0]


def test_braking__stops_at_standstill_and_holds():
    after, _ = advance(line([50.0], [4.0, 4.0]), [-2.0, -4.0], 10.0)
    assert after.speeds_mps.tolist() == [[0.0, 0.0]]
    assert after.gaps_m[0, 0] == 50.0 + 4.0 - 2.0


def test_latency__falls_inside_the_segment_exactly():
    after, _ = advance(line([50.0], [8.0, 8.0], latency=[0.0, 0.75]), [-2.0, -4.0], 1.75)
    assert after.speeds_mps[0, 1] == 4.0  # coasts 0.75 s, brakes 1 s
    front, rear = 8.0 * 1.75 - 1.75**2, 8.0 * 0.75 + 8.0 - 2.0
    assert after.gaps_m[0, 0] == pytest.approx(50.0 + front - rear, abs=1e-12)


def test_speed_limit__ends_the_drive():
    after, _ = advance(line([50.0], [8.0, 0.0], limit=10.0), [2.0, 0.0], 3.0)
    assert after.speeds_mps[0, 0] == 10.0
    assert after.gaps_m[0, 0] == 50.0 + 9.0 + 20.0


def test_impact__follows_the_papers_velocity_exchange():
    # 10 m at 10 m/s closing; masses 2 and 3; e = 0.5: v1+ = 3/5 * 1.5 * 10 = 9, v2+ = 10 - 2/5 * 1.5 * 10 = 4
    after, impacts = advance(line([10.0], [0.0, 10.0], mass=[2.0, 3.0], e=0.5), [0.0, 0.0], 2.0, record=True)
    assert after.speeds_mps[0] == pytest.approx([9.0, 4.0], abs=1e-14)
    assert after.gaps_m[0, 0] == pytest.approx(5.0, abs=1e-13)
    assert impacts.first_impact_harm.tolist() == impacts.total_harm.tolist() == [[100.0]]
    rows = impacts.rows
    assert rows.time_s.tolist() == [1.0] and rows.closing_speed_mps.tolist() == [10.0] and rows.first.tolist() == [True]
    assert rows.front_speed_change_mps[0] == pytest.approx(9.0) and rows.rear_speed_change_mps[0] == pytest.approx(-6.0)


def test_impact__is_listed_only_on_demand_and_then_in_one_run(monkeypatch):
    module, runs = importlib.import_module("ethbrake_marl.physics.batch"), []
    monkeypatch.setattr(module, "by_parts", lambda *given: runs.append(given) or by_parts(*given))
    worlds = line([10.0], [0.0, 10.0])
    assert advance(worlds, 0.0, 2.0)[1].rows is None
    assert advance(worlds, 0.0, 2.0, record=True)[1].rows is not None
    assert len(runs) == 2  # the list was long enough at once


def test_impact__closing_speed_is_the_root_of_the_discriminant():
    # g = 9, w = 3, b = 8: D = 9 + 144 = 153
    _, impacts = advance(line([9.0], [5.0, 8.0]), [-8.0, 0.0], 0.625)
    assert impacts.count.sum() == 0
    _, impacts = advance(line([9.0], [20.0, 23.0]), [-8.0, 0.0], 2.0)
    assert impacts.total_harm[0, 0] == pytest.approx(153.0, rel=1e-15)


def test_impact__at_the_end_of_a_segment_belongs_to_that_segment():
    worlds = line([10.0], [0.0, 10.0])
    here, impacts = advance(worlds, [0.0, 0.0], 1.0)
    assert impacts.count.tolist() == [[1]]
    _, impacts = advance(here, [0.0, 0.0], 1.0)
    assert impacts.count.tolist() == [[0]]


def test_bounce_back__keeps_the_negative_speed_and_the_brakes_end_it():
    # m_rear = 1 < e m_front = 0.5 * 4: v2+ = 10 - 4/5 * 1.5 * 10 = -2; braking at 4 stops it after 0.5 s, 0.5 m back
    worlds = line([0.0], [0.0, 10.0], mass=[4.0, 1.0], e=0.5)
    struck, impacts = advance(worlds, [0.0, -4.0], 0.0)
    assert struck.speeds_mps[0] == pytest.approx([3.0, -2.0], abs=1e-14) and impacts.count.tolist() == [[1]]
    after, _ = advance(struck, [0.0, -4.0], 1.0)
    assert after.speeds_mps[0, 1] == 0.0
    assert after.gaps_m[0, 0] == pytest.approx(3.5, abs=1e-13)


def test_touch__is_no_impact_and_no_harm():
    # w^2 = 2 q g: the rear vehicle just reaches the front one with no closing speed
    after, impacts = advance(line([4.0], [10.0, 14.0]), [0.0, -2.0], 2.0)
    assert impacts.count.sum() == 0 and impacts.total_harm.sum() == 0.0
    assert after.gaps_m[0, 0] == 0.0 and after.speeds_mps.tolist() == [[10.0, 10.0]]


@pytest.mark.parametrize(("push", "moves"), [(3.0, False), (5.0, True)])
def test_holding_brake__moves_only_above_its_braking_force(push, moves):
    worlds = line([0.0], [0.0, 0.0], mass=[2.0, 2.0])
    after, impacts = advance(worlds, [-4.0, push], 2.0)
    expected = (push - 4.0) / 2 * 2.0 if moves else 0.0  # (2 * push - 2 * 4) / 4 for 2 s
    assert after.speeds_mps.tolist() == [[expected, expected]]
    assert after.gaps_m.tolist() == [[0.0]] and impacts.count.sum() == 0


def test_resting_contact__shares_the_common_deceleration_and_releases():
    # joined at 5 m/s after a plastic impact; front brakes at 6, rear at 2: block -4 until rest
    worlds = line([0.0], [0.0, 10.0])
    after, _ = advance(worlds, [-6.0, -2.0], 1.0)
    assert after.speeds_mps.tolist() == [[1.0, 1.0]] and after.gaps_m.tolist() == [[0.0]]
    released, _ = advance(after, [0.0, -2.0], 0.25)
    assert released.speeds_mps.tolist() == [[1.0, 0.5]] and released.gaps_m[0, 0] == 0.0625


def test_cluster__three_touching_vehicles_share_by_the_order_free_law():
    # rear strikes two that touch and stand: P pools all three, 9 * 1/3 = 3; e = 0.5: v+ = 4.5 - 0.5 v-
    after, impacts = advance(line([0.0, 0.0], [0.0, 0.0, 9.0], e=0.5), [0.0, 0.0, 0.0], 0.0)
    assert after.speeds_mps[0] == pytest.approx([4.5, 4.5, 0.0], abs=1e-14)
    assert impacts.count.tolist() == [[0, 1]] and impacts.total_harm.tolist() == [[0.0, 81.0]]


def test_bounces__end_in_resting_contact_and_each_is_counted():
    # front stands and holds (heavy); rear is driven against it: bounces 8, 4, 2, 1, ... until below 0.05 m/s
    worlds = line([0.0], [0.0, 8.0], mass=[1e15, 1.0], e=0.5)
    after, impacts = advance(worlds, [-10.0, 4.0], 60.0)
    speeds = [8.0 * 0.5**k for k in range(9)]  # the ninth, 0.03125, is plastic
    assert impacts.count.tolist() == [[len(speeds)]]
    assert impacts.total_harm[0, 0] == pytest.approx(sum(s * s for s in speeds), rel=1e-9)
    assert impacts.first_impact_harm.tolist() == [[64.0]]
    assert after.gaps_m.tolist() == [[0.0]] and after.speeds_mps[0, 1] == pytest.approx(0.0, abs=1e-12)


def test_batch__a_world_has_the_same_bits_alone():
    rng = np.random.default_rng(3)
    worlds = make_worlds(
        rng.uniform(1, 10, (200, 4)),
        rng.uniform(5, 25, (200, 5)),
        braking_capacity_mps2=7.0,
        driving_capacity_mps2=7.0,
        latency_s=rng.uniform(0, 1, (200, 5)),
        mass_t=rng.uniform(1, 8, (200, 5)),
        restitution=0.2,
    )
    command = rng.uniform(-7, 7, (200, 5))
    whole, impacts = advance(worlds, command, 5.0)
    assert impacts.count.sum() > 100
    for k in (0, 57, 199):
        alone, _ = advance(worlds.take([k]), command[k], 5.0)
        assert alone.gaps_m.tobytes() == whole.gaps_m[k : k + 1].tobytes()
        assert alone.speeds_mps.tobytes() == whole.speeds_mps[k : k + 1].tobytes()


def test_split__two_half_segments_equal_one():
    rng = np.random.default_rng(4)
    worlds = make_worlds(
        rng.uniform(1, 10, (500, 2)),
        rng.uniform(5, 25, (500, 3)),
        braking_capacity_mps2=7.0,
        driving_capacity_mps2=7.0,
        latency_s=0.5,
        mass_t=[4.5, 5.5, 5.9],
        restitution=0.1,
    )
    command = rng.uniform(-7, 0, (500, 3))
    whole, once = advance(worlds, command, until_s=6.0)
    half, first = advance(worlds, command, until_s=rng.uniform(0, 6, 500))
    rest, second = advance(half, command, until_s=6.0)
    np.testing.assert_allclose(rest.gaps_m, whole.gaps_m, rtol=0, atol=1e-11)
    np.testing.assert_allclose(first.total_harm + second.total_harm, once.total_harm, rtol=1e-12, atol=1e-10)
    assert (first.count + second.count).tolist() == once.count.tolist()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: advance(w, [-11.0, 0.0], 1.0), r"command_mps2\[0, 0\] = -11: must be in \[-10, 10\]"),
        (lambda w: advance(w, [float("nan"), 0.0], 1.0), "nan"),
        (lambda w: advance(w, [0.0, 0.0, 0.0], 1.0), "shape"),
        (lambda w: advance(w, [0.0, 0.0], -1.0), "cannot be advanced"),
        (lambda w: advance(w, [0.0, 0.0], until_s=float("inf")), "world 0 is at 0 s and cannot be advanced to inf s"),
        (lambda w: advance(w, [0.0, 0.0]), "either"),
        (lambda w: line([-1.0], [0.0, 0.0]), r"gaps_m\[0, 0\] = -1"),
        (lambda w: line([1.0], [0.0, 0.0], mass=[1.0, -2.0]), r"mass_t\[0, 1\] = -2"),
        (lambda w: line([1.0], [0.0, 200.0]), "speed_limit"),
        (lambda w: line([1.0, 2.0], [0.0, 0.0]), "gaps_m"),
    ],
)
def test_bad_input__is_refused_with_its_place_and_range(call, message):
    with pytest.raises(InvalidInput, match=message):
        call(line([5.0], [1.0, 1.0]))


@pytest.mark.parametrize(("command", "message"), [([10.0, -11.0], "0, 1] = -11"), ([-10.0, 10.5], "0, 1] = 10.5")])
def test_bad_command__is_named_also_behind_one_that_is_just_allowed(command, message):
    with pytest.raises(InvalidInput, match=re.escape(message)):
        advance(line([5.0], [1.0, 1.0]), command, 1.0)


def test_overlap__that_no_advance_could_have_left_is_reported():
    # pair 0 meets, so the world goes event by event; pair 1 overlaps by 1 m (a state of the sampled map) and separates
    worlds = replace(line([1.0, 1.0], [0.0, 8.0, 4.0]), gaps_m=np.array([[1.0, -1.0]]))
    with pytest.raises(PhysicsError, match=r"world 0: a contact was missed between 0 s and 2 s"):
        advance(worlds, [0.0, 0.0, 0.0], 2.0)


def test_bounces__more_than_any_segment_holds_are_reported(monkeypatch):
    # e = 1 and a push of 10 m/s2 against a heavy wall: a bounce of 0.2 m/s every 0.04 s for 50,000 s
    if numba.config.DISABLE_JIT:  # a million events would take long
        monkeypatch.setattr(kernel, "BOUND", kernel.BOUND._replace(MOST_EVENTS=50))
    wall = line([0.0], [0.0, 0.2], mass=[2.0**60, 1.0], e=1.0)
    most = kernel.BOUND.MOST_EVENTS
    with pytest.raises(PhysicsError, match=f"world 0: more than {most} events between 0 s and 50000 s"):
        advance(wall, [-10.0, 10.0], 50_000.0)
