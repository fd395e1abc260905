"""Best responses in turn: cases by hand, a plain grid that beats none of them, and what is refused."""

from itertools import product

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.extensions.cooperation import (
    Equilibrium,
    best_joint_harm,
    compare_starts,
    equilibria,
    find_equilibria,
    price_of_anarchy,
)
from ethbrake_marl.extensions.search.best_harm import joined, scripted_commands, starting_profiles, task_problem
from ethbrake_marl.extensions.search.problem import Found, search_profiles
from ethbrake_marl.first_edition.engine.profiles import ProfileProblem
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.game.objectives import aim_of, parse_objective
from ethbrake_marl.first_edition.physics.episode import CLOCK, Decisions
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.scenario.task import Task

LEVELS = ("cooperation-3-pair", "cooperation-4-all")


def two_vehicles(rear_braking: float, front: str) -> tuple[eb.Scenario, Worlds]:
    """Both at 20 m/s, 2 m apart, of 1 t and 3 t, without latency; the front one brakes by 8 m/s2, the rear one less."""
    scenario = eb.load_scenario("cooperation-4-all").replace(
        vehicles=2, gaps_m=[2.0], speeds_mps=[20.0, 20.0], braking_capacity_mps2=[8.0, rear_braking], mass_t=[1.0, 3.0],
        driving_capacity_mps2=3.0, latency_s=0.0, obstacle_gap_m=60.0, objective="own",
        roles={"vehicle_1": front, "vehicle_2": "learner"},
    )  # fmt: skip
    return scenario, scenario.sample(1, 0).worlds


def test_rear_vehicle_alone__can_do_no_better_than_brake_from_any_start() -> None:
    """Closing at 8 - 6 m/s2 over 2 m: the square of the impact speed is 2 * 2 * 2 = 8, of which 1/4 is the rear's."""
    scenario, worlds = two_vehicles(6.0, "full_brake")
    for end in find_equilibria(scenario, worlds).values():
        assert end.converged.all()
        assert end.borne["first"] == pytest.approx(np.array([[6.0, 2.0]]), abs=0.02)
    braking = find_equilibria(scenario, worlds)["braking"]
    assert braking.rounds.tolist() == [1] and (braking.profiles.commands_mps2 == -6.0).all()


def test_two_learners__with_room_ahead_do_no_harm_and_stay_as_they_are_where_braking_does_none() -> None:
    """The front one stops after 25 m if it brakes fully and needs 60; braking by 6 m/s2 like the rear takes 33 m."""
    for end in find_equilibria(*two_vehicles(6.0, "learner")).values():
        assert end.converged.all() and end.borne["total"].sum() < 0.01
    braking = find_equilibria(*two_vehicles(8.0, "learner"))["braking"]
    assert braking.rounds.tolist() == [1] and (braking.profiles.commands_mps2 == -8.0).all()
    assert braking.borne["total"].tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("count", HARM_COUNTS)
def test_one_learner__does_what_a_search_of_its_objective_does(count: str) -> None:
    scenario = eb.load_scenario("cooperation-1-front")
    worlds = scenario.sample(12, 3).worlds
    ends = find_equilibria(scenario, worlds, harm_count=count, budget=500, rounds=1, tolerance=0.0, seed=4)
    weights, largest = aim_of(parse_objective("own"), worlds.vehicles, 1)
    problem = task_problem(worlds, Task(scenario, (1,), count)).minimising(weights, largest=largest)
    task, braking = Task(scenario, (1,), count), problem.constant(problem.bounds[:, np.newaxis, :, 0])
    given = starting_profiles(problem, worlds, task, scripted_commands(worlds, task), [braking])
    found, _ = search_profiles(problem, joined(given, 12), budget=500, seed=4)
    assert ends["braking"].borne[count].tolist() == problem.borne(found)[count].tolist()
    assert not ends["driving"].converged.any() and ends["driving"].rounds.tolist() == [1] * 12


class Replay:
    """Drives one vehicle of the joint profile of an equilibrium."""

    name = "replay"

    def __init__(self, commands: Floats, clock: Floats) -> None:
        self.commands, self.decisions = commands, Decisions(clock[:, CLOCK.START], clock[:, CLOCK.TIME_STEP])

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        return self.commands[np.arange(worlds.n), self.decisions.latest(worlds.time_s)]


@pytest.mark.parametrize("name", LEVELS)
def test_harm__is_the_engines_to_the_bit(name: str) -> None:
    scenario = eb.load_scenario(name)
    worlds = scenario.sample(30, 5).worlds
    clock = task_problem(worlds, Task(scenario, scenario.learners)).clock
    for end in find_equilibria(scenario, worlds, "own", budget=100, rounds=2).values():
        agents = {
            vehicle: Replay(end.profiles.commands_mps2[:, :, c], clock) for c, vehicle in enumerate(scenario.learners)
        }
        team = eb.evaluate(worlds, {"it": eb.Team(agents, "it")}, scenario=scenario, aftermath=False).outcome("it")
        for count in HARM_COUNTS:
            assert team.vehicle_harm(count).tolist() == end.borne[count].tolist()


def beaten_by(scenario: eb.Scenario, worlds: Worlds, end: Equilibrium, objective: str) -> Floats:
    """By how much some learner's constant or profile of two phases beats its own in each world, [n] m2/s2."""
    problem = task_problem(worlds, Task(scenario, scenario.learners))
    steps, gains = np.arange(end.profiles.ends.shape[1]), []
    for c, vehicle in enumerate(scenario.learners):
        weights, largest = aim_of(parse_objective(objective), worlds.vehicles, vehicle)

        def amount(borne: Floats, weights: Floats = weights, largest: bool = largest) -> Floats:
            return (weights * borne).max(axis=1) if largest else (weights * borne).sum(axis=1)

        for first, second, border in product(np.linspace(0.0, 1.0, 7), np.linspace(0.0, 1.0, 7), (3, 8, 15)):
            low, high = problem.bounds[:, c, :1], problem.bounds[:, c, 1:]
            commands = end.profiles.commands_mps2.copy()
            commands[:, :, c] = low + np.where(steps < border, first, second) * (high - low)
            other = problem.borne(end.profiles._replace(commands_mps2=commands))["first"]
            gains.append(amount(end.borne["first"]) - amount(other))
    return np.max(gains, axis=0)


CHANGED = {
    "brakes in pieces": ("cooperation-3-pair", {"vehicle_1": {"profile": [[0, 2], [0.7, 6]]}}),
    "slow brakes": ("realistic-truck-buildup", {"vehicle_2": "learner", "vehicle_3": "learner"}),
}


@pytest.mark.parametrize(("name", "objective"), [*product(LEVELS, ("own", "maximin")), *product(CHANGED, ["total"])])
def test_what_converged__no_learner_improves_by_constants_or_two_phases(name: str, objective: str) -> None:
    level, roles = CHANGED.get(name, (name, {}))
    scenario = eb.load_scenario(level)
    scenario = scenario.replace(roles={**scenario.roles, **roles})
    worlds = scenario.sample(8, 11).worlds
    for end in find_equilibria(scenario, worlds, objective, budget=2_000).values():
        assert end.converged.mean() >= 0.7
        assert beaten_by(scenario, worlds, end, objective)[end.converged].max() <= 0.02


def test_selfish_ends__never_beat_the_joint_optimum_and_do_not_depend_on_other_worlds() -> None:
    scenario = eb.load_scenario("cooperation-3-pair")
    worlds = scenario.sample(12, 9).worlds
    ends = find_equilibria(scenario, worlds, "own", budget=500)
    part = find_equilibria(scenario, worlds.take([7, 2]), "own", budget=500, threads=2)
    for name, end in ends.items():
        assert part[name].borne["total"].tolist() == end.borne["total"][[7, 2]].tolist()
    alone, joint = (best_joint_harm(scenario, worlds, each, budget=4_000)["first"] for each in ((), ends.values()))
    for end in ends.values():
        assert (end.borne["first"].sum(axis=1) >= joint.sum(axis=1)).all()
        assert (end.borne["first"].sum(axis=1) >= alone.sum(axis=1) - 0.02).all()


def test_world_that_fails_in_a_later_round__is_named_by_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = eb.load_scenario("cooperation-4-all")
    worlds = scenario.sample(12, 9).worlds
    rounds = find_equilibria(scenario, worlds, budget=100, rounds=2)["braking"].rounds
    worlds, first = worlds.take(np.argsort(rounds, kind="stable")), int((rounds == 1).sum())
    assert 0 < first < 12  # of the worlds that are left in the second round

    def failing(problem: ProfileProblem, *given: object, **options: object) -> Found:
        if problem.n < 12:
            raise PhysicsError({0: "planted"})
        return search_profiles(problem, *given, **options)

    monkeypatch.setattr(equilibria, "search_profiles", failing)
    with pytest.raises(PhysicsError) as caught:
        find_equilibria(scenario, worlds, budget=100, rounds=2)
    assert caught.value.worlds == {first: "planted"}


def ends_of(*borne: list[list[float]], converged: list[list[bool]]) -> dict[str, Equilibrium]:
    profiles, rounds = None, np.ones(len(borne[0]), np.int64)
    return {
        str(k): Equilibrium(profiles, {"first": np.array(each)}, np.array(there), rounds)
        for k, (each, there) in enumerate(zip(borne, converged, strict=True))
    }


def test_spread__is_of_the_ends_that_converged() -> None:
    one, other = [[1.0, 2.0], [5.0, 0.0], [9.0, 9.0]], [[2.05, 1.0], [0.0, 0.0], [8.0, 8.0]]
    spread = compare_starts(ends_of(one, other, converged=[[True, True, False], [True, False, False]]), "first")
    assert spread.found.tolist() == [2, 1, 0] and spread.differs.tolist() == [True, False, False]
    assert spread.best[:2].tolist() == [[1.0, 2.0], [5.0, 0.0]] and spread.worst[:2].tolist() == [
        [2.05, 1.0],
        [5.0, 0.0],
    ]
    assert np.isnan(spread.best[2]).all() and np.isnan(spread.worst[2]).all()
    close = ends_of([[1.0, 2.0]], [[1.09, 2.0]], converged=[[True], [True]])
    assert not compare_starts(close, "first").differs.any() and compare_starts(close, "first", 0.05).differs.all()


def test_price__is_the_ratio_of_the_means_over_worlds_where_something_converged() -> None:
    optimum = np.array([[1.0, 0.0], [1.0, 2.0], [7.0, 0.0]])
    price = price_of_anarchy(np.array([[3.0, 1.0], [2.0, 2.0], [np.nan, np.nan]]), optimum)
    assert price is not None and price.value == pytest.approx(2.0)  # (4 + 4) / (1 + 3)
    assert price.interval is not None and price.interval[0] < 2.0 < price.interval[1]
    assert price_of_anarchy(np.ones((2, 2)), np.zeros((2, 2))) is None


@pytest.mark.parametrize(
    ("level", "options", "message"),
    [
        (
            "cooperation-0-sensors",
            {},
            "scenario 'cooperation-0-sensors': the scenario has no learner; give at least one vehicle",
        ),
        ("cooperation-3-pair", {"tolerance": float("nan")}, "tolerance = nan: the tolerance must be a finite"),
        ("cooperation-3-pair", {"rounds": 0}, "rounds = 0: must be a whole number, at least 1"),
        ("cooperation-3-pair", {"budget": 0}, "budget = 0: must be a whole number, at least 1"),
        ("cooperation-3-pair", {"seed": -1}, "seed = -1: must be a whole number, at least 0"),
        ("cooperation-3-pair", {"objective": ["own"]}, "objective: the list has 1 entries; must have 3"),
        ("cooperation-3-pair", {"objective": "injury:lr4s"}, "is not a weighted sum of the vehicles' harm; use"),
        ("cooperation-3-pair", {"harm_count": "last"}, "last"),
    ],
)
def test_bad_input__is_refused_in_one_line(level: str, options: dict[str, object], message: str) -> None:
    scenario = eb.load_scenario(level)
    with pytest.raises(InvalidInput, match=message) as caught:
        find_equilibria(scenario, scenario.sample(1, 0).worlds, **options)
    assert "\n" not in str(caught.value)
