"""Avoidability: touches by hand, then witnesses and counter-examples in the exact physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl import load_scenario
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.limits.lower_bound import REASONS, avoidability
from ethbrake_marl.physics import Worlds, advance, make_worlds
from tests.limits.avoidability_worlds import random_profiles, wide_worlds, with_gap
from tests.reference.play_profile import play_profile

LINES = [(3, 1), (2, 1), (2, 0)]  # vehicles, controlled one


def line(gaps, speeds, braking, latency, driving=0.0, limit=100.0, time_s=0.0):
    worlds = make_worlds(
        [gaps],
        [speeds],
        braking_capacity_mps2=braking,
        driving_capacity_mps2=driving,
        latency_s=latency,
        mass_t=5.0,
        restitution=0.1,
        speed_limit_mps=limit,
    )
    return replace(worlds, time_s=np.array([time_s]))


def paper_line(gaps, speeds, latency):
    return make_worlds(
        [gaps],
        [speeds],
        braking_capacity_mps2=[6, 7, 6],
        driving_capacity_mps2=[6, 7, 6],
        latency_s=latency,
        mass_t=[4.5, 5.5, 5.9],
        restitution=0.1,
    )


# gap, speeds, braking capacities, latencies -> margin by hand, controlled vehicle behind
FRONT_BY_HAND = {
    "both stop: 40 m + gap against 20 m + 40 m": ((19, [20, 20], [5, 5], [0, 1]), -1.0),
    "both stop: a touch at rest": ((20, [20, 20], [5, 5], [0, 1]), 0.0),
    "both stop: one metre left": ((21, [20, 20], [5, 5], [0, 1]), 1.0),
    "equal speeds after 2 s, 4 m lost": ((3.5, [20, 24], [4, 6], [0, 0]), -0.5),
    "equal speeds: a touch of moving vehicles": ((4, [20, 24], [4, 6], [0, 0]), 0.0),
    "weak brakes, the leader stands at 8 m": ((40, [8, 20], [4, 4], [0, 0]), -2.0),
    "a standing leader": ((10, [0, 10], [4, 5], [0, 0]), 0.0),
    "a standing follower": ((0, [0, 0], [4, 5], [0, 0]), 0.0),
}


@pytest.mark.parametrize("case", FRONT_BY_HAND)
def test_front_margin__by_hand(case):
    (gap, speeds, braking, latency), margin = FRONT_BY_HAND[case]
    verdict = avoidability(line([gap], speeds, braking, latency), 1)
    assert verdict.margin_m[0] == pytest.approx(margin, abs=1e-12)
    assert verdict.reason_name[0] == ("" if margin >= 0 else "front")
    assert verdict.avoidable[0] == (margin >= 0)


@pytest.mark.parametrize(
    ("gap", "margin"),
    [(2.5, 0.5), (2.0, 0.0), (1.5, -0.5)],  # 4 m/s faster, 2 + 2 m/s2 apart: 16 / 8 = 2 m
)
def test_rear_margin__of_a_driving_front_vehicle(gap, margin):
    verdict = avoidability(line([gap], [10, 14], [5, 2], [0, 0], driving=[2, 0]), 0)
    assert verdict.margin_m[0] == pytest.approx(margin, abs=1e-12)
    assert verdict.reason_name[0] == ("" if margin >= 0 else "rear")


def test_early__a_pair_that_meets_before_the_vehicle_may_act():
    front = line([1, 9], [10, 12, 9], [5, 8, 5], [1, 1, 2])  # 2 m lost in 1 s
    rear = line([9, 1], [10, 10, 12], [5, 8, 5], [1, 1, 2])
    brakes_in_time = line([9, 0.5], [10, 10, 12], [5, 8, 4], [1, 1, 0])  # 2 m/s at 4 m/s2: 0.5 m, a touch at 0.5 s
    verdict = avoidability(Worlds.concatenate([front, rear, brakes_in_time]))
    assert verdict.reason_name.tolist() == ["early", "early", ""]
    assert verdict.margin_m[:2] == pytest.approx([-1, -1])


# Room, own speed and so on chosen for round numbers; vehicle 3 stands far behind and never matters.
@pytest.mark.parametrize(
    ("gap", "speeds", "braking", "driving", "limit", "switch", "last"),
    [
        # A leader at rest, 30 m: V^2 (1/5 + 1/5) = 2 * 30 + 20, V = sqrt(200).
        (30, [0, 10], [4, 5], 5, 100, [(200**0.5 - 10) / 5, (2 * 200**0.5 - 10) / 5], -5),
        # At most 12 m/s: 0.4 s and 4.4 m to get there, 14.4 m to stop, so 11.2 m at 12 m/s.
        (30, [0, 10], [4, 5], 5, 12, [0.4 + 11.2 / 12, 0.4 + 11.2 / 12 + 2.4], -5),
        # Both move: after 1 s 8 m/s faster and 8 m behind; equal speeds 2 s later. Then follow with 4 m/s2.
        (12, [20, 20], [4, 8], 4, 100, [1, 3], -4),
        # No drive: coast for (30 - 10) m / 10 m/s, then 2 s to rest.
        (30, [0, 10], [4, 5], 0, 100, [2, 4], -5),
        # No drive and no speed: stays.
        (30, [0, 0], [4, 5], 0, 100, [np.inf, np.inf], -5),
        # No room and no speed: stays, whatever it could drive.
        (0, [0, 0], [4, 5], 3, 100, [0, 0], -5),
    ],
)
def test_witness__is_the_largest_trajectory_behind_the_front_vehicle(
    gap, speeds, braking, driving, limit, switch, last
):
    worlds = line([gap, 50], [*speeds, 0], [*braking, 5], [0, 0, 0], driving=driving, limit=limit)
    verdict = avoidability(worlds)
    assert verdict.switch_s[0] == pytest.approx([0, *switch], abs=1e-8)
    assert verdict.command_mps2[0].tolist() == [driving, -braking[1], last]
    _, ledger = play_profile(worlds, 1, verdict.switch_s, verdict.command_mps2)
    assert ledger.count.sum() == 0


@pytest.mark.parametrize(
    ("gaps", "speeds", "latency", "margin"),
    [
        # Vehicle 3 needs 0.8 * 20 + 400 / 12 m; gaps and vehicle 1's way to rest give 2 m more, or less.
        ([10, 8], [20, 18, 20], [0, 0.5, 0.8], 2),
        ([5, 9], [22, 18, 20], [0, 0.5, 0.8], 5),
        ([7, 7], [20, 18, 20], [0, 0.5, 0.8], -2),
        ([7, 7], [20, 18, 20], [0, 0.2, 0.8], -2),
        ([7, 7], [20, 18, 20], [0, 0.8, 1.2], -10),
    ],
)
def test_paper_worlds__by_stopping_distances(gaps, speeds, latency, margin):
    verdict = avoidability(paper_line(gaps, speeds, latency))
    assert verdict.margin_m[0] == pytest.approx(margin, abs=1e-12)
    assert REASONS[verdict.reason[0]] == ("" if margin > 0 else "rear")


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("paper-random", 0.635, 0.655),
        ("paper-random-early", 0.550, 0.575),
        ("paper-delay-low", 0.07, 0.10),
        ("paper-delay-middle", 0.36, 0.40),
        ("paper-delay-high", 0.935, 0.955),
    ],
)
def test_unavoidable_share__of_the_paper_lists(name, low, high):
    scenario = load_scenario(name)
    verdict = avoidability(scenario.sample(10_000, seed=7).worlds, scripts=scenario.scripts)
    assert low <= 1 - verdict.avoidable.mean() <= high


@pytest.mark.parametrize(("vehicles", "controlled"), LINES)
def test_witness__has_no_impact_in_the_physics(vehicles, controlled):
    worlds = wide_worlds(40_000, vehicles, seed=21)
    verdict = avoidability(worlds, controlled)
    good = verdict.avoidable
    assert 0.2 < good.mean() < 0.9
    _, ledger = play_profile(worlds.take(good), controlled, verdict.switch_s[good], verdict.command_mps2[good])
    assert ledger.count.sum() == 0
    assert np.isnan(verdict.switch_s[~good]).all() and np.isnan(verdict.command_mps2[~good]).all()


def at_the_edge(reason, pair, shift):
    """Worlds unavoidable for ``reason``, with the gap of ``pair`` changed so that ``shift`` metres are to spare."""
    worlds = wide_worlds(40_000, 3, seed=22)
    worlds = worlds.take(np.all(worlds.gaps_m > 0, axis=1) & (worlds.speeds_mps[:, 1] > 0))
    verdict = avoidability(worlds)
    rows = np.flatnonzero((verdict.reason == reason) & (verdict.margin_m > -20))
    assert rows.size > 500
    worlds = worlds.take(rows)
    return with_gap(worlds, pair, worlds.gaps_m[:, pair] - verdict.margin_m[rows] + shift)


@pytest.mark.parametrize(("shift", "avoidable"), [(2e-9, True), (1e-5, True), (5e-10, False), (-1e-9, False)])
def test_boundary__less_than_1e_9_m_between_both_neighbours_counts_as_unavoidable(shift, avoidable):
    worlds = at_the_edge(3, 1, shift)
    verdict = avoidability(worlds)
    assert np.all(verdict.avoidable == avoidable)
    assert np.abs(verdict.margin_m - shift).max() < 1e-11
    if avoidable:
        _, ledger = play_profile(worlds, 1, verdict.switch_s, verdict.command_mps2)
        assert ledger.count.sum() == 0


@pytest.mark.parametrize(("shift", "reasons"), [(1e-9, {0, 3}), (0.0, {0, 3}), (-1e-9, {2})])
def test_boundary__full_braking_may_touch_the_front_vehicle(shift, reasons):
    worlds = at_the_edge(2, 0, shift)
    verdict = avoidability(worlds)
    assert set(np.unique(verdict.reason)) == reasons
    good = verdict.avoidable
    _, ledger = play_profile(worlds.take(good), 1, verdict.switch_s[good], verdict.command_mps2[good])
    assert ledger.count.sum() == 0


@pytest.mark.parametrize(("vehicles", "controlled"), LINES)
def test_early__is_what_happens_in_the_physics_before_the_latency(vehicles, controlled):
    worlds = wide_worlds(20_000, vehicles, seed=23)
    # Vehicles that start touching at equal speeds may lean on each other early: contact, but no impact.
    worlds = worlds.take(np.all((worlds.gaps_m > 0) | (np.diff(worlds.speeds_mps, axis=1) != 0), axis=1))
    until = worlds.vehicles.latency_s[:, controlled]
    _, impacts = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=until)
    early = avoidability(worlds, controlled).reason == 1
    assert 0.01 < early.mean() < 0.5
    assert np.array_equal(early, impacts.count.sum(axis=1) > 0)


def collides(worlds, controlled, profiles, seed):
    """How many random profiles were played, and in how many worlds each of them had an impact."""
    rng = np.random.default_rng(seed)
    hit = np.ones(worlds.n, dtype=bool)
    for _ in range(profiles):
        _, ledger = play_profile(worlds, controlled, *random_profiles(worlds, controlled, rng))
        hit &= ledger.collided
    return profiles * worlds.n, hit


def unavoidable_worlds():
    paper = load_scenario("paper-random").sample(1500, seed=7).worlds
    early = load_scenario("paper-random-early").sample(1500, seed=7).worlds
    for worlds in (paper, early, wide_worlds(4000, 3, seed=24)):
        # Pressed together from the start, vehicles may push each other along without an impact.
        worlds = worlds.take(np.all((worlds.gaps_m > 0) | (np.diff(worlds.speeds_mps, axis=1) != 0), axis=1))
        yield worlds.take(~avoidability(worlds).avoidable)


def test_unavoidable__no_random_profile_avoids_collision():
    played = 0
    for worlds in unavoidable_worlds():
        count, hit = collides(worlds, 1, 25, seed=25)
        assert hit.all()
        played += count
    assert played >= 100_000


@pytest.mark.long
def test_unavoidable__no_random_profile_of_a_million_avoids_collision():
    played = 0
    for worlds in unavoidable_worlds():
        count, hit = collides(worlds, 1, 250, seed=26)
        assert hit.all()
        played += count
    assert played >= 1_000_000


def test_later_states__give_the_same_verdict_and_a_witness_from_there():
    worlds = load_scenario("paper-random").sample(3000, seed=3).worlds
    later, _ = advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=0.4)
    at_alert, from_there = avoidability(worlds), avoidability(later)
    assert np.array_equal(at_alert.reason, from_there.reason)
    assert np.abs(at_alert.margin_m - from_there.margin_m).max() < 1e-11
    good = from_there.avoidable
    _, ledger = play_profile(later.take(good), 1, from_there.switch_s[good], from_there.command_mps2[good])
    assert ledger.count.sum() == 0


def test_a_world_alone__gives_the_same_bits():
    worlds = wide_worlds(300, 3, seed=27)
    together = avoidability(worlds)
    for k in range(0, 300, 7):
        alone = avoidability(worlds.take([k]))
        assert alone.margin_m.tobytes() == together.margin_m[[k]].tobytes()
        assert alone.switch_s.tobytes() == together.switch_s[[k]].tobytes()


def test_leaning__is_contact_but_no_impact():
    # Vehicle 3 touches vehicle 2 from the start and coasts on when vehicle 2 brakes: it is slowed by it.
    worlds = paper_line([12, 0], [20, 20, 20], [0, 0.1, 0.8])
    assert avoidability(worlds).reason_name[0] == "rear"
    _, ledger = play_profile(worlds, 1, np.array([[0.0]]), np.array([[-7.0]]))
    assert ledger.count.sum() == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: avoidability(wide_worlds(2, 3, seed=1), 0), "vehicle_1 of 3 vehicles"),
        (lambda: avoidability(wide_worlds(2, 4, seed=1), 1), "vehicle_2 of 4 vehicles.*avoidable_by_lp"),
        (lambda: avoidability(wide_worlds(2, 3, seed=1), -1), "vehicle = -1: must be a whole number"),
        (lambda: avoidability(wide_worlds(2, 3, seed=1), scripts={2: "coast"}), "vehicle_3 follows 'coast'"),
        (
            lambda: avoidability(line([5, 5], [9, 9, 9], 5, [1, 0.5, 0])),
            r"latency_s\[0, 0\] = 1: .*not above vehicle_2",
        ),
        (lambda: avoidability(replace(line([5], [9, 9], 5, 0), speeds_mps=np.array([[9, -1.0]])), 1), r"\[0, 1\] = -1"),
        (lambda: avoidability(replace(line([5], [9, 9], 5, 0), speeds_mps=np.array([[9, np.nan]])), 1), "= nan"),
    ],
)
def test_bad_input__is_refused(change, message):
    with pytest.raises(InvalidInput, match=message):
        change()


def test_front_latency__counts_from_now():
    # Vehicle 1 brakes only after vehicle 2 may act, but at 1 s both latencies have passed.
    assert avoidability(line([5, 5], [9, 9, 9], 5, [1, 0.5, 0], time_s=1.0)).reason.shape == (1,)


@pytest.mark.parametrize(
    ("switch", "command", "message"),
    [
        ([[0.0, 1.0]], [[-5.0]], "switch_s"),
        ([[0.5]], [[-5.0]], "time_s"),
        ([[0.0, 2.0, 1.0]], [[0.0, 0.0, 0.0]], "never fall"),
        ([[0.0, np.nan]], [[0.0, 0.0]], "never fall"),
        ([[0.0]], [[-6.0]], "command_mps2"),
    ],
)
def test_play_profile__refuses_what_does_not_fit(switch, command, message):
    with pytest.raises(InvalidInput, match=message):
        play_profile(line([5], [9, 9], 5, 0), 1, np.array(switch), np.array(command))


def test_play_profile__ends_at_its_time_and_leaves_out_later_commands():
    worlds = line([5], [9, 9], 5, 0, driving=5)
    after, _ = play_profile(worlds, 1, np.array([[0.0, 0.5, 9.0]]), np.array([[0.0, -2.0, 5.0]]), until_s=1.0)
    assert after.time_s[0] == 1.0
    assert after.speeds_mps[0].tolist() == [4, 8]
