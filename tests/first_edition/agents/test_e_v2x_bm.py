"""E-V2X-BM: its closed form by hand and against the physics, and the coupled search that is no worse than a grid."""

import hashlib
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.e_v2x_bm import coupled
from ethbrake_marl.first_edition.agents.e_v2x_bm.constants import (
    Line,
    make_line,
    share_start,
    simulate,
    will_stay_apart,
)
from ethbrake_marl.first_edition.agents.e_v2x_bm.contacts import (
    closing_speed_squared,
    least_to_spare_front,
    most_to_spare_rear,
)
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import CoupledOptimum, optimise_coupled
from ethbrake_marl.first_edition.agents.e_v2x_bm.pairwise import optimise_pairwise, pairwise_harm
from ethbrake_marl.first_edition.agents.e_v2x_bm.samples import Samples
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.forecast import forecast
from ethbrake_marl.first_edition.physics.jit import compiled
from ethbrake_marl.first_edition.physics.left_out import Impacts
from ethbrake_marl.first_edition.physics.rows import FLAG, ROW
from ethbrake_marl.first_edition.physics.state import Floats, Worlds, make_worlds
from tests.first_edition.agents.test_drive import PAIR

PAPER = eb.load_scenario("paper-random")


def wide_worlds(n: int, vehicles: int, seed: int, *, exact_zeros: bool = False) -> Worlds:
    """Lines far beyond the paper's ranges."""
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(0, 60, (n, vehicles - 1)) * rng.choice([0.05, 0.3, 1.0], (n, 1))
    speeds = rng.uniform(0, 35, (n, vehicles))
    latency = rng.uniform(0, 2.5, (n, vehicles))
    if exact_zeros:
        for part in (gaps, speeds, latency):
            part[rng.random(part.shape) < 0.1] = 0.0
    return make_worlds(
        gaps,
        speeds,
        braking_capacity_mps2=rng.uniform(1, 10, (n, vehicles)),
        driving_capacity_mps2=3,
        latency_s=latency,
        mass_t=5,
        restitution=0.1,
    )


def harm_of_pairs(worlds: Worlds, vehicle: int, deceleration: Floats) -> tuple[Floats, Floats]:
    """Harm of the front and of the rear pair of ``vehicle``, zero where there is none."""
    everyone = worlds.vehicles.braking_capacity_mps2.copy()
    everyone[:, vehicle] = deceleration
    padded = np.pad(pairwise_harm(worlds, everyone), ((0, 0), (1, 1)))
    return padded[:, vehicle], padded[:, vehicle + 1]


# Function, and what it makes of which numbers.
BY_HAND = {
    closing_speed_squared: [  # gap, v_l, a_l, onset_l, v_f, a_f, onset_f
        ((8, 10, 4, 0, 10, 5, 5), 64.0),  # A: leader brakes, follower coasts; gap falls by 2 t^2: t = 2
        ((10, 4, 4, 0, 6, 5, 5), 36.0),  # A': leader at rest, follower coasts; 2 m to rest, 12 m at 6 m/s: t = 2
        ((9, 20, 4, 0, 22, 2, 0), 40.0),  # B: both brake; 2^2 + 2 * 2 * 9
        ((10, 4, 4, 0, 10, 2, 0), 52.0),  # C: leader at rest, follower brakes; 100 - 2 * 2 * 12
        ((4, 10, 5, 3, 12, 5, 4), 4.0),  # both coast: 4 m at 2 m/s: t = 2
        ((3, 10, 5, 9, 14, 2, 0), 4.0),  # follower brakes, leader still coasts: 16 - 2 * 2 * 3
        ((4.5, 10, 6, 1, 13, 2, 0), 21.0),  # follower brakes first, both brake: at 1 s: gap 2.5, w = 1; 1 + 2 * 4 * 2.5
        ((4, 10, 5, 9, 14, 2, 0), 0.0),  # touch: 16 - 2 * 2 * 4
        ((12, 4, 4, 0, 10, 50 / 14, 0), 0.0),  # just spared at rest
        ((4, 12, 2, 0, 10, 5, 0), 0.0),  # opening
        ((4, 12, 0, 0, 10, 0, 0), 0.0),  # nobody brakes, opening
        ((4, 12, 2, 0, 0, 5, 0), 0.0),  # standing follower
        ((5, 0, 2, 0, 3, 0, 0), 9.0),  # standing leader, no brakes
        ((0, 12, 4, 0, 10, 1, 9), 4.0),  # touching and opening, then caught: w = -2: closes again at +2
        ((0, 10, 4, 0, 10, 1, 9), 0.0),  # pressed together
    ],
    least_to_spare_front: [  # gap, v_l, a_l, onset_l, v_f, onset_f
        ((12, 4, 4, 0, 10, 0), 100 / 28),  # 14 m to stop from 10 m/s
        ((10, 20, 5, 0, 10, 0), 0.5 * 100 / 50),  # 50 m
        ((2, 30, 3, 0, 33, 0), 3 + 9 / 4),  # would stop first, but grazes while both move
        ((4, 10, 5, 9, 14, 0), 2.0),  # grazes the coasting leader, then stops in 4 + 90 + 10 = 104 m > 49 m
        ((4, 10, 5, 3, 12, 4), math.inf),  # they meet while both coast
        ((8, 10, 4, 0, 10, 5), math.inf),  # they meet before the follower may brake
        ((1, 10, 4, 0, 0, 5), 0.0),
    ],
    most_to_spare_rear: [  # gap, v_l, onset_l, v_f, a_f, onset_f
        ((5, 10, 0, 10, 5, 0), 10.0),  # the follower needs 10 m, the leader may stop in 5
        ((11, 10, 0, 10, 5, 0), math.inf),  # the follower stops within the gap
        ((2, 30, 0, 33, 3, 0), 0.75),  # grazing: 9 = 2 (3 - a) 2
        ((17.5, 10, 1, 20, 5, 0), 4.0),  # braking first, 10 m away and at 15 m/s after 1 s: 22.5 m = 10 m + 100 / (2 a)
        ((1, 10, 0, 14, 2, 0), -math.inf),  # even a coasting leader is hit
        ((4, 10, 3, 12, 5, 4), -math.inf),  # they meet while both coast
        ((3, 10, 9, 14, 2, 0), -math.inf),  # hit before it may brake
        ((20, 10, 9, 14, 2, 0), math.inf),  # the follower is at rest before the leader brakes
        ((5, 0, 0, 3, 9, 0), math.inf),  # a standing leader out of reach,
        ((5, 0, 0, 10, 5, 0), -math.inf),  # and within
        ((0, 10, 0, 10, 5, 0.5), math.inf),  # pressed together: no impact
    ],
}


@pytest.mark.parametrize(
    ("function", "given", "expected"), [(function, *case) for function, cases in BY_HAND.items() for case in cases]
)
def test_closed_form__by_hand(function, given, expected):
    tolerance = {"abs": 1e-12} if function is closing_speed_squared else {"rel": 1e-14}
    assert function(*map(float, given)) == pytest.approx(expected, **tolerance)


@pytest.mark.parametrize(("exact_zeros", "at_s"), [(False, 0.0), (True, 0.0), (False, 0.2)])
def test_closing_speed__equals_the_first_impact_of_the_event_exact_physics(exact_zeros, at_s):
    worlds = wide_worlds(8000, 2, seed=11, exact_zeros=exact_zeros)
    if at_s > 0.0:
        apart = worlds.take(worlds.gaps_m[:, 0] > at_s * 35)  # no impact before
        worlds, _ = advance(apart, np.zeros((apart.n, 2)), until_s=at_s)
    share = np.random.default_rng(12).uniform(0.05, 1, worlds.speeds_mps.shape)
    deceleration = worlds.vehicles.braking_capacity_mps2 * share
    _, impacts = advance(worlds, -deceleration, until_s=1000.0, record=True)
    first, simulated = impacts.rows.first, np.zeros(worlds.n)
    simulated[impacts.rows.world[first]] = impacts.rows.closing_speed_mps[first] ** 2
    closed = pairwise_harm(worlds, deceleration)[:, 0]
    assert 0.3 < np.mean(closed > 0) < 0.7 and np.abs(closed - simulated).max() < 1e-9


@pytest.mark.parametrize(("vehicles", "vehicle"), [(3, 1), (2, 0), (2, 1), (5, 2)])
def test_optimum__is_not_above_a_fine_grid_and_is_attained(vehicles, vehicle):
    worlds = wide_worlds(2000, vehicles, seed=14, exact_zeros=vehicles == 3)
    best = optimise_pairwise(worlds, vehicle)
    capacity = worlds.vehicles.braking_capacity_mps2[:, vehicle]
    grid = np.full(worlds.n, np.inf)
    for share in np.linspace(0, 1, 501):
        grid = np.minimum(grid, np.add(*harm_of_pairs(worlds, vehicle, share * capacity)))
    assert np.all(best.harm <= grid + 1e-9) and 0.2 < np.mean(best.harm > 0) < 0.9
    assert np.all((best.deceleration_mps2 >= 0) & (best.deceleration_mps2 <= capacity))
    assert np.array_equal(np.add(*harm_of_pairs(worlds, vehicle, best.deceleration_mps2)), best.harm)


def line_worlds(n: int, vehicles: int, seed: int) -> Worlds:
    """Worlds of very different vehicles, some of them so early that nobody may brake yet."""
    rng = np.random.default_rng(seed)
    shape = n, vehicles
    return make_worlds(
        rng.uniform(0.5, 12, (n, vehicles - 1)),
        rng.uniform(10, 30, shape),
        braking_capacity_mps2=rng.uniform(3, 9, shape),
        driving_capacity_mps2=3,
        latency_s=rng.uniform(0, 1.2, shape),
        mass_t=rng.uniform(1, 20, shape),
        restitution=rng.uniform(0, 1, n),
    )


def kinds(vehicles: int) -> Iterator[tuple[str, Worlds, dict[str, object]]]:
    """Name, worlds and options: at the alert, with gentle, coasting and driving others, later, and with an obstacle."""
    n = 24
    rng, worlds = np.random.default_rng(vehicles), line_worlds(n, vehicles, seed=vehicles)
    braking = worlds.vehicles.braking_capacity_mps2
    others = np.clip(rng.uniform(-1, 0.3, braking.shape) * braking, -braking, 3)
    later, _ = advance(worlds, -braking * rng.uniform(0, 1, braking.shape), until_s=rng.uniform(0, 2, n))
    forward = np.flatnonzero((later.speeds_mps >= 0).all(axis=1))
    obstacle = np.where(rng.random(n) < 0.5, rng.uniform(5, 120, n), np.inf)
    yield "alert", worlds, {"harm_count": "total"}
    yield "others", worlds, {"others_mps2": others, "horizon_s": 6.3}
    yield "later", later.take(forward), {"others_mps2": others[forward], "horizon_s": 5.0}
    yield "obstacle", replace(worlds, obstacle_gap_m=obstacle), {"harm_count": "total"}
    slow = replace(worlds.vehicles, brake_rate_mps3=rng.uniform(3, 40, braking.shape))
    yield "build-up", replace(worlds, vehicles=slow, obstacle_gap_m=obstacle), {"others_mps2": others}
    profiles = {0: [(0.0, 1.0), (0.6, 4.0), (1.4, 0.5)], worlds.N - 1: [(0.0, 3.0), (0.2, 0.0)]}
    yield "pieces", replace(worlds, obstacle_gap_m=obstacle).play_pieces(profiles), {"others_mps2": others}


def line_of(worlds: Worlds, k: int, vehicle: int, command: Floats, *, total: bool = False) -> Line:
    v = worlds.vehicles
    made = make_line(
        worlds.gaps_m[k], worlds.speeds_mps[k], worlds.pair_hit[k], worlds.obstacle_gap_m[k], worlds.obstacle_hit[k],
        command[k], v.latency_s[k], v.mass_t[k], v.speed_limit_mps[k], worlds.command_mps2[k], v.brake_rate_mps3[k],
        v.release_rate_mps3[k], v.pieces[k], worlds.time_s[k], v.restitution[k], 7.0, vehicle, total,
    )  # fmt: skip
    assert share_start(made) == FLAG.DONE
    return made


def harms(made: Line, decelerations: Floats, bound: float = math.inf) -> Samples:
    n = len(decelerations)
    found = Samples(decelerations.copy(), np.full(n, np.nan), np.full(n, np.nan), np.full(n, np.nan))
    assert simulate(made, found, 0, n, bound) == FLAG.DONE
    return found


@pytest.mark.parametrize("vehicles", [2, 3, 5, 10, 18])  # NumPy adds up a row of 8 or more pairs in another order
@pytest.mark.parametrize("kind", ["alert", "others", "later", "obstacle", "build-up", "pieces"])
def test_simulate__does_the_harm_of_advance(kind, vehicles):
    ((_, worlds, options),) = (each for each in kinds(vehicles) if each[0] == kind)
    command = options.get("others_mps2", -worlds.vehicles.braking_capacity_mps2).copy()
    command[np.random.default_rng(vehicles).random(command.shape) < 0.2] = 0.0  # some coast
    harmed = 0
    for vehicle in sorted({0, vehicles // 2, vehicles - 1}):
        capacity = worlds.vehicles.braking_capacity_mps2[:, vehicle]
        for k in range(0, worlds.n, 1 + vehicles // 5):
            at = capacity[k] * np.array([0.0, 0.0, 0.31, 0.77, 1.0])
            same = np.full(len(at), k)
            told = command[same]
            told[:, vehicle] = -at
            _, impacts = advance(worlds.take(same), told, until_s=7.0)
            first = impacts.first_impact_harm.sum(axis=1) + impacts.obstacle_first_harm
            total = impacts.total_harm.sum(axis=1) + impacts.obstacle_total_harm
            for counts_all, expected in ((False, (first, total)), (True, (total, first))):
                found = harms(line_of(worlds, k, vehicle, command, total=counts_all), at)
                assert np.array_equal((found.harm, found.other), expected)
            impacts_of = np.column_stack([impacts.count, impacts.obstacle_count])
            if vehicles <= 5:
                assert len(np.unique(found.course)) == len(np.unique(impacts_of, axis=0))
            harmed += int((total > 0).sum())
    assert harmed > 20


def test_simulate__gives_up_at_a_bound_and_tells_no_less():
    worlds, given_up = line_worlds(25, 4, seed=104), 0
    for k in range(worlds.n):
        at = np.linspace(0.0, worlds.vehicles.braking_capacity_mps2[k, 1], 23)
        made = [line_of(worlds, k, 1, -0.6 * worlds.vehicles.braking_capacity_mps2) for _ in range(2)]
        whole = harms(made[0], at)
        bound = float(np.median(whole.harm))
        cut, below = harms(made[1], at, bound), whole.harm < bound
        assert np.array_equal(cut.harm[below], whole.harm[below])
        assert np.array_equal(cut.other[below], whole.other[below]) and np.all(cut.harm[~below] >= bound)
        given_up += int((cut.other[~below] < whole.other[~below]).sum())
    assert given_up > 0


@compiled
def _will_stay_apart(table: Floats) -> bool:
    return will_stay_apart(table)


@pytest.mark.parametrize(
    ("speeds", "commands", "gaps", "apart"),
    [
        ([10, 9], [-5, -6], [0.0], True),  # separates, and the rear brakes harder
        ([10, 9.5], [-6, -5], [0.0], False),  # separates, and meets again: 8.33 m to stop, and 9.03 m
        ([10, 8], [-6, -5], [0.0], True),  # separates, and stops behind: 8.33 m, and 6.4 m
        ([10, 10], [-6, -5], [0.0], True),  # one body: the rear presses
        ([10, 10], [-5, -6], [0.0], True),  # comes apart
        ([0, 10], [-5, -5], [10.1], True),  # stops 0.1 m behind one that stands
        ([0, 10], [-5, -5], [9.9], False),
        ([10, 14], [-4, -8], [1.9], False),  # stops behind (14.4 m, 12.25 m), but 16 > 2 * 4 * 1.9
        ([10, 14], [-4, -8], [2.1], True),
        ([10, 14], [-4, 0], [99.0], False),  # coasts
        ([10, 10], [-5, 1], [99.0], False),  # drives
        ([0, 0], [-5, -5], [0.0], True),  # stand
        ([10, 9, 9], [-5, -6, -5], [1.0, 0.0], True),  # the last two, as one body, brake by 5.5
        ([10, 9, 9], [-5, -5.2, -3], [1.0, 0.0], True),  # ... by 4.1: 10 m + 1 m, and 9.88 m
        ([10, 9, 9], [-5, -5.2, -2], [1.0, 0.0], False),  # ... by 3.6: 11 m, and 11.25 m; each alone would keep apart
    ],
)
def test_will_stay_apart__by_hand_and_once_every_command_is_followed(speeds, commands, gaps, apart):
    worlds = make_worlds(
        np.array(gaps, float), np.array(speeds, float), braking_capacity_mps2=9, driving_capacity_mps2=3, latency_s=0,
        mass_t=1, restitution=0.1,
    )  # fmt: skip
    table = line_of(worlds, 0, 0, np.array([commands], float)).table
    table[ROW.COMMAND], table[ROW.SPEED], table[ROW.GAP, :-1] = commands, speeds, gaps
    for active in (1.0, 0.0):
        table[ROW.ACTIVE] = active
        assert bool(_will_stay_apart(table)) is (apart and active == 1.0)


def random_worlds(n: int, seed: int, *, vehicles: int = 3, gap: tuple[float, float] = (5, 10)) -> Worlds:
    """The paper's random test, or more of such vehicles."""
    rng = np.random.default_rng(seed)
    return make_worlds(
        rng.uniform(*gap, (n, vehicles - 1)),
        rng.uniform(18, 22, (n, vehicles)),
        braking_capacity_mps2=np.resize([6, 7, 6], vehicles),
        driving_capacity_mps2=6,
        latency_s=[0, *(0.2 + 0.3 * np.arange(1, vehicles))],
        mass_t=np.resize([4.5, 5.5, 5.9], vehicles),
        restitution=0.1,
    )


def realised(worlds: Worlds, vehicle: int, deceleration: Floats) -> Impacts:
    command = -worlds.vehicles.braking_capacity_mps2
    command[:, vehicle] = -deceleration
    return advance(worlds, command, until_s=8.0)[1]


@pytest.mark.parametrize(
    ("n", "vehicles", "vehicle", "rear_mps2", "points"),
    [
        (150, 3, 1, -6.0, 401),
        (100, 3, 1, -3.0, 401),
        (60, 2, 1, -7.0, 401),
        (60, 2, 0, -7.0, 401),
        (60, 4, 2, -6.0, 401),
        (120, "paper", 1, -6.0, 2001),
        pytest.param(10_000, "paper", 1, -6.0, 2001, marks=pytest.mark.long),
    ],
)
def test_coupled__is_not_worse_than_an_even_grid(n, vehicles, vehicle, rear_mps2, points):
    worlds = PAPER.sample(n, seed=7).worlds if vehicles == "paper" else random_worlds(n, seed=21, vehicles=vehicles)
    others = -worlds.vehicles.braking_capacity_mps2
    others[:, -1] = rear_mps2
    grid = -worlds.vehicles.braking_capacity_mps2[:, [vehicle]] * np.linspace(0.0, 1.0, points)
    for count, harms in zip(("first", "total"), forecast(worlds, others, vehicle, grid, 8.0), strict=True):
        excess = optimise_coupled(worlds, vehicle, others_mps2=others, harm_count=count).harm - harms.min(axis=1)
        assert excess.max() <= 1e-9
        assert (np.mean(excess) < 0.0) == (vehicles != 2)  # narrowing finds more; of one pair an end is best


@pytest.mark.parametrize("rear_mps2", [6.0, 4.5])
def test_coupled__takes_the_middle_of_a_collision_free_interval(rear_mps2):
    worlds, gentle = (random_worlds(200, seed=25, gap=(9, 16)) for _ in range(2))
    gentle.vehicles.braking_capacity_mps2[:, 2] = rear_mps2
    others = -gentle.vehicles.braking_capacity_mps2
    closed, best = optimise_pairwise(gentle, 1), optimise_coupled(worlds, 1, others_mps2=others)
    free = closed.harm == 0
    assert 10 < free.sum() < 190 and np.array_equal(best.deceleration_mps2[free], closed.deceleration_mps2[free])
    assert np.array_equal(best.harm == 0, free)


def test_coupled__threads_batch_and_what_was_searched_before_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    worlds, searches = PAPER.sample(600, 7).worlds, []
    search = coupled._search_worlds
    monkeypatch.setattr(coupled, "_search_worlds", lambda *given: searches.append(1) or search(*given))
    found = {}
    for cores in (1, 3):
        monkeypatch.setattr(coupled, "_FOUND", {})
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        found[cores] = optimise_coupled(worlds, 1)
        again = optimise_coupled(worlds, 1)
        again.harm[:] = -1.0  # whoever changes what it was given changes nothing that is remembered
        assert all((one == other).all() for one, other in zip(optimise_coupled(worlds, 1), found[1], strict=True))
        assert len(searches) == cores
        searches.clear()
    total, other = optimise_coupled(worlds, 1, harm_count="total"), optimise_coupled(worlds, 1, horizon_s=4.0)
    assert len(searches) == 6 and (total.harm != found[1].harm).any() and (other.harm != found[1].harm).any()
    assert [column[0] for column in optimise_coupled(worlds.take([7]), 1)] == [column[7] for column in found[1]]


@pytest.mark.parametrize(
    ("worlds", "vehicle", "harm_count", "least"),
    [
        # Just before one more impact the harm is least: a sawtooth that an even look from outside does not show.
        (PAPER.sample(1, seed=7, first=609).worlds, 1, "first", 12.2943),
        (PAPER.sample(1, seed=7, first=3545).worlds, 1, "first", 18.3988),
        (PAPER.sample(1, seed=7, first=3290).worlds, 1, "total", 55.3322),
        (line_worlds(250, 5, seed=3).take([191]), 2, "total", 1048.2),  # not in the most promising cell
    ],
)
def test_coupled__finds_what_hides_between_two_samples_of_its_grid(worlds, vehicle, harm_count, least):
    assert optimise_coupled(worlds, vehicle, harm_count=harm_count).harm[0] < least


# By the code of 20 November 2026 (6d87c15); `stress-wide` on worlds that are the same on every processor.
RECORDED = {
    "paper-random first": "f6036961a834b1aa",
    "paper-random total": "5548d34fa2c72965",
    "stress-wide first": "8acd5e1399f3c8e6",
    "stress-wide total": "e0f215e3b3fb51c7",
    "cooperation-2-five first": "03149d118acf6d73",
    "cooperation-2-five total": "6b755b628058f8d0",
    "paper-random-obstacle first": "f5aa1e29bc9839de",
    "paper-random-obstacle total": "62ed6d773c287e98",
    "2 alert 0": "6cb904efc8483c24",
    "2 alert 1": "13f625a162e41fff",
    "2 others 0": "0728ecb5c28b8fd1",
    "2 others 1": "3ba20ebd20680914",
    "2 later 0": "21a20eced1ea519b",
    "2 later 1": "f8a3f81be6bdbd97",
    "2 obstacle 0": "fd91ed2f4876dd27",
    "2 obstacle 1": "1039644effe99f93",
    "4 alert 0": "6666c5f4afb7ac1e",
    "4 alert 2": "9ad7a5ef7b382388",
    "4 alert 3": "7d82f8c206b4f6e0",
    "4 others 0": "cc46d0f6561dfa4b",
    "4 others 2": "3b4c9091c7632ce0",
    "4 others 3": "ce7efeb53082c736",
    "4 later 0": "89f9c72cbc375394",
    "4 later 2": "1029ddbce3d95203",
    "4 later 3": "7ae249d828c2d220",
    "4 obstacle 0": "b1b4be2ddd7dd898",
    "4 obstacle 2": "00a371ab2741ada8",
    "4 obstacle 3": "4cf3087c3be9299f",
    "7 alert 0": "20958775e9ebdc8d",
    "7 alert 3": "37fb39945dee3433",
    "7 alert 6": "61d64faad7e32e10",
    "7 others 0": "cef8fc4481cee921",
    "7 others 3": "fb79ad8e2ff74c9d",
    "7 others 6": "ef3472e372ecca86",
    "7 later 0": "da2e43afe4f29d71",
    "7 later 3": "2f1d846b09424b09",
    "7 later 6": "6b04d206515ab8b3",
    "7 obstacle 0": "71e95c4a167763ef",
    "7 obstacle 3": "be7b766457234825",
    "7 obstacle 6": "c8dc7cdaeea2859b",
}


def recorded_cases() -> Iterator[tuple[str, CoupledOptimum]]:
    for name in ("paper-random", "stress-wide", "cooperation-2-five", "paper-random-obstacle"):
        worlds = eb.load_scenario(name).sample(20, seed=7).worlds
        for harm_count in ("first", "total"):
            yield f"{name} {harm_count}", optimise_coupled(worlds, 1, harm_count=harm_count)
    for vehicles in (2, 4, 7):
        for kind, worlds, options in kinds(vehicles):
            for vehicle in sorted({0, vehicles // 2, vehicles - 1}) if kind not in ("build-up", "pieces") else ():
                yield f"{vehicles} {kind} {vehicle}", optimise_coupled(worlds, vehicle, **options)


def test_coupled__finds_what_it_found_when_each_step_ran_over_all_worlds_at_once() -> None:
    """The first 16 digits of the SHA-256 of all columns."""
    assert {
        name: hashlib.sha256(b"".join(np.ascontiguousarray(column).tobytes() for column in found)).hexdigest()[:16]
        for name, found in recorded_cases()
    } == RECORDED


def test_optimum__takes_the_middle_of_a_flat_minimum() -> None:
    # The front pair meets while both coast, whatever vehicle 2 does; the rear pair is spared up to 5 m/s2.
    worlds = make_worlds(
        [1.0, 5.0],
        [10.0, 12.0, 12.0],
        braking_capacity_mps2=[5, 8, 5],
        driving_capacity_mps2=0,
        latency_s=[1.0, 1.0, 1.0],
        mass_t=1,
        restitution=0,
    )
    best = optimise_pairwise(worlds, 1)
    # The rear one stops in 14.4 m, so vehicle 2 may stop in 9.4 m: 7.66 m/s2.
    assert best.spares_rear_mps2[0] == pytest.approx(72 / 9.4)
    assert best.spares_front_mps2[0] == math.inf
    assert best.harm[0] == 4.0
    assert best.deceleration_mps2[0] == pytest.approx(36 / 9.4)


def test_coupled__stays_off_the_edge_of_a_jump() -> None:
    # The least harm, 1.2376, ends at a* = 5.93951, where a second impact makes it 1.6387: rounding must not decide.
    world = make_worlds(
        [7.59, 9.53],
        [20.07, 19.34, 20.35],
        braking_capacity_mps2=[6, 7, 6],
        driving_capacity_mps2=6,
        latency_s=[0, 0.5, 0.8],
        mass_t=[4.5, 5.5, 5.9],
        restitution=0.1,
    )
    best = optimise_coupled(world, 1)
    around = [float(realised(world, 1, best.deceleration_mps2 + d).first_impact_harm.sum()) for d in (-1e-9, 0, 1e-9)]
    assert around == pytest.approx([1.2376] * 3, abs=1e-4)
    assert realised(world, 1, best.deceleration_mps2 + 1e-8).first_impact_harm.sum() > 1.6


def test_coupled__follows_the_commands_of_the_others() -> None:
    # Nobody else brakes: vehicle 2 harms nobody by coasting like them, and is hit if it brakes.
    worlds = make_worlds(
        [10.0, 10.0],
        [20.0, 20.0, 20.0],
        braking_capacity_mps2=6,
        driving_capacity_mps2=0,
        latency_s=0,
        mass_t=1,
        restitution=0,
    )
    best = optimise_coupled(worlds, 1, others_mps2=np.zeros((1, 3)), horizon_s=30.0)
    assert best.total_harm[0] == 0.0
    assert best.deceleration_mps2[0] == pytest.approx(0.0, abs=10 * 2 / 30**2)


def test_coupled__finds_a_kink_to_nine_digits() -> None:
    # Front pair alone: harm falls linearly to the grazing deceleration 2 + 4^2 / (2 * 8) = 3, from where it is zero.
    world = make_worlds(
        [8.0, 500.0],
        [20.0, 24.0, 0.0],
        braking_capacity_mps2=[2, 2.9, 6],
        driving_capacity_mps2=0,
        latency_s=0,
        mass_t=1,
        restitution=0,
    )
    best = optimise_coupled(world, 1, horizon_s=30.0)
    assert best.deceleration_mps2[0] == 2.9  # beyond its brakes: as hard as it can
    assert best.harm[0] == pytest.approx(16 - 2 * 0.9 * 8, abs=1e-12)
    assert math.isclose(optimise_pairwise(world, 1).spares_front_mps2[0], 3.0)


def test_e_v2x_bm__takes_the_other_learners_to_brake_fully() -> None:
    worlds = PAIR.sample(30, 7).worlds
    both = drive(worlds, Team.of(make_agent("e_v2x_bm"), (1, 2)), PAIR).memories[1]
    alone = drive(worlds, make_agent("e_v2x_bm"), PAIR.with_learners(["vehicle_2"]), 1).memories[1]
    assert both["deceleration_mps2"].tolist() == alone["deceleration_mps2"].tolist()
