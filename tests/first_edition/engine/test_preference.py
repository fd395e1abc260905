"""Weights of harm as a quantity of the world: drawn, fixed, observed, and minimised by the objective ``preference``."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput, Unfamiliar
from ethbrake_marl.first_edition.evaluation.identity import worlds_sha256
from ethbrake_marl.first_edition.game.objectives import scored
from ethbrake_marl.first_edition.scenario.fields import QUANTITY

PAPER = eb.load_scenario("paper-random")
SHARES = ["own_harm_weight", "front_1.harm_weight", "rear_1.harm_weight"]


def harms(scenario: eb.Scenario) -> np.ndarray:
    agent = eb.make_agent("full_brake")
    return eb.evaluate(scenario.sample(20, 3), {"it": agent}, scenario=scenario).outcome("it").vehicle_harm("total")


@pytest.mark.parametrize("weights", [[1, 4, 1], [0, 0, 2], [0.25, 0.5, 1]])
@pytest.mark.parametrize("count", ["first", "total"])
def test_preference__is_the_weighted_objective_with_the_weights_of_the_world_to_the_bit(
    weights: list, count: str
) -> None:
    text = "weighted:" + ",".join(map(str, weights))
    rewards = []
    for scenario in (PAPER.replace(harm_weight=weights, objective="preference"), PAPER.replace(objective=text)):
        env = eb.parallel_env(scenario, reward={"harm": 1.0, "harm_count": count})
        told = []
        for seed in range(5):
            env.reset(seed=seed)
            while env.agents:
                told.append(env.step({"vehicle_2": np.array([-1.0], np.float32)})[1])
        rewards.append(told)
    assert rewards[0] == rewards[1] and any(sum(each.values()) < 0.0 for each in rewards[0])


def test_weights__are_drawn_from_numbers_of_their_own_and_change_no_motion() -> None:
    drawn = PAPER.replace(harm_weight={"loguniform": [0.01, 1.0]}, objective="preference")
    one, other = PAPER.sample(20, 3), drawn.sample(20, 3)
    assert one.worlds.gaps_m.tolist() == other.worlds.gaps_m.tolist()
    weights = other.worlds.vehicles.harm_weight
    assert ((weights >= 0.01) & (weights <= 1.0)).all() and len(np.unique(weights)) == 60
    assert (one.worlds.vehicles.harm_weight == 1.0).all()
    assert harms(PAPER).tolist() == harms(drawn).tolist()
    hashes = [worlds_sha256(each.worlds, each.index) for each in (one, other)]
    assert hashes[0] != hashes[1]


def test_weights__reach_observations_as_shares_and_stay_through_an_episode() -> None:
    scenario = PAPER.replace(harm_weight=[1, 2, 5], observation=SHARES)
    env = eb.EthBrakeEnv(scenario)
    observation, _ = env.reset(seed=1)
    assert observation.tolist() == [0.25, 0.125, 0.625]
    for _ in range(5):
        observation = env.step(np.array([-1.0], np.float32))[0]
    assert observation.tolist() == [0.25, 0.125, 0.625]


def test_weights__stand_in_a_table_of_worlds_and_come_back() -> None:
    scenario = PAPER.replace(harm_weight=[{"uniform": [0.0, 3.0]}, 1, {"loguniform": [1e-3, 1]}])
    worlds = scenario.sample(4, 9).worlds
    again = eb.worlds_from_table(scenario, QUANTITY.columns(worlds))
    assert again.vehicles.harm_weight.tolist() == worlds.vehicles.harm_weight.tolist()
    assert "harm_weight_1" not in QUANTITY.columns(PAPER.sample(4, 9).worlds)


def test_weights__weigh_the_same_ledger_in_results() -> None:
    scenario = PAPER.replace(harm_weight=[3, 0, 0], objective="preference")
    outcome = eb.evaluate(scenario.sample(20, 3), {"it": eb.make_agent("coast")}, scenario=scenario).outcome("it")
    amounts = scored(outcome.ledger, "first", ["preference"])["preference"]
    assert amounts == pytest.approx(3.0 * outcome.vehicle_harm("first")[:, [0, 0, 0]])


def test_weights__do_not_make_a_policy_unfamiliar(recwarn: pytest.WarningsRecorder) -> None:
    scenario = PAPER.replace(harm_weight=[1, 0, 9])
    eb.evaluate(scenario.sample(3, 3), {"it": eb.make_agent("ppo")}, scenario=scenario)
    assert not [each for each in recwarn if issubclass(each.category, Unfamiliar)]


@pytest.mark.parametrize(
    ("weights", "words"),
    [
        ([0, 0, 0], "harm_weight = [0, 0, 0]: may be 0 in all vehicles; at least one vehicle must"),
        ({"choice": [0, 1, 1]}, "may be 0 in all vehicles"),
        ({"uniform": [0, 1]}, "may be 0 in all vehicles"),
        ({"loguniform": [1e-320, 1]}, "low is too near to 0"),
        ([1, -1, 1], "harm_weight"),
        ([1, 1], "harm_weight"),
        ([1, float("nan"), 1], "harm_weight"),
        (2e6, "harm_weight"),
    ],
)
def test_weights__that_are_none_are_refused(weights: object, words: str) -> None:
    with pytest.raises(InvalidInput) as error:
        PAPER.replace(harm_weight=weights).sample(1, 0)
    assert words in str(error.value)


def test_world__in_which_nobody_counts_is_refused_by_its_number() -> None:
    with pytest.raises(InvalidInput, match="world 1: the weight of at least one vehicle must be 1e-06"):
        eb.make_worlds(
            [7.0, 7.0], [[20.0, 18.0, 20.0]] * 2, braking_capacity_mps2=6.0, driving_capacity_mps2=3.0, latency_s=0.0,
            mass_t=4.5, restitution=0.1, harm_weight=[[1.0, 0.0, 0.0], [0.0, 0.0, 1e-9]],
        )  # fmt: skip
