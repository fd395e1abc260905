"""Vector rewards: a component for each vehicle's harm, in every interface."""

from typing import Any

import gymnasium
import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.first_edition.game.objectives import OBJECTIVES, HarmSoFar, parse_objective

WEIGHTS = {
    "paper-random": "1,4,2",
    "cooperation-4-all": "1,4,2",
    "realistic-truck": "3,1,0.5",
    "cooperation-3-five": "1,2,3,4,5",
}
# Vehicle 2 is 4 m/s faster than the coasting Vehicle 1 and strikes it after 0.5 s
LINE = {"gaps_m": [2.0, 40.0], "speeds_mps": [10.0, 14.0, 10.0]}
COASTING = eb.load_scenario("paper-random").replace(
    roles={"vehicle_1": "coast", "vehicle_2": "learner", "vehicle_3": "coast"}, latency_s=[0.0, 0.0, 0.0]
)


def weighted(vector: np.ndarray, weights: str) -> float:
    """N (w_1 r_1 + ... + w_N r_N) / (w_1 + ... + w_N), summed front to rear."""
    total, whole = 0.0, 0.0
    for reward, weight in zip(vector, map(float, weights.split(",")), strict=True):
        total, whole = total + weight * reward, whole + weight
    return len(vector) * total / whole


@pytest.mark.parametrize("scenario", WEIGHTS)
@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_weighted_sum__equals_the_reward_of_these_weights_to_the_bit(scenario: str, harm_count: str) -> None:
    base = {"harm": 1.0, "harm_count": harm_count}
    reward = {**base, "objective": f"weighted:{WEIGHTS[scenario]}"}
    many = eb.parallel_env(scenario, agents="learners", reward=base, reward_vector="vehicles")
    one = eb.parallel_env(scenario, agents="learners", reward=reward)
    draws, struck = np.random.default_rng(1), 0
    for seed in range(12):
        many.reset(seed=seed), one.reset(seed=seed)
        while many.agents:
            actions = {agent: draws.uniform(-1.0, 1.0, 1) for agent in many.agents}
            vectors, numbers = many.step(actions)[1], one.step(actions)[1]
            for agent, vector in vectors.items():
                assert weighted(vector, WEIGHTS[scenario]) == numbers[agent] and many.reward_space(agent).contains(
                    vector
                )
                struck += bool(vector.any())
    assert struck > 10


def test_vector__by_hand() -> None:
    """The masses of the paper share the harm of 16 m2/s2: 8.8 for Vehicle 1 (4.5 t), 7.2 for Vehicle 2 (5.5 t)."""
    names = ["pair_1_2", "harm_2", "harm_1", "harm_3", "jerk", "obstacle"]
    env = eb.EthBrakeEnv(COASTING, reward={"harm": 0.5, "jerk": 1e-3}, reward_vector=names)
    env.reset(options={"initial_state": LINE})
    rewards = np.array([env.step(np.zeros(1))[1] for _ in range(8)])
    struck = np.flatnonzero(rewards[:, 0])
    assert len(struck) == 1 and rewards[struck[0], :4] == pytest.approx([-16.0, -7.2, -8.8, 0.0])
    assert not np.signbit(rewards[0, :4]).any() and rewards[:, 4:].tolist() == [[0.0, 0.0]] * 8
    assert env.reward_dim == 6 and env.reward_space.shape == (6,)


def test_interfaces__give_the_same_vectors() -> None:
    actions = np.random.default_rng(3).uniform(-1.0, 1.0, (60, 1, 1))
    vector = gymnasium.make_vec("EthBrakeMO-v1", num_envs=1, scenario="paper-random", autoreset_mode="Disabled")
    made: list[Any] = [
        gymnasium.make("EthBrakeMO-v1", scenario="paper-random"),
        eb.ShieldedEnv(eb.EthBrakeEnv(reward_vector="vehicles"), mode="step"),
        eb.parallel_env(reward_vector="vehicles"),
        eb.env(reward_vector="vehicles"),
    ]
    for env in (vector, *made):
        env.reset(seed=5)
    shielded = eb.EthBrakeEnv(reward_vector="vehicles")
    shielded.reset(seed=5)
    for action in actions:
        expected = vector.step(action)[1][0]
        single, parallel, turns = made[0].step(action[0])[1], made[2].step({"vehicle_2": action[0]})[1], made[3]
        for agent in turns.agents:
            turns.step(action[0] if agent == "vehicle_2" else None)
        each = [single, parallel["vehicle_2"], parallel["vehicle_1"], turns.rewards["vehicle_2"]]
        assert [one.tolist() for one in each] == [expected.tolist()] * 4
        if made[1].unwrapped.engine.ended[0]:
            break
        applied = made[1].step(action[0])
        assert applied[1].tolist() == shielded.step(applied[4]["shield_applied_action"])[1].tolist()
        if not parallel or not made[2].agents:
            break
    assert vector.unwrapped.reward_space == made[0].unwrapped.reward_space


@pytest.mark.parametrize(
    "given", ["harm", [], ["harm_1", "harm_1"], 3, "vehicle", [["harm_1"]], np.array(["harm_1", "harm_2"])]
)
def test_vector__that_is_none_is_refused(given: Any) -> None:
    with pytest.raises(InvalidInput, match=r"^reward_vector = .*: must be 'vehicles', or a list of different"):
        eb.parallel_env(reward_vector=given)


@pytest.mark.parametrize(("name", "known"), [("harm_4", "harm_3"), ("jerk", "harm_1"), ("pair_2_1", "pair_2_3")])
def test_component__that_is_none_is_refused_by_name(name: str, known: str) -> None:
    with pytest.raises(UnknownName, match=f"{name}.*{known}"):
        eb.EthBrakeEnv(reward_vector=["harm_1", name])


def test_number__where_a_vector_is_asked_for() -> None:
    with pytest.raises(InvalidInput, match="reward_space: the rewards of this environment are numbers"):
        eb.parallel_env().reward_space("vehicle_2")
    with pytest.raises(InvalidInput, match="wrap the environment in mo_gymnasium's LinearReward"):
        env = eb.CostEnv(eb.EthBrakeEnv(reward_vector="vehicles"))
        env.reset(seed=0)
        env.step(np.zeros(1))


@pytest.mark.parametrize("text", ["total", "own", "social:30", "mass-weighted", "weighted:1,4,0", "preference"])
def test_weights__of_an_objective_give_its_amount(text: str) -> None:
    line = eb.load_scenario("paper-random").replace(harm_weight=[1, 0, 3]).sample(1, 0).worlds.vehicles
    borne = np.array([[3.0, 5.0, 7.0]])
    harm = HarmSoFar(borne, borne.sum(axis=1), line.mass_t, borne, borne, line.harm_weight)
    objective = parse_objective(text)
    for vehicle in range(3):
        kind = OBJECTIVES[objective.kind]
        weights = kind.weights(objective, line, vehicle)
        assert (weights * borne).sum() == pytest.approx(kind.amount(objective, harm, vehicle)[0])


def test_turns__before_the_first_step_and_between_steps_give_vectors_of_zeros() -> None:
    turns = eb.env(COASTING, reward_vector="vehicles")
    turns.reset(options={"initial_state": LINE})
    assert (
        turns.reward_space("vehicle_1")
        == turns.reward_spaces["vehicle_3"]
        == turns.unwrapped.reward_spaces["vehicle_2"]
    )
    collected: dict[str, Any] = dict.fromkeys(turns.agents, 0.0)
    for agent in turns.agent_iter():
        reward, over = turns.last()[1], any(turns.last()[2:4])
        collected[agent] += reward
        for given in (reward, *turns.rewards.values()):
            assert given.dtype == np.float64 and turns.reward_space(agent).contains(given)
        turns.step(np.zeros(1) if agent == "vehicle_2" and not over else None)
    assert [each.tolist() for each in collected.values()] == [collected["vehicle_1"].tolist()] * 3
    assert collected["vehicle_1"][:2] == pytest.approx([-8.8, -7.2])
