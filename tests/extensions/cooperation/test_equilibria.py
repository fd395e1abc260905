"""Best responses in turn: cases by hand, a plain grid that beats none of them, and what is refused."""

from itertools import product

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.objectives import amounts, objectives_of
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.cooperation import (
    Equilibrium,
    best_joint_harm,
    compare_starts,
    find_equilibria,
    price_of_anarchy,
)
from ethbrake_marl.extensions.cooperation.equilibria import turn_of
from ethbrake_marl.extensions.search.pricing import Profiles, problem_of
from ethbrake_marl.motion.layout import Floats


def two_vehicles(rear_braking: float, front: str) -> tuple[eb.Scenario, eb.State]:
    """Both at 20 m/s, 2 m apart, of 1 t and 3 t, without latency; the front one brakes by 8 m/s2, the rear one less."""
    scenario = eb.load_scenario("cooperation-4-all").replace(
        vehicles=2, gaps_m=[2.0], speeds_mps=[20.0, 20.0], braking_capacity_mps2=[8.0, rear_braking], mass_t=[1.0, 3.0],
        driving_capacity_mps2=3.0, latency_s=0.0, obstacle_gap_m=60.0, objective="own",
        roles={"vehicle_1": front, "vehicle_2": "learner"},
    )  # fmt: skip
    return scenario, scenario.sample(1, 0)


def test_rear_vehicle_alone__can_do_no_better_than_brake_from_any_start() -> None:
    """Closing at 8 - 6 m/s2 over 2 m: the square of the impact speed is 2 * 2 * 2 = 8, of which 1/4 is the rear's."""
    ends = find_equilibria(*two_vehicles(6.0, "full_brake"), budget=1_000)
    for end in ends.values():
        assert end.converged.all() and end.borne == pytest.approx(np.array([[6.0, 2.0]]), abs=0.02)
    assert ends["braking"].rounds.tolist() == [1] and (ends["braking"].profiles.commands_mps2 == -6.0).all()


def test_two_learners__with_room_ahead_do_no_harm_and_stay_as_they_are_where_braking_does_none() -> None:
    """The front one stops after 25 m if it brakes fully and needs 60; braking by 6 m/s2 like the rear takes 33 m."""
    ends = find_equilibria(*two_vehicles(6.0, "learner"), budget=1_000)
    assert all(end.converged.all() for end in ends.values()) and ends["braking"].borne.sum() < 0.01
    braking = find_equilibria(*two_vehicles(8.0, "learner"), budget=300)["braking"]
    assert braking.rounds.tolist() == [1] and (braking.profiles.commands_mps2 == -8.0).all()
    assert braking.borne.tolist() == [[0.0, 0.0]]


def beaten_by(scenario: eb.Scenario, worlds: eb.State, end: Equilibrium, objective: str) -> Floats:
    """By how much some learner's constant or plan of two commands beats its own in each world, [n] m2/s2."""
    problem, objectives = problem_of(eb.open_game(scenario)[1], worlds), objectives_of(objective, scenario.vehicles)
    steps, gains = np.arange(end.profiles.ends.shape[1]), []
    for c, body in enumerate(scenario.learners):

        def amount(profiles: Profiles, vehicle: int = body - 1) -> Floats:
            return amounts(objectives, None, problem.follow(profiles), "first")[:, vehicle]

        for first, second, border in product(np.linspace(0.0, 1.0, 7), np.linspace(0.0, 1.0, 7), (3, 8, 15)):
            low, high = problem.bounds[:, c, :1], problem.bounds[:, c, 1:]
            commands = end.profiles.commands_mps2.copy()
            commands[:, :, c] = np.clip(low + np.where(steps < border, first, second) * (high - low), low, high)
            gains.append(amount(end.profiles) - amount(end.profiles._replace(commands_mps2=commands)))
    return np.max(gains, axis=0)


@pytest.mark.parametrize(("name", "objective"), [("cooperation-3-pair", "own"), ("cooperation-4-all", "maximin")])
def test_what_converged__no_learner_improves_by_constants_or_two_commands(name: str, objective: str) -> None:
    scenario = eb.load_scenario(name)
    worlds = scenario.sample(4, 11)
    for end in find_equilibria(scenario, worlds, objective, budget=1_000).values():
        assert end.converged.mean() >= 0.7
        assert beaten_by(scenario, worlds, end, objective)[end.converged].max() <= 0.02


@pytest.mark.parametrize("count", ["first", "honest"])
def test_turn__minimises_the_objective_of_its_learner_alone(count: str) -> None:
    scenario, game = eb.open_game("cooperation-3-pair")
    worlds = scenario.sample(5, 3)
    for body, other in ((2, 3), (3, 2)):
        problem = turn_of(game, worlds, body, ["total", "own", "maximin"], count)
        assert problem.bodies.tolist() == [body, other]
        last = problem.follow(problem.constant(problem.bounds[:, np.newaxis, :, 1]))
        borne = last.borne_harm(count)
        expected = borne[:, 1] if body == 2 else borne.max(axis=1)
        assert problem.value(last) == pytest.approx(expected)


def test_ends__never_beat_the_joint_optimum_and_do_not_depend_on_other_worlds() -> None:
    scenario = eb.load_scenario("cooperation-3-pair")
    worlds = scenario.sample(4, 9)
    ends = find_equilibria(scenario, worlds, "own", budget=500)
    part = find_equilibria(scenario, worlds.take([3, 1]), "own", budget=500)
    for name, end in ends.items():
        assert part[name].borne.tolist() == end.borne[[3, 1]].tolist()
    joint = best_joint_harm(scenario, worlds, ends.values(), budget=2_000).sum(axis=1)
    best = best_joint_harm(scenario, worlds, (), budget=2_000).sum(axis=1)
    assert (joint <= best).all()
    for end in ends.values():
        assert (end.borne.sum(axis=1) >= joint).all()


def test_honest_cost__counts_in_equilibria_and_in_the_joint_optimum() -> None:
    scenario, worlds = two_vehicles(6.0, "learner")
    ends = find_equilibria(scenario, worlds, count="honest", budget=300)
    problem = problem_of(eb.open_game(scenario)[1], worlds)
    for end in ends.values():
        assert end.borne.tolist() == problem.follow(end.profiles).borne_harm("honest").tolist()
    joint = best_joint_harm(scenario, worlds, ends.values(), budget=300, count="honest")
    assert joint.sum() <= min(end.borne.sum() for end in ends.values())


def ends_of(*borne: list[list[float]], converged: list[list[bool]]) -> dict[str, Equilibrium]:
    nothing, rounds = Profiles(np.zeros((0, 1), int), np.zeros((0, 1, 1))), np.ones(len(borne[0]), np.int64)
    return {
        str(k): Equilibrium(nothing, np.array(each), np.array(there), rounds)
        for k, (each, there) in enumerate(zip(borne, converged, strict=True))
    }


def test_spread__is_of_the_ends_that_converged() -> None:
    one, other = [[1.0, 2.0], [5.0, 0.0], [9.0, 9.0]], [[2.05, 1.0], [0.0, 0.0], [8.0, 8.0]]
    spread = compare_starts(ends_of(one, other, converged=[[True, True, False], [True, False, False]]))
    assert spread.found.tolist() == [2, 1, 0] and spread.differs.tolist() == [True, False, False]
    assert spread.best[:2].tolist() == [[1.0, 2.0], [5.0, 0.0]]
    assert spread.worst[:2].tolist() == [[2.05, 1.0], [5.0, 0.0]]
    assert np.isnan(spread.best[2]).all() and np.isnan(spread.worst[2]).all()
    close = ends_of([[1.0, 2.0]], [[1.09, 2.0]], converged=[[True], [True]])
    assert not compare_starts(close).differs.any()


def test_price__is_the_ratio_of_the_means_over_worlds_where_something_converged() -> None:
    optimum = np.array([[1.0, 0.0], [1.0, 2.0], [7.0, 0.0]])
    price = price_of_anarchy(np.array([[3.0, 1.0], [2.0, 2.0], [np.nan, np.nan]]), optimum)
    assert price is not None and price.value == pytest.approx(2.0)  # (4 + 4) / (1 + 3)
    assert price.interval is not None and price.interval[0] < 2.0 < price.interval[1]
    assert price_of_anarchy(np.ones((2, 2)), np.zeros((2, 2))) is None


@pytest.mark.parametrize(
    ("level", "options", "message"),
    [
        ("level-0-sensors", {}, "'level-0-sensors' has no learner; give at least one vehicle"),
        ("cooperation-3-pair", {"rounds": 0}, "rounds = 0: must be a whole number, at least 1"),
        ("cooperation-3-pair", {"budget": 0}, "budget = 0: must be a whole number, at least 1"),
        ("cooperation-3-pair", {"objective": ["own"]}, "objective: the list has 1 entries; must have 3"),
        ("cooperation-3-pair", {"objective": "injury:lr4s"}, "is not a weighted sum of the vehicles' harm; use"),
        ("cooperation-3-pair", {"count": "last"}, "count = 'last'"),
    ],
)
def test_bad_input__is_refused_in_one_line(level: str, options: dict[str, object], message: str) -> None:
    scenario = eb.load_scenario(level)
    with pytest.raises(InvalidInput, match=message) as caught:
        find_equilibria(scenario, scenario.sample(1, 0), **options)
    assert "\n" not in str(caught.value)
