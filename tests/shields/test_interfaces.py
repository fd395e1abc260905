"""One wrapper for all interfaces: the bound holds in each, the caller's environment stays, infos are flat, refusals."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

import ethbrake_marl as eb
from ethbrake_marl.agent_names import make_teams, register_shield
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.agents.team import Team
from ethbrake_marl.episode.counts import ALL_IMPACTS, FIRST_IMPACTS, HONEST
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv, raw_env
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.faces.shield import shield
from ethbrake_marl.faces.vector import EthBrakeVectorEnv
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.shields.shield import ShieldReason
from ethbrake_marl.shields.step import StepShield
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.shields.attack import LINES, ONLY_ONE, PLAYS, TEAMS, WAYS, attack

INFOS = {
    "bound_harm": float,
    "settles": bool,
    "proposed_action": float,
    "applied_action": float,
    "intervened": bool,
    "reason": int,
    "margin": float,
}
COAST = Held("coast")
CELLS = [  # each interface in two lines; `test_step` draws from all lines
    (play, name)
    for k, play in enumerate(PLAYS)
    for name in list(LINES)[k % 4 :: 4][:2]
    if not (play in ONLY_ONE and name in TEAMS)
]


@pytest.mark.parametrize(("play", "name"), CELLS)
def test_harm_is_the_certified_harm(play: str, name: str) -> None:
    k = CELLS.index((play, name))
    count, way = ("first", "total")[k % 2], list(WAYS)[k % len(WAYS)]
    assert attack(play, name, count, way, {"parallel": 2, "search": 3}.get(play, 12)).held


def shield_infos(info: dict[str, Any]) -> dict[str, Any]:
    return {name.removeprefix("shield_"): value for name, value in info.items() if name.startswith("shield_")}


def test_infos_are_flat_numbers_from_the_reset_on() -> None:
    env = shield(EthBrakeParallelEnv("cooperation-3-pair"))
    for infos in (env.reset(seed=7)[1], env.step({"vehicle_2": [1.0], "vehicle_3": [-1.0]})[4]):
        for info in infos.values():
            assert {name: type(value) for name, value in shield_infos(info).items()} == INFOS
    assert shield_infos(infos["vehicle_1"])["reason"] == ShieldReason.NO_DECISION
    assert shield_infos(infos["vehicle_2"])["proposed_action"] == 1.0
    assert shield_infos(infos["vehicle_3"])["proposed_action"] == -1.0


MAKERS: dict[str, Callable[[], Any]] = {
    "parallel": lambda: EthBrakeParallelEnv("paper-random", agents="learners"),
    "in wrappers": lambda: gymnasium.wrappers.OrderEnforcing(
        gymnasium.wrappers.ClipAction(EthBrakeEnv("paper-random"))
    ),
    "vector": lambda: EthBrakeVectorEnv(2, "paper-random"),
    "VecEnv": lambda: make_sb3_vec_env("paper-random", 2, 5),
}


def begin(env: Any) -> None:
    env.reset(**({} if isinstance(env, VecEnv) else {"seed": 7}))


def push(env: Any, u: float = 1.0) -> Any:
    if hasattr(env, "num_envs"):
        return env.step(np.full((env.num_envs, 1), u, np.float32))
    return env.step({"vehicle_2": [u]} if isinstance(env, EthBrakeParallelEnv) else np.array([u], np.float32))


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_the_callers_environment_stays_as_it_is_and_the_copy_starts_with_reset(make: Callable[[], Any]) -> None:
    env, other = make(), make()
    begin(env)
    begin(other)
    guarded = shield(env)
    assert type(guarded) is type(env) and type(guarded.unwrapped) is type(env.unwrapped)
    with pytest.raises(InvalidInput, match="no episode is running; call reset first"):
        push(guarded)
    begin(guarded)
    push(guarded)
    assert guarded.unwrapped.episode.memories["shield"].intervened.any() and env.unwrapped.game.shield is None
    push(env)
    push(other)
    np.testing.assert_array_equal(env.unwrapped.episode.line, other.unwrapped.episode.line)


@pytest.mark.filterwarnings("ignore::ethbrake_marl.faces.stream.UnknownResetOption")
def test_the_libraries_accept_it() -> None:
    check_env(shield(EthBrakeEnv("paper-random")), skip_render_check=True)
    parallel_api_test(shield(EthBrakeParallelEnv("paper-random", agents="learners"), "coast"), num_cycles=100)
    api_test(shield(raw_env("cooperation-3-pair", agents="learners")), num_cycles=100)


def test_policies_propose_what_the_caller_leaves_out() -> None:
    for policy in (COAST, "coast", {"vehicle_2": COAST}, Team("coasting", {2: COAST})):
        env = shield(EthBrakeParallelEnv("paper-random"), policy)
        env.reset(seed=7)
        info = env.step({})[4]["vehicle_2"]
        assert info["shield_proposed_action"] == 0.0 and info["shield_reason"] != ShieldReason.NOT_A_NUMBER
    env = shield(EthBrakeParallelEnv("cooperation-3-pair"), "coast")
    env.reset(seed=7)
    infos = env.step({"vehicle_3": [0.5]})[4]
    assert [infos[f"vehicle_{i}"]["shield_proposed_action"] for i in (1, 2, 3)] == [0.0, 0.0, 0.5]
    gym = shield(EthBrakeEnv("paper-random", reward="first-impact-harm"), load_shipped("ppo"))
    first = gym.reset(seed=7)[1]["shield_bound_harm"]
    over = False
    while not over:
        *_, ended, cut, info = gym.step([np.nan])
        over = ended or cut
        assert not info["shield_intervened"]
    assert info["world_first_impact_harm"] == first


def test_the_bound_holds_where_the_next_step_begins_the_next_episode() -> None:
    """Gymnasium's default: the step after an episode's last one reports the bound of the next one."""
    env = shield(EthBrakeVectorEnv(8, "paper-random", reward="first-impact-harm"))
    first, over, episodes = env.reset(seed=1)[1]["shield_bound_harm"].copy(), np.zeros(8, bool), 0
    for _ in range(120):
        *_, ended, cut, infos = env.step(np.ones((8, 1)))
        assert (infos["shield_reason"][over] == ShieldReason.NO_DECISION).all()
        first[over], over = infos["shield_bound_harm"][over], ended | cut
        assert (infos["world_first_impact_harm"][over] <= first[over]).all()
        episodes += over.sum()
    assert episodes > 8


def test_mode_episode() -> None:
    env = shield(EthBrakeEnv("paper-random", reward="first-impact-harm"), "full_brake", "episode", bound="pairwise")
    env.reset(seed=7)
    info = env.step([0.0])[4]
    names = {"chosen_policy", "policy_harm", "bound_harm", "proposed_action", "applied_action", "intervened"}
    assert shield_infos(info).keys() == names


def test_teams_and_names() -> None:
    team = Team("coasting", {2: COAST})
    guarded = shield(team, harm_count="total", allowance=1.0)
    assert guarded.name == "coasting+step" and guarded.shield.drivers == {2: COAST}
    assert (guarded.shield.harm_count, guarded.shield.allowance) == (ALL_IMPACTS, 1.0)
    for agent in (COAST, "coast"):
        alone = shield(agent, scenario="paper-random", mode="episode")
        assert alone.drivers == {2: COAST} and alone.name == "coast+episode"
    assert shield("e_v2x_bm", scenario="paper-random", harm_count="total").drivers[2].harm_count == ALL_IMPACTS
    with pytest.raises(InvalidInput, match="pass scenario="):
        shield("coast")
    scenario = load_scenario("paper-random")
    teams = make_teams("ppo+step,coast+episode:pairwise", scenario, harm_count="total")
    assert [type(each.shield).__name__ for each in teams.values()] == ["StepShield", "EpisodeShield"]
    assert [each.shield.harm_count for each in teams.values()] == [ALL_IMPACTS, FIRST_IMPACTS]  # the paper's


def test_the_count__is_that_of_the_reward_unless_it_is_given() -> None:
    for env, count in (
        (EthBrakeEnv("paper-random"), HONEST),
        (EthBrakeEnv("paper-random", reward="first-impact-harm"), FIRST_IMPACTS),
    ):
        assert shield(env).unwrapped.game.shield.harm_count == count
        assert shield(env, "ppo", "episode").unwrapped.game.shield.harm_count == count
        assert shield(env, harm_count="total").unwrapped.game.shield.harm_count == ALL_IMPACTS
    assert shield(COAST, scenario="paper-random").shield.harm_count == HONEST


def test_a_shield_that_is_registered_for_names_is_a_mode() -> None:
    register_shield("lax", lambda team, argument, settings: team._replace(shield=StepShield(**settings.options)))
    register_shield("bare", lambda team, argument, settings: team)
    assert shield(EthBrakeEnv(), mode="lax", allowance=3.0).game.shield.allowance == 3.0
    with pytest.raises(InvalidInput, match="shield: mode 'bare': is no shield"):
        shield(COAST, scenario="paper-random", mode="bare")


def test_a_network__is_refused_with_the_name_of_the_function_that_makes_it_an_agent() -> None:
    with pytest.raises(InvalidInput, match=r"must be a team, .* make an agent of .* eb.shield\(eb.policy_agent\("):
        shield(lambda seen: seen[:, :1])


def test_the_term_intervention() -> None:
    reward = {"harm": 1.0, "intervention": 0.5}
    env = shield(EthBrakeParallelEnv("cooperation-3-pair", reward=reward))
    env.reset(seed=7)
    replaced = 0
    for _ in range(5):
        _, rewards, _, _, infos = env.step({"vehicle_2": [1.0], "vehicle_3": [1.0]})
        for agent, info in infos.items():
            assert info["reward_intervention"] == -1.0 * info["shield_intervened"]
            assert rewards[agent] == info["reward_harm"] + 0.5 * info["reward_intervention"]
            replaced += info["shield_intervened"]
    assert replaced > 0
    alone = EthBrakeParallelEnv("paper-random", reward=reward)
    alone.reset(seed=7)
    with pytest.raises(
        InvalidInput, match=r"^term 'intervention': this game has no shield, so the term would always be 0"
    ):
        alone.step({"vehicle_2": [0.0]})


def test_the_measure_intervention__counts_each_replaced_action_and_is_0_without_a_shield() -> None:
    result = eb.evaluate("paper-random", "coast+step,coast", episodes=20, measures="intervention")
    guarded, alone = (result[name] for name in ("coast+step", "coast"))
    assert (guarded["intervention_2"] == -guarded["replaced_actions"]).all() and guarded["replaced_actions"].any()
    assert all((alone[f"intervention_{k}"] == 0.0).all() for k in (1, 2, 3))
    assert {row["agent"]: row["intervention_2"] < 0.0 for row in eb.summarise(result).to_json()} == {
        "coast+step": True, "coast": False,
    }  # fmt: skip


REFUSED: list[tuple[Callable[[], Any], type[Exception], str]] = [
    (lambda: shield(4), InvalidInput, "4: must be a team, an agent, or an environment"),
    (lambda: shield(DummyVecEnv([EthBrakeEnv])), InvalidInput, "must be a team, an agent, or an environment"),
    (lambda: shield(VecNormalize(make_sb3_vec_env("paper-random", 1))), InvalidInput, "VecNormalize\\(eb.shield\\(env"),
    (lambda: shield(shield(EthBrakeEnv())), InvalidInput, "this environment already has a shield"),
    (lambda: shield(shield(Team("t", {2: COAST}))), InvalidInput, "team 't\\+step' already has a shield"),
    (lambda: shield(Team("t", {2: COAST}), "coast"), InvalidInput, "'t' proposes by itself; leave out policy"),
    (lambda: shield(COAST), InvalidInput, "'coast'.*: pass scenario="),
    (lambda: shield(Team("t", {2: COAST}), scenario="paper-random"), InvalidInput, "leave out scenario"),
    (lambda: shield(EthBrakeEnv(), scenario="paper-random"), InvalidInput, "EthBrakeEnv.*: leave out scenario"),
    (lambda: shield(EthBrakeEnv(), "coast+step"), InvalidInput, "policy 'coast\\+step' has a shield of its own"),
    (lambda: shield(EthBrakeEnv(), mode="stp"), UnknownName, "unknown shield 'stp'; did you mean 'step'"),
    (lambda: make_teams("coast+step+step", load_scenario("paper-random")), InvalidInput, "already has a shield"),
    (lambda: shield(EthBrakeEnv(), alowance=1), InvalidInput, "'alowance'; its options: harm_count, allowance, cap"),
    (
        lambda: shield(EthBrakeEnv(), {"vehicle_3": COAST}),
        InvalidInput,
        "drives vehicle_3; must drive exactly vehicle_2",
    ),
]


@pytest.mark.parametrize(("call", "error", "text"), REFUSED, ids=[text for *_, text in REFUSED])
def test_refusals(call: Callable[[], Any], error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text):
        call()
