from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils.conversions import aec_to_parallel

import ethbrake_marl as eb
from ethbrake_marl.envs.interfaces import EthBrakeParallelEnv, env, parallel_env, raw_env
from ethbrake_marl.errors import InvalidInput, UnknownName
from tests.contract.interfaces import FIVE, PAPER, actions
from tests.envs.lines import CRASH, REST

near = pytest.approx


def terms_of(info: dict[str, Any]) -> dict[str, float]:
    return {name.removeprefix("reward_"): value for name, value in info.items() if name.startswith("reward_")}


def act(value: float) -> np.ndarray:
    return np.array([value], np.float32)


def started(*args: Any, seed: int = 0, **settings: Any) -> EthBrakeParallelEnv:
    environment = parallel_env(*args, **settings)
    environment.reset(seed=seed)
    return environment


def test_agents__are_all_vehicles_until_the_collective_end() -> None:
    environment = parallel_env(REST)
    names = ["vehicle_1", "vehicle_2"]
    assert (environment.possible_agents, environment.agents) == (names, [])
    environment.reset(seed=0)
    for k in range(10):
        assert environment.agents == names
        results = environment.step({"vehicle_2": act(-1.0)})
        assert all(set(part) == set(names) for part in results)
        assert results[2] == dict.fromkeys(names, k == 9)
        assert results[3] == dict.fromkeys(names, False)
    assert environment.agents == []
    with pytest.raises(InvalidInput, match="step: no episode is running; call reset first"):
        environment.step({"vehicle_2": act(0.0)})
    environment.reset()
    assert environment.agents == names


def test_agents__after_truncation_no_step_either() -> None:
    environment = started(CRASH)
    results = [environment.step({"vehicle_2": act(0.0)}) for _ in range(8)]
    assert [all(r[3].values()) for r in results] == [False] * 7 + [True]
    assert not any(any(r[2].values()) for r in results)
    with pytest.raises(InvalidInput, match="call reset first"):
        environment.step({"vehicle_2": act(0.0)})


def test_agents__the_list_given_out_is_not_the_environments_own() -> None:
    environment = started()
    environment.agents.clear()
    environment.reset(seed=0)
    assert environment.agents == environment.possible_agents


def test_reset__starts_at_the_first_moment_a_learner_may_act() -> None:
    assert started(CRASH).engine.worlds.time_s == [0.5]
    assert started(CRASH.replace(obstacle_gap_m=30), learners=["vehicle_1"]).engine.worlds.time_s == [0.0]
    observations, infos = parallel_env(FIVE, learners=["vehicle_5", "vehicle_4"]).reset(seed=0)
    assert {info["time_s"] for info in infos.values()} == {0.51}
    assert list(observations) == [f"vehicle_{i}" for i in range(1, 6)]


def test_scripted_vehicle__applies_its_script_whatever_is_passed() -> None:
    quiet, noisy = started(FIVE), started(FIVE)
    for k in range(20):
        expected = quiet.step({"vehicle_4": act(-0.3)})
        passed = {"vehicle_1": act(1.0), "vehicle_2": act(np.nan), "vehicle_3": "coast", "vehicle_4": act(-0.3)}
        given = noisy.step(passed | {"vehicle_5": None})
        for agent in quiet.possible_agents:
            assert np.array_equal(given[0][agent], expected[0][agent]), (k, agent)
        assert given[1:4] == expected[1:4]


def test_infos__show_the_action_that_was_applied() -> None:
    environment = started(FIVE)
    infos = environment.step({"vehicle_1": act(1.0), "vehicle_4": act(-0.3)})[4]
    applied = {agent: info["chosen_action"] for agent, info in infos.items()}
    assert applied["vehicle_1"] == act(-1.0)
    assert applied["vehicle_2"] == act(-3.0 / 7.0)  # constant:3 of 7 m/s2
    assert applied["vehicle_4"] == act(-0.3)
    assert all(action in environment.action_space(agent) for agent, action in applied.items())
    assert infos["vehicle_2"]["chosen_command_mps2"] == -3.0
    capacity = environment.engine.worlds.vehicles.braking_capacity_mps2[0, 3]
    assert infos["vehicle_4"]["chosen_command_mps2"] == near(-0.3 * capacity)


def test_infos__a_command_is_in_force_once_its_latency_has_elapsed() -> None:
    environment = started(PAPER)  # Vehicle 3 wants to brake from t = 0; its latency is 0.8 s
    in_force = [environment.step({"vehicle_2": act(0.5)})[4] for _ in range(4)]
    assert [info["vehicle_3"]["time_s"] for info in in_force] == near([0.6, 0.7, 0.8, 0.9])
    assert [info["vehicle_3"]["chosen_command_mps2"] for info in in_force] == [-6.0] * 4
    assert [info["vehicle_3"]["command_in_force_mps2"] for info in in_force][::3] == [0.0, -6.0]
    assert [info["vehicle_2"]["command_in_force_mps2"] for info in in_force] == [3.5] * 4


def test_infos_and_rewards__split_a_crash_by_mass() -> None:
    environment = started(CRASH)
    total = dict.fromkeys(environment.agents, 0.0)
    for _ in range(6):
        *_, infos = results = environment.step({"vehicle_2": act(0.0)})
        total = {agent: total[agent] + results[1][agent] for agent in total}
        terms = sum(info["reward_harm"] for info in infos.values())
        assert terms == sum(results[1].values())
    assert total == {"vehicle_1": near(-36.0), "vehicle_2": near(-36.0)}
    assert [infos[agent]["first_impact_harm"] for agent in total] == near([27.0, 9.0])
    assert [infos[agent]["total_harm"] for agent in total] == near([27.0, 9.0])
    assert [infos[agent]["world_first_impact_harm"] for agent in total] == near([36.0, 36.0])
    assert all(infos[agent]["collided"] is True for agent in total)


def test_infos__keep_both_counts_apart() -> None:
    # Elastic: after the first impact with w = 6 the pair separates, and meets again while Vehicle 1 brakes.
    environment = started(CRASH.replace(restitution=1, horizon_s=6), reward="total-harm")
    rewards = 0.0
    for _ in range(55):  # from 0.5 to 6 s
        results = environment.step({"vehicle_2": act(0.0)})
        rewards += results[1]["vehicle_1"]
    info = results[4]["vehicle_1"]
    assert info["world_first_impact_harm"] == near(36.0)
    assert info["world_total_harm"] > 71.0
    assert (info["first_impact_harm"], info["total_harm"]) == (near(27.0), near(0.75 * info["world_total_harm"]))
    assert rewards == near(-info["world_total_harm"])


def test_rewards__the_papers_terms_are_named_before_their_weights() -> None:
    environment = started(PAPER, reward="paper")
    *_, infos = results = environment.step({"vehicle_2": act(-1.0)})
    terms = terms_of(infos["vehicle_2"])
    assert set(terms) == {"collision", "risk", "jerk", "terminal"}
    assert terms["jerk"] == near(-(70.0**2))  # from coasting to 7 m/s2 in 0.1 s
    weighted = terms["collision"] + 0.1 * terms["risk"] + 1e-5 * terms["jerk"] + 10.0 * terms["terminal"]
    assert results[1]["vehicle_2"] == near(weighted)


@pytest.mark.parametrize("missing", ["vehicle_2", "vehicle_3"])
def test_step__every_learner_needs_an_action(missing: str) -> None:
    environment = started(FIVE, learners=["vehicle_2", "vehicle_3"])
    given = {"vehicle_2": act(0.0), "vehicle_3": act(0.0)}
    del given[missing]
    with pytest.raises(InvalidInput, match=f"no action for the learner {missing}"):
        environment.step(given)


@pytest.mark.parametrize("bad", [np.nan, 1.5, -1.01])
def test_step__an_unusable_action_is_refused_by_name(bad: float) -> None:
    environment = started(FIVE, learners=["vehicle_2", "vehicle_3"])
    with pytest.raises(InvalidInput, match=r"action of vehicle_3: .*; must be in \[-1, 1\]"):
        environment.step({"vehicle_2": act(0.0), "vehicle_3": act(bad)})


def test_step__an_agent_that_does_not_exist_is_refused() -> None:
    with pytest.raises(UnknownName, match="unknown agent 'vehicle_22'; did you mean 'vehicle_2'"):
        started().step({"vehicle_22": act(0.0)})


def test_learners__none_at_all_plays_the_scripts_from_the_alert() -> None:
    environment = started(CRASH, learners=[])
    assert environment.engine.worlds.time_s == [0.0]
    infos = environment.step({})[4]
    assert infos["vehicle_2"]["chosen_action"] == act(-1.0)  # who learned and no longer does brakes fully


def test_spaces__are_one_object_for_each_agent() -> None:
    environment = parallel_env(FIVE)
    for agent in environment.possible_agents:
        assert environment.observation_space(agent) is environment.observation_spaces[agent]
        assert environment.action_space(agent) is environment.action_spaces[agent]
    assert len({id(space) for space in environment.action_spaces.values()}) == 5


def test_state__is_what_a_person_would_write_down() -> None:
    environment = started(CRASH)
    environment.step({"vehicle_2": act(-0.5)})
    t = 0.6
    speeds = [20.0 - 6.0 * t, 20.0 - 4.0 * 0.1]
    gap = 3.0 - 0.5 * 6.0 * t * t + 0.5 * 4.0 * 0.1 * 0.1
    own = [[speeds[0] / 20, -0.6, 0.6, 0.6, 0.1, 0.0, 0.0], [speeds[1] / 20, -0.4, 0.8, 0.4, 0.3, 0.0, 0.0]]
    expected = [*own[0], *own[1], gap / 10, 0.0, t / 1.3]
    assert environment.state() == near(np.array(expected), abs=1e-6)
    for _ in range(6):
        environment.step({"vehicle_2": act(0.0)})
    assert environment.state()[-3:] == near(np.array([0.0, 1.0, 1.2 / 1.3]), abs=1e-6)


@pytest.mark.parametrize("scenario", [PAPER, FIVE])
def test_state__stays_in_its_space_and_owns_its_memory(scenario: Any) -> None:
    environment = started(scenario)
    learner = environment.possible_agents[environment.engine.learners[0]]
    kept = []
    for action in actions(3, 60, 1):
        state = environment.state()
        assert state in environment.state_space and state.dtype == np.float32
        kept.append((state, state.copy()))
        if environment.agents:
            environment.step({learner: action[0]})
    assert all(np.array_equal(state, copy) for state, copy in kept)
    assert np.isfinite(environment.state_space.low).all() and np.isfinite(environment.state_space.high).all()


def test_state__before_the_first_reset_is_refused() -> None:
    with pytest.raises(InvalidInput, match="call reset first"):
        parallel_env().state()


def test_metadata__names_the_environment() -> None:
    assert parallel_env.metadata["name"] == "ethbrake_v0"
    assert parallel_env.metadata["is_parallelizable"] is True
    assert str(env()) == "ethbrake_v0"


@pytest.mark.parametrize("make", [env, raw_env])
def test_aec__plays_the_same_episode_in_turns(make: Any) -> None:
    together, in_turn = parallel_env(FIVE), make(scenario=FIVE)
    together.reset(seed=3), in_turn.reset(seed=3)
    for action in actions(3, 200, 1):
        for agent in together.agents:
            assert in_turn.agent_selection == agent
            in_turn.step(action[0])
        observations, rewards, terminations, truncations, infos = together.step({"vehicle_4": action[0]})
        for agent in together.possible_agents:
            assert np.array_equal(in_turn.observe(agent), observations[agent])
            assert in_turn.rewards[agent] == rewards[agent]
            assert in_turn.infos[agent] == infos[agent]
        assert (in_turn.terminations, in_turn.truncations) == (terminations, truncations)
        assert np.array_equal(in_turn.state(), together.state())
        if not together.agents:
            break
    assert in_turn.terminations["vehicle_1"] or in_turn.truncations["vehicle_1"]
    while in_turn.agents:
        in_turn.step(None)


@pytest.mark.parametrize("bad", [[2.0], [0.1, 0.2], "x", None, [np.nan]])
def test_aec__refuses_an_unusable_action_in_its_own_turn_and_loses_nothing(bad: Any) -> None:
    in_turn, other = env(learners=["vehicle_2", "vehicle_3"]), env(learners=["vehicle_2", "vehicle_3"])
    for each in (in_turn, other):
        each.reset(seed=3)
        each.step(None)
    with pytest.raises(InvalidInput, match="action of vehicle_2"):
        in_turn.step(bad)
    assert in_turn.agent_selection == "vehicle_2"
    for each in (in_turn, other):
        for action in ([-1.0], [-0.5]):
            each.step(np.array(action, np.float32))
    assert in_turn.observe("vehicle_1").tobytes() == other.observe("vehicle_1").tobytes()
    assert in_turn.rewards == other.rewards


def test_aec__after_the_end_only_none_is_taken() -> None:
    in_turn = env(max_cycles=1)
    in_turn.reset(seed=3)
    for _ in in_turn.possible_agents:
        in_turn.step(np.zeros(1, np.float32))
    with pytest.raises(InvalidInput, match="the episode of vehicle_1 is over; only None may follow, or reset"):
        in_turn.step(np.zeros(1, np.float32))
    while in_turn.agents:
        in_turn.step(None)


def test_aec__converts_back_to_the_parallel_environment() -> None:
    assert isinstance(aec_to_parallel(env(scenario=FIVE)), EthBrakeParallelEnv)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"reward": 5}, "reward = 5: must be a name"),
        ({"observation": "x"}, "observation = 'x': must be an ObservationSpec"),
        ({"learners": 5}, "learners = 5: must be a list of vehicles"),
    ],
)
def test_settings__that_cannot_be_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        parallel_env(**settings)


@pytest.mark.parametrize("options", [5, ["initial_state"], "initial_state"])
def test_reset__options_that_are_no_mapping_are_refused(options: Any) -> None:
    with pytest.raises(InvalidInput, match=r"reset: options = .*: must be None or a mapping"):
        parallel_env().reset(options=options)


def test_step__actions_that_are_no_mapping_or_of_nobody_are_refused() -> None:
    environment = started()
    for actions_ in (None, [0.5]):
        with pytest.raises(InvalidInput, match=r"step: actions = .*: must be a mapping"):
            environment.step(actions_)  # type: ignore[arg-type]
    with pytest.raises(UnknownName, match="unknown agent 1"):
        environment.step({1: act(0.0)})  # type: ignore[dict-item]


def test_reset__that_fails_leaves_the_episode_running() -> None:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "constant:5"}
    environment, twin = (started(PAPER.replace(roles=roles)) for _ in range(2))
    environment.step({"vehicle_2": act(0.0)})
    twin.step({"vehicle_2": act(0.0)})
    with pytest.raises(InvalidInput, match="constant:5"):
        environment.reset(
            seed=3, options={"initial_state": {"braking_capacity_mps2": 4, "gaps_m": 3, "speeds_mps": 20}}
        )
    mine, its = environment.step({"vehicle_2": act(-0.5)}), twin.step({"vehicle_2": act(-0.5)})
    assert mine[1:4] == its[1:4]
    assert (mine[0]["vehicle_2"] == its[0]["vehicle_2"]).all()
    assert (environment.reset()[0]["vehicle_2"] == twin.reset()[0]["vehicle_2"]).all()


def test_learners__may_be_none_where_early_impacts_are_rejected() -> None:
    environment = parallel_env("paper-random", learners=[])
    _, infos = environment.reset(seed=0)
    assert infos["vehicle_1"]["time_s"] == 0.0
    while environment.agents:
        environment.step({})


def test_rewards__do_not_tell_the_harm_before_the_first_decision() -> None:
    # 1 m apart, braking against coasting: they meet at sqrt(2/6) s with w = 6 t, harm 12, before 0.6 s.
    early = CRASH.replace(gaps_m=1, latency_s=[0, 0.6], horizon_s=3, early_impacts="keep")
    environment = parallel_env(early)
    _, infos = environment.reset(seed=0)
    assert infos["vehicle_2"]["world_first_impact_harm"] == near(12.0)
    told = 0.0
    while environment.agents:
        _, rewards, _, _, infos = environment.step({"vehicle_2": act(-1.0)})
        told += rewards["vehicle_2"]
    assert -told == near(infos["vehicle_2"]["world_first_impact_harm"] - 12.0)


def test_supersuit__frame_skip_draws_from_the_seed_of_the_reset() -> None:
    supersuit = pytest.importorskip("supersuit")

    def played() -> list[float]:
        env = supersuit.frame_skip_v0(parallel_env(scenario="cooperation-3-pair", agents="learners"), (1, 4))
        env.reset(seed=5)
        times = []
        while env.agents:
            infos = env.step({agent: np.array([-1.0], np.float32) for agent in env.agents})[4]
            times.append(infos["vehicle_2"]["time_s"])
        return times

    assert played() == played() and len(set(np.diff(played()).round(6))) > 1


def test_gymnasium__which_vector_wrappers_take_same_step_is_what_the_page_says() -> None:
    wrappers = gymnasium.wrappers.vector
    page = (Path(__file__).resolve().parents[2] / "docs" / "environment.md").read_text("utf-8")
    for wrap in (wrappers.NormalizeReward, wrappers.RecordEpisodeStatistics, wrappers.ClipAction):
        wrap(eb.EthBrakeVectorEnv(2, autoreset_mode="SameStep")).reset(seed=1)
    for wrap in (wrappers.NormalizeObservation, wrappers.FlattenObservation):
        assert f"`{wrap.__name__}`" in page
        wrap(eb.EthBrakeVectorEnv(2)).reset(seed=1)
        with pytest.raises((ValueError, AssertionError)):  # Gymnasium 1.1 asserts, without a word
            wrap(eb.EthBrakeVectorEnv(2, autoreset_mode="SameStep"))
