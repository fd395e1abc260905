"""Avoidability: margins by hand, witnesses and counter-examples in the exact physics, and a linear programme."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from tests.fixtures.lines import line, opening, paper_line, random_profiles, wide_worlds
from tests.reference.avoidability_lp import avoidable_by_lp
from tests.reference.play_profile import play_profile

LINES = [(3, 1), (2, 1), (2, 0)]  # vehicles, controlled one


# world, controlled vehicle -> margin and what it is short of
BY_HAND = {
    "both stop: 40 m + gap against 20 m + 40 m": (line([19], [20, 20], 5, [0, 1]), 1, -1.0, "front"),
    "both stop: a touch at rest": (line([20], [20, 20], 5, [0, 1]), 1, 0.0, ""),
    "both stop: one metre left": (line([21], [20, 20], 5, [0, 1]), 1, 1.0, ""),
    "equal speeds after 2 s, 4 m lost": (line([3.5], [20, 24], [4, 6]), 1, -0.5, "front"),
    "equal speeds: a touch of moving vehicles": (line([4], [20, 24], [4, 6]), 1, 0.0, ""),
    "weak brakes, the leader stands at 8 m": (line([40], [8, 20], [4, 4]), 1, -2.0, "front"),
    "a standing leader": (line([10], [0, 10], [4, 5]), 1, 0.0, ""),
    "a standing follower": (line([0], [0, 0], [4, 5]), 1, 0.0, ""),
    # 4 m/s faster than Vehicle 1, 2 + 2 m/s2 apart: 16 / 8 = 2 m are needed.
    "ahead of a follower, 2.5 m": (opening(2.5), 0, 0.5, ""),
    "ahead of a follower, 2 m": (opening(2.0), 0, 0.0, ""),
    "ahead of a follower, 1.5 m": (opening(1.5), 0, -0.5, "rear"),
    # Vehicle 3 needs 0.8 * 20 + 400 / 12 m; gaps and vehicle 1's way to rest give 2 m more, or less.
    "paper, 2 m left": (paper_line([10, 8], [20, 18, 20], [0, 0.5, 0.8]), 1, 2.0, ""),
    "paper, 5 m left": (paper_line([5, 9], [22, 18, 20], [0, 0.5, 0.8]), 1, 5.0, ""),
    "paper, 2 m short": (paper_line([7, 7], [20, 18, 20], [0, 0.5, 0.8]), 1, -2.0, "rear"),
    "paper, 2 m short, sooner": (paper_line([7, 7], [20, 18, 20], [0, 0.2, 0.8]), 1, -2.0, "rear"),
    "paper, 10 m short": (paper_line([7, 7], [20, 18, 20], [0, 0.8, 1.2]), 1, -10.0, "rear"),
}


@pytest.mark.parametrize("case", BY_HAND)
def test_margin__by_hand(case):
    world, vehicle, margin, reason = BY_HAND[case]
    verdict = avoidability(world, vehicle)
    assert verdict.margin_m[0] == pytest.approx(margin, abs=1e-12)
    assert (verdict.reason_name[0], verdict.avoidable[0]) == (reason, margin >= 0)


def test_early__a_pair_that_meets_before_the_vehicle_may_act():
    front = line([1, 9], [10, 12, 9], [5, 8, 5], [1, 1, 2])  # 2 m lost in 1 s
    rear = line([9, 1], [10, 10, 12], [5, 8, 5], [1, 1, 2])
    brakes_in_time = line([9, 0.5], [10, 10, 12], [5, 8, 4], [1, 1, 0])  # 2 m/s at 4 m/s2: 0.5 m, a touch at 0.5 s
    verdict = avoidability(eb.Worlds.concatenate([front, rear, brakes_in_time]))
    assert verdict.reason_name.tolist() == ["early", "early", ""] and verdict.margin_m[:2] == pytest.approx([-1, -1])


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
    scenario = eb.load_scenario(name)
    verdict = avoidability(scenario.sample(10_000, seed=7).worlds, scripts=scenario.scripts)
    assert low <= 1 - verdict.avoidable.mean() <= high


def impacts_of_witnesses(worlds, verdict, controlled=1):
    """How many impacts the witnesses of the avoidable worlds have in the physics."""
    good = verdict.avoidable
    _, ledger = play_profile(worlds.take(good), controlled, verdict.switch_s[good], verdict.command_mps2[good])
    return ledger.count.sum()


@pytest.mark.parametrize(("vehicles", "controlled"), LINES)
def test_witness__has_no_impact_in_the_physics(vehicles, controlled):
    worlds = wide_worlds(20_000, vehicles, seed=21)
    verdict = avoidability(worlds, controlled)
    assert 0.2 < verdict.avoidable.mean() < 0.9 and impacts_of_witnesses(worlds, verdict, controlled) == 0
    assert np.isnan(verdict.switch_s[~verdict.avoidable]).all()
    assert np.isnan(verdict.command_mps2[~verdict.avoidable]).all()


def at_the_edge(reason, pair, shift):
    """Worlds unavoidable for ``reason``, with the gap of ``pair`` changed so that ``shift`` metres are to spare."""
    worlds = wide_worlds(40_000, 3, seed=22)
    worlds = worlds.take(np.all(worlds.gaps_m > 0, axis=1) & (worlds.speeds_mps[:, 1] > 0))
    verdict = avoidability(worlds)
    rows = np.flatnonzero((verdict.reason == reason) & (verdict.margin_m > -20))
    assert rows.size > 500
    worlds = worlds.take(rows)
    worlds.gaps_m[:, pair] += shift - verdict.margin_m[rows]
    return worlds


# Less than 1e-9 m between both neighbours counts as unavoidable; full braking may touch the front vehicle.
@pytest.mark.parametrize(
    ("reason", "pair", "shift", "reasons"),
    [
        (3, 1, 2e-9, {0}), (3, 1, 1e-5, {0}), (3, 1, 5e-10, {3}), (3, 1, -1e-9, {3}),
        (2, 0, 1e-9, {0, 3}), (2, 0, 0.0, {0, 3}), (2, 0, -1e-9, {2}),
    ],
)  # fmt: skip
def test_boundary__is_where_it_is_said_to_the_last_nanometre(reason, pair, shift, reasons):
    worlds = at_the_edge(reason, pair, shift)
    verdict = avoidability(worlds)
    assert set(np.unique(verdict.reason)) == reasons
    assert reason == 2 or np.abs(verdict.margin_m - shift).max() < 1e-11
    assert impacts_of_witnesses(worlds, verdict) == 0


def apart(worlds):
    """Those in which no vehicles touch at equal speeds: these may lean on each other, which is contact, no impact."""
    return worlds.take(np.all((worlds.gaps_m > 0) | (np.diff(worlds.speeds_mps, axis=1) != 0), axis=1))


@pytest.mark.parametrize(("vehicles", "controlled"), LINES)
def test_early__is_what_happens_in_the_physics_before_the_latency(vehicles, controlled):
    worlds = apart(wide_worlds(20_000, vehicles, seed=23))
    until = worlds.vehicles.latency_s[:, controlled]
    _, impacts = eb.advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=until)
    early = avoidability(worlds, controlled).reason == 1
    assert 0.01 < early.mean() < 0.5 and np.array_equal(early, impacts.count.sum(axis=1) > 0)


@pytest.mark.parametrize("profiles", [8, pytest.param(250, marks=pytest.mark.long)])
def test_unavoidable__no_random_profile_avoids_collision(profiles):
    played, rng = 0, np.random.default_rng(profiles)
    lists = [eb.load_scenario(name).sample(1500, seed=7).worlds for name in ("paper-random", "paper-random-early")]
    for worlds in (*lists, wide_worlds(4000, 3, seed=24)):
        worlds = apart(worlds)
        worlds = worlds.take(~avoidability(worlds).avoidable)
        for _ in range(profiles):
            assert play_profile(worlds, 1, *random_profiles(worlds, 1, rng))[1].collided.all()
            played += worlds.n
    assert played >= 4000 * profiles


def test_later_states__give_the_same_verdict_and_a_witness_from_there():
    worlds = eb.load_scenario("paper-random").sample(3000, seed=3).worlds
    later, _ = eb.advance(worlds, -worlds.vehicles.braking_capacity_mps2, until_s=0.4)
    at_alert, from_there = avoidability(worlds), avoidability(later)
    assert np.array_equal(at_alert.reason, from_there.reason)
    assert np.abs(at_alert.margin_m - from_there.margin_m).max() < 1e-11
    assert impacts_of_witnesses(later, from_there) == 0


def test_a_world_alone__gives_the_same_bits():
    worlds = wide_worlds(300, 3, seed=27)
    together = avoidability(worlds)
    for k in range(0, 300, 7):
        alone = avoidability(worlds.take([k]))
        assert alone.margin_m.tobytes() == together.margin_m[[k]].tobytes()
        assert alone.switch_s.tobytes() == together.switch_s[[k]].tobytes()


def test_front_latency__counts_from_now():
    # Vehicle 1 brakes only after vehicle 2 may act, but at 1 s both latencies have passed.
    assert avoidability(line([5, 5], [9, 9, 9], 5, [1, 0.5, 0], time_s=1.0)).reason.shape == (1,)


def drawn(n, vehicles, controlled, seed):
    """n worlds that do not meet early; for three vehicles a third for each verdict, and some of the paper's."""
    worlds = wide_worlds(40 * n, vehicles, seed)
    reason = avoidability(worlds, controlled).reason
    if vehicles == 2:
        return worlds.take(np.flatnonzero(reason != 1)[:n])
    rows = np.concatenate([np.flatnonzero(reason == code)[: n // 4 + 1] for code in (0, 2, 3)])
    paper = eb.load_scenario("paper-random-early").sample(n - 3 * (n // 4), seed=seed).worlds
    return eb.Worlds.concatenate([worlds.take(rows), paper])


@pytest.mark.parametrize(("vehicles", "controlled", "n"), [(3, 1, 32), (2, 1, 8), (2, 0, 8)])
@pytest.mark.parametrize(
    ("times", "steps", "certain"), [(1, 120, 0.9), pytest.param(62, 500, 0.97, marks=pytest.mark.long)]
)
def test_exact_verdict__agrees_with_a_linear_programme_where_that_is_certain(
    vehicles, controlled, n, times, steps, certain
):
    worlds = drawn(n * times, vehicles, controlled, seed=31)
    exact, found = avoidability(worlds, controlled).avoidable, 0
    for k in range(worlds.n):
        linear = avoidable_by_lp(worlds.take([k]), (controlled,), steps)
        assert linear.avoidable == exact[k] or not linear.certain, (k, linear.margin_m)
        found += linear.certain
    assert found > certain * worlds.n
