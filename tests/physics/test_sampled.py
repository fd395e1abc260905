"""The paper's fixed-step map: steps computed by hand, the equations written out once more, and its limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.physics import Worlds, advance, advance_sampled, make_worlds
from ethbrake_marl.scenario import load_scenario


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


def paper_random(n, latency=(0.0, 0.5, 0.8), seed=7) -> tuple[Worlds, np.ndarray]:
    """Worlds of the paper's random test and full braking."""
    rng = np.random.default_rng(seed)
    worlds = line(
        rng.uniform(5, 10, (n, 2)),
        rng.uniform(18, 22, (n, 3)),
        mass=[4.5, 5.5, 5.9],
        e=0.1,
        latency=latency,
        braking=[6.0, 7.0, 6.0],
        limit=40.0,
    )
    return worlds, -worlds.vehicles.braking_capacity_mps2


def world_harm(impacts, harm_count="total") -> np.ndarray:
    return (impacts.total_harm if harm_count == "total" else impacts.first_impact_harm).sum(axis=1)


def test_step__without_impact_is_the_papers_matrix():
    # h = 0.5: v = 8 - 2 * 0.5 = 7, way 0.5 * 8 - 0.125 * 2 = 3.75; front vehicle 5 m
    after, impacts = advance_sampled(line([10.0], [10.0, 8.0]), [0.0, -2.0], until_s=0.5, step_s=0.5)
    assert after.speeds_mps.tolist() == [[10.0, 7.0]]
    assert after.gaps_m.tolist() == [[11.25]]
    assert after.time_s.tolist() == [0.5] and after.command_mps2.tolist() == [[0.0, -2.0]]
    assert impacts.count.tolist() == [[0]] and impacts.rows is None


def test_step__front_impact():
    # m1 = 1, m2 = 3, e = 0.5, w = 4: v1 = 4 + 3/4 * 1.5 * 4 = 8.5, v2 = 8 - 1/4 * 1.5 * 4 = 6.5; u2 = -2 for 0.5 s:
    # v2 = 5.5, way 3.25 - 0.25 = 3; front way 4.25
    worlds = line([0.0, 50.0], [4.0, 8.0, 0.0], mass=[1.0, 3.0, 2.0], e=0.5)
    after, impacts = advance_sampled(worlds, [0.0, -2.0, 0.0], until_s=0.5, step_s=0.5)
    assert after.speeds_mps.tolist() == [[8.5, 5.5, 0.0]]
    assert after.gaps_m.tolist() == [[1.25, 53.0]]
    assert impacts.first_impact_harm.tolist() == impacts.total_harm.tolist() == [[16.0, 0.0]]
    assert impacts.count.tolist() == [[1, 0]] and after.pair_hit.tolist() == [[True, False]]


def test_step__rear_impact():
    # m2 = 3, m3 = 1, e = 0.5, w = 4: v2 = 4 + 1/4 * 1.5 * 4 = 5.5, v3 = 8 - 3/4 * 1.5 * 4 = 3.5
    worlds = line([50.0, 0.0], [0.0, 4.0, 8.0], mass=[2.0, 3.0, 1.0], e=0.5)
    after, impacts = advance_sampled(worlds, [0.0, 2.0, 0.0], until_s=0.5, step_s=0.5)
    assert after.speeds_mps.tolist() == [[0.0, 6.5, 3.5]]
    assert after.gaps_m.tolist() == [[47.0, 1.25]]  # Vehicle 2 moves 2.75 + 0.25, Vehicle 3 1.75
    assert impacts.total_harm.tolist() == [[0.0, 16.0]]


def test_step__both_impacts_at_one_sample_rear_first():
    # Equal masses, e = 0, v = (0, 2, 6). f3: v2 = v3 = 4; then f1 with the changed v2: v1 = v2 = 2.
    # Front first would give (1, 3.5, 3.5), both at once (1, 3, 4).
    after, impacts = advance_sampled(line([0.0, 0.0], [0.0, 2.0, 6.0]), [0.0, 0.0, 0.0], until_s=0.5, step_s=0.5)
    assert after.speeds_mps.tolist() == [[2.0, 2.0, 4.0]]
    assert after.gaps_m.tolist() == [[0.0, -1.0]]
    assert impacts.total_harm.tolist() == [[16.0, 16.0]]  # each with the closing speed that it had


def test_step__a_rear_impact_can_make_the_front_pair_close():
    # The front pair separates until f3 pushes Vehicle 2: v = (3, 2, 6) -> (3, 4, 4) -> (3.5, 3.5, 4)
    after, impacts = advance_sampled(line([0.0, 0.0], [3.0, 2.0, 6.0]), [0.0, 0.0, 0.0], until_s=0.5, step_s=0.5)
    assert after.speeds_mps.tolist() == [[3.5, 3.5, 4.0]]
    assert impacts.total_harm.tolist() == [[1.0, 16.0]]


def test_long_line__is_treated_from_the_rear_pair_to_the_front_pair():
    # v = (0, 0, 0, 0, 16) -> 8 8 -> 4 4 -> 2 2 -> 1 1
    after, impacts = advance_sampled(line([0.0] * 4, [0.0] * 4 + [16.0]), [0.0] * 5, until_s=0.5, step_s=0.5)
    assert after.speeds_mps.tolist() == [[1.0, 1.0, 2.0, 4.0, 8.0]]
    assert impacts.total_harm.tolist() == [[4.0, 16.0, 64.0, 256.0]]


def test_detection__waits_for_the_sample_and_the_last_sample_belongs_to_the_next_call():
    # 1 m at 4 m/s closing: contact at 0.25 s is seen at 0.5 s, 1 m deep
    worlds = line([1.0], [0.0, 4.0])
    seen, impacts = advance_sampled(worlds, [0.0, 0.0], until_s=0.5, step_s=0.5)
    assert seen.gaps_m.tolist() == [[-1.0]] and seen.speeds_mps.tolist() == [[0.0, 4.0]]
    assert impacts.count.tolist() == [[0]]
    after, impacts = advance_sampled(seen, [0.0, 0.0], until_s=1.0, step_s=0.5)
    assert after.speeds_mps.tolist() == [[2.0, 2.0]] and after.gaps_m.tolist() == [[-1.0]]
    assert impacts.total_harm.tolist() == [[16.0]]


def test_detection__a_contact_between_samples_is_missed():
    # 1 m at 4.5 m/s closing while the front vehicle drives off at 9 m/s2: contact after 1/3 s, but again 1 m at 1 s
    worlds = line([1.0], [0.0, 4.5], driving=9.0)
    assert advance(worlds, [9.0, 0.0], 1.0)[1].count.tolist() == [[1]]
    after, impacts = advance_sampled(worlds, [9.0, 0.0], until_s=2.0, step_s=1.0)
    assert impacts.count.tolist() == [[0]] and after.gaps_m.tolist() == [[1.0 + 18.0 - 9.0]]


def test_overlap__strikes_again_only_while_it_closes():
    # e = 0.5 at w = 4, 1 m deep: leaves at 2 m/s, no second impact; pressed at 8 m/s2 it closes at 2 m/s after 0.5 s
    seen, _ = advance_sampled(line([1.0], [2.0, 6.0], e=0.5), [0.0, 0.0], until_s=0.5, step_s=0.5)
    leaving, impacts = advance_sampled(seen, [0.0, 0.0], until_s=1.5, step_s=0.5)
    assert impacts.count.tolist() == [[1]] and leaving.speeds_mps.tolist() == [[5.0, 3.0]]
    pressed, impacts = advance_sampled(seen, [0.0, 8.0], until_s=1.5, step_s=0.5)
    assert impacts.count.tolist() == [[2]]
    assert impacts.first_impact_harm.tolist() == [[16.0]] and impacts.total_harm.tolist() == [[20.0]]
    _, impacts = advance_sampled(pressed, [0.0, 8.0], until_s=2.0, step_s=0.5)
    assert impacts.first_impact_harm.tolist() == [[0.0]] and impacts.count.tolist() == [[1]]  # hit before


def test_touch__is_no_impact_and_no_harm():
    after, impacts = advance_sampled(line([0.0], [10.0, 10.0 + 8e-6]), [0.0, 0.0], until_s=0.1)
    assert impacts.count.tolist() == [[0]] and impacts.total_harm.tolist() == [[0.0]]
    assert after.speeds_mps[0, 0] == pytest.approx(after.speeds_mps[0, 1], abs=1e-12)


def test_grid__starts_at_the_latency_of_vehicle_2():
    # Nothing is sampled before 0.75 s: Vehicle 1 stops exactly (1 m, 0.5 s) and the overlap stays unseen until then.
    worlds = line([2.0], [4.0, 8.0], latency=[0.0, 0.75], braking=8.0)
    after, impacts = advance_sampled(worlds, [-8.0, -8.0], until_s=0.6, step_s=0.5)
    assert after.time_s.tolist() == [0.6] and after.speeds_mps.tolist() == [[0.0, 8.0]]
    assert after.gaps_m[0, 0] == pytest.approx(2.0 + 1.0 - 4.8, abs=1e-14)
    assert after.command_mps2.tolist() == [[-8.0, 0.0]]
    after, impacts = advance_sampled(after, [-8.0, -8.0], until_s=0.75, step_s=0.5)
    assert impacts.count.sum() == 0 and after.gaps_m[0, 0] == pytest.approx(-3.0, abs=1e-14)
    after, impacts = advance_sampled(after, [-8.0, -8.0], until_s=0.8, step_s=0.5)
    assert after.time_s.tolist() == [1.25]  # whole steps
    assert impacts.total_harm.tolist() == [[64.0]]
    assert after.speeds_mps.tolist() == [[0.0, 0.0]]  # both at 4 m/s, and braking


@pytest.mark.parametrize("until", [np.nextafter(0.75, 0.0), 0.75, np.nextafter(0.75, 9.0)])
def test_grid__a_time_that_rounding_parts_from_its_first_sample_is_that_sample(until):
    worlds = line([9.0], [4.0, 8.0], latency=[0.0, 0.75], braking=8.0)
    after, _ = advance_sampled(worlds, [-8.0, -8.0], until_s=until, step_s=0.5)
    assert after.time_s.tolist() == [0.75]
    assert after.command_mps2.tolist() == [[-8.0, -8.0]] and after.speeds_mps.tolist() == [[0.0, 8.0]]
    again, _ = advance_sampled(after, [-8.0, -8.0], until_s=0.75, step_s=0.5)
    assert again.time_s.tolist() == [0.75] and again.gaps_m.tolist() == after.gaps_m.tolist()


def test_grid__a_negative_speed_is_known_from_the_first_sample_on():
    worlds = replace(line([9.0], [3.0, 0.0]), speeds_mps=np.array([[3.0, -2.0]]))
    after, _ = advance_sampled(worlds, [0.0, -2.0], until_s=0.5, step_s=0.5)
    assert after.speeds_mps.tolist() == [[3.0, -1.0]] and after.gaps_m.tolist() == [[9.0 + 1.5 + 0.75]]


def test_grid__before_it_a_drive_ends_exactly_at_the_speed_limit():
    after, _ = advance_sampled(line([50.0], [8.0, 0.0], latency=[0.0, 2.0], limit=10.0), [2.0, 0.0], until_s=2.0)
    assert after.speeds_mps.tolist() == [[10.0, 0.0]] and after.gaps_m.tolist() == [[50.0 + 9.0 + 10.0]]


def test_hold__a_latency_between_samples_takes_effect_at_the_later_one():
    # samples at 0.5, 1, 1.5; Vehicle 3 may act at 0.8: it brakes from 1 s on
    worlds = line([50.0, 50.0], [8.0, 8.0, 8.0], latency=[0.0, 0.5, 0.8])
    after, _ = advance_sampled(worlds, [0.0, -2.0, -2.0], until_s=1.5, step_s=0.5)
    assert after.speeds_mps.tolist() == [[8.0, 6.0, 7.0]]
    exact, _ = advance(worlds, [0.0, -2.0, -2.0], until_s=1.5)
    assert exact.speeds_mps[0, 2] == pytest.approx(6.6)


@pytest.mark.parametrize("step", [0.1, 0.02, 0.003, 0.001])
def test_hold__a_latency_on_the_grid_is_not_lost_to_rounding(step):
    latency = 0.5 + round(0.3 / step) * step
    for late in (latency, np.nextafter(latency, 9.0), np.nextafter(latency, 0.0)):
        worlds = line([50.0, 50.0], [20.0] * 3, latency=[0.0, 0.5, late])
        after, _ = advance_sampled(worlds, [0.0, 0.0, -6.0], until_s=0.5 + 600 * step, step_s=step)
        braking = (600 - round(0.3 / step)) * step
        assert after.speeds_mps[0, 2] == pytest.approx(max(20.0 - 6.0 * braking, 0.0), abs=1e-9)


def test_constraint__the_command_is_cut_to_end_at_standstill_or_at_the_limit():
    # 1 m/s, braking at 8 for 0.5 s: u = -2, way 0.25 m (exactly it is 0.0625 m). 9 of 10 m/s, driving: u = 2, 4.75 m.
    after, _ = advance_sampled(line([1.0], [9.0, 1.0], limit=10.0), [8.0, -8.0], until_s=0.5, step_s=0.5)
    assert after.speeds_mps.tolist() == [[10.0, 0.0]]
    assert after.gaps_m.tolist() == [[1.0 + 4.75 - 0.25]]
    after, _ = advance_sampled(after, [8.0, -8.0], until_s=1.0, step_s=0.5)
    assert after.speeds_mps.tolist() == [[10.0, 0.0]] and after.gaps_m.tolist() == [[10.5]]


def test_constraint__a_negative_speed_after_an_impact_stays_until_brakes_end_it():
    # m = (4, 1), e = 0.5, w = 10: v2 = 10 - 4/5 * 1.5 * 10 = -2, v1 = 3. Braking at 2: -1 after 0.5 s, 0.75 m back.
    worlds = line([0.0], [0.0, 10.0], mass=[4.0, 1.0], e=0.5)
    after, _ = advance_sampled(worlds, [0.0, -2.0], until_s=0.5, step_s=0.5)
    assert after.speeds_mps[0] == pytest.approx([3.0, -1.0], abs=1e-14)
    assert after.gaps_m[0, 0] == pytest.approx(1.5 + 0.75, abs=1e-14)
    after, _ = advance_sampled(after, [0.0, -3.0], until_s=1.0, step_s=0.5)
    assert after.speeds_mps[0] == pytest.approx([3.0, 0.0], abs=1e-14)


def test_constraint__a_vehicle_pushed_beyond_its_limit_coasts():
    worlds = line([0.0], [9.0, 10.0], mass=[1.0, 9.0], e=1.0, limit=10.0)  # v1 = 9 + 0.9 * 2 = 10.8
    after, _ = advance_sampled(worlds, [5.0, -1.0], until_s=0.5, step_s=0.5)
    assert after.speeds_mps[0, 0] == pytest.approx(10.8, abs=1e-14)


def test_momentum__is_kept_by_every_sample():
    rng = np.random.default_rng(3)
    mass = rng.uniform(1, 40, (200, 5))
    worlds = line(rng.uniform(0, 1, (200, 4)), rng.uniform(0, 30, (200, 5)), mass=mass, e=rng.uniform(0, 1, 200))
    after, impacts = advance_sampled(worlds, np.zeros(5), until_s=2.0, step_s=0.1)
    assert impacts.count.sum() > 400
    before = (mass * worlds.speeds_mps).sum(axis=1)
    assert (mass * after.speeds_mps).sum(axis=1) == pytest.approx(before, rel=1e-13)


def papers_equations(worlds, command, steps, step):
    """Three vehicles by their positions, equations as printed (with the gate), one world: (x, v, harm by pair)."""
    m, e = worlds.vehicles.mass_t[0], worlds.vehicles.restitution[0]
    start = worlds.vehicles.latency_s[0, 1]
    x = [worlds.gaps_m[0].sum(), worlds.gaps_m[0, 1], 0.0]
    v = [float(s) for s in worlds.speeds_mps[0]]
    x[0] += v[0] * start + 0.5 * command[0] * start**2  # Vehicle 1 brakes alone until the grid begins
    x[1], x[2], v[0] = x[1] + v[1] * start, x[2] + v[2] * start, v[0] + command[0] * start
    harm = [0.0, 0.0]
    for n in range(steps):
        t, w2 = start + n * step, v[2] - v[1]
        f = list(v)
        if x[1] - x[2] <= 0 and w2 > 0:
            f[1] = v[1] + m[2] * (1 + e) / (m[1] + m[2]) * w2
            f[2] = v[2] - m[1] * (1 + e) / (m[1] + m[2]) * w2
            harm[1] += w2**2
        w1 = f[1] - v[0]
        if x[0] - x[1] <= 0 and w1 > 0:
            f[1], f[0] = f[1] - m[0] * (1 + e) / (m[0] + m[1]) * w1, v[0] + m[1] * (1 + e) / (m[0] + m[1]) * w1
            harm[0] += w1**2
        for i in range(3):
            u = command[i] if worlds.vehicles.latency_s[0, i] <= t + 1e-9 else 0.0
            u = max(u, -f[i] / step)
            x[i], v[i] = x[i] + step * f[i] + step**2 / 2 * u, f[i] + step * u
    return x, v, harm


@pytest.mark.parametrize("step", [0.1, 0.03])
def test_map__equals_the_papers_equations_written_by_position(step):
    worlds, command = paper_random(60)
    after, impacts = advance_sampled(worlds, command, until_s=0.5 + 100 * step, step_s=step)
    for k in range(worlds.n):
        x, v, harm = papers_equations(worlds.take([k]), command[k], 100, step)
        assert after.gaps_m[k] == pytest.approx([x[0] - x[1], x[1] - x[2]], abs=1e-10)
        assert after.speeds_mps[k] == pytest.approx(v, abs=1e-10)
        assert impacts.total_harm[k] == pytest.approx(harm, abs=1e-9)
    assert (impacts.count.sum(axis=0) > 20).all()


def test_no_collision__equals_the_exact_advance():
    worlds, command = paper_random(200)
    worlds = replace(worlds, gaps_m=worlds.gaps_m + 40.0)
    exact, _ = advance(worlds, command, until_s=2.0)
    moving, impacts = advance_sampled(worlds, command, until_s=2.0)
    assert impacts.count.sum() == 0
    assert moving.gaps_m == pytest.approx(exact.gaps_m, abs=1e-12)
    assert moving.speeds_mps == pytest.approx(exact.speeds_mps, abs=1e-12)
    exact, _ = advance(worlds, command, until_s=8.0)
    stopped, impacts = advance_sampled(worlds, command, until_s=8.0)
    error = np.abs(stopped.gaps_m - exact.gaps_m)
    assert impacts.count.sum() == 0 and stopped.speeds_mps.tolist() == exact.speeds_mps.tolist()
    assert 0.0 < error.max() <= 7.0 * 0.1**2 / 8  # each vehicle stops at most a h^2 / 8 too far


def test_calls__can_be_chained_at_samples_and_before_them():
    worlds, command = paper_random(100, (0.25, 0.5, 0.8))
    whole, impacts = advance_sampled(worlds, command, until_s=5.0)
    state, first, count = worlds, np.zeros((100, 2)), np.zeros((100, 2), np.int64)
    for until in (0.3, 0.5, 0.7, 0.7, 1.9, 5.0):
        state, part = advance_sampled(state, command, until_s=until)
        first, count = first + part.first_impact_harm, count + part.count
    assert state.gaps_m == pytest.approx(whole.gaps_m, abs=1e-12)
    assert state.speeds_mps == pytest.approx(whole.speeds_mps, abs=1e-12)
    assert state.time_s.tolist() == whole.time_s.tolist() and state.pair_hit.tolist() == whole.pair_hit.tolist()
    assert first == pytest.approx(impacts.first_impact_harm, abs=1e-11) and count.tolist() == impacts.count.tolist()


def test_batch__a_world_has_the_same_bits_alone_and_inputs_are_left_alone():
    worlds, command = paper_random(50, np.linspace(0.0, 0.9, 150).reshape(50, 3))
    gaps = worlds.gaps_m.copy()
    together, impacts = advance_sampled(worlds, command, until_s=4.0)
    assert worlds.gaps_m.tolist() == gaps.tolist() and not worlds.pair_hit.any() and not worlds.time_s.any()
    for k in (0, 17, 49):
        alone, impacts_alone = advance_sampled(worlds.take([k]), command[[k]], until_s=4.0)
        assert alone.gaps_m[0].tobytes() == together.gaps_m[k].tobytes()
        assert alone.speeds_mps[0].tobytes() == together.speeds_mps[k].tobytes()
        assert impacts_alone.total_harm[0].tobytes() == impacts.total_harm[k].tobytes()


def test_limit__first_impact_harm_approaches_the_exact_one_with_order_one():
    worlds = load_scenario("paper-random").sample(300, 7).worlds
    command = -worlds.vehicles.braking_capacity_mps2
    exact = world_harm(advance(worlds, command, until_s=8.0)[1], "first")
    steps = np.array([0.1, 0.02, 0.005, 0.001])
    error = []
    for step in steps:
        impacts = advance_sampled(worlds, command, until_s=8.0, step_s=step)[1]
        error.append(np.abs(world_harm(impacts, "first") - exact).mean())
    order = np.polyfit(np.log(steps), np.log(error), 1)[0]
    assert 0.85 < order < 1.15
    assert error[-1] < 0.01 * exact.mean()
