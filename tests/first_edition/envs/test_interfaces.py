"""What is special to one interface; what all promise: ``tests/first_edition/contract``."""

import re
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.vector import AutoresetMode
from pettingzoo.utils.conversions import aec_to_parallel

import ethbrake_marl.first_edition as eb
from ethbrake_marl import ethbrake_v1
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.stream import Stream
from ethbrake_marl.first_edition.envs.gymnasium import EthBrakeEnv
from ethbrake_marl.first_edition.envs.making import IgnoredAction, action_box, feature_box
from ethbrake_marl.first_edition.envs.pettingzoo import env, parallel_env
from ethbrake_marl.first_edition.envs.registration import GYMNASIUM_ID, PETTINGZOO_ID, register_environments
from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.first_edition.game.features import Feature
from ethbrake_marl.first_edition.game.full_state import full_state, state_features
from tests.first_edition.contract.interfaces import CRASH, FIVE, PAPER, REST, actions, initial_state, line

near = pytest.approx
ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "environments.md").read_text("utf-8")
INFOS = PAGE.partition("\n## Infos\n")[2].partition("\n\n- ")[0]
BRAKE = np.full(1, -1.0, np.float32)


def started(*args: Any, seed: int = 0, **settings: Any) -> eb.EthBrakeParallelEnv:
    environment = eb.parallel_env(*args, **settings)
    environment.reset(seed=seed)
    return environment


# ---------------------------------------------------------------- PettingZoo: all agents at once


def test_scripted_vehicle__applies_its_script_whatever_is_passed_and_infos_show_it() -> None:
    quiet, noisy = started(FIVE), started(FIVE)
    capacity = quiet.engine.worlds.vehicles.braking_capacity_mps2[0, 3]
    own = {"vehicle_4": np.array([-0.3], np.float32)}
    passed = {"vehicle_1": -BRAKE, "vehicle_2": BRAKE * np.nan, "vehicle_3": "coast", "vehicle_5": None}
    for k in range(20):
        expected = quiet.step(own)
        with pytest.warns(IgnoredAction) if k == 0 else nullcontext():
            given = noisy.step(passed | own)
        assert all(np.array_equal(given[0][agent], expected[0][agent]) for agent in quiet.possible_agents)
        assert given[1:4] == expected[1:4]
    infos = given[4]
    assert all(info["chosen_action"] in noisy.action_space(agent) for agent, info in infos.items())
    applied = [infos[agent]["chosen_action"].item() for agent in ("vehicle_1", "vehicle_2", "vehicle_4")]
    assert applied == near([-1.0, -3.0 / 7.0, -0.3])  # constant:3 of 7 m/s2
    assert [infos[agent]["chosen_command_mps2"] for agent in ("vehicle_2", "vehicle_4")] == near([-3, -0.3 * capacity])


def test_infos__hold_the_same_keys_in_every_step_and_the_page_names_them() -> None:
    environment = eb.EthBrakeEnv(REST)
    at_reset = environment.reset(seed=0)[1]
    told = [environment.step(BRAKE) for _ in range(10)]
    assert {frozenset(turn[4]) for turn in told} == {frozenset(at_reset)}
    assert at_reset["chosen_action"] == at_reset["cost"] == at_reset["reward_harm"] == 0.0
    assert {type(value) for value in told[0][4].values()} == {float, bool, int, np.ndarray}
    assert [type(part) for part in told[0][1:4]] == [float, bool, bool]
    assert {(turn[4]["world_seed"], turn[4]["world"]) for turn in told} == {(0, 0)}
    given = environment.reset(seed=5, options={"initial_state": {"gaps_m": 7}})[1]
    assert (given["world_seed"], given["world"]) == (5, -1)
    rows = re.findall(r"^\| (`.*?) \|", INFOS, re.MULTILINE)
    assert {name for row in rows for name in re.findall("`(.*?)`", row)} == set(at_reset)


@pytest.mark.parametrize(("reward", "total"), [("harm", "world_first_impact_harm"), ("total-harm", "world_total_harm")])
def test_infos__cost_is_the_harm_of_the_step_as_the_reward_counts_it(reward: str, total: str) -> None:
    environment = eb.CostEnv(gymnasium.wrappers.ClipAction(eb.EthBrakeEnv("paper-random", reward=reward)))
    for seed, action in ((0, 0.3), (2, -0.8)):  # collisions in front, and in front and behind
        _, info = environment.reset(seed=seed)
        before, costs, over = info[total], [info["cost"]], False
        while not over:
            _, _, cost, terminated, truncated, info = environment.step(np.array([action], np.float32))
            over = terminated or truncated
            costs.append(info["cost"])
            assert cost == info["cost"]
        assert sum(costs) == near(info[total] - before) and info["reward_harm"] == -info["cost"]
    with pytest.raises(InvalidInput, match="must be an EthBrakeEnv, or a wrapper"):
        eb.CostEnv(eb.make_sb3_vec_env("paper-random", n_envs=2))  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="already contains a CostEnv"):
        eb.CostEnv(gymnasium.wrappers.ClipAction(environment))


def test_learners_only__are_the_agents_and_nothing_else_changes() -> None:
    whole, learners = eb.parallel_env("cooperation-3-pair"), eb.parallel_env("cooperation-3-pair", agents="learners")
    assert learners.possible_agents == ["vehicle_2", "vehicle_3"]
    assert set(learners.observation_spaces) == set(learners.action_spaces) == set(learners.possible_agents)
    told, every = learners.reset(seed=4), whole.reset(seed=4)
    rng = np.random.default_rng(0)
    while learners.agents:
        for part, of_all in zip(told, every, strict=True):
            assert repr(part) == repr({name: of_all[name] for name in learners.possible_agents})
        given = {name: rng.uniform(-1, 1, 1).astype(np.float32) for name in learners.agents}
        told, every = learners.step(given), whole.step(given)
    assert not whole.agents and np.array_equal(learners.state(), whole.state())


# ---------------------------------------------------------------- PettingZoo: one agent after the other


@pytest.mark.parametrize("make", [env, eb.raw_env])
def test_aec__plays_the_same_episode_in_turns(make: Any) -> None:
    together, in_turn = eb.parallel_env(FIVE), make(scenario=FIVE)
    together.reset(seed=3), in_turn.reset(seed=3)
    for action in actions(3, 200, 1):
        for agent in together.agents:
            assert in_turn.agent_selection == agent
            in_turn.step(action[0] if agent == "vehicle_4" else None)
        observations, *told = together.step({"vehicle_4": action[0]})
        assert all(np.array_equal(in_turn.observe(agent), observations[agent]) for agent in observations)
        assert [in_turn.rewards, in_turn.terminations, in_turn.truncations, in_turn.infos] == told
        assert np.array_equal(in_turn.state(), together.state())
        if not together.agents:
            break
    assert isinstance(aec_to_parallel(in_turn), eb.EthBrakeParallelEnv)


# ---------------------------------------------------------------- Gymnasium: one world


# ---------------------------------------------------------------- Gymnasium: many worlds

SHORT = REST.replace(name="short", gaps_m={"uniform": [1, 8]}, horizon_s=2)  # some rest before, others do not


class FromOneStream(gymnasium.Wrapper):
    """Takes each of its worlds from the list that all rows share, as the rows of the native environment do."""

    def __init__(self, worlds: Iterator[dict[str, Any]]) -> None:
        super().__init__(eb.EthBrakeEnv(SHORT))
        self.worlds = worlds

    def reset(self, **_: Any) -> Any:
        return self.env.reset(seed=0, options={"initial_state": next(self.worlds)})


def assert_same_infos(ours: dict[str, Any], theirs: dict[str, Any], alone: bool) -> None:
    """Every info that Gymnasium's gives, where its mask says that it is one; no two share their memory."""
    assert set(theirs) <= set(ours) == {*ours, *(f"_{name}" for name in ours if not name.startswith("_"))}
    arrays = [column for column in ours.values() if isinstance(column, np.ndarray)]
    assert not any(np.shares_memory(one, other) for k, one in enumerate(arrays) for other in arrays[:k])
    for name, column in theirs.items():
        if name.startswith("_") or (name in ("world", "world_seed") and not alone):
            continue  # of a world that was given: none
        marked = theirs[f"_{name}"]
        assert np.array_equal(ours[f"_{name}"], marked), name
        if name == "final_info":
            assert_same_infos(ours[name], column, alone)
            continue
        for row in np.flatnonzero(marked):
            assert np.array_equal(ours[name][row], column[row]), (name, row)


@pytest.mark.parametrize("way", [None, "vector_entry_point", "sync", "async"])
def test_make_vec__makes_it_in_every_way(way: str | None) -> None:
    environment = gymnasium.make_vec("EthBrake-v1", num_envs=2, vectorization_mode=way, scenario=PAPER)
    assert environment.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    native = type(environment.unwrapped) is eb.EthBrakeVectorEnv
    assert native == (way in (None, "vector_entry_point"))
    observation, _ = environment.reset(seed=7)
    assert observation in environment.observation_space and environment.action_space.shape == (2, 1)
    seeded = eb.EthBrakeEnv(PAPER).reset(seed=8)[0]  # Gymnasium gives world k the seed 7 + k
    assert np.array_equal(observation[1], seeded) != native
    environment.close()


# ---------------------------------------------------------------- by id, and what the page shows


def test_registration__by_id_twice_and_with_the_projects_name() -> None:
    before = (gymnasium.registry[GYMNASIUM_ID], pettingzoo.parallel_registry[PETTINGZOO_ID])
    register_environments()
    assert (gymnasium.registry[GYMNASIUM_ID], pettingzoo.parallel_registry[PETTINGZOO_ID]) == before
    named, usual = gymnasium.make("ethbrake/EthBrake-v1"), gymnasium.make("EthBrake-v1")
    assert type(named.unwrapped) is type(usual.unwrapped) is eb.EthBrakeEnv
    assert gymnasium.make_vec("ethbrake/EthBrake-v1", num_envs=2).reset(seed=1)[0].shape[0] == 2
    assert isinstance(pettingzoo.make("parallel", "ethbrake/ethbrake-v1", learners=[2]), eb.EthBrakeParallelEnv)
    in_turn = pettingzoo.make("aec", "ethbrake/ethbrake-v1")
    assert isinstance(in_turn, pettingzoo.AECEnv) and isinstance(in_turn.unwrapped, eb.EthBrakeParallelEnv)
    assert (str(env()), eb.parallel_env.metadata["name"]) == ("ethbrake_v1", "ethbrake_v1")
    assert eb.parallel_env.metadata["is_parallelizable"] is True
    assert ethbrake_v1.parallel_env is eb.parallel_env and {"env", "raw_env"} <= set(dir(ethbrake_v1))


def test_page__its_examples_run() -> None:
    names: dict[str, object] = {}
    for code in re.findall("```python\n(.*?)```", PAGE, re.DOTALL):
        exec(code.replace("4096", "4").replace("512", "4"), names)
    assert {"many", "frame", "smooth"} <= set(names)


# ---------------------------------------------------------------- Stable-Baselines3

PAIR = ["vehicle_2", "vehicle_3"]


def begun(*args: Any, **settings: Any) -> EthBrakeVecEnv:
    env = make_sb3_vec_env(*args, **settings)
    env.reset()
    return env


def test_episode__returns_and_lengths_start_again_with_each_one_and_with_a_reset() -> None:
    env, episodes = begun(CRASH, 1), []
    for k in range(33):
        if k == 25:
            env.reset()
        _, reward, _, infos = env.step(np.full((1, 1), 0.0 if k < 16 else -1.0, np.float32))
        episodes += [info["episode"] for info in infos if "episode" in info]
    assert reward.dtype == np.float32
    assert episodes == [{"r": near(harm), "l": 8, "t": 0.0} for harm in (-36.0, -36.0, 0.0, 0.0)]


def test_rows__are_learners_within_worlds() -> None:
    n, seed = 3, 5
    env = make_sb3_vec_env(FIVE, n, seed=seed, learners=PAIR, step_infos=True)
    plain = begun(FIVE, n, seed=seed, learners=PAIR)
    start = env.reset()
    worlds = FIVE.with_learners(PAIR).sample(n, seed, channel="training").worlds
    alone = [parallel_env(FIVE, learners=PAIR) for _ in range(n)]
    for k, single in enumerate(alone):
        given = single.reset(seed=seed, options={"initial_state": initial_state(worlds, k)})[0]
        assert np.array_equal(start[2 * k : 2 * k + 2], [given[agent] for agent in PAIR])
    running = set(range(n))
    for action in actions(3, 100, 2 * n):
        observation, reward, done, infos = env.step(action)
        assert not np.shares_memory(observation, start) and observation.flags.c_contiguous
        infos_of_plain = plain.step(action)[3]
        for k in sorted(running):
            rows = [2 * k, 2 * k + 1]
            given = alone[k].step(dict(zip(PAIR, action[rows], strict=True)))
            ended = given[2]["vehicle_1"] or given[3]["vehicle_1"]
            assert done[rows].tolist() == [ended] * 2
            assert [np.float32(given[1][agent]) for agent in PAIR] == reward[rows].tolist()
            seen = [infos[row]["terminal_observation"] for row in rows] if ended else observation[rows]
            assert np.array_equal(seen, [given[0][agent] for agent in PAIR])
            for row, agent in zip(rows, PAIR, strict=True):
                told = {**given[4][agent], "world": k, "world_seed": seed}  # alone they were given
                assert {name: infos[row][name] for name in told} == told
                assert infos_of_plain[row].keys() == (infos[row].keys() if ended else set())
            running -= {k} if ended else set()
    assert not running


def test_seed__is_used_by_the_next_reset_only_and_none_is_fresh_entropy() -> None:
    env = make_sb3_vec_env(PAPER, 2, seed=8)
    first, second = env.reset(), env.reset()
    assert np.array_equal(first[0], EthBrakeEnv(PAPER).reset(seed=8)[0]) and not np.array_equal(first, second)
    assert env.seed(8) == [8, 8]
    assert np.array_equal(env.reset(), first) and np.array_equal(env.reset(), second)
    assert env.seed(None) != env.seed(None)


def test_set_options__gives_each_world_its_own_start_once_and_fails_one_reset_only() -> None:
    env = make_sb3_vec_env(CRASH.replace(obstacle_gap_m=30), 2, learners=["vehicle_1", "vehicle_2"])
    far, near_, bad = ({"initial_state": {"gaps_m": gap, "speeds_mps": 10}} for gap in (40, 4, -1))
    env.set_options([far, far, near_, near_])
    env.reset()
    assert env.engine.worlds.speeds_mps.tolist() == [[10.0, 10.0]] * 2
    assert env.engine.worlds.gaps_m[:, 0].tolist() == [40.0, 4.0]
    env.set_options([bad] * 4)
    with pytest.raises(InvalidInput, match=r"gaps_m\[0\] = -1"):
        env.reset()
    assert env.engine.worlds.gaps_m[:, 0].tolist() == [40.0, 4.0]
    env.reset()
    assert env.engine.worlds.gaps_m[:, 0].tolist() == [3.0, 3.0]
    env.set_options([{"listed_world": {"seed": 7, "number": 40}}] * 4)
    with pytest.warns(UserWarning, match="unknown keys listed_world, which are ignored; known keys: initial_state"):
        env.reset()


def test_reset_infos__belong_to_the_running_episodes_and_tell_the_news_of_each_learner() -> None:
    env = begun(CRASH.replace(latency_s=[0, {"uniform": [0.3, 0.6]}]), 2)
    starts = [set(), set()]
    for _ in range(30):
        done = env.step(np.zeros((2, 1), np.float32))[2]
        for row in range(2):
            starts[row].add(env.reset_infos[row]["time_s"])
            assert not done[row] or env.reset_infos[row]["time_s"] == env.engine.worlds.time_s[row]
    assert min(len(seen) for seen in starts) >= 4  # an episode takes 7 to 10 steps
    env = begun(line(4), 3, seed=5)
    known = env.engine.packed.known_from_s
    told = [info["known_from_s"].tolist() for info in env.reset_infos]
    assert told == [known[k, i].tolist() for k in range(3) for i in range(4)]


def test_step_async__keeps_its_own_copy_of_the_actions() -> None:
    env, untouched = begun(PAPER, 2, seed=0), begun(PAPER, 2, seed=0)
    action = np.full((1, 2), -0.5, np.float32)  # lying: the only row of a batch of columns
    env.step_async(action)
    action[:] = np.nan
    assert np.array_equal(env.step_wait()[0], untouched.step(np.full((2, 1), -0.5, np.float32))[0])


@pytest.mark.parametrize(
    ("settings", "hides"), [({}, True), ({"horizon_is_end": True}, True), ({"horizon_is_end": False}, False)]
)
def test_horizon_is_end__hides_the_truncation_and_nothing_else(settings: dict[str, bool], hides: bool) -> None:
    env = begun(PAPER, 3, seed=4, **settings)
    cut = []
    for _ in range(75):  # 0.5 s to 8 s
        _, _, done, infos = env.step(np.ones((3, 1), np.float32))  # drives on, so that the horizon cuts the episode off
        cut += [info["TimeLimit.truncated"] for info in infos if info]
    assert done.all() and cut == [not hides] * 3
    assert all(info["terminal_observation"].shape == (27,) for info in infos)


@pytest.mark.parametrize("appended", ["number", "state"])
def test_appended__stands_behind_the_own_observation_in_every_row(appended: Any) -> None:
    three = ["vehicle_2", "vehicle_3", "vehicle_5"]
    plain = make_sb3_vec_env(FIVE, 3, seed=2, learners=three)
    more = make_sb3_vec_env(FIVE, 3, seed=2, learners=three, appended=appended)
    own = plain.observation_space.shape[0]
    rows, seen = plain.reset(), more.reset()
    ended = 0
    for _ in range(90):
        expected = np.tile([[0.0], [1.0], [2.0]], (3, 1))
        if appended == "state":
            expected = full_state(more.engine.worlds, more.engine.scenario).repeat(3, axis=0)
        np.testing.assert_array_equal(seen, np.hstack([rows, expected.astype(np.float32)]))
        assert more.observation_space.contains(seen[2])
        given = np.full((9, 1), -0.8, np.float32)
        (rows, _, _, plainly), (seen, _, dones, infos) = plain.step(given), more.step(given)
        for row in np.flatnonzero(dones):
            last = infos[row]["terminal_observation"]
            np.testing.assert_array_equal(last[:own], plainly[row]["terminal_observation"])
            assert last.shape == more.observation_space.shape
            assert appended == "state" or last[own] == row % 3
            ended += 1
    assert ended > 0


def test_episode__starts_when_a_learner_may_act_first() -> None:
    # Who learned and no longer does brakes fully, also where early impacts are rejected.
    assert started(CRASH).engine.worlds.time_s.tolist() == [0.5]
    assert started(CRASH.replace(obstacle_gap_m=30), learners=["vehicle_1"]).engine.worlds.time_s.tolist() == [0.0]
    observations, infos = eb.parallel_env(FIVE, learners=["vehicle_5", "vehicle_4"]).reset(seed=0)
    assert [*observations] == ["vehicle_1", "vehicle_2", "vehicle_3", "vehicle_4", "vehicle_5"]
    assert {info["time_s"] for info in infos.values()} == {0.51}
    nobody = started("paper-random", learners=[])
    assert nobody.engine.worlds.time_s.tolist() == [0.0]
    assert nobody.step({})[4]["vehicle_2"]["chosen_action"].tolist() == [-1.0]


def test_command__is_in_force_once_its_latency_has_elapsed() -> None:
    # A command is in force once its latency has elapsed: Vehicle 3 wants to brake from t = 0; its latency is 0.8 s.
    environment = started(PAPER)
    for time, in_force in ((0.6, 0.0), (0.7, 0.0), (0.8, 0.0), (0.9, -6.0)):
        infos = environment.step({"vehicle_2": np.array([0.5], np.float32)})[4]
        assert infos["vehicle_3"]["time_s"] == near(time)
        assert infos["vehicle_3"]["chosen_command_mps2"] == -6.0
        assert infos["vehicle_3"]["command_in_force_mps2"] == in_force
        assert infos["vehicle_2"]["command_in_force_mps2"] == 3.5


def test_crash__is_split_by_mass_in_infos_and_rewards() -> None:
    environment = started(CRASH)
    results = [environment.step({"vehicle_2": np.zeros(1, np.float32)}) for _ in range(6)]
    for told in results:
        assert sum(info["reward_harm"] for info in told[4].values()) == sum(told[1].values())
    for agent, share in (("vehicle_1", 27.0), ("vehicle_2", 9.0)):
        info = results[-1][4][agent]
        assert [info[name] for name in ("first_impact_harm", "total_harm")] == near([share, share])
        assert (info["world_first_impact_harm"], info["collided"]) == (near(36.0), True)
        assert sum(told[1][agent] for told in results) == near(-36.0)


def test_reward_of_the_paper__names_its_terms_before_their_weights() -> None:
    # The terms of the paper are named before their weights; from coasting to 7 m/s2 in 0.1 s the jerk is 70 m/s3.
    *_, infos = results = started(PAPER, reward="paper").step({"vehicle_2": BRAKE})
    told = infos["vehicle_2"]
    weights = {"reward_collision": 1.0, "reward_risk": 0.1, "reward_jerk": 1e-5, "reward_terminal": 10.0}
    assert {name for name in told if name.startswith("reward_")} == set(weights)
    assert round(told["reward_jerk"], 3) == -4900.0
    assert abs(results[1]["vehicle_2"] / sum(told[name] * weight for name, weight in weights.items()) - 1) < 1e-6


def test_rewards__do_not_tell_the_harm_before_the_first_decision() -> None:
    # Rewards do not tell the harm before the first decision: 1 m apart, braking against coasting, they meet at
    # sqrt(2/6) s with w = 6 t, harm 12, before 0.6 s.
    environment = eb.parallel_env(CRASH.replace(gaps_m=1, latency_s=[0, 0.6], horizon_s=3, early_impacts="keep"))
    _, infos = environment.reset(seed=0)
    assert round(infos["vehicle_2"]["world_first_impact_harm"], 6) == 12.0
    told = 0.0
    while environment.agents:
        _, rewards, _, _, infos = environment.step({"vehicle_2": BRAKE})
        told += rewards["vehicle_2"]
    assert abs(told + infos["vehicle_2"]["world_first_impact_harm"] - 12.0) < 1e-9


def test_state__by_hand() -> None:
    # At 0.6 s Vehicle 1 has braked with 6 m/s2 all the time, and Vehicle 2 with 4 m/s2 for 0.1 s; the last three
    # numbers are gap, impact and share of the horizon of 1.3 s. At 1.2 s they have met.
    environment = started(CRASH)
    environment.step({"vehicle_2": np.array([-0.5])})
    state = environment.state().astype(float).round(6)
    assert state[:7].tolist() == [0.82, -0.6, 0.6, 0.6, 0.1, 0.0, 0.0]
    # round((20.0 - 6.0 * 0.6) / 20, 6) = 0.82
    assert state[7:14].tolist() == [0.98, -0.4, 0.8, 0.4, 0.3, 0.0, 0.0]
    # round((20.0 - 4.0 * 0.1) / 20, 6) = 0.98
    assert state[14:].tolist() == [0.194, 0.0, 0.461538]
    # round((3.0 - 0.5 * 6.0 * 0.6**2 + 0.5 * 4.0 * 0.1**2) / 10, 6) = 0.194
    # round(0.6 / 1.3, 6) = 0.461538
    for _ in range(6):
        environment.step({"vehicle_2": np.zeros(1, np.float32)})
    assert environment.state()[-3:].astype(float).round(6).tolist() == [0.0, 1.0, 0.923077]
    # round(1.2 / 1.3, 6) = 0.923077


def test_state__is_clipped_to_the_bounds_of_its_features() -> None:
    strong = {"braking_capacity_mps2": 60, "driving_capacity_mps2": 60, "speed_limit_mps": 90}
    worlds = eb.make_worlds(500.0, [90.0] * 3, **strong, latency_s=9, mass_t=400, restitution=1)
    state = full_state(worlds, PAPER)[0]
    assert state in feature_box(state_features(PAPER))
    assert float(state[0]) == 4.0
    assert float(state[21]) == 10.0
    box = feature_box([Feature("a", "1", 1.0, -2.0, 4.0, ""), Feature("b", "1", 5.0, 0.0, 1.0, "")])
    assert [(each.low.tolist(), each.high.tolist(), str(each.dtype)) for each in (box, action_box())] == [
        ([-2.0, 0.0], [4.0, 1.0], "float32"),
        ([-1.0], [1.0], "float32"),
    ]


def test_max_cycles__truncate_unless_the_episode_is_over_before() -> None:
    environment = eb.parallel_env(max_cycles=3)
    for _ in range(2):
        environment.reset(seed=0)
        assert [environment.step({"vehicle_2": [0.0]})[3]["vehicle_2"] for _ in range(3)] == [False, False, True]
        assert environment.agents == []
    plain, limited = started(), started(max_cycles=10_000)
    while plain.agents:
        assert plain.step({"vehicle_2": [-1.0]})[2:4] == limited.step({"vehicle_2": [-1.0]})[2:4]
    assert limited.agents == []
    at_its_end = started(REST, max_cycles=10)
    for _ in range(10):
        *_, terminated, truncated, _ = at_its_end.step({"vehicle_2": BRAKE})
    assert terminated == {"vehicle_1": True, "vehicle_2": True}
    assert truncated == {"vehicle_1": False, "vehicle_2": False}


@pytest.mark.parametrize(
    ("obstacle", "count", "harms", "world"),
    [
        (False, "first_impact_harm", [39.74, 32.51, 0.0], 72.25),
        (False, "total_harm", [40.14, 32.84, 0.0], 72.98),
        (True, "first_impact_harm", [539.41, 190.76, 0.0], 730.17),
        (True, "total_harm", [826.4, 266.73, 0.0], 1093.13),
    ],
)
def test_obstacle__is_hit_by_vehicle_1_and_belongs_to_the_sums_of_the_world(obstacle, count, harms, world) -> None:
    scenario = PAPER.replace(obstacle_gap_m=12, gaps_m=[40, 6], early_impacts="keep") if obstacle else PAPER
    environment = eb.parallel_env(scenario)
    environment.reset(seed=3)
    while environment.agents:
        *_, infos = environment.step({"vehicle_2": [0.0]})
    assert [round(info[count], 2) for info in infos.values()] == harms
    assert round(infos["vehicle_1"][f"world_{count}"], 2) == world
    assert all(info["collided"] for info in infos.values())


@pytest.mark.parametrize("said", ["by an argument", "by the scenario"])
def test_features__each_learner_may_observe_its_own(said) -> None:
    own = {"vehicle_2": ["own", "place"], "vehicle_3": ["front_1.gap", "place"]}
    pair = eb.load_scenario("cooperation-3-pair")
    declared = pair.replace(observation=own)
    environment = eb.parallel_env(pair, observation=own) if "argument" in said else eb.parallel_env(declared)
    seen = environment.reset(seed=1)[0]
    assert [each.shape for each in seen.values()] == [(27,), (8,), (2,)]  # who is not named observes as ever
    assert [environment.observation_space(agent).shape for agent in seen] == [(27,), (8,), (2,)]
    assert seen["vehicle_2"].tolist() == environment.engine.observe(1)[0].tolist()
    assert seen["vehicle_3"][1] == 2.0
    assert [eb.make_engine(declared, 2, learners=[name]).observe_all().shape for name in own] == [(2, 1, 8), (2, 1, 2)]
    assert eb.EthBrakeEnv(declared, learners=["vehicle_3"]).reset(seed=1)[0].shape == (2,)
    assert eb.observation_for(pair, "vehicle_2").size == 27
    assert eb.Scenario(**declared.declared()) == declared
    assert declared.replace(observation=["own"]).observation == ("own",)


def test_stream__gives_every_world_of_its_list_once_and_in_order() -> None:
    stream = Stream(PAPER, [1], {0: eb.make_agent("full_brake"), 2: eb.make_agent("constant:5")}, seed=4)
    taken = eb.Worlds.concatenate([stream.take(count).alert for count in (1000, 100, 3000, 50)])
    expected = PAPER.sample(4150, 4, channel="training").worlds
    assert (taken.gaps_m == expected.gaps_m).all()
    assert (taken.speeds_mps == expected.speeds_mps).all()
