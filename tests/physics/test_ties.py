"""Two events at one instant, and events at the end of a segment: each kind by hand, in numbers that doubles hold."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ethbrake_marl.physics import Impacts, Worlds, advance, make_worlds


def line(gaps, speeds, *, mass=1.0, e=0.0, latency=0.0, limit=64.0) -> Worlds:
    return make_worlds(
        gaps,
        speeds,
        braking_capacity_mps2=16.0,
        driving_capacity_mps2=16.0,
        latency_s=latency,
        mass_t=mass,
        restitution=e,
        speed_limit_mps=limit,
    )


def run(worlds: Worlds, command, until: float, cuts: tuple[float, ...] = ()) -> tuple[Worlds, list[Impacts]]:
    """Advance to ``until``, cut at the given times."""
    parts = []
    for time in (*cuts, until):
        worlds, impacts = advance(worlds, command, until_s=time, record=True)
        parts.append(impacts)
    return worlds, parts


def events(parts: list[Impacts]) -> list[tuple[float, int, float]]:
    """(time, pair, closing speed) of every impact."""
    return [
        (float(t), int(p), float(w))
        for part in parts
        for t, p, w in zip(part.rows.time_s, part.rows.pair, part.rows.closing_speed_mps, strict=True)
    ]


# ---------------------------------------------------------------- contact and the end of a segment


def test_contact__at_the_end_of_a_segment_belongs_to_it_and_is_counted_once():
    worlds, parts = run(line([6.0], [0.0, 8.0], e=0.5), [0.0, 0.0], 2.0, cuts=(0.75,))
    assert [part.count.tolist() for part in parts] == [[[1]], [[0]]]
    assert events(parts) == [(0.75, 0, 8.0)]
    assert worlds.gaps_m.tolist() == [[4.0 * 1.25]]


def test_contact__one_double_before_the_end_and_one_after():
    worlds = line([6.0], [0.0, 8.0])
    before, after = math.nextafter(0.75, 0.0), math.nextafter(0.75, 1.0)
    assert advance(worlds, [0.0, 0.0], before)[1].count.tolist() == [[0]]
    assert advance(worlds, [0.0, 0.0], after)[1].count.tolist() == [[1]]
    found = [part.count[0, 0] for part in run(worlds, [0.0, 0.0], 1.0, cuts=(before, 0.75))[1]]
    assert found == [0, 1, 0]


def test_contact__at_the_start_of_a_segment_happens_at_once():
    worlds, parts = run(line([0.0], [0.0, 8.0]), [0.0, 0.0], 0.0)
    assert events(parts) == [(0.0, 0, 8.0)] and worlds.speeds_mps.tolist() == [[4.0, 4.0]]
    assert advance(worlds, [0.0, 0.0], 1.0)[1].count.tolist() == [[0]]


def test_segment__of_no_length_changes_nothing_where_nothing_touches():
    worlds = line([6.0], [3.0, 8.0])
    after, impacts = advance(worlds, [-4.0, 4.0], 0.0)
    assert after.speeds_mps.tolist() == [[3.0, 8.0]] and after.gaps_m.tolist() == [[6.0]]
    assert impacts.count.tolist() == [[0]] and after.command_mps2.tolist() == [[-4.0, 4.0]]


# ---------------------------------------------------------------- contact and standstill


@pytest.mark.parametrize("cuts", [(), (2.0,), (1.0, 2.0, 2.5)])
def test_standstill__exactly_at_the_bumper_is_a_touch(cuts):
    # 8 m/s, braking at 4: stops after 2 s and 8 m, where the front vehicle stands
    worlds, parts = run(line([8.0], [0.0, 8.0], e=0.5), [-4.0, -4.0], 4.0, cuts)
    assert events(parts) == []
    assert worlds.gaps_m.tolist() == [[0.0]] and worlds.speeds_mps.tolist() == [[0.0, 0.0]]
    assert not worlds.pair_hit.any()


@pytest.mark.parametrize("cuts", [(), (1.0,), (0.5, 1.0)])
def test_standstill__of_the_front_vehicle_at_the_moment_it_is_struck(cuts):
    # front: 4 m/s, braking at 4, stops after 1 s and 2 m; rear coasts 8 m in that second: gap 6
    worlds, parts = run(line([6.0], [4.0, 8.0]), [-4.0, 0.0], 1.0, cuts)
    assert events(parts) == [(1.0, 0, 8.0)]
    assert worlds.speeds_mps.tolist() == [[4.0, 4.0]]


@pytest.mark.parametrize("cuts", [(), (1.0,)])
def test_standstill__of_both_at_the_moment_they_touch(cuts):
    # front 2 m in 1 s, rear 4 m in 1 s: gap 2; both stand
    worlds, parts = run(line([2.0], [4.0, 8.0], e=0.5), [-4.0, -8.0], 3.0, cuts)
    assert events(parts) == [] and worlds.speeds_mps.tolist() == [[0.0, 0.0]] and worlds.gaps_m.tolist() == [[0.0]]


def test_standstill__after_a_bounce_back_comes_from_below():
    # 3 t standing, struck at 8 by 1 t, e = 0.5: P = 2, front 3, rear -1; braking at 2 it rests after 0.5 s
    start = line([0.0], [0.0, 8.0], mass=[3.0, 1.0], e=0.5)
    worlds, _ = run(start, [0.0, -2.0], 0.25)
    assert worlds.speeds_mps.tolist() == [[3.0, -0.5]]
    worlds, _ = run(start, [0.0, -2.0], 2.0)
    assert worlds.speeds_mps.tolist() == [[3.0, 0.0]] and worlds.gaps_m.tolist() == [[6.25]]


def test_standstill__a_coasting_vehicle_thrown_back_rolls_on():
    worlds, _ = run(line([0.0], [0.0, 8.0], mass=[3.0, 1.0], e=0.5), [0.0, 0.0], 2.0)
    assert worlds.speeds_mps.tolist() == [[3.0, -1.0]] and worlds.gaps_m.tolist() == [[8.0]]


def test_standstill__thrown_back_it_drives_forward_again():
    # from -1 at +2: stands after 0.5 s, 3 m/s after 2 s
    worlds, _ = run(line([0.0], [0.0, 8.0], mass=[3.0, 1.0], e=0.5), [0.0, 2.0], 2.0)
    assert worlds.speeds_mps.tolist() == [[3.0, 3.0]] and worlds.gaps_m.tolist() == [[4.0]]


# ---------------------------------------------------------------- contact and the onset of a command


@pytest.mark.parametrize("cuts", [(), (0.25,), (0.25, 0.5)])
def test_onset__at_the_moment_of_contact_comes_too_late(cuts):
    worlds, parts = run(line([6.0], [0.0, 8.0], latency=[0.0, 0.75]), [0.0, -16.0], 0.75, cuts)
    assert events(parts) == [(0.75, 0, 8.0)]
    assert worlds.command_mps2.tolist() == [[0.0, -16.0]]  # an event at the end belongs to the segment


def test_onset__of_the_front_vehicle_releases_it():
    # joined at 4 m/s; from 0.5 s on the front drives away at 2: 1 s later 1 m ahead
    worlds, parts = run(line([0.0], [4.0, 4.0], latency=[0.5, 0.0]), [2.0, 0.0], 1.5)
    assert worlds.speeds_mps.tolist() == [[6.0, 4.0]] and worlds.gaps_m.tolist() == [[1.0]] and events(parts) == []


def test_onset__at_standstill_holds():
    # rear stops at 1 s; the front, from 1 s on, brakes at rest
    worlds, _ = run(line([8.0], [0.0, 4.0], latency=[1.0, 0.0]), [-4.0, -4.0], 3.0)
    assert worlds.speeds_mps.tolist() == [[0.0, 0.0]] and worlds.gaps_m.tolist() == [[6.0]]


def test_onset__exactly_at_the_end_of_a_segment_is_in_force_after_it():
    worlds, _ = run(line([8.0], [4.0, 4.0], latency=[0.5, 0.75]), [-4.0, -4.0], 0.5)
    assert worlds.command_mps2.tolist() == [[-4.0, 0.0]] and worlds.speeds_mps.tolist() == [[4.0, 4.0]]


# ---------------------------------------------------------------- speed limits


def test_limit__reached_at_the_moment_of_contact():
    # rear: 4 to 8 m/s at 4 in 1 s, 6 m
    worlds, parts = run(line([6.0], [0.0, 4.0], limit=8.0), [0.0, 4.0], 1.0)
    assert events(parts) == [(1.0, 0, 8.0)] and worlds.speeds_mps.tolist() == [[4.0, 4.0]]


def test_limit__of_the_rear_vehicle_ends_the_push():
    # 1 t at +4 pushes a coasting 1 t: +2 each from 4 to its limit 6 after 1 s, 5 m; then both hold 6
    worlds, _ = run(line([0.0], [4.0, 4.0], limit=[64.0, 6.0]), [0.0, 4.0], 3.0)
    assert worlds.speeds_mps.tolist() == [[6.0, 6.0]] and worlds.gaps_m.tolist() == [[0.0]]


def test_limit__a_driver_at_its_limit_gives_the_drag_of_a_braking_front_vehicle_and_no_more():
    # both at 8, the rear's limit; the front brakes at 2, the rear could drive at 6: it holds 8 against the brake
    worlds, _ = run(line([0.0], [8.0, 8.0], limit=[64.0, 8.0]), [-2.0, 6.0], 2.0)
    assert worlds.speeds_mps.tolist() == [[8.0, 8.0]]
    # against 10 it cannot: (-10 + 6) / 2 = -2
    worlds, _ = run(line([0.0], [8.0, 8.0], limit=[64.0, 8.0]), [-10.0, 6.0], 2.0)
    assert worlds.speeds_mps.tolist() == [[4.0, 4.0]]


def test_limit__a_vehicle_struck_beyond_its_limit_coasts():
    worlds, _ = run(line([0.0], [8.0, 16.0], limit=[8.0, 64.0]), [4.0, 0.0], 2.0)
    assert worlds.speeds_mps.tolist() == [[12.0, 12.0]]


# ---------------------------------------------------------------- resting contact


@pytest.mark.parametrize(("push", "after"), [(2.0, 0.0), (4.0, 0.0), (6.0, 1.0)])
def test_holding__moves_only_when_pushed_harder_than_it_holds(push, after):
    # 2 t hold with 4: 8 kN; 2 t push with `push`; (2 push - 8) / 4 for 1 s
    worlds, parts = run(line([0.0], [0.0, 0.0], mass=2.0), [-4.0, push], 1.0)
    assert worlds.speeds_mps.tolist() == [[after, after]] and events(parts) == []


def test_holding__two_braked_members_hold_together():
    # 8 + 4 kN hold; 3 t at 4 push with 12: no motion; at 8 with 24: (24 - 12) / 8 = 1.5
    start = line([0.0, 0.0], [0.0, 0.0, 0.0], mass=[4.0, 1.0, 3.0])
    assert run(start, [-2.0, -4.0, 4.0], 2.0)[0].speeds_mps.tolist() == [[0.0, 0.0, 0.0]]
    assert run(start, [-2.0, -4.0, 8.0], 2.0)[0].speeds_mps.tolist() == [[3.0, 3.0, 3.0]]


def test_holding__a_moving_block_stops_and_then_holds():
    # 2 t at -4 and 2 t at +2 from 4 m/s: block -1, rests after 4 s and stays
    worlds, _ = run(line([0.0], [4.0, 4.0], mass=2.0), [-4.0, 2.0], 9.0)
    assert worlds.speeds_mps.tolist() == [[0.0, 0.0]] and worlds.gaps_m.tolist() == [[0.0]]


def test_resting__a_block_shares_by_mass():
    # 1 t at -8 before 3 t at 0: -2
    worlds, _ = run(line([0.0], [8.0, 8.0], mass=[1.0, 3.0]), [-8.0, 0.0], 1.0)
    assert worlds.speeds_mps.tolist() == [[6.0, 6.0]]


def test_resting__only_the_pressing_part_of_a_line_is_a_block():
    # vehicle 1 drives away; 2 and 3 press: (-4 * 1 + 4 * 3) / 4 = 2
    worlds, _ = run(line([0.0, 0.0], [8.0] * 3, mass=[1.0, 1.0, 3.0]), [4.0, -4.0, 4.0], 1.0)
    assert worlds.speeds_mps.tolist() == [[12.0, 10.0, 10.0]] and worlds.gaps_m.tolist() == [[1.0, 0.0]]


# ---------------------------------------------------------------- simultaneous impacts


def test_impacts__of_two_pairs_apart_from_each_other_at_one_instant():
    worlds, parts = run(line([6.0, 99.0, 6.0], [0.0, 8.0, 0.0, 8.0]), [0.0] * 4, 0.75)
    assert events(parts) == [(0.75, 0, 8.0), (0.75, 2, 8.0)]
    assert worlds.speeds_mps.tolist() == [[4.0, 4.0, 4.0, 4.0]]


def test_impacts__of_neighbouring_pairs_at_one_instant_do_not_depend_on_an_order():
    # all meet after 1 s: P = (4 + 8) / 4 = 3 for 1, 2, 1 t at 0, 2, 8; e = 0.5: v+ = 4.5 - 0.5 v
    worlds, parts = run(line([2.0, 6.0], [0.0, 2.0, 8.0], mass=[1.0, 2.0, 1.0], e=0.5), [0.0] * 3, 1.0)
    assert events(parts) == [(1.0, 0, 2.0), (1.0, 1, 6.0)]
    assert worlds.speeds_mps.tolist() == [[4.5, 3.5, 0.5]]


def test_impacts__a_second_round_at_the_same_instant_counts_again():
    # 4, 8, 4 touch, equal masses, e = 0.5: the front pair closes at 4, the rear pair opens at 4. P = 6, 6, 4:
    # v+ = 7, 5, 4; nothing approaches. With a heavy rear: 0, 8, 7 -> P = (0 + 8 + 14) / 4 = 5.5, v+ = 8.25, 4.25, 4.75
    worlds, parts = run(line([0.0, 0.0], [4.0, 8.0, 4.0], e=0.5), [0.0] * 3, 0.0)
    assert worlds.speeds_mps.tolist() == [[7.0, 5.0, 4.0]] and events(parts) == [(0.0, 0, 4.0)]
    worlds, parts = run(line([0.0, 0.0], [0.0, 8.0, 7.0], mass=[1.0, 1.0, 2.0], e=0.5), [0.0] * 3, 0.0)
    assert events(parts) == [(0.0, 0, 8.0), (0.0, 1, 0.5)]
    assert parts[0].count.tolist() == [[1, 1]] and parts[0].rows.first.tolist() == [True, True]
    assert worlds.speeds_mps[0, 0] == 8.25 and worlds.speeds_mps[0, 1:] == pytest.approx([4.25 + 0.5, 4.75 - 0.25])


# ---------------------------------------------------------------- bounces


@pytest.mark.parametrize("e", [0.125, 0.25, 0.5, 0.75, 0.875])
def test_bounces__end_after_the_sum_of_their_flights(e):
    # rear presses with 4 on a holding wall: bounces 8, 8e, 8e^2, ... down to the first below 0.05, which is plastic
    wall = line([0.0], [0.0, 8.0], mass=[2.0**50, 1.0], e=e)
    closing = [8.0]
    while closing[-1] >= 0.05:
        closing.append(closing[-1] * e)
    flights = sum(2.0 * w / 4.0 for w in closing[1:])
    worlds, parts = run(wall, [-16.0, 4.0], 60.0)
    assert [w for *_, w in events(parts)] == pytest.approx(closing, rel=1e-10)
    assert events(parts)[-1][0] == pytest.approx(flights, rel=1e-12)
    assert flights <= 2.0 * 8.0 * e / (4.0 * (1.0 - e))
    assert worlds.gaps_m.tolist() == [[0.0]] and worlds.speeds_mps[0, 1] == pytest.approx(0.0, abs=1e-12)
    assert parts[0].first_impact_harm.tolist() == [[64.0]]


def test_bounces__without_loss_go_on_at_a_steady_pace():
    # e = 1: every flight lasts 2 * 8 / 4 = 4 s; 15 s hold the impacts at 0, 4, 8 and 12 s
    worlds, parts = run(line([0.0], [0.0, 8.0], mass=[2.0**50, 1.0], e=1.0), [-16.0, 4.0], 15.0)
    assert [t for t, *_ in events(parts)] == pytest.approx([0.0, 4.0, 8.0, 12.0], abs=1e-12)
    assert worlds.speeds_mps[0, 1] == pytest.approx(-8.0 + 4.0 * 3.0, abs=1e-9)


@pytest.mark.parametrize(("closing", "e", "apart"), [(0.0625, 0.5, 0.03125), (0.03125, 0.5, 0.0)])
def test_bounces__below_the_plastic_speed_there_is_none_but_harm(closing, e, apart):
    worlds, parts = run(line([0.0], [1.0, 1.0 + closing], e=e), [0.0, 0.0], 0.0)
    assert worlds.speeds_mps[0, 0] - worlds.speeds_mps[0, 1] == apart
    assert parts[0].total_harm.tolist() == [[closing * closing]]


@pytest.mark.parametrize(("closing", "count"), [(1e-5, 0), (math.nextafter(1e-5, 1.0), 1), (0.5e-5, 0)])
def test_touch__up_to_its_speed_is_no_impact_but_ends_in_contact(closing, count):
    worlds, parts = run(line([0.0], [0.0, closing], e=0.5), [0.0, 0.0], 0.0)
    assert parts[0].count.tolist() == [[count]] and worlds.pair_hit.tolist() == [[bool(count)]]
    assert worlds.speeds_mps[0, 0] == worlds.speeds_mps[0, 1] == pytest.approx(closing / 2.0)


def test_bounces__at_exactly_the_plastic_speed_still_bounce():
    worlds, _ = run(line([0.0], [0.0, 0.05], e=0.5), [0.0, 0.0], 0.0)
    assert worlds.speeds_mps[0, 0] - worlds.speeds_mps[0, 1] == pytest.approx(0.025)


def test_bounces__of_three_pressing_vehicles_end_and_lose_energy():
    rng = np.random.default_rng(8)
    n = 300
    start = line(
        np.zeros((n, 2)), rng.uniform(0, 12, (n, 3)), mass=rng.uniform(1, 8, (n, 3)), e=rng.uniform(0.0, 0.95, n)
    )
    worlds, parts = run(start, np.tile([-16.0, 0.0, 4.0], (n, 1)), 300.0)
    assert parts[0].count.max() > 20
    assert np.all(worlds.gaps_m == 0.0) and np.all(worlds.speeds_mps == worlds.speeds_mps[:, :1])
