"""Brakes that build up: by hand, against small steps of time, and that everybody who plays on sees the same brakes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.motion import stopping_distances
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds, make_worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from tests.first_edition.physics.random_worlds import Draws, line
from tests.reference.small_steps import run

SWITCHES_S = (0.0, 0.75, 1.5, 6.0)


def random_lines(key: int, n: int, N: int, *, obstacle: bool = False) -> tuple[dict[str, Floats], list[Floats]]:
    """Lines of unlike vehicles, every fifth rate infinite, and their commands between the switches, [n, N] each."""
    draws = Draws(key)

    def rates() -> Floats:
        fifth = draws.uniform(0.0, 1.0, (n, N)) < 0.2
        return np.where(fifth, np.inf, np.exp(draws.uniform(0.5, 4.5, (n, N))))

    given = {
        "gaps_m": draws.uniform(0.5, 15.0, (n, N - 1)),
        "speeds_mps": draws.uniform(2.0, 25.0, (n, N)),
        "braking_capacity_mps2": draws.uniform(3.0, 9.0, (n, N)),
        "driving_capacity_mps2": draws.uniform(1.0, 5.0, (n, N)),
        "latency_s": np.maximum(draws.uniform(-0.3, 1.0, (n, N)), 0.0),
        "mass_t": np.exp(draws.uniform(0.0, 3.0, (n, N))),
        "restitution": draws.uniform(0.0, 0.6, (n,)),
        "speed_limit_mps": draws.choice([26.0, 40.0], (n, N)),
        "brake_rate_mps3": rates(),
        "release_rate_mps3": rates(),
    }
    if obstacle:
        given["obstacle_gap_m"] = draws.uniform(5.0, 80.0, (n,))
    low, high = -given["braking_capacity_mps2"], given["driving_capacity_mps2"]
    shares = [draws.uniform(-1.0, 1.0, (n, N)) for _ in SWITCHES_S[1:]]
    shares[-1] = np.where(draws.uniform(0.0, 1.0, (n, N)) < 0.6, -1.0, shares[-1])
    return given, [np.where(share < 0.0, -share * low, share * high) for share in shares]


def played(worlds: Worlds, commands: list[Floats]) -> tuple[Worlds, Floats, Ints]:
    """The worlds at the last switch, the total harm of each pair (an obstacle's first), and the number of impacts."""
    harm, count = np.zeros(worlds.gaps_m.shape), np.zeros(worlds.n, np.int64)
    ahead = np.zeros((worlds.n, 1))
    for command, until in zip(commands, SWITCHES_S[1:], strict=True):
        worlds, impacts = advance(worlds, command, until_s=until)
        harm += impacts.total_harm
        ahead[:, 0] += impacts.obstacle_total_harm
        count += impacts.count.sum(axis=1) + impacts.obstacle_count
    return worlds, np.concatenate([ahead, harm], axis=1) if worlds.obstacle_ahead.any() else harm, count


Pieces = dict[int, list[tuple[float, float]]]  # by vehicle: s after its latency, m/s2 of braking


def random_pieces(key: int, given: dict[str, Floats]) -> Pieces:
    """Pieces of the front vehicle, and of others; where it has no latency its second one begins at a switch."""
    draws, pieces = Draws(1_000 + key), {}
    for i, most in enumerate(given["braking_capacity_mps2"].min(axis=0)):
        steps = np.round(draws.uniform(0.05, 1.2, (4,)), 3)
        times = np.cumsum([0.0, 0.75 if i == 0 else steps[0], *steps[1:]])[: draws.choice([2, 3, 5], (1,))[0]]
        if i != 1:
            pieces[i] = list(zip(times.tolist(), (most * draws.uniform(0.0, 1.0, times.shape)).tolist(), strict=True))
    return pieces


def by_small_steps(
    given: dict[str, Floats],
    commands: list[Floats],
    step_s: float,
    pieces: Pieces,
    switches_s: Sequence[float] = SWITCHES_S,
) -> tuple[Floats, ...]:
    """Gaps, speeds, forces, total and first-impact harm of each pair after the same commands, and pieces."""
    ahead = "obstacle_gap_m" in given
    found: list[tuple[Floats, ...]] = []
    for k in range(len(given["speeds_mps"])):
        row = {key: value[k] for key, value in given.items() if key != "restitution"}

        def front(key: str, value: float, row: dict[str, Floats] = row) -> Floats:
            return np.concatenate([[value], row[key]]) if ahead else row[key].copy()

        gap, speed = front("gaps_m", 0.0), front("speeds_mps", 0.0)
        if ahead:
            gap[0] = row["obstacle_gap_m"]
        force, first, total = np.zeros(len(speed)), -np.ones(len(gap)), np.zeros(len(gap))
        begins = (row["latency_s"][i] + time for i, each in pieces.items() for time, _ in each)
        for start, until in pairwise(sorted({*switches_s, *(time for time in begins if time < switches_s[-1])})):
            command = commands[sum(start >= switch for switch in switches_s) - 1][k].copy()
            for i, each in pieces.items():
                command[i] = -[braking for time, braking in each if time == 0.0 or row["latency_s"][i] + time <= start][
                    -1
                ]
            wanted = np.concatenate([[0.0], command]) if ahead else command
            run(
                gap, speed, force, wanted, front("latency_s", 0.0), front("mass_t", math.inf),
                front("speed_limit_mps", 0.0), front("brake_rate_mps3", math.inf), front("release_rate_mps3", math.inf),
                float(given["restitution"][k]), start, until, step_s, first, total,
            )  # fmt: skip
        first = np.maximum(first, 0.0)
        found.append((gap[1:] if ahead else gap, speed[int(ahead) :], force[int(ahead) :], total, first))
    return tuple(np.array(each) for each in zip(*found, strict=True))


# ---------------------------------------------------------------- by hand


@pytest.mark.parametrize(
    ("speed", "capacity", "rate", "distance"),
    [
        (20.0, 7.0, 12.65, 34.01572),  # PHYSICS: the ramp takes 0.55336 s
        (1.0, 7.0, 12.65, 0.26508),  # stands before its brakes are full
        (20.0, 7.0, math.inf, 28.57143),
    ],
)
def test_stopping_distance__is_that_of_the_formula_and_of_the_motion(
    speed: float, capacity: float, rate: float, distance: float
) -> None:
    worlds = line([9.0], [speed, 0.0], braking_capacity_mps2=capacity, brake_rate_mps3=rate, obstacle_gap_m=100.0)
    after, _ = advance(worlds, [[-capacity, 0.0]], 60.0)
    assert 100.0 - after.obstacle_gap_m[0] == pytest.approx(distance, abs=5e-6)
    told = stopping_distances(*(np.array([each]) for each in (speed, 0.0, capacity, rate)))
    assert told[0] == pytest.approx(100.0 - after.obstacle_gap_m[0], rel=1e-12)


# force after 1 s, speed after 1 s, from 10 m/s and the command -4; the latency is 0.5 s in the last two
@pytest.mark.parametrize(
    ("settings", "force", "speed"),
    [
        ({"brake_rate_mps3": 8.0}, -4.0, 10.0 - 1.0 - 2.0),  # 0.5 s of build-up, 0.5 s of full braking
        ({"brake_rate_mps3": 2.0}, -2.0, 10.0 - 1.0),
        ({"release_rate_mps3": 2.0}, -4.0, 10.0 - 4.0),
        ({"brake_rate_mps3": 8.0, "latency_s": 0.5}, -4.0, 10.0 - 1.0),
        ({"brake_rate_mps3": 8.0, "latency_s": 1.0}, 0.0, 10.0),
    ],
)
def test_force__builds_up_from_the_latency_on(settings: dict[str, Any], force: float, speed: float) -> None:
    after, _ = advance(line([50.0], [10.0, 10.0], **settings), [[-4.0, -4.0]], 1.0)
    assert after.command_mps2.tolist() == [[force, force]]
    assert after.speeds_mps.tolist() == [[speed, speed]] and after.gaps_m.tolist() == [[50.0]]


@pytest.mark.parametrize("rear", [25.9, 25.91])  # the second comes so near that every event is looked for
def test_speed_limit__is_met_while_the_drive_builds_up(rear: float) -> None:
    worlds = line([0.001], [25.9, rear], release_rate_mps3=4.0, speed_limit_mps=26.0)
    after, impacts = advance(worlds, [[2.0, 0.0]], 1.0)  # at 26 m/s after sqrt(0.05) s, before the 2 m/s2 are there
    assert after.speeds_mps.tolist() == [[26.0, rear]] and impacts.count.sum() == 0


def test_rates_too_high_to_matter__leave_the_motion_as_it_is() -> None:
    given, commands = random_lines(5, 40, 3)
    at_once = make_worlds(**given | {"brake_rate_mps3": np.inf, "release_rate_mps3": np.inf})
    nearly = make_worlds(**given | {"brake_rate_mps3": 1e9, "release_rate_mps3": 1e9})
    (one, harm, _), (other, same, _) = played(at_once, commands), played(nearly, commands)
    np.testing.assert_allclose(other.speeds_mps, one.speeds_mps, atol=1e-5)
    np.testing.assert_allclose(same, harm, rtol=1e-5, atol=1e-5)


def test_command__that_never_acted_leaves_no_force_behind() -> None:
    """Vehicle 3 asks for full drive up to its latency of 0.8 s, and brakes from then on: it never drives."""
    worlds = line([100.0, 100.0], [20.0] * 3, latency_s=[0.0, 0.5, 0.8], brake_rate_mps3=12.65)
    for step, until in enumerate([0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2]):
        worlds, _ = advance(worlds, [[-4.0, -4.0, 4.0 if 1 <= step <= 3 else -6.0]], until_s=until)
        assert worlds.command_mps2[0, 2] == 0.0 or until > 0.8
    assert worlds.speeds_mps[0, 2] == pytest.approx(20.0 - 12.65 * 0.4**2 / 2, abs=1e-12)


@pytest.mark.parametrize("N", [3, 5])
def test_bodies__that_touch_with_one_force_and_rate_are_not_parted_by_rounding(N: int) -> None:
    """Without restitution nobody is struck a second time; a rounding error of the speeds moves no harm."""
    draws, n = Draws(5), 500
    gaps, speeds = draws.uniform(0.2, 2.0, (n, N - 1)), draws.uniform(15.0, 25.0, (n, N))
    gaps[:, 0], speeds[:, 0] = draws.uniform(8.0, 14.0, (n,)), 0.0
    given = {
        "mass_t": draws.uniform(1.0, 10.0, (n, N)), "latency_s": [0.0] + [0.3] * (N - 1), "restitution": 0.0,
        "braking_capacity_mps2": 9.0, "driving_capacity_mps2": 3.0, "brake_rate_mps3": 12.65,
        "release_rate_mps3": 12.65,
    }  # fmt: skip

    def total_harm(share: float) -> Floats:
        worlds = make_worlds(gaps, speeds * share, **given)
        _, impacts = advance(worlds, np.full((n, N), -9.0), until_s=30.0)
        np.testing.assert_array_equal(impacts.total_harm, impacts.first_impact_harm)
        return impacts.total_harm.sum(axis=1)

    harm = total_harm(1.0)
    assert harm.mean() > 100.0
    for share in (1.0 + 1e-12, 1.0 - 1e-12):
        np.testing.assert_allclose(total_harm(share), harm, rtol=0.0, atol=1e-6)


# ---------------------------------------------------------------- against small steps


@pytest.mark.parametrize(
    ("key", "N", "obstacle", "rates", "in_pieces"),
    [
        (1, 2, False, True, False),
        (2, 3, True, True, False),
        (3, 5, False, True, False),
        (4, 2, True, True, True),
        (5, 4, False, True, True),
        (6, 3, False, False, True),
        (7, 3, True, False, True),
    ],
)
def test_motion__is_that_of_small_steps(key: int, N: int, obstacle: bool, rates: bool, in_pieces: bool) -> None:
    given, commands = random_lines(key, 12, N, obstacle=obstacle)
    given["latency_s"] = np.round(given["latency_s"], 3) if in_pieces else given["latency_s"]
    pieces = random_pieces(key, given) if in_pieces else {}
    given |= {} if rates else dict.fromkeys(("brake_rate_mps3", "release_rate_mps3"), np.full((12, N), np.inf))
    worlds, harm, _ = played(make_worlds(**given).play_pieces(pieces), commands)
    gaps, speeds, forces, total, _ = by_small_steps(given, commands, 1e-4, pieces)
    assert (harm.sum(axis=1) > 1.0).sum() > 4
    np.testing.assert_allclose(forces, worlds.command_mps2, atol=1e-9)
    # a step too late changes a speed by 1e-3; where one cascade of bounces falls otherwise, a world is far off
    near = (np.abs(gaps - worlds.gaps_m) < 0.05).all(axis=1) & (np.abs(speeds - worlds.speeds_mps) < 0.02).all(axis=1)
    near &= np.abs(total - harm).max(axis=1) < 2e-3 * (1.0 + harm.max(axis=1))
    assert near.sum() >= 11


def test_world__has_the_same_bits_in_any_batch_and_split_the_same_motion() -> None:
    given, commands = random_lines(9, 30, 4, obstacle=True)
    worlds = make_worlds(**given)
    whole, harm, _ = played(worlds, commands)
    for k in (0, 7, 29):
        alone, own, _ = played(worlds.take([k]), [each[[k]] for each in commands])
        assert alone.gaps_m.tobytes() == whole.gaps_m[[k]].tobytes() and own.tobytes() == harm[[k]].tobytes()
    half = [advance(advance(worlds, commands[0], until_s=0.3)[0], commands[0], until_s=0.75)[0]]
    straight, _ = advance(worlds, commands[0], until_s=0.75)
    np.testing.assert_allclose(half[0].speeds_mps, straight.speeds_mps, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(half[0].command_mps2, straight.command_mps2, rtol=0.0, atol=1e-12)


# ---------------------------------------------------------------- who plays on


@pytest.fixture(scope="module")
def slow() -> Scenario:
    """Paper-random, whose brakes build up."""
    return load_scenario("paper-random").replace(brake_rate_mps3=12.65, release_rate_mps3=25)


def test_shield__executes_what_it_foresees(slow: Scenario) -> None:
    names = ("full_brake", "e_v2x_bm", "constant:2+step")
    agents = {name: eb.make_agent(name, scenario=slow) for name in names}
    result = eb.evaluate(slow.sample(40, seed=7), agents, scenario=slow)
    harm = {name: result.outcome(name).first_impact_harm for name in names}
    np.testing.assert_allclose(result.outcome("e_v2x_bm").predicted_harm, harm["e_v2x_bm"], rtol=1e-9, atol=1e-9)
    assert harm["e_v2x_bm"].mean() < harm["full_brake"].mean()
    assert (harm["constant:2+step"] <= harm["e_v2x_bm"] + 1e-9).all()  # its bound
    assert (harm["constant:2+step"] != harm["e_v2x_bm"]).any()


@pytest.mark.parametrize("key", ["brake_rate_mps3", "release_rate_mps3"])
def test_shield__of_several_learners_with_one_finite_rate_certifies_every_step(key: str) -> None:
    env = eb.shield(eb.parallel_env(scenario=load_scenario("cooperation-3-pair").replace(**{key: 12.65})))
    draws = Draws(0)
    for seed in range(15):
        env.reset(seed=seed)  # at 0.5 s; the latency of Vehicle 3 elapses at 0.8 s, a decision
        while env.agents:
            env.step({f"vehicle_{i}": draws.uniform(-1.0, 1.0, (1,)).astype(np.float32) for i in (2, 3)})


def test_release__has_its_own_rate_and_passes_zero_without_a_stop() -> None:
    worlds = line([50.0], [10.0, 10.0], brake_rate_mps3=8.0, release_rate_mps3=4.0)
    braking, _ = advance(worlds, [[-4.0, -4.0]], 1.0)
    driving, _ = advance(braking, [[2.0, 2.0]], 1.5)  # from -4 to 2 at 4 m/s3 takes 1.5 s
    assert driving.command_mps2.tolist() == [[2.0, 2.0]]
    assert driving.speeds_mps[0].tolist() == pytest.approx([7.0 - 4.0 * 1.5 + 0.5 * 4.0 * 1.5**2] * 2, rel=1e-15)


def test_standing_vehicle__moves_when_its_force_passes_zero() -> None:
    worlds = line([50.0], [0.0, 1.0], brake_rate_mps3=8.0, release_rate_mps3=4.0)
    held, _ = advance(worlds, [[-4.0, -4.0]], 1.0)  # the brakes of a standing vehicle build up too
    assert held.command_mps2.tolist() == [[-4.0, -4.0]]
    assert held.speeds_mps.tolist() == [[0.0, 0.0]]
    drives, _ = advance(held, [[2.0, -4.0]], 2.0)  # 1 s to release, then 0.5 s to 2 m/s2, then 0.5 s of it
    assert drives.speeds_mps[0].tolist() == pytest.approx([0.5 + 1.0, 0.0], rel=1e-15)


def test_pushed_vehicle__is_let_go_when_its_front_one_would_be_faster() -> None:
    # Both touch at rest; the rear one pushes at once, the front one more and more; they part at equal forces.
    worlds = line([0.0], [0.0, 0.0], release_rate_mps3=[4.0, math.inf])
    after, impacts = advance(worlds, [[4.0, 2.0]], 1.0)
    apart = 0.5 + 4.0 * 0.5**3 / 6.0  # from 0.5 s on the front one has 4 t, the rear one 2; both had the mean before
    together = 0.5 * 2.0 * 0.5 + 0.25 * 4.0 * 0.5**2
    assert impacts.count.sum() == 0
    assert after.gaps_m[0, 0] == pytest.approx(4.0 * 0.5**3 / 6.0, rel=1e-9)
    assert apart > 0.5
    assert after.speeds_mps[0].tolist() == pytest.approx([together + 1.5, together + 1.0], rel=1e-9)


def test_equal_vehicles__keep_their_gap_at_any_rate() -> None:
    worlds = line([[3.0], [0.5]], [[20.0, 20.0]] * 2, brake_rate_mps3=[[12.65] * 2, [0.5] * 2])
    after, _ = advance(worlds, -worlds.vehicles.braking_capacity_mps2, 60.0)
    assert after.gaps_m.tolist() == worlds.gaps_m.tolist()
    assert not after.speeds_mps.any()
