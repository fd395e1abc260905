"""Planted weaknesses are found, and sooner than at random."""

from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.studies.falsification import APART, Scored, far_apart, search
from ethbrake_marl.extensions.studies.weakness import Measure, MeasureName
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds
from ethbrake_marl.first_edition.scenario.ranges import ranges

SCENARIO = eb.load_scenario("paper-random")


def measured(name: MeasureName, **agents: Any) -> Measure:
    return Measure(name, {"holed": Holed(), "full_brake": eb.make_agent("full_brake")} | agents, SCENARIO, "first")


@pytest.mark.parametrize("name", ["regret", "difference"])
def test_falsify__finds_a_hole_in_a_thousandth_of_the_worlds(name: MeasureName) -> None:
    found = measured(name).falsify(4_000, 0)
    assert in_hole(found.sample.worlds).all() and found.sample.worlds.n >= 3
    scores = [world.score for world in found.worlds]
    assert (np.diff(scores) <= 0.0).all() and scores[-1] > 0.0
    at_random = measured(name).falsify(4_000, 0, adaptive=False)
    assert found.share_above > 20.0 * at_random.share_above
    assert scores[0] > 0.98 * at_random.worlds[0].score


@pytest.mark.parametrize("harm_count", HARM_COUNTS)
def test_falsify__the_bound_of_the_shield_holds_where_it_is_tightest(harm_count: HarmCount) -> None:
    measure = Measure.of("bound", "coast+step", None, SCENARIO, harm_count)
    found = measure.falsify(256, 1)
    assert max(world.score for world in found.worlds) <= 1e-9 and found.sample.worlds.n > 3
    assert all(world.score == world.harm - (world.reference or 0.0) for world in found.worlds)


@pytest.mark.parametrize(
    "name", ["stress-wide", "realistic-mixed", "realistic-motorway", "cooperation-4-all", "cooperation-2-five"]
)
def test_ranges__points_are_as_likely_as_a_list(name: str) -> None:
    """Worlds of even points have the means of a list, in every quantity."""
    scenario = eb.load_scenario(name).replace(early_impacts="keep")
    drawn = ranges(scenario)
    points = np.random.default_rng(0).random((5_000, len(drawn.names)))
    found, listed = drawn.sample(points)[0].worlds, scenario.sample(5_000, 7).worlds
    for one, other in (
        (found.gaps_m, listed.gaps_m),
        (found.speeds_mps, listed.speeds_mps),
        (found.vehicles.mass_t, listed.vehicles.mass_t),
        (found.vehicles.latency_s, listed.vehicles.latency_s),
        (found.vehicles.braking_capacity_mps2, listed.vehicles.braking_capacity_mps2),
    ):
        assert np.allclose(one.mean(axis=0), other.mean(axis=0), atol=0.1 * other.std() + 1e-12)
        assert np.allclose(one.std(axis=0), other.std(axis=0), rtol=0.15, atol=1e-12)


def _peak(points: Floats) -> Floats:
    return -np.abs(points - 0.7).sum(axis=1)


def test_search__climbs_a_peak_that_random_points_stay_away_from() -> None:
    adaptive, at_random = (search(_peak, 6, 2_000, 3, adaptive=how).scores.max() for how in (True, False))
    assert adaptive > 0.6 * at_random


def test_search__finds_several_peaks() -> None:
    centres = np.array([[0.2, 0.2, 0.8], [0.8, 0.3, 0.1], [0.5, 0.9, 0.5]])

    def peaks(points: Floats) -> Floats:
        return -np.linalg.norm(points[:, np.newaxis] - centres, axis=2).min(axis=1)

    found = search(peaks, 3, 3_000, 0)
    best = found.points[far_apart(found, 3)]
    assert (np.linalg.norm(best[:, np.newaxis] - centres, axis=2).min(axis=0) < 0.1).all()


class Holed:
    """Brakes fully, but coasts in a corner of the ranges: 0.1 % of the worlds of ``paper-random``."""

    name = "holed"

    def begin(self, alert: Worlds, vehicle: int, scripts: object) -> Bools:
        return in_hole(alert)

    def act(self, worlds: Worlds, memory: Bools, vehicle: int) -> tuple[Floats, Bools]:
        return np.where(memory, 0.0, -worlds.vehicles.braking_capacity_mps2[:, vehicle]), memory


def in_hole(worlds: Worlds) -> Bools:
    """Three conditions, each of which a tenth of the worlds meets."""
    return np.asarray((worlds.gaps_m < 5.5).all(axis=1) & (worlds.speeds_mps[:, 1] > 21.6))


def test_far_apart__takes_the_best_first_without_what_does_not_count() -> None:
    points = np.array([[0.1, 0.1], [0.1, 0.1 + 0.9 * APART], [0.9, 0.9], [0.5, 0.5]])
    assert far_apart(Scored(points, np.array([1.0, 2.0, 0.5, -np.inf])), 9).tolist() == [1, 2]


def test_ranges__are_what_a_scenario_draws() -> None:
    paper, wide = eb.load_scenario("paper-random"), ranges(eb.load_scenario("stress-wide"))
    sample, accepted = ranges(paper).sample(np.full((1, 5), 0.5))
    assert len(ranges(paper).names) == 5
    assert accepted.tolist() == [True]
    assert sample.worlds.gaps_m.tolist() == [[7.5, 7.5]]
    assert sample.worlds.speeds_mps.tolist() == [[20.0, 20.0, 20.0]]
    assert float(wide.sample(np.random.default_rng(0).random((2_000, len(wide.names))))[1].mean()) == 0.9625


def test_search__keeps_nothing_where_nothing_is_wrong() -> None:
    paper = eb.load_scenario("paper-random")
    braking = eb.make_agent("full_brake")
    found = Measure("difference", {"mine": braking, "full_brake": braking}, paper, "first").falsify(300, 0)
    assert found.sample.worlds.n == 0
    assert len(found.worlds) == 0
    assert found.first_above is None
    assert found.share_above == 0.0


def test_search__stays_in_the_cube_and_repeats_by_seed() -> None:
    one, same, other = (search(_peak, 2, 700, seed) for seed in (1, 1, 2))
    assert len(one.points) == len(one.scores) == 700
    assert ((one.points >= 0.0) & (one.points < 1.0)).all()
    assert np.array_equal(one.points, same.points)
    assert not np.array_equal(one.points, other.points)


def test_search__spreads_evenly_while_all_points_are_alike() -> None:
    found = search(lambda points: np.zeros(len(points)), 3, 1_024, 0)
    cells = np.unique((found.points * 8).astype(int), axis=0)
    assert len(cells) == 512


@pytest.mark.parametrize(("budget", "seed", "key"), [(0, 0, "budget"), (10, -1, "seed")])
def test_search__numbers_that_are_too_small_are_refused(budget: int, seed: int, key: str) -> None:
    with pytest.raises(InvalidInput, match=key):
        search(_peak, 2, budget, seed)
