"""What a first meeting leaves, and what the command in force costs: by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ethbrake_marl.limits import lower_bound
from ethbrake_marl.limits.lower_bound import (
    CELLS,
    FRONT_FIRST,
    HEAP_WIDTH,
    LARGE,
    LINE,
    REAR_FIRST,
    after_front,
    after_rear,
    empty_plan,
    front_first,
    gentlest_front,
    held_by_leader,
    lacking,
    last_soft,
    lead,
    obstacle_harm,
    rear_first,
    slowed_by_rear,
    widest_flight,
)


def state(**given):
    """A state at the onset, all else 0; no obstacle."""
    at = np.zeros(LINE.WIDTH)
    at[LINE.OBSTACLE] = math.inf
    for name, value in given.items():
        at[getattr(LINE, name)] = value
    return at


def test_obstacle__is_met_by_a_leader_that_was_pushed_on():
    # 12 against 10 m/s, equal masses, no bounce: both at 11. Brakes of 5 take 2 * 5 * 11 of 121 on the way of 11 m.
    at = state(V_L=10, A_L=5, FRONT_SHARE=0.5, OBSTACLE=11)
    assert obstacle_harm(at, 0.0, 0.0, 2.0) == pytest.approx(11)
    at[LINE.OBSTACLE] = 13
    assert obstacle_harm(at, 0.0, 0.0, 2.0) == 0
    at[LINE.OBSTACLE] = 10  # the leader stops at the obstacle itself: all three are one cluster
    assert obstacle_harm(at, 0.0, 0.0, 2.0) == 0


def test_obstacle__takes_the_centre_of_mass_from_the_proof():
    at = state(GAP_R=4, V_L=10, A_L=5, V_F=12, A_F=7, U_F=7, LIMIT_F=40, V_R=20, A_R=6, FRONT_SHARE=0.5)
    free = after_front(at, 0.0, 0.0, 2.0, 0.0, 0.0, empty_plan(), empty_plan())
    at[LINE.OBSTACLE] = 11
    assert after_front(at, 0.0, 0.0, 2.0, 0.0, 0.0, empty_plan(), empty_plan()) < free


def test_command_in_force__the_way_to_meet_gently_is_the_wrong_one_after_it():
    # In the step from 1 to 2 s; the gentlest meeting at 1.5 s drives for the first second, then brakes with 8.
    at = state(GAP_L=1.5, V_L=0, A_L=1, V_F=2, A_F=8, U_F=0, LIMIT_F=40, V_R=9, A_R=1)
    at[lower_bound.LINE.GAP_L] = 2 * 1.5 - 0.5 * 8 * 0.25
    closing, drive = gentlest_front(at, 1.5)
    assert (closing, drive) == (pytest.approx(0.0, abs=1e-9), pytest.approx(1.0))
    at[lower_bound.LINE.GAP_L] = 10.0
    at[lower_bound.LINE.V_F] = 8.0
    closing, drive = gentlest_front(at, 1.5)
    assert drive == pytest.approx(1.5 - math.sqrt(2 * (12 - 10) / 8)) and closing == pytest.approx(
        8 - 8 * math.sqrt(0.5)
    )
    # 0.5 s at c instead of -8 and braking earlier instead: the speed at the end is higher by (8 + c) / 2 times 0.5 s or
    # more. So with 0.5 m/s more than the least, c is at most 2 * 0.5 / 0.5 above -8 and lacks 6 of 8.
    lack = lacking(FRONT_FIRST, at, 1.5, 1.5, closing, closing + 0.5, 1.0)
    share = (drive - 1.0) / 0.5 if drive > 1.0 else 0.0
    if share > 0.0:
        assert lack == pytest.approx(max(8 - 2 - 8 * share**2, 0.0))
    else:
        steep = 0.5 / (1.0 - drive)
        assert lack == pytest.approx(8 - (1 + steep) / (1 + 0.5 * steep))
    assert lacking(FRONT_FIRST, at, 1.5, 1.5, closing, closing, 1.0) == pytest.approx(8)
    assert lacking(REAR_FIRST, at, 1.0, 1.5, closing, closing, 1.0) == 0


@pytest.mark.parametrize(("share", "press", "reach"), [(0.2, 13, 14), (0.45, 13, 14), (0.55, 13, 14), (0.78, 13, 9)])
def test_lead__is_what_a_flight_gains_less_the_command_it_costs(share, press, reach):
    # Every flight, tried: brake for s, then drive until the partner is met again. The last one brakes less than it.
    opening = 0.3
    best = -math.inf
    for s in np.linspace(0.0, 0.5, 501):
        if opening * s + 0.5 * (reach - press) * s * s < 0.0:
            break
        gap, relative = opening * s + 0.5 * (reach - press) * s * s, -(opening + (reach - press) * s)
        met = (-relative + math.sqrt(relative**2 + 2 * press * gap)) / press
        best = max(best, share * (relative + press * met) - reach * s * (1.0 - share))
    found = lead(share, press, reach, opening, 0.0, 50.0, 0.0)
    assert found >= best - 1e-9
    assert found == pytest.approx(best, abs=2e-3)


def test_after_rear__of_one_that_brakes_less_than_the_rear_vehicle_is_its_own_braking():
    # Both at 19 after 20 against 18 m/s; the rear one, braking harder, is no help: 19^2 - 2 * 4 * 7.
    at = state(GAP_L=7, V_L=0, A_L=5, V_F=18, A_F=4, V_R=20, A_R=8, REAR_SHARE=0.5)
    assert after_rear(at, 0.0, 0.0, 2.0, 0.0, 0.0, empty_plan(), empty_plan()) == pytest.approx(361 - 56)


def test_widest_flight__is_attained_by_braking_to_the_top_of_the_gap_and_driving():
    # Parted with 1 m/s from one that brakes harder by 4: 0.125 m. Driving closes with 13: 2 * 13 * 0.125 = 13 / 4.
    found = widest_flight(0.8, 4.0, 13.0, 7.0, 0.1, 10.0, 0.0, 3.0)
    assert found**2 == pytest.approx(13 / 4)
    assert widest_flight(0.8, 0.0, 13.0, 7.0, 0.1, 10.0, 0.0, 3.0) == math.inf  # it may stay behind for ever
    assert widest_flight(0.8, 4.0, 13.0, 7.0, 0.9, 10.0, 0.0, 3.0) == math.inf  # every touch throws it further
    # Thrown back with 0.5 m/s, it rolls for 3 s at most: 2 * 7 * 1.5 more.
    assert widest_flight(0.8, 4.0, 13.0, 7.0, 0.1, 10.0, 0.5, 3.0) ** 2 == pytest.approx(13 / 4 + 21)


def test_held__without_a_bounce_it_keeps_the_common_speed():
    # 20 against 10 m/s, nine tenths of the mass in front, no bounce: both at 11, slowing by 0.9 * 8 - 0.1 * 2 = 7, and
    # rest after 11^2 / 14 m. The rear one, at 30 m/s with 4, comes there after 100 m in all: 900 - 800.
    at = state(V_L=10, A_L=8, V_F=20, A_F=4, U_F=2, LIMIT_F=40, V_R=30, A_R=4, FRONT_SHARE=0.9)
    at[lower_bound.LINE.GAP_R] = 100 - 121 / 14
    assert held_by_leader(at, 0.0, 0.0, 10.0, empty_plan(), empty_plan()) == pytest.approx(10.0, abs=1e-3)
    at[lower_bound.LINE.A_F] = 9.0
    assert held_by_leader(at, 0.0, 0.0, 10.0, empty_plan(), empty_plan()) == 0


def test_slowed__is_the_common_speed_less_the_way_it_must_stay_ahead():
    # 20 against 18 m/s: both at 19, slowing by 6, and by 7 on average for f alone. 7 m before one that stands.
    at = state(V_L=0, A_L=5, V_F=18, A_F=8, V_R=20, A_R=4, REAR_SHARE=0.5)
    until = (19 - math.sqrt(19**2 - 2 * 6 * 7)) / 6
    found = slowed_by_rear(at, 0.0, 2.0, 7.0, empty_plan(), empty_plan())
    assert found == pytest.approx(19 - 7 * until)
    at[lower_bound.LINE.A_L] = 7.5  # harder than 7: the closing speed may rise
    assert slowed_by_rear(at, 0.0, 2.0, 7.0, empty_plan(), empty_plan()) == 0


def test_soft_meetings__with_one_that_brakes_harder_end_where_it_would_have_been_too_fast():
    # It was faster by 2 t a time t before, over 1 m: t is at most 1 s, and 1.5 s for 3 m/s.
    at = state(V_L=30, A_L=1, V_F=18, A_F=5, U_F=4, V_R=21, A_R=7, GAP_L=50, GAP_R=1)
    assert last_soft(at, 9.0, empty_plan(), empty_plan()) == pytest.approx(1.0)
    at[lower_bound.LINE.GAP_R] = 90
    assert last_soft(at, 9.0, empty_plan(), empty_plan()) == pytest.approx(1.5)
    at[lower_bound.LINE.ONSET_R] = 0.2  # till then it can be left behind by up to 4, or be come towards by up to 5
    assert last_soft(at, 9.0, empty_plan(), empty_plan()) == pytest.approx(0.2 + 4 / 2)


def room():
    return empty_plan(), empty_plan(), np.empty((CELLS, HEAP_WIDTH))


def test_rear_first__is_impossible_where_the_leader_must_be_met_before():
    # One stands 5 m ahead, the other comes from 100 m behind; 60 m ahead it may come in time.
    at = state(GAP_L=5, V_L=0, A_L=5, V_F=20, A_F=6, U_F=4, LIMIT_F=40, GAP_R=100, V_R=40, A_R=4, FRONT_SHARE=0.9)
    assert rear_first(at, 0.0, LARGE, -1.0, *room()) == LARGE
    at[lower_bound.LINE.GAP_L] = 60
    assert rear_first(at, 0.0, LARGE, -1.0, *room()) < LARGE


def test_all_at_once__is_impossible_where_the_leader_must_be_met_before():
    # As above: 400 - 2 * 6 * 5 = 340 in front; the rear one has 400 - 2 * 4 * 105 < 0 left, or 60 with weaker brakes.
    at = state(GAP_L=5, V_L=0, A_L=5, V_F=20, A_F=4.5, U_F=0, LIMIT_F=40, GAP_R=100, V_R=30, A_R=4, FRONT_SHARE=0.98)
    at[lower_bound.LINE.REAR_SHARE] = 0.5
    front = 400 - 2 * 4.5 * 5
    assert front_first(at, 0.0, LARGE, -1.0, *room()) > front + 30  # 900 - 840 less what is pushed on
