"""Avoidability: margins by hand, witnesses and counter-examples in the exact physics, and a linear programme."""

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.evaluation.record import advance_worlds
from ethbrake_marl.extensions.proofs.avoidability import PROVEN_FOR, avoidability
from ethbrake_marl.extensions.proofs.lower_bound import lower_bound
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.motion.layout import GAP, IMPACTS, LATENCY, RELEASE_RATE, SPEED, scratch_for
from tests.extensions.proofs.worlds import opening, paper_line, play, random_commands, wide_worlds, worlds
from tests.reference.avoidability_lp import avoidable_by_lp
from tests.refused import refused

LINES = [(3, 2), (2, 1)]  # vehicles, body of the controlled one

# world, controlled body -> margin and what it is short of
BY_HAND = {
    "both stop: 40 m + gap against 20 m + 40 m": (worlds(19, [20, 20], 5, [0, 1]), 2, -1.0, "front"),
    "both stop: a touch at rest": (worlds(20, [20, 20], 5, [0, 1]), 2, 0.0, ""),
    "equal speeds after 2 s, 4 m lost": (worlds(3.5, [20, 24], [4, 6]), 2, -0.5, "front"),
    "weak brakes, the leader stands at 8 m": (worlds(40, [8, 20], [4, 4]), 2, -2.0, "front"),
    "a standing follower": (worlds(0, [0, 0], [4, 5]), 2, 0.0, ""),
    # 4 m/s faster than Vehicle 1, 2 + 2 m/s2 apart: 16 / 8 = 2 m are needed
    "ahead of a follower, 2.5 m": (opening(2.5), 1, 0.5, ""),
    "ahead of a follower, 1.5 m": (opening(1.5), 1, -0.5, "rear"),
    # Vehicle 3 needs 0.8 * 20 + 400 / 12 m; gaps and Vehicle 1's way to rest give 2 m more, or less
    "paper, 2 m left": (paper_line([10, 8], [20, 18, 20], [0, 0.5, 0.8]), 2, 2.0, ""),
    "paper, 2 m short": (paper_line([7, 7], [20, 18, 20], [0, 0.5, 0.8]), 2, -2.0, "rear"),
    "paper, 10 m short": (paper_line([7, 7], [20, 18, 20], [0, 0.8, 1.2]), 2, -10.0, "rear"),
    # 2 m lost in 1 s before Vehicle 2 may act, in front or behind
    "early, in front": (worlds([1, 9], [10, 12, 9], [5, 8, 5], [1, 1, 2]), 2, -1.0, "early"),
    "early, behind": (worlds([9, 1], [10, 10, 12], [5, 8, 5], [1, 1, 2]), 2, -1.0, "early"),
}


@pytest.mark.parametrize("case", BY_HAND)
def test_margin__by_hand(case):
    world, body, margin, reason = BY_HAND[case]
    verdict = avoidability(world, body)
    assert verdict.margin_m[0] == pytest.approx(margin, abs=1e-12)
    assert (verdict.reason_name[0], verdict.avoidable[0]) == (reason, margin >= 0)


def test_rear_vehicle__that_only_touches_before_the_latency_is_no_contact():
    # 2 m/s at 4 m/s2: 0.5 m, a touch at 0.5 s
    assert avoidability(worlds([9, 0.5], [10, 10, 12], [5, 8, 4], [1, 1, 0])).avoidable[0]


# Room, own speed and so on chosen for round numbers; Vehicle 3 stands far behind and never matters.
@pytest.mark.parametrize(
    ("gap", "speeds", "braking", "drive", "limit", "switch", "last"),
    [
        # A leader at rest, 30 m: V^2 (1/5 + 1/5) = 2 * 30 + 20, V = sqrt(200).
        (30, [0, 10], [4, 5], 5, 100, [(200**0.5 - 10) / 5, (2 * 200**0.5 - 10) / 5], -5),
        # At most 12 m/s: 0.4 s and 4.4 m to get there, 14.4 m to stop, so 11.2 m at 12 m/s.
        (30, [0, 10], [4, 5], 5, 12, [0.4 + 11.2 / 12, 0.4 + 11.2 / 12 + 2.4], -5),
        # Both move: after 1 s 8 m/s faster and 8 m behind; equal speeds 2 s later. Then follow with 4 m/s2.
        (12, [20, 20], [4, 8], 4, 100, [1, 3], -4),
        # No drive: coast for (30 - 10) m / 10 m/s, then 2 s to rest.
        (30, [0, 10], [4, 5], 0, 100, [2, 4], -5),
        (0, [0, 0], [4, 5], 3, 100, [0, 0], -5),  # no room and no speed: stays
    ],
)
def test_witness__is_the_largest_trajectory_behind_the_front_vehicle(gap, speeds, braking, drive, limit, switch, last):
    state = worlds([gap, 50], [*speeds, 0], [*braking, 5], drive=drive, limit=limit)
    verdict = avoidability(state)
    assert verdict.switch_s[0] == pytest.approx([0, *switch], abs=1e-8)
    assert verdict.command_mps2[0].tolist() == [drive, -braking[1], last]
    assert not play(state, 2, verdict.switch_s, verdict.command_mps2).collided.any()


# Recorded from version 0.5, to the last bit: reasons and margins of the first worlds of seed 7.
RECORDED = {
    "paper-random": (
        [2, 2, 0, 0, 0, 3],
        [
            -2.2536039320876817, -1.5703694384732874, 7.362816780293642, 4.214819274606084, 5.774688637270305,
            -7.215421674897859,
        ],
        0.645,
    ),
    "stress-wide": (
        [0, 2, 3, 0, 2, 0],
        [
            37.43159595791285, -17.742546999470413, -11.013769439609861, 11.782993674018558, -3.148588565568509,
            22.51020049534073,
        ],
        0.555,
    ),
    "paper-delay-high": (
        [2, 2, 0, 3, 3, 3],
        [
            -8.699578932545494, -7.188878678262009, 2.637305150021483, -3.9972256202212306, -1.2948754935417053,
            -15.98011769287201,
        ],
        0.945,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", RECORDED)
def test_verdicts__of_shipped_lists(name):
    reason, margin, share = RECORDED[name]
    verdict = avoidability(eb.load_scenario(name).sample(5000, seed=7))
    assert verdict.reason[:6].tolist() == reason and verdict.margin_m[:6].tolist() == margin
    assert (~verdict.avoidable).mean() == pytest.approx(share, abs=0.012)


def impacts_of_witnesses(state, verdict, body=2):
    """How many impacts the witnesses of the avoidable worlds have in the physics."""
    good = verdict.avoidable
    return play(state.take(good), body, verdict.switch_s[good], verdict.command_mps2[good]).line[:, IMPACTS].sum()


@pytest.mark.parametrize(("vehicles", "body"), LINES)
def test_witness__has_no_impact_in_the_physics(vehicles, body):
    state = wide_worlds(20_000, vehicles, seed=21)
    verdict = avoidability(state, body)
    assert 0.2 < verdict.avoidable.mean() < 0.9 and impacts_of_witnesses(state, verdict, body) == 0
    assert np.isnan(verdict.switch_s[~verdict.avoidable]).all()
    assert np.isnan(verdict.command_mps2[~verdict.avoidable]).all()


def apart(state):
    """Worlds in which no vehicles touch at equal speeds: these may lean on each other without impact."""
    return state.take(np.all((state.gaps_m > 0) | (np.diff(state.speeds_mps, axis=1) != 0), axis=1))


@pytest.mark.parametrize(("vehicles", "body"), LINES)
def test_early__is_what_happens_in_the_physics_before_the_latency(vehicles, body):
    state = apart(wide_worlds(20_000, vehicles, seed=23))
    until, wanted = state.latency_s[:, body - 1].copy(), np.zeros(state.wanted.shape)
    wanted[:, 1:] = -state.braking_capacity_mps2
    line = state.line.copy()
    advance_worlds(line, state.car, state.time_s.copy(), until, wanted, scratch_for(vehicles + 1))
    early = avoidability(state, body).reason == 1
    assert 0.01 < early.mean() < 0.5 and np.array_equal(early, line[:, IMPACTS].any(axis=1))


def test_unavoidable__no_random_commands_avoid_an_impact():
    rng = np.random.default_rng(8)
    for state in (*(eb.load_scenario(name).sample(1500, 7) for name in ("paper-random", "paper-random-early")),
                  wide_worlds(4000, 3, seed=24)):  # fmt: skip
        state = apart(state)
        state = state.take(~avoidability(state).avoidable)
        for _ in range(6):
            assert play(state, 2, *random_commands(state, 2, rng)).collided.all()


# Less than 1e-9 m between both neighbours counts as unavoidable; full braking may touch the front vehicle.
@pytest.mark.parametrize(
    ("reason", "pair", "shift", "reasons"),
    [
        (3, 1, 2e-9, {0}), (3, 1, -1e-9, {3}),
        (2, 0, 0.0, {0, 3}), (2, 0, -1e-9, {2}),
    ],
)  # fmt: skip
def test_boundary__is_where_it_is_said_to_the_last_nanometre(reason, pair, shift, reasons):
    state = wide_worlds(20_000, 3, seed=22)
    verdict = avoidability(state)
    moves = np.all(state.gaps_m > 0, axis=1) & (state.speeds_mps[:, 1] > 0)
    rows = np.flatnonzero(moves & (verdict.reason == reason) & (verdict.margin_m > -20))
    assert rows.size > 300
    state = state.take(rows)
    state.line[:, GAP, pair + 1] += shift - verdict.margin_m[rows]
    verdict = avoidability(state)
    assert set(np.unique(verdict.reason)) == reasons
    assert reason == 2 or np.abs(verdict.margin_m - shift).max() < 1e-11
    assert impacts_of_witnesses(state, verdict) == 0


@pytest.mark.parametrize(("vehicles", "body", "n"), [(3, 2, 12), (2, 2, 4), (2, 1, 4)])
@pytest.mark.parametrize(("times", "steps", "share"), [(1, 120, 0.7)])
def test_verdict__agrees_with_a_linear_programme_where_that_is_certain(vehicles, body, n, times, steps, share):
    n *= times
    state, certain = wide_worlds(40 * n, vehicles, seed=31), 0
    reason = avoidability(state, body).reason
    state = state.take(np.concatenate([np.flatnonzero(reason == code)[:n] for code in (0, 2, 3)]))
    exact = avoidability(state, body).avoidable
    for k in range(state.n):
        linear = avoidable_by_lp(state.take([k]), (body - 1,), steps)
        assert linear.avoidable == exact[k] or not linear.certain, (k, linear.margin_m)
        certain += linear.certain
    assert certain > share * state.n


def test_later_states__give_the_same_verdict_and_a_witness_from_there():
    scenario, game = eb.open_game("paper-random")
    state = scenario.sample(500, 3)
    first = game.reset(state)
    at_alert, from_there = avoidability(state), avoidability(first)
    assert first.time_s[0] == 0.5 and np.array_equal(at_alert.reason, from_there.reason)
    assert np.abs(at_alert.margin_m - from_there.margin_m).max() < 1e-11
    assert impacts_of_witnesses(first, from_there) == 0


def changed(array, row, body, value):
    """Three worlds, of which only the second has another value."""
    state = worlds([9, 9], [9, 9, 9], 5, [0, 0.5, 0.8]).take([0, 0, 0])
    getattr(state, array)[1, row, body] = value
    return state


def test_proofs__are_for_this_physics():
    assert physics_digest() == PROVEN_FOR, (
        f"the code of motion/ has changed: set PROVEN_FOR (extensions/proofs/avoidability.py) to {physics_digest()!r},"
        " and keep it only if `pytest --all tests/extensions/proofs` and `pytest -m nightly"
        " tests/motion/test_proofs.py` succeed (docs/physics.md)"
    )


def test_proofs__claim_nothing_under_another_impact_law(other_law):
    claims = (
        f"proven for other physics ('{PROVEN_FOR}') than this installation's ('{other_law}'), so nothing is claimed"
    )
    for prove in (avoidability, lower_bound):
        with refused(claims):
            prove(paper_line([7, 7], [20, 18, 20], [0, 0.5, 0.8]))
    for measure in ("contact_avoidable", "proven_harm"):
        with refused(claims):
            eb.evaluate("paper-random", "coast", episodes=2, seed=77, measures=measure)


REFUSED = {
    "avoidability: vehicle_1 of 3 vehicles is controlled, but the proof covers only": lambda: avoidability(
        paper_line([9, 9], [9, 9, 9], [0, 0.5, 0.8]), 1
    ),
    "world 1 has a vehicle_1 that may brake only after the controlled vehicle": lambda: avoidability(
        changed("car", LATENCY, 1, 0.6)
    ),
    "a proof does not cover backward, by which world 1 departs": lambda: avoidability(changed("line", SPEED, 3, -1)),
    "world 1 has an obstacle ahead of the controlled vehicle_1": lambda: avoidability(
        State.join([worlds(5, [9, 9], 5), worlds(5, [9, 9], 5, obstacle=90)]), 1
    ),
    "a proof does not cover build-up, by which world 1 departs from the plain game": lambda: avoidability(
        changed("car", RELEASE_RATE, 1, 9.0)
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_line__is_refused(message):
    with refused(message):
        REFUSED[message]()
