"""Planted weaknesses are found, and sooner than at random; the file of worlds is read back."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.studies.cube import cube_of
from ethbrake_marl.extensions.studies.falsification import LEAST_DISTANCE, far_apart, search_cube
from ethbrake_marl.extensions.studies.weakness import WeaknessMeasure
from ethbrake_marl.motion.layout import Bools, Floats
from tests.fixtures.commands import Command, Refuse, told_json
from tests.refused import refused

SCENARIO = eb.load_scenario("paper-random")


def in_hole(worlds: eb.State) -> Bools:
    return (worlds.gaps_m > 9.5).all(axis=1) & (worlds.speeds_mps[:, 1] < 18.4)


class Holed:
    """Brakes fully, but coasts in the hole."""

    name, knows = "holed", "own sensors"

    def begin(self, alert: eb.State, body: int) -> Bools:
        return in_hole(alert)

    def act(self, state: eb.State, memory: Any, body: int) -> tuple[Floats, Any]:
        return np.where(memory, 0.0, -state.braking_capacity_mps2[:, body - 1]), memory


def test_falsify__finds_a_hole_in_a_thousandth_of_the_worlds() -> None:
    measure = WeaknessMeasure.of("regret", Holed(), "full_brake", SCENARIO)
    worlds, measured, scores = measure.falsify(4_000, 0)
    assert in_hole(worlds).all() and worlds.n >= 3
    assert (np.diff(measured.score) <= 0.0).all() and measured.score[-1] > 0.0
    assert (measured.score == measured.harm - measured.reference).all()
    at_random = measure(SCENARIO.sample(4_000, 3)).score
    assert (scores > 0.0).mean() > 20.0 * (at_random > 0.0).mean() and measured.score[0] > 0.98 * at_random.max()


def test_bound__of_the_shield_holds_where_it_is_tightest() -> None:
    measure = WeaknessMeasure.of("bound", "coast+step", None, SCENARIO, "total")
    worlds, measured, _ = measure.falsify(256, 1)
    assert measured.score.max() <= 0.0 and worlds.n > 3 and measured.harm.max() > 0.0
    listed = SCENARIO.sample(200, 3)
    promised = measure.teams[0].game(measure.game).reset(listed).memories["shield"].price  # at the alert
    everywhere = measure(listed)
    assert (everywhere.reference == promised).all() and (everywhere.harm < promised).any()


def test_harm__is_the_score_that_an_evaluation_gives() -> None:
    worlds, measured, _ = WeaknessMeasure.of("harm", "full_brake", None, SCENARIO, "total").falsify(64, 2, most=5)
    assert measured.reference is None and (measured.score == measured.harm).all()
    result = eb.evaluate(worlds, "full_brake", scenario=SCENARIO)
    assert (result["full_brake"]["total_harm"] == measured.harm).all()


@pytest.mark.parametrize(("name", "coordinates"), [("paper-random", 5), ("stress-wide", 18), ("realistic-mixed", 17)])
def test_cube__points_are_as_likely_as_a_list(name: str, coordinates: int) -> None:
    """Worlds of even points have the means and spreads of a list, in every quantity."""
    scenario = eb.load_scenario(name).replace(early_impacts="keep")
    cube = cube_of(scenario)
    assert len(cube.places) == coordinates
    points = np.random.default_rng(0).random((5_000, coordinates))
    drawn, listed = cube.worlds(points), scenario.sample(5_000, 7)
    assert cube.accepts(drawn).all()
    for one, other in zip(
        (drawn.line[:, :3, 1:-1], drawn.car[:, :5, 1:]), (listed.line[:, :3, 1:-1], listed.car[:, :5, 1:]), strict=True
    ):
        assert np.allclose(one.mean(axis=0), other.mean(axis=0), atol=0.1 * other.std() + 1e-12)
        assert np.allclose(one.std(axis=0), other.std(axis=0), rtol=0.15, atol=1e-9)


def test_cube__rejects_what_the_scenario_rejects() -> None:
    cube = cube_of(eb.load_scenario("paper-delay-high").replace(gaps_m={"uniform": [0.5, 10]}))
    worlds = cube.worlds(np.random.default_rng(1).random((300, len(cube.places))))
    accepted = cube.accepts(worlds)
    assert 0.1 < accepted.mean() < 0.95
    early = eb.open_game(cube.scenario)[1].reset(worlds).collided
    assert np.array_equal(accepted, ~early)


def test_search__climbs_a_peak_that_random_points_stay_away_from() -> None:
    def peak(points: Floats) -> Floats:
        return -np.abs(points - 0.7).sum(axis=1)

    found = search_cube(peak, 6, 2_000, 3, lambda done: None)[1].max()
    assert found > 0.6 * peak(np.random.default_rng(0).random((2_000, 6))).max()


def test_search__finds_several_peaks_that_are_apart_and_is_repeated_to_the_bit() -> None:
    centres = np.array([[0.2, 0.2, 0.8], [0.8, 0.3, 0.1], [0.5, 0.9, 0.5]])

    def hills(points: Floats) -> Floats:
        return -np.abs(points[:, np.newaxis] - centres).max(axis=2).min(axis=1)

    points, scores = search_cube(hills, 3, 1_500, 0, lambda done: None)
    rows = far_apart(points, scores, 3)
    nearest = np.abs(points[rows][:, np.newaxis] - centres).max(axis=2)
    assert sorted(nearest.argmin(axis=1)) == [0, 1, 2] and (nearest.min(axis=1) < 0.04).all()
    chosen = points[far_apart(points, scores, 20)]
    for k, point in enumerate(chosen):
        assert (np.abs(np.delete(chosen, k, axis=0) - point).max(axis=1) >= LEAST_DISTANCE).all()
    assert ((points > 0.0) & (points < np.nextafter(1.0, 0.0))).all()  # reflected at the faces, not cut off there
    again = search_cube(hills, 3, 1_500, 0, lambda done: None)
    assert again[0].tobytes() == points.tobytes()


def test_far_apart__never_takes_an_invalid_point() -> None:
    points, scores = np.array([[0.1], [0.5], [0.9]]), np.array([-np.inf, 1.0, 2.0])
    assert far_apart(points, scores, 9).tolist() == [2, 1]


def test_file__has_the_worlds_bit_for_bit(ethbrake: Command, empty_folder: Path) -> None:
    words = ("--agent", "coast", "--against", "full_brake", "--budget", "300", "--keep", "4", "--output", "worst.csv")
    told = told_json(ethbrake("study", "falsify", *words, "--json"))
    worlds = eb.read_worlds(SCENARIO, "worst.csv")
    result = eb.evaluate(worlds, "coast,full_brake", scenario=SCENARIO)
    harm, other = (result[name]["first_impact_harm"] for name in ("coast", "full_brake"))
    assert [each["harm"] for each in told["worlds"]] == harm.tolist() and told["worst"] == told["worlds"][0]["score"]
    assert [each["score"] for each in told["worlds"]] == (harm - other).tolist()
    assert told["worlds"][0]["state"]["gap_1_m"] == worlds.gaps_m[0, 0] and told["tried"] == 300
    shown = ethbrake("study", "falsify", *words[:4], "--budget", "64")
    assert "paper-random: 64 worlds tried; regret in m2/s2, first count: worst" in shown.out


def test_no_bad_world__writes_no_file(ethbrake: Command, empty_folder: Path) -> None:
    words = ("--agent", "full_brake", "--against", "constant:7", "--budget", "64", "--output", "none.csv")
    answer = ethbrake("study", "falsify", *words)
    assert answer.status == 0 and "no world has a score above 0, so none.csv was not written" in answer.err
    assert not Path("none.csv").exists()


@pytest.mark.parametrize(
    ("options", "key"),
    [
        ("--budget 0", "--budget"),
        ("--budget 10 --output worst.txt", "must end in .csv"),
        ("--budget 10 --output there.csv", "there.csv: already exists"),
        ("--budget 10 --measure bound", "is not behind a shield that promises a bound"),
        ("--measure harm --against coast --budget 10", "only --measure regret compares two agents"),
        ("--budget 10 --measure hram", "did you mean 'harm'?"),
        ("--measure harm --agent ppo@nowhere --budget 10", "nowhere"),
        ("--measure harm --budget 10 --scenario mixture-delays", "is a mixture"),
        ("--measure harm --budget 10 --scenario cooperation-2-blocked", "has random delays or losses"),
        ("--measure harm --budget 10 --scenario paper-scenario-1", "no quantity is random"),
        ("--agent ladder --measure harm --budget 8", "a name means several agents"),
    ],
)
def test_falsify__is_refused(options: str, key: str, refuse: Refuse, empty_folder: Path) -> None:
    Path("there.csv").write_text("precious")
    refuse(f"study falsify {'' if '--agent' in options.split() else '--agent coast '}{options}", key)


def test_scenario__whose_worlds_are_all_rejected_is_refused() -> None:
    lost = eb.load_scenario("paper-random").replace(gaps_m={"uniform": [0.1, 0.2]}, speeds_mps=[10, 20, 30])
    with refused("in all 10 tried worlds an impact happens before any agent may act"):
        WeaknessMeasure.of("harm", "coast", None, lost).falsify(10, 0)
