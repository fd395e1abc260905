"""Observations: every feature by name against hand-computed values."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import ObservationSpec, observe
from ethbrake_marl.physics import advance, make_worlds
from ethbrake_marl.scenario import load_scenario, observation_for

SPEC = ObservationSpec(front=2, rear=1)


def worlds():
    start = make_worlds(
        [[8.0, 6.0, 10.0]],
        [[20.0, 18.0, 22.0, 10.0]],
        braking_capacity_mps2=[6.0, 7.0, 5.0, 8.0],
        driving_capacity_mps2=[1.0, 2.0, 3.0, 4.0],
        latency_s=[0.0, 0.5, 0.25, 1.0],
        mass_t=[4.5, 5.5, 5.9, 7.0],
        restitution=0.1,
    )
    return advance(start, [-6.0, 0.0, -5.0, 0.0], until_s=0.5)[0]


def by_name(vehicle, spec=SPEC):
    return dict(zip([f.name for f in spec.features], observe(worlds(), vehicle, spec)[0].tolist(), strict=True))


def test_observe__own_features():
    seen = by_name(2)
    assert seen["own.speed"] == pytest.approx((22 - 5 * 0.25) / 20)
    assert seen["own.acceleration"] == pytest.approx(-0.5)
    assert seen["own.braking_capacity"] == pytest.approx(0.5)
    assert seen["own.driving_capacity"] == pytest.approx(0.3)
    assert seen["own.mass"] == pytest.approx(0.59)
    assert seen["own.latency_left"] == 0.0
    assert seen["own.restitution"] == pytest.approx(0.1)


def test_observe__front_and_rear_neighbours():
    seen = by_name(2)
    v1, v2, v3, v4 = 17.0, 18.0, 22.0 - 1.25, 10.0
    x1, x3 = 20 * 0.5 - 6 * 0.125, 22 * 0.5 - 5 * 0.25**2 / 2
    gap1, gap2, gap3 = 8 + x1 - 9, 6 + 9 - x3, 10 + x3 - 5
    assert seen["front_1.known"] == seen["front_2.known"] == seen["rear_1.known"] == 1.0
    assert seen["front_1.gap"] == pytest.approx(gap2 / 10, rel=1e-6)
    assert seen["front_2.gap"] == pytest.approx((gap1 + gap2) / 10, rel=1e-6)
    assert seen["rear_1.gap"] == pytest.approx(gap3 / 10, rel=1e-6)
    assert seen["front_1.closing_speed"] == pytest.approx((v3 - v2) / 10, rel=1e-6)
    assert seen["front_2.closing_speed"] == pytest.approx((v3 - v1) / 10, rel=1e-6)
    assert seen["rear_1.closing_speed"] == pytest.approx((v4 - v3) / 10, rel=1e-6)
    assert seen["front_2.acceleration"] == pytest.approx(-0.6)
    assert seen["front_1.braking_capacity"] == pytest.approx(0.7)
    assert seen["rear_1.mass"] == pytest.approx(0.7)
    assert seen["rear_1.latency_left"] == pytest.approx(0.5)
    assert seen["front_1.hit"] == seen["rear_1.hit"] == 0.0
    own, front, rear = v3**2 / 10, v1**2 / 12, v4 * 0.5 + v4**2 / 16
    assert seen["front_2.stopping_margin"] == pytest.approx((gap1 + gap2 + front - own) / 10, rel=1e-5)
    assert seen["rear_1.stopping_margin"] == pytest.approx((gap3 + own - rear) / 10, rel=1e-5)
    assert seen["front_2.fitting_deceleration"] == pytest.approx(v3**2 / (2 * (gap1 + gap2 + front)) / 10, rel=1e-5)
    assert seen["rear_1.fitting_deceleration"] == 2.0  # no deceleration of its own lets the rear one touch: clipped


def test_observe__what_is_not_known_or_not_there_reads_zero():
    uninformed = by_name(3)
    assert all(value == 0.0 for name, value in uninformed.items() if not name.startswith("own."))
    first = by_name(0)
    assert all(value == 0.0 for name, value in first.items() if name.startswith("front_"))
    assert first["rear_1.known"] == 1.0


def test_observe__hit_flag_belongs_to_the_pair_on_that_side():
    struck, _ = advance(worlds(), [-6.0, 0.0, -5.0, 0.0], until_s=2.0)
    assert struck.pair_hit.tolist() == [[True, False, False]]
    names = [f.name for f in SPEC.features]
    second, third = (dict(zip(names, observe(struck, i, SPEC)[0], strict=True)) for i in (1, 2))
    assert (second["front_1.hit"], second["rear_1.hit"]) == (1.0, 0.0)
    assert (third["front_1.hit"], third["front_2.hit"], third["rear_1.hit"]) == (0.0, 0.0, 0.0)


def test_observe__is_clipped_to_the_stated_bounds():
    far = make_worlds([1e6], [1.0, 1e4], braking_capacity_mps2=100.0, driving_capacity_mps2=100.0, latency_s=0.0,
                      mass_t=1e5, restitution=1.0, speed_limit_mps=1e5)  # fmt: skip
    seen = observe(far, 1, SPEC)[0]
    low = np.array([f.low for f in SPEC.features], np.float32)
    high = np.array([f.high for f in SPEC.features], np.float32)
    assert (seen >= low).all() and (seen <= high).all() and (seen == high).sum() >= 5


def test_spec__names_are_unique_and_size_fits():
    names = [f.name for f in SPEC.features]
    assert len(set(names)) == len(names) == SPEC.size


@pytest.mark.parametrize(("speed", "reads"), [(0.0, 0.0), (0.1, 0.5), (0.2, 2.0), (20.0, 2.0)])
def test_observe__without_room_the_fitting_deceleration_is_that_of_one_millimetre(speed, reads):
    # v^2 / (2 * 0.001 m) = 500 v^2 m/s2, scale 10 and clipped at 2: 0.1 m/s reads 5 / 10.
    touching = make_worlds([0.0], [0.0, speed], braking_capacity_mps2=6, driving_capacity_mps2=1, latency_s=0, mass_t=1,
                           restitution=0)  # fmt: skip
    names = [f.name for f in ObservationSpec(1, 0).features]
    seen = dict(zip(names, observe(touching, 1, ObservationSpec(1, 0))[0].tolist(), strict=True))
    assert seen["front_1.fitting_deceleration"] == pytest.approx(reads, rel=1e-6)


@pytest.mark.parametrize("front", [1.5, True, "a", 65, None])
def test_spec__refuses_what_is_not_a_number_of_neighbours(front):
    with pytest.raises(InvalidInput, match=r"front = .*must be a whole number"):
        ObservationSpec(front, 0)


@pytest.mark.parametrize("call", [lambda: ObservationSpec(front=-1), lambda: observe(worlds(), 4, SPEC)])
def test_bad_input__is_refused(call):
    with pytest.raises(InvalidInput):
        call()


def test_observation_for__adds_place_and_obstacle_only_where_there_is_one():
    assert observation_for(load_scenario("paper-random")) == ObservationSpec(1, 1)
    spec = observation_for(load_scenario("cooperation-4-all"))
    assert spec == ObservationSpec(1, 1, role=True, obstacle=True)
    assert [f.name for f in spec.features][: ObservationSpec().size] == [f.name for f in ObservationSpec().features]
    assert [f.name for f in spec.features][ObservationSpec().size :] == [
        "role.vehicles_ahead", "role.vehicles_behind", "obstacle.known", "obstacle.gap", "obstacle.hit",
        "obstacle.stopping_margin", "obstacle.fitting_deceleration",
    ]  # fmt: skip
    assert spec.size == len(spec.features) == 34


def test_observe__place_and_obstacle_by_hand():
    spec = ObservationSpec(0, 0, role=True, obstacle=True)
    start = make_worlds(
        [[8.0, 6.0, 10.0]], [[20.0, 18.0, 22.0, 10.0]], braking_capacity_mps2=8.0, driving_capacity_mps2=1.0,
        latency_s=[0.0, 0.5, 1.0, 1.0], mass_t=1.0, restitution=0.1, obstacle_gap_m=42.0,
    )  # fmt: skip
    names = [f.name for f in spec.features]
    now = [dict(zip(names, observe(start, i, spec)[0].tolist(), strict=True)) for i in (0, 1)]
    assert now[0]["obstacle.known"] == 1.0 and now[0]["obstacle.gap"] == pytest.approx(4.2)
    assert now[0]["obstacle.stopping_margin"] == pytest.approx((42.0 - 400 / 16) / 10)
    assert now[0]["obstacle.fitting_deceleration"] == pytest.approx(400 / 84 / 10)
    assert [now[1][name] for name in names[-5:]] == [0.0] * 5
    later = advance(start, 0.0, until_s=1.0)[0]
    seen = [dict(zip(names, observe(later, i, spec)[0].tolist(), strict=True)) for i in range(4)]
    assert [s["role.vehicles_ahead"] for s in seen] == [0.0, 1.0, 2.0, 2.0]
    assert [s["role.vehicles_behind"] for s in seen] == [2.0, 2.0, 1.0, 0.0]
    # all have coasted for 1 s: Vehicle 3 was 8 + 6 m behind Vehicle 1 and drove 22 m, Vehicle 1 has 22 m left
    assert seen[0]["obstacle.gap"] == pytest.approx(2.2) and seen[2]["obstacle.gap"] == pytest.approx(
        (42 + 14 - 22) / 10
    )
    assert (
        seen[2]["obstacle.stopping_margin"] == pytest.approx((34 - 22**2 / 16) / 10) and seen[2]["obstacle.hit"] == 0.0
    )
    struck = advance(start, 0.0, until_s=2.2)[0]
    assert observe(struck, 3, spec)[0, -3] == 1.0
    nothing_ahead = observe(worlds(), 0, spec)[0]
    assert nothing_ahead[-5:].tolist() == [0.0] * 5


def test_observation_spec__what_follows_is_true_or_false():
    with pytest.raises(InvalidInput, match="observation: obstacle = 1; must be True or False"):
        ObservationSpec(obstacle=1)
