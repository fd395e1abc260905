"""Observations: every feature by name against hand-computed values."""

from __future__ import annotations

import numpy as np
import pytest

from ethbrake_marl.observations import ObservationSpec, observe
from ethbrake_marl.physics import Worlds, advance, make_worlds
from ethbrake_marl.scenario import load_scenario, observation_for

near = pytest.approx
SPEC = ObservationSpec(front=2, rear=1)
START = make_worlds(
    [[8.0, 6.0, 10.0]],
    [[20.0, 18.0, 22.0, 10.0]],
    braking_capacity_mps2=[6.0, 7.0, 5.0, 8.0],
    driving_capacity_mps2=[1.0, 2.0, 3.0, 4.0],
    latency_s=[0.0, 0.5, 0.25, 1.0],
    mass_t=[4.5, 5.5, 5.9, 7.0],
    restitution=0.1,
)
COMMAND = [-6.0, 0.0, -5.0, 0.0]
WORLDS = advance(START, COMMAND, until_s=0.5)[0]


def by_name(vehicle: int, worlds: Worlds = WORLDS, spec: ObservationSpec = SPEC) -> dict[str, float]:
    return dict(zip([f.name for f in spec.features], observe(worlds, vehicle, spec)[0].tolist(), strict=True))


def test_observe__own_features_and_neighbours_by_hand() -> None:
    v1, v2, v3, v4 = 17.0, 18.0, 22.0 - 1.25, 10.0
    x1, x3 = 20 * 0.5 - 6 * 0.125, 22 * 0.5 - 5 * 0.25**2 / 2
    gap1, gap2, gap3 = 8 + x1 - 9, 6 + 9 - x3, 10 + x3 - 5
    own, front, rear = v3**2 / 10, v1**2 / 12, v4 * 0.5 + v4**2 / 16
    expected = {
        "own.speed": v3 / 20,
        "own.acceleration": -0.5,
        "own.braking_capacity": 0.5,
        "own.driving_capacity": 0.3,
        "own.mass": 0.59,
        "own.latency_left": 0.0,
        "own.restitution": 0.1,
        **{f"{neighbour}.known": 1.0 for neighbour in ("front_1", "front_2", "rear_1")},
        "front_1.gap": gap2 / 10,
        "front_2.gap": (gap1 + gap2) / 10,
        "rear_1.gap": gap3 / 10,
        "front_1.closing_speed": (v3 - v2) / 10,
        "front_2.closing_speed": (v3 - v1) / 10,
        "rear_1.closing_speed": (v4 - v3) / 10,
        "front_2.acceleration": -0.6,
        "front_1.braking_capacity": 0.7,
        "rear_1.mass": 0.7,
        "rear_1.latency_left": 0.5,
        "front_1.hit": 0.0,
        "rear_1.hit": 0.0,
        "front_2.stopping_margin": (gap1 + gap2 + front - own) / 10,
        "rear_1.stopping_margin": (gap3 + own - rear) / 10,
        "front_2.fitting_deceleration": v3**2 / (2 * (gap1 + gap2 + front)) / 10,
        "rear_1.fitting_deceleration": 2.0,  # no deceleration of its own lets the rear one touch: clipped
    }
    seen = by_name(2)
    assert {name: seen[name] for name in expected} == near(expected, rel=1e-5)
    assert len(seen) == SPEC.size


def test_observe__what_is_not_known_or_not_there_reads_zero() -> None:
    uninformed, first = by_name(3), by_name(0)
    assert {value for name, value in uninformed.items() if not name.startswith("own.")} == {0.0}
    assert {value for name, value in first.items() if name.startswith("front_")} == {0.0}
    assert first["rear_1.known"] == 1.0


def test_observe__hit_flag_belongs_to_the_pair_on_that_side() -> None:
    struck, _ = advance(WORLDS, COMMAND, until_s=2.0)
    assert struck.pair_hit.tolist() == [[True, False, False]]
    hits = [[value for name, value in by_name(i, struck).items() if name.endswith(".hit")] for i in (1, 2)]
    assert hits == [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]  # of front_1, front_2 and rear_1


def test_observe__is_clipped_to_the_stated_bounds() -> None:
    far = make_worlds([1e6], [1.0, 1e4], braking_capacity_mps2=100.0, driving_capacity_mps2=100.0, latency_s=0.0,
                      mass_t=1e5, restitution=1.0, speed_limit_mps=1e5)  # fmt: skip
    seen = observe(far, 1, SPEC)[0]
    low, high = (np.array([getattr(f, side) for f in SPEC.features], np.float32) for side in ("low", "high"))
    assert (seen >= low).all() and (seen <= high).all() and (seen == high).sum() >= 5


@pytest.mark.parametrize(("speed", "reads"), [(0.0, 0.0), (0.1, 0.5), (0.2, 2.0), (20.0, 2.0)])
def test_observe__without_room_the_fitting_deceleration_is_that_of_one_millimetre(speed: float, reads: float) -> None:
    # v^2 / (2 * 0.001 m) = 500 v^2 m/s2, scale 10 and clipped at 2: 0.1 m/s reads 5 / 10.
    touching = make_worlds([0.0], [0.0, speed], braking_capacity_mps2=6, driving_capacity_mps2=1, latency_s=0, mass_t=1,
                           restitution=0)  # fmt: skip
    assert by_name(1, touching, ObservationSpec(1, 0))["front_1.fitting_deceleration"] == near(reads, rel=1e-6)


def test_observation_for__adds_place_and_obstacle_only_where_there_is_one() -> None:
    assert observation_for(load_scenario("paper-random")) == ObservationSpec(1, 1)
    spec = observation_for(load_scenario("cooperation-4-all"))
    assert spec == ObservationSpec(1, 1, role=True, obstacle=True)
    assert [f.name for f in spec.features] == [f.name for f in ObservationSpec().features] + [
        "role.vehicles_ahead", "role.vehicles_behind", "obstacle.known", "obstacle.gap", "obstacle.hit",
        "obstacle.stopping_margin", "obstacle.fitting_deceleration",
    ]  # fmt: skip
    assert spec.size == len({f.name for f in spec.features}) == 34


def test_observe__place_and_obstacle_by_hand() -> None:
    spec = ObservationSpec(0, 0, role=True, obstacle=True)
    start = make_worlds(
        [[8.0, 6.0, 10.0]], [[20.0, 18.0, 22.0, 10.0]], braking_capacity_mps2=8.0, driving_capacity_mps2=1.0,
        latency_s=[0.0, 0.5, 1.0, 1.0], mass_t=1.0, restitution=0.1, obstacle_gap_m=42.0,
    )  # fmt: skip
    names = ("known", "gap", "hit", "stopping_margin", "fitting_deceleration")
    later, struck = (advance(start, 0.0, until_s=time)[0] for time in (1.0, 2.2))

    def obstacle(vehicle: int, worlds: Worlds) -> list[float]:
        seen = by_name(vehicle, worlds, spec)
        return [seen[f"obstacle.{name}"] for name in names]

    assert obstacle(0, start) == near([1.0, 4.2, 0.0, (42.0 - 400 / 16) / 10, 400 / 84 / 10])
    assert obstacle(1, start) == obstacle(0, WORLDS) == [0.0] * 5  # not known yet; nothing ahead
    seen = [by_name(i, later, spec) for i in range(4)]
    assert [s["role.vehicles_ahead"] for s in seen] == [0.0, 1.0, 2.0, 2.0]
    assert [s["role.vehicles_behind"] for s in seen] == [2.0, 2.0, 1.0, 0.0]
    # all have coasted for 1 s: Vehicle 3 was 8 + 6 m behind Vehicle 1 and drove 22 m, Vehicle 1 has 22 m left
    assert obstacle(0, later)[1] == near(2.2)
    assert obstacle(2, later)[1:4] == near([(42 + 14 - 22) / 10, 0.0, (34 - 22**2 / 16) / 10])
    assert obstacle(3, struck)[2] == 1.0
