"""Search and proofs where an obstacle stands ahead of Vehicle 1."""

from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.search.best_harm import best_harm, task_problem
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.task import Task
from tests.refused import refused

ALL = load_scenario("cooperation-4-all")


def test_best_harm__of_the_whole_line_is_no_worse_than_of_its_followers() -> None:
    worlds, level_3 = ALL.sample(3, 7).worlds, ALL.with_learners([1, 2])
    settings = {"counts": ("total",), "budget": 3_000, "threads": 1}
    together, followers = (best_harm(each, worlds, **settings).best["total"] for each in (ALL, level_3))
    assert together.harm.mean() < followers.harm.mean()
    _, again = task_problem(worlds, Task(ALL, (0, 1, 2))).follow(together.profiles)
    assert again.tobytes() == together.harm.tobytes()


def test_proofs__cover_an_obstacle_that_full_braking_never_meets() -> None:
    worlds, plain = (load_scenario(name).with_learners([1]).sample(200, 7).worlds for name in
                     ("cooperation-4-all", "cooperation-2-paper"))  # fmt: skip
    assert avoidability(worlds).reason.tolist() == avoidability(plain).reason.tolist()


def test_proof__of_an_obstacle_that_full_braking_meets_is_refused() -> None:
    near = ALL.replace(obstacle_gap_m={"uniform": [10, 45]})
    with refused("avoidability: obstacle_gap_m[0] = 33.6372: must be greater than the stopping distance of vehicle_1"):
        avoidability(near.sample(200, 7).worlds)
