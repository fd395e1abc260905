from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from ethbrake_marl.engine import Engine
from ethbrake_marl.envs.interfaces import EthBrakeEnv
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.rewards import RewardParams
from tests.contract.interfaces import FIVE
from tests.envs.lines import CRASH, REST

near = pytest.approx
COAST, BRAKE = np.zeros(1, np.float32), np.full(1, -1.0, np.float32)


def test_episode__of_a_crash_by_hand() -> None:
    env = EthBrakeEnv(CRASH)
    observation, info = env.reset(seed=0)
    assert info["time_s"] == 0.5
    assert observation[0] == 1.0  # 20 m/s at a scale of 20
    steps = [env.step(COAST) for _ in range(8)]
    assert sum(step[1] for step in steps) == near(-36.0)
    assert [step[3] for step in steps] == [False] * 7 + [True]
    last = steps[-1][4]
    assert (last["first_impact_harm"], last["world_first_impact_harm"]) == (near(9.0), near(36.0))
    assert last["command_in_force_mps2"] == 0.0
    with pytest.raises(InvalidInput, match="step: no episode is running; call reset first"):
        env.step(COAST)


def test_step__returns_plain_types() -> None:
    env = EthBrakeEnv(CRASH)
    env.reset(seed=0)
    _, reward, terminated, truncated, info = env.step(BRAKE)
    assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
    assert {type(value) for value in info.values()} == {float, bool, int, np.ndarray}
    assert info["chosen_command_mps2"] == -8.0


def test_infos__hold_the_same_keys_in_every_step() -> None:
    env = EthBrakeEnv(REST)
    _, at_reset = env.reset(seed=0)
    infos = [env.step(BRAKE)[4] for _ in range(10)]
    assert {frozenset(info) for info in infos} == {frozenset(at_reset)}
    assert at_reset["chosen_action"] == at_reset["cost"] == at_reset["reward_harm"] == 0.0
    assert (at_reset["world_seed"], at_reset["world"]) == (0, 0)
    assert {(info["world_seed"], info["world"]) for info in infos} == {(0, 0)}
    env.reset(options={"initial_state": {"gaps_m": 7}})
    assert env.reset()[1]["world"] >= 1


def test_infos__cost_is_the_harm_of_the_step_as_the_reward_counts_it() -> None:
    for reward, total in (("harm", "world_first_impact_harm"), ("total-harm", "world_total_harm")):
        env = EthBrakeEnv("paper-random", reward=reward)
        for seed in range(5):
            _, info = env.reset(seed=seed)
            before, costs, over = info[total], [info["cost"]], False
            while not over:
                _, _, terminated, truncated, info = env.step(np.array([0.3], np.float32))
                over = terminated or truncated
                costs.append(info["cost"])
            assert sum(costs) == pytest.approx(info[total] - before)
            assert info["reward_harm"] == -info["cost"]


def test_seed__of_an_unseeded_environment_can_be_read_and_repeated() -> None:
    env = EthBrakeEnv()
    start, _ = env.reset()
    assert np.array_equal(EthBrakeEnv().reset(seed=env.np_random_seed)[0], start)


def test_seed__of_a_stream_that_the_user_set_goes_on() -> None:
    env = EthBrakeEnv()
    env.np_random = np.random.default_rng(7)
    info = env.reset()[1]
    assert (info["world_seed"], info["world"]) == (0, 1)
    assert env.np_random.integers(10**6) == 944_904


def test_settings__reach_the_engine() -> None:
    params = RewardParams(harm=2.0)
    spec = ObservationSpec(front=2, rear=0)
    env = EthBrakeEnv(FIVE, learners=["vehicle_3"], reward=params, observation=spec)
    assert isinstance(env.engine, Engine)
    assert (env.engine.reward, env.engine.observation, env.learner) == (params, spec, 2)
    assert env.observation_space.shape == (spec.size,)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scenario": "paper-randm"}, "did you mean 'paper-random'"),
        ({"reward": "harmm"}, "did you mean 'harm'"),
        ({"learners": ["vehicle_9"]}, "vehicle_9"),
        ({"learners": "vehicle_2"}, r"must be a list of vehicles"),
        ({"render_mode": "depth"}, "render_mode = 'depth': must be 'human'"),
    ],
)
def test_settings__bad_ones_are_refused_when_the_environment_is_made(settings: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        EthBrakeEnv(**settings)  # type: ignore[arg-type]


def test_make__passes_settings_and_adds_no_time_limit() -> None:
    env = gymnasium.make("EthBrake-v0", scenario=REST, reward="paper")
    env.reset(seed=0)
    assert env.unwrapped.engine.scenario == REST
    assert env.spec is not None and env.spec.max_episode_steps is None
    ends = [env.step(BRAKE)[2] for _ in range(10)]
    assert ends == [False] * 9 + [True]


def test_make__the_scenario_may_be_a_path(tmp_path: object) -> None:
    folder = str(tmp_path)
    text = "\n".join(
        [
            "name: mine",
            "vehicles: 2",
            "gaps_m: 9",
            "speeds_mps: 20",
            "braking_capacity_mps2: 6",
            "driving_capacity_mps2: 6",
            "mass_t: 1",
            "latency_s: 0.25",
        ]
    )
    with open(f"{folder}/mine.yaml", "w", encoding="utf-8") as file:
        file.write(text + "\n")
    _, info = EthBrakeEnv(f"{folder}/mine.yaml").reset(seed=0)
    assert info["time_s"] == 0.25
