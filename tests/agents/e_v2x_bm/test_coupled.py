"""The coupled optimum: no worse than brute force in the same physics, and what it promises beyond that."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ethbrake_marl.agents import e_v2x_bm
from ethbrake_marl.agents.e_v2x_bm import optimise_coupled, optimise_pairwise
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import Floats, Impacts, Worlds, advance, forecast, make_worlds
from ethbrake_marl.scenario import load_scenario


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


def least_on_grid(worlds: Worlds, vehicle: int, points: int) -> tuple[Floats, Floats]:
    """Least first-impact and least total harm of each world over an even grid."""
    first, total = np.full(worlds.n, np.inf), np.full(worlds.n, np.inf)
    for share in np.linspace(0, 1, points):
        impacts = realised(worlds, vehicle, share * worlds.vehicles.braking_capacity_mps2[:, vehicle])
        first = np.minimum(first, impacts.first_impact_harm.sum(axis=1))
        total = np.minimum(total, impacts.total_harm.sum(axis=1))
    return first, total


@pytest.mark.parametrize(("vehicles", "vehicle", "n"), [(3, 1, 150), (2, 1, 60), (2, 0, 60), (4, 2, 60)])
def test_coupled__is_not_worse_than_a_grid_of_401(vehicles, vehicle, n):
    worlds = random_worlds(n, seed=21, vehicles=vehicles)
    first, total = least_on_grid(worlds, vehicle, 401)
    assert np.all(optimise_coupled(worlds, vehicle, harm_count="first").harm <= first + 1e-9)
    assert np.all(optimise_coupled(worlds, vehicle, harm_count="total").harm <= total + 1e-9)


@pytest.mark.parametrize("n", [120, pytest.param(10_000, marks=pytest.mark.long)])
def test_coupled__is_not_worse_than_a_grid_of_2001_on_the_papers_list(n):
    worlds = load_scenario("paper-random").sample(n, seed=7).worlds
    others = -worlds.vehicles.braking_capacity_mps2
    grid = np.full((n, 1), -7.0) * np.linspace(0.0, 1.0, 2001)
    for count, harms in zip(("first", "total"), forecast(worlds, others, 1, grid, 8.0), strict=True):
        excess = optimise_coupled(worlds, 1, harm_count=count).harm - harms.min(axis=1)
        print(f"{count}: largest excess {excess.max():.1e}, mean {excess.mean():.5f} m2/s2")
        assert excess.max() <= 1e-6
        assert np.mean(excess) < 0.0  # narrowing finds more than the grid


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_coupled__states_the_harm_that_its_deceleration_realises(harm_count):
    worlds = random_worlds(200, seed=23)
    best = optimise_coupled(worlds, 1, harm_count=harm_count)
    impacts = realised(worlds, 1, best.deceleration_mps2)
    assert np.array_equal(best.first_impact_harm, impacts.first_impact_harm.sum(axis=1))
    assert np.array_equal(best.total_harm, impacts.total_harm.sum(axis=1))
    assert np.array_equal(best.harm, best.first_impact_harm if harm_count == "first" else best.total_harm)
    assert 0.3 < np.mean(best.harm > 0) < 0.9


def test_coupled__is_never_worse_than_the_pairwise_deceleration_realised():
    worlds = random_worlds(200, seed=24)
    pairwise = realised(worlds, 1, optimise_pairwise(worlds, 1).deceleration_mps2)
    assert np.all(optimise_coupled(worlds, 1).harm <= pairwise.first_impact_harm.sum(axis=1) + 1e-9)


def test_coupled__takes_the_middle_of_a_collision_free_interval():
    worlds = random_worlds(200, seed=25, gap=(9, 16))
    closed = optimise_pairwise(worlds, 1)
    best = optimise_coupled(worlds, 1)
    free = closed.harm == 0
    assert 20 < free.sum() < 180
    assert np.array_equal(best.deceleration_mps2[free], closed.deceleration_mps2[free])
    assert np.array_equal(best.harm == 0, free)


def test_coupled__a_world_alone_gives_the_same_bits():
    worlds = random_worlds(30, seed=26)
    together = optimise_coupled(worlds, 1)
    for k in (0, 7, 29):
        alone = optimise_coupled(worlds.take([k]), 1)
        assert [column[0] for column in alone] == [column[k] for column in together]


def test_coupled__threads_and_what_was_searched_before_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    worlds, searches = load_scenario("paper-random").sample(600, 7).worlds, []
    search = e_v2x_bm._search_worlds
    monkeypatch.setattr(e_v2x_bm, "_search_worlds", lambda *given: searches.append(1) or search(*given))
    found = {}
    for cores in (1, 3):
        monkeypatch.setattr(e_v2x_bm, "_FOUND", {})
        monkeypatch.setattr("os.cpu_count", lambda cores=cores: cores)
        found[cores] = optimise_coupled(worlds, 1)
        assert len(searches) == cores
        again = optimise_coupled(worlds, 1)
        again.harm[:] = -1.0  # whoever changes what it was given changes nothing that is remembered
        assert all((one == other).all() for one, other in zip(optimise_coupled(worlds, 1), found[1], strict=True))
        assert len(searches) == cores
        searches.clear()
    total, other = optimise_coupled(worlds, 1, harm_count="total"), optimise_coupled(worlds, 1, horizon_s=4.0)
    assert len(searches) == 6 and (total.harm != found[1].harm).any() and (other.harm != found[1].harm).any()


def test_coupled__stays_off_the_edge_of_a_jump():
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


def test_coupled__follows_the_others_commands():
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


def test_coupled__no_world_is_fine():
    assert optimise_coupled(random_worlds(2, seed=1).take(np.arange(0)), 1).harm.shape == (0,)


def test_coupled__refuses_an_unknown_count():
    with pytest.raises(InvalidInput, match="'first' or 'total'"):
        optimise_coupled(random_worlds(1, seed=1), 1, harm_count="both")


def test_coupled__finds_a_kink_to_nine_digits():
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


def test_coupled__looks_into_more_than_the_most_promising_cell():
    # In this world the least harm hides in a cell of the grid that is not the most promising one: 1.13 less.
    rng = np.random.default_rng(3)
    worlds = make_worlds(
        rng.uniform(0.5, 12, (250, 4)),
        rng.uniform(10, 30, (250, 5)),
        braking_capacity_mps2=rng.uniform(3, 9, (250, 5)),
        driving_capacity_mps2=3,
        latency_s=rng.uniform(0, 1.2, (250, 5)),
        mass_t=rng.uniform(1, 20, (250, 5)),
        restitution=rng.uniform(0, 1, 250),
    )
    assert optimise_coupled(worlds.take([191]), 2, harm_count="total").harm[0] < 1048.2


@pytest.mark.parametrize(
    ("world", "harm_count", "least"), [(609, "first", 12.2943), (3545, "first", 18.3988), (3290, "total", 55.3322)]
)
def test_coupled__finds_what_falls_toward_a_jump_between_two_samples(world, harm_count, least):
    # Just before one more impact the harm is least: a sawtooth that an even look from outside does not show.
    one = load_scenario("paper-random").sample(1, seed=7, first=world).worlds
    assert optimise_coupled(one, 1, harm_count=harm_count).harm[0] < least


def test_coupled__is_steady_around_its_optimum():
    worlds = random_worlds(150, seed=21)
    best = optimise_coupled(worlds, 1)
    for off in (-1e-9, 1e-9):
        beside = np.clip(best.deceleration_mps2 + off, 0, 7)
        assert np.abs(realised(worlds, 1, beside).first_impact_harm.sum(axis=1) - best.harm).max() < 1e-6


def test_coupled__is_not_worse_than_a_grid_when_the_others_brake_gently():
    worlds = random_worlds(100, seed=27)
    others = -worlds.vehicles.braking_capacity_mps2
    others[:, 2] = -3.0
    least = np.full(worlds.n, np.inf)
    for share in np.linspace(0, 1, 401):
        command = others.copy()
        command[:, 1] = -7.0 * share
        least = np.minimum(least, advance(worlds, command, until_s=8.0)[1].first_impact_harm.sum(axis=1))
    assert np.all(optimise_coupled(worlds, 1, others_mps2=others).harm <= least + 1e-9)


def test_coupled__takes_the_middle_of_the_interval_that_the_others_commands_leave():
    worlds = random_worlds(200, seed=25, gap=(9, 16))
    others = -worlds.vehicles.braking_capacity_mps2
    others[:, 2] = -4.5
    gentle = random_worlds(200, seed=25, gap=(9, 16))
    gentle.vehicles.braking_capacity_mps2[:, 2] = 4.5
    closed, best = optimise_pairwise(gentle, 1), optimise_coupled(worlds, 1, others_mps2=others)
    free = closed.harm == 0
    assert 10 < free.sum() < 190
    assert np.array_equal(best.deceleration_mps2[free], closed.deceleration_mps2[free])
    assert np.all(best.harm[free] == 0)
