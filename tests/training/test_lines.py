"""Mixtures of lines: what they are, who refuses them, and how a training uses them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.training.fixed_list import drive_list, full_braking
from ethbrake_marl.training.recipe import load_recipe
from ethbrake_marl.training.train import make_environment, train
from ethbrake_marl.training.training import Training
from tests.refused import refused
from tests.training.tiny import TINY

FILE = """name: lines
mixture:
  - {scenario: paper-random, weight: 3}
  - scenario: {name: five, based_on: cooperation-2-five, roles: {vehicle_1: full_brake, vehicle_3: learner, vehicle_5: learner}}
"""  # noqa: E501  # a flow mapping cannot be broken more clearly
MEMBERS = [eb.load_scenario("paper-random"), eb.load_scenario("cooperation-2-five")]
LINES = eb.load_scenario(
    {
        "name": "lines",
        "mixture": [
            {"scenario": MEMBERS[0].declared(), "weight": 3},
            {"scenario": MEMBERS[1].with_learners(["vehicle_3", "vehicle_5"]).replace(name="five").declared()},
        ],
    }
)
TRAINING = Training(TINY, LINES, "shared", ("vehicle_2", "vehicle_3", "vehicle_5"), (eb.View(["own", "front_1"]),) * 3)


def test_mixture_of_lines__has_the_vehicles_of_the_longest_and_the_learners_of_all(empty_folder: Path) -> None:
    Path("lines.yaml").write_text(FILE)
    scenario = eb.load_scenario("lines.yaml")
    assert [line.name for line in scenario.lines] == ["paper-random", "five"]
    assert [line.learners for line in scenario.lines] == [(2,), (3, 5)]
    assert [line.vehicles for line in scenario.lines] == [3, 5]
    assert (scenario.vehicles, scenario.learners) == (5, (2, 3, 5))
    with refused("roles of a scenario cannot be changed"):
        scenario.roles["vehicle_2"] = "coast"
    again = eb.Scenario(**scenario.declared())
    assert again == scenario and again.lines == scenario.lines == eb.load_scenario("lines.yaml").lines
    assert {"vehicles", "roles"}.isdisjoint(scenario.content()) and len(scenario.content()["mixture"]) == 2
    slower = scenario.replace(horizon_s=5.0)
    assert [line.horizon_s for line in slower.lines] == [5.0, 5.0]
    assert eb.load_scenario("mixture-delays").lines == MEMBERS[0].lines == ()


@pytest.mark.parametrize(
    "use",
    [
        lambda: LINES.sample(2, 7),
        lambda: LINES.with_learners(["vehicle_2"]),
        lambda: eb.parallel_env(LINES),
        lambda: eb.evaluate(LINES, "full_brake", episodes=2),
    ],
)
def test_worlds_games_and_evaluations__need_one_line(use: Callable[[], object]) -> None:
    with refused("scenario 'lines': its scenarios have different vehicles or roles, so only a training"):
        use()


def test_training__needs_an_algorithm_that_mixes_lines_and_a_learner_in_every_line(tmp_path: Path) -> None:
    with refused("scenario 'lines': its scenarios have different vehicles or roles, and the algorithm ppo of recipe"):
        train(load_recipe("ppo"), LINES, tmp_path / "run", on_progress=None)
    members = [{"scenario": MEMBERS[0].declared()}, {"scenario": MEMBERS[1].with_learners([]).declared()}]
    silent = eb.load_scenario({"name": "silent", "mixture": members})

    class Mixing(type(TINY)):  # type: ignore[misc]  # the class is a value here
        mixes_lines = True

    with refused("scenario 'cooperation-2-five' has no learner"):
        Training.of(Mixing(**TINY.model_dump(mode="json")), silent)


def test_environment__has_the_rows_of_every_line_and_goes_on_from_a_snapshot() -> None:
    assert [line.recipe.n_envs for line in TRAINING.lines] == [6, 2]
    assert [line.recipe.evaluation.worlds for line in TRAINING.lines] == [8, 2]
    assert [line.learners for line in TRAINING.lines] == [("vehicle_2",), ("vehicle_3", "vehicle_5")]
    environment = make_environment(TRAINING)
    parts = [
        eb.make_sb3_vec_env(line, n, seed=0, reward=TINY.reward, observation=["own", "front_1"])
        for line, n in zip(LINES.lines, (6, 2), strict=True)
    ]
    assert environment.num_envs == 6 + 2 * 2
    assert environment.get_attr("n", [0, 9]) == [6, 2] and environment.env_is_wrapped(object, [0, 9]) == [False, False]
    np.testing.assert_array_equal(environment.reset(), np.concatenate([part.reset() for part in parts]))
    actions, saved = np.linspace(-1, 1, 10)[:, np.newaxis], environment.snapshot()
    for _ in range(60):  # beyond the end of every episode
        rows, rewards, dones, infos = environment.step(actions)
        expected = [
            part.step(actions[part_rows]) for part, part_rows in zip(parts, (slice(6), slice(6, 10)), strict=True)
        ]
        for result, results in zip((rows, rewards, dones), zip(*expected, strict=True), strict=False):
            np.testing.assert_array_equal(result, np.concatenate(results))
        assert [info.get("episode") for info in infos] == [info.get("episode") for part in expected for info in part[3]]
    environment.restore(saved)
    again = [environment.step(actions) for _ in range(60)][-1]
    np.testing.assert_array_equal(again[0], rows)
    environment.close()


def test_environment__repeats_the_worlds_of_a_seed() -> None:
    environment = make_environment(TRAINING)
    observations = []
    for seed in (5, 5, 6, None):
        assert len(set(environment.seed(seed))) <= 2 and len(environment.seed(seed)) == environment.num_envs
        observations.append(environment.reset())
    first, again, other, random = observations
    np.testing.assert_array_equal(first, again)
    for rows in (slice(6), slice(6, 10)):  # of each line
        assert (first[rows] != other[rows]).any() and (first[rows] != random[rows]).any()
    np.testing.assert_array_equal(first, make_environment(TRAINING._replace(recipe=TINY.replace(seed=5))).reset())
    environment.close()


def test_metrics__are_means_over_the_worlds_and_costs_relative_to_full_braking() -> None:
    agents = dict.fromkeys(TRAINING.learners, eb.make_agent("coast"))
    metrics, (first, second) = drive_list(TRAINING)(agents), TRAINING.lines
    alone = [drive_list(line)({name: agents[name] for name in line.learners}) for line in (first, second)]
    assert metrics["total_harm"] == pytest.approx((8 * alone[0]["total_harm"] + 2 * alone[1]["total_harm"]) / 10)
    ratios = [
        coasting["honest_cost"] / full_braking(line)["honest_cost"]
        for line, coasting in zip((first, second), alone, strict=True)
    ]
    assert [metrics["relative_paper-random"], metrics["relative_five"]] == ratios
    assert metrics["objective"] == pytest.approx((8 * ratios[0] + 2 * ratios[1]) / 10)
    assert full_braking(TRAINING)["objective"] == pytest.approx(1.0)


def test_metrics__of_lines_with_an_objective_are_relative_to_its_cost() -> None:
    recipe = TINY.replace(reward={"harm": 1.0, "harm_count": "total", "objective": "own"})
    training = TRAINING._replace(recipe=recipe)
    metrics = drive_list(training)(dict.fromkeys(training.learners, eb.make_agent("coast")))
    ratios = []
    for line, learners in zip(training.lines, ([2], [3, 5]), strict=True):
        plan = line.recipe.evaluation
        result = eb.evaluate(line.scenario, "coast,full_brake", episodes=plan.worlds, seed=plan.seed, measures="own")
        coasting, braking = (
            np.mean([result[agent][f"own_total_{body}"].mean() for body in learners])
            for agent in ("coast", "full_brake")
        )
        ratios.append(coasting / braking)
        harms = [result[agent]["total_harm"].mean() for agent in ("coast", "full_brake")]
        assert coasting / braking != pytest.approx(harms[0] / harms[1])
    assert [metrics["relative_paper-random"], metrics["relative_five"]] == pytest.approx(ratios)


def test_metrics__of_a_line_without_cost_are_refused() -> None:
    far = MEMBERS[0].replace(name="far", gaps_m=200.0)
    free = LINES.replace(mixture=[{"scenario": far.declared()}, {"scenario": LINES.lines[1].declared()}])
    with refused("scenario 'far': full braking costs nothing in the worlds of the fixed list (5)"):
        drive_list(TRAINING._replace(scenario=free))
