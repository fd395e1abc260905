"""What always holds, with the tolerances published in ``ethbrake_marl/physics/tolerances.py``."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ethbrake_marl.harm import empty_ledger, split
from ethbrake_marl.physics import Worlds, advance, make_worlds
from ethbrake_marl.physics.tolerances import ENERGY_EPS, EPS, GAP_M, MOMENTUM_EPS, RESTITUTION_EPS
from tests.physics.measures import energy_rise_eps, momentum_eps, restitution_eps, rounds
from tests.physics.random_worlds import driving_lines, touching_lines

SPEED = st.floats(0.0, 40.0)
MASS = st.floats(1e-2, 1e4)


def pair(speeds: tuple[float, float], mass: tuple[float, float], e: float) -> Worlds:
    """Two touching vehicles."""
    return make_worlds(
        [0.0], speeds, braking_capacity_mps2=9, driving_capacity_mps2=9, latency_s=0, mass_t=mass, restitution=e
    )


@settings(max_examples=400)
@given(SPEED, SPEED, MASS, MASS, st.floats(0.0, 1.0))
def test_impact__of_two_conserves_momentum_and_obeys_restitution(front, rear, m_front, m_rear, e):
    after, impacts = advance(pair((front, rear), (m_front, m_rear), e), [0.0, 0.0], 0.0)
    before, now = [Fraction(front), Fraction(rear)], [Fraction(float(v)) for v in after.speeds_mps[0]]
    mass = [Fraction(m_front), Fraction(m_rear)]
    if rear <= front:
        assert now == before and impacts.count[0, 0] == 0
        return
    scale = sum(m * max(abs(v), abs(u)) for m, v, u in zip(mass, before, now, strict=True))
    assert abs(sum(m * (u - v) for m, v, u in zip(mass, before, now, strict=True))) <= MOMENTUM_EPS * EPS * scale
    closing = before[1] - before[0]
    bounce = Fraction(e) if rear - front >= 0.05 else 0
    assert abs(now[0] - now[1] - bounce * closing) <= RESTITUTION_EPS * EPS * max(map(abs, [*before, *now]))
    energy = [sum(m * v * v for m, v in zip(mass, speeds, strict=True)) for speeds in (before, now)]
    assert energy[1] <= energy[0] * (1 + Fraction(ENERGY_EPS * EPS))
    assert impacts.count[0, 0] == (rear - front > 1e-5)
    assert impacts.total_harm[0, 0] == ((rear - front) ** 2 if rear - front > 1e-5 else 0.0)


@pytest.mark.parametrize("ratio", [1.0, 1e3, 1e6])
@pytest.mark.parametrize("N", [2, 3, 5, 20])
def test_impact__of_a_whole_cluster_conserves_momentum_and_loses_energy(N, ratio):
    before, command = touching_lines(31, 20_000 // N, N, heaviest_ratio=ratio)
    after, impacts = advance(before, command, 0.0)
    assert impacts.count.sum() > 3_000
    assert np.max(momentum_eps(before, after) / rounds(impacts)) <= MOMENTUM_EPS
    assert np.max(energy_rise_eps(before, after) / rounds(impacts)) <= ENERGY_EPS
    if N == 2:
        assert np.max(restitution_eps(before, after)) <= RESTITUTION_EPS
    assert np.all(after.speeds_mps[:, 1:] <= after.speeds_mps[:, :-1], where=after.gaps_m == 0.0)


def test_impact__a_heavy_vehicle_behind_a_fast_light_one_keeps_its_momentum():
    # One touching line: vehicle 1 already leaves; 2 (heavy, almost at rest) is struck by 3. Speeds taken relative to
    # vehicle 1 lost the digits of vehicle 2: 600 eps.
    before = make_worlds(
        [0.0, 0.0], [29.7, 0.013, 11.1], braking_capacity_mps2=9, driving_capacity_mps2=9, latency_s=0,
        mass_t=[0.7, 6100.0, 0.9], restitution=0.3,
    )  # fmt: skip
    after, impacts = advance(before, [0.0, 0.0, 0.0], 0.0)
    assert impacts.count.tolist() == [[0, 1]]
    assert momentum_eps(before, after)[0] <= MOMENTUM_EPS
    assert after.speeds_mps[0, 0] == 29.7  # nobody strikes it: not a bit changes


def test_impact__a_pair_that_separates_is_left_alone_to_the_last_bit():
    rng = np.random.default_rng(0)
    rear = rng.uniform(0.0, 30.0, 2_000)
    front = rear + rng.uniform(0.0, 1.0, 2_000) * rng.choice([0.0, 1e-12, 1.0], 2_000)
    before = make_worlds(
        np.zeros((2_000, 1)), np.stack([front, rear], axis=1), braking_capacity_mps2=9, driving_capacity_mps2=9,
        latency_s=0, mass_t=rng.uniform(1, 9, (2_000, 2)), restitution=0.5,
    )  # fmt: skip
    after, impacts = advance(before, np.zeros((2_000, 2)), 0.0)
    assert after.speeds_mps.tobytes() == before.speeds_mps.tobytes() and impacts.count.sum() == 0


class Sampled:
    """A batch advanced in many short half-steps, with what its motion did in each step."""

    def __init__(self, key: int, n: int, N: int, *, drive: bool, steps: int = 300, horizon_s: float = 6.0) -> None:
        self.start, self.command = driving_lines(key, n, N, drive=drive)
        self.states, self.struck, self.worst, self.checked = [self.start], [], 0.0, 0
        edges = np.linspace(0.0, horizon_s, 2 * steps + 1)
        for a, b in zip(edges[1::2], edges[2::2], strict=True):
            middle, first = advance(self.states[-1], self.command, until_s=a)
            end, second = advance(middle, self.command, until_s=b)
            self.struck.append((first.count + second.count).any(axis=1))
            self._check_gaps(self.states[-1], middle, end)
            self.states.append(end)

    def _check_gaps(self, a: Worlds, b: Worlds, c: Worlds) -> None:
        """Where accelerations are constant, the gap without any clipping follows from three speeds (Simpson, exact)."""
        bend = np.abs(a.speeds_mps - 2.0 * b.speeds_mps + c.speeds_mps).max(axis=1)
        steady = (bend < 1e-12) & ~self.struck[-1]
        opening = [w.speeds_mps[:, :-1] - w.speeds_mps[:, 1:] for w in (a, b, c)]
        span = (c.time_s - a.time_s)[:, None]
        unclipped = a.gaps_m + span * (opening[0] + 4.0 * opening[1] + opening[2]) / 6.0
        self.worst = max(self.worst, float(np.abs(unclipped - c.gaps_m)[steady].max()), float(-unclipped[steady].min()))
        self.checked += int(steady.sum())


@pytest.mark.parametrize("N", [2, 3, 5])
@pytest.mark.parametrize("drive", [False, True])
def test_motion__gaps_follow_the_speeds_and_never_turn_negative(N, drive):
    motion = Sampled(41, 400, N, drive=drive)
    assert motion.checked > 0.7 * 400 * 300
    assert motion.worst <= GAP_M
    assert min(state.gaps_m.min() for state in motion.states) >= 0.0


@pytest.mark.parametrize("N", [2, 3, 5])
def test_motion__under_brakes_nothing_speeds_up_and_only_a_bounce_back_is_negative(N):
    motion = Sampled(42, 150, N, drive=False)
    negative = 0
    for a, b, struck in zip(motion.states, motion.states[1:], motion.struck, strict=False):
        assert np.all(energy_rise_eps(a, b) <= 100 * ENERGY_EPS)  # many events in one step: rounding adds up
        back = b.speeds_mps < 0.0
        negative += int(back.sum())
        hit_from_either_side = np.zeros(back.shape, bool)
        hit_from_either_side[:, :-1] |= b.pair_hit
        hit_from_either_side[:, 1:] |= b.pair_hit
        assert np.all(hit_from_either_side[back])
        assert np.all(b.vehicles.restitution[back.any(axis=1)] > 0.0)
        unmoved = ~struck[:, None] & back
        assert np.all((b.speeds_mps >= a.speeds_mps - 1e-12)[unmoved])  # brakes end it from below
    assert negative > 0


@pytest.mark.parametrize("N", [2, 4])
def test_motion__driving_ends_at_the_limit_unless_pushed(N):
    motion = Sampled(43, 150, N, drive=True)
    limit, reached = motion.start.vehicles.speed_limit_mps, 0
    for state in motion.states:
        alone = ~state.pair_hit.any(axis=1)
        assert np.all((state.speeds_mps <= limit)[alone])
        reached += int((state.speeds_mps == limit)[alone].sum())
    assert reached > 100


def test_speeds__are_never_negative_without_restitution():
    start, command = driving_lines(44, 2_000, 4, drive=False)
    plastic = make_worlds(
        start.gaps_m, start.speeds_mps, braking_capacity_mps2=8, driving_capacity_mps2=8,
        latency_s=start.vehicles.latency_s, mass_t=start.vehicles.mass_t, restitution=0.0,
    )  # fmt: skip
    for until in np.linspace(0.1, 8.0, 80):
        plastic, _ = advance(plastic, command, until_s=until)
        assert plastic.speeds_mps.min() >= 0.0
    assert plastic.pair_hit.sum() > 2_000


@settings(max_examples=300)
@given(st.lists(MASS, min_size=2, max_size=6), st.data())
def test_harm__shares_add_up_to_the_last_bit(mass, data):
    value = st.just(0.0) | st.floats(1e-10, 2_000.0)
    harm = data.draw(st.lists(value, min_size=len(mass) - 1, max_size=len(mass) - 1))
    for p, squared in enumerate(harm):  # pair by pair: a vehicle between two pairs bears a sum of rounded numbers
        front, rear = split(np.array([[squared]]), np.array([mass[p : p + 2]]))[0]
        assert Fraction(float(front)) + Fraction(float(rear)) == Fraction(squared)
        assert min(front, rear) >= 0.0
        rounding = 4.0 * EPS * squared * max(mass[p : p + 2])
        assert front * mass[p] == pytest.approx(rear * mass[p + 1], rel=0, abs=rounding)
    whole = split(np.array([harm]), np.array([mass]))
    assert whole.sum() == pytest.approx(sum(harm), rel=1e-14)


@pytest.mark.parametrize("N", [2, 3, 6])
def test_ledger__is_the_sum_of_the_recorded_impacts_to_the_last_bit(N):
    worlds, command = driving_lines(45, 1_500, N)
    ledger = empty_ledger(worlds)
    first, total, count = (np.zeros(worlds.gaps_m.shape) for _ in range(3))
    for until in (0.7, 2.0, 6.0):
        worlds, impacts = advance(worlds, command, until_s=until, record=True)
        rows = impacts.rows
        harm = rows.closing_speed_mps * rows.closing_speed_mps
        segment_first, segment_total = np.zeros(first.shape), np.zeros(first.shape)
        np.add.at(segment_total, (rows.world, rows.pair), harm)
        np.add.at(segment_first, (rows.world[rows.first], rows.pair[rows.first]), harm[rows.first])
        np.add.at(count, (rows.world, rows.pair), 1)
        assert np.all(np.diff(rows.time_s)[np.diff(rows.world) == 0] >= 0.0)
        assert segment_total.tobytes() == impacts.total_harm.tobytes()
        assert segment_first.tobytes() == impacts.first_impact_harm.tobytes()
        first, total = first + segment_first, total + segment_total
        ledger = ledger.add(impacts)
    assert ledger.pair_harm("first").tobytes() == first.tobytes()
    assert ledger.pair_harm("total").tobytes() == total.tobytes()
    assert ledger.count.tolist() == count.tolist()
    assert np.array_equal(worlds.pair_hit, count > 0) and ledger.collided.tolist() == (count.sum(axis=1) > 0).tolist()
    assert ledger.world_harm("total") == pytest.approx(ledger.vehicle_harm("total").sum(axis=1), rel=1e-14)
