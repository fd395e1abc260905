"""The step shield on every interface: the libraries' own checkers, and the bound."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo import AECEnv
from pettingzoo.test import api_test, parallel_api_test
from pettingzoo.utils import BaseParallelWrapper, BaseWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

import ethbrake_marl as eb
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.envs.interfaces import EthBrakeEnv, EthBrakeVectorEnv, env as aec_env, parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.shield import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from ethbrake_marl.shield.sb3 import ShieldedVecEnv

KEYS = {
    "mode", "proposed_action", "chosen_action", "intervened", "reason", "bound_harm", "margin", "trusted", "settles",
}  # fmt: skip


def test_parallel__keeps_the_bound_against_full_driving():
    env = HybridShield(parallel_env(), mode="step")
    for seed in range(5):
        env.reset(seed=seed)
        first = env.attached.shield.first_bound[0]
        while env.agents:
            *_, infos = env.step({"vehicle_2": np.array([1.0])})
            told = infos["vehicle_2"]["shield"]
            assert set(told) == KEYS and told["bound_harm"] <= first and told["trusted"]
        assert env.unwrapped.engine.ledger.world_harm("first")[0] == told["bound_harm"]


def test_parallel__a_policy_proposes_where_nobody_does():
    env = HybridShield(parallel_env(), make_agent("constant:5"), mode="step")
    env.reset(seed=1)
    *_, infos = env.step({})
    assert infos["vehicle_2"]["shield"]["proposed_action"] == pytest.approx(-5.0 / 9.0, abs=0.6)
    alone = HybridShield(parallel_env(), mode="step")
    alone.reset(seed=1)
    with pytest.raises(InvalidInput, match="no action was given"):
        alone.step({})


def test_parallel__what_is_told_with_an_allowance_never_rises_and_holds():
    env = HybridShield(parallel_env(), mode="step", allowance=50.0)
    env.reset(seed=7)
    told = []
    while env.agents:
        *_, infos = env.step({"vehicle_2": np.array([1.0])})
        told.append(infos["vehicle_2"]["shield"]["bound_harm"])
    assert told[0] == env.attached.shield.first_bound[0] + 50.0
    assert told == sorted(told, reverse=True)
    assert told[-1] == env.unwrapped.engine.ledger.world_harm("first")[0]


def test_pettingzoo__checkers_pass():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        parallel_api_test(HybridShield(parallel_env(), mode="step"), num_cycles=100)
        api_test(shielded_aec(parallel_env(), mode="step"), num_cycles=100)


def test_gymnasium__checker_passes_and_the_penalty_is_taken():
    plain = gymnasium.make("EthBrake-v0").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(ShieldedEnv(plain), skip_render_check=True)
    env = ShieldedEnv(gymnasium.make("EthBrake-v0").unwrapped, intervention_penalty=7.0)
    env.reset(seed=0)
    over, paid, harm = False, 0.0, 0.0
    while not over:
        _, reward, terminated, truncated, info = env.step(np.array([1.0], np.float32))
        paid += 7.0 * info["shield"]["intervened"]
        harm += reward
        over = terminated or truncated
    assert paid > 0.0 and set(info["shield"]) == KEYS
    assert info["world_first_impact_harm"] == info["shield"]["bound_harm"]


def test_sb3__rows_keep_their_bounds_over_automatic_resets():
    env = ShieldedVecEnv(make_sb3_vec_env("paper-random", 8, seed=3))
    env.reset()
    rng, ended = np.random.default_rng(0), 0
    for _ in range(120):
        _, _, done, infos = env.step(rng.uniform(-1.0, 1.0, (8, 1)).astype(np.float32))
        assert all(info["shield"]["trusted"] for info in infos)
        for k in np.flatnonzero(done):
            assert infos[k]["world_first_impact_harm"] == infos[k]["shield"]["bound_harm"]
            ended += 1
    assert ended >= 8


def test_sb3__the_log_tells_episodes_apart():
    env = ShieldedVecEnv(make_sb3_vec_env("paper-random", 2, seed=3), logging=True)
    env.reset()
    for _ in range(150):
        env.step(np.ones((2, 1), np.float32))
    log = env.attached.shield.log
    assert len({(entry.world, entry.episode, entry.step) for entry in log}) == len(log)
    assert {entry.episode for entry in log} >= {0, 1} and env.attached.shield.episode.min() >= 1


def test_sb3__learns_under_the_shield():
    env = ShieldedVecEnv(make_sb3_vec_env("paper-random", 4), intervention_penalty=1.0)
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=32, n_epochs=1, seed=3, device="cpu")
    model.learn(128)
    assert np.isfinite(env.step(np.zeros((4, 1), np.float32))[1]).all()


def test_applied__what_something_between_the_shield_and_the_engine_does_is_shielded():
    class Driving(BaseParallelWrapper):
        def step(self, actions):
            return super().step({name: np.ones_like(action) for name, action in actions.items()})

    env = HybridShield(Driving(parallel_env()), mode="step")
    env.reset(seed=0)
    bound, replaced = env.attached.shield.first_bound[0], 0
    while env.agents:
        *_, infos = env.step({"vehicle_2": np.array([-1.0])})
        told = infos["vehicle_2"]["shield"]
        assert told["proposed_action"] == 1.0 and told["trusted"]
        replaced += told["intervened"]
    assert env.unwrapped.engine.ledger.world_harm("first")[0] <= bound and replaced > 0


class Speechless:
    """Proposes nothing that is a number."""

    name = "speechless"

    def act(self, worlds, vehicle):
        return np.full(worlds.n, np.nan)


def test_parallel__a_policy_that_proposes_no_number_is_replaced():
    env = HybridShield(parallel_env(), Speechless(), mode="step")
    env.reset(seed=1)
    *_, infos = env.step({})
    told = infos["vehicle_2"]["shield"]
    assert told["reason"] == "not a number" and told["intervened"] and np.isnan(told["proposed_action"])
    with pytest.raises(InvalidInput, match=r"action of vehicle_2: nan; must be in \[-1, 1\]"):
        env.step({"vehicle_2": np.array([np.nan])})


@pytest.mark.parametrize("actions", [None, [0.0], np.array([0.0])])
def test_parallel__actions_that_are_no_mapping_are_refused(actions):
    env = HybridShield(parallel_env(), mode="step")
    env.reset(seed=1)
    with pytest.raises(InvalidInput, match="must be a mapping"):
        env.step(actions)


@pytest.mark.parametrize(
    ("interface", "make", "shape"),
    [
        (HybridShield, parallel_env, None),
        (ShieldedEnv, lambda: gymnasium.make("EthBrake-v0"), (1,)),
        (ShieldedVectorEnv, lambda: gymnasium.make_vec("EthBrake-v0", num_envs=2), (2, 1)),
        (ShieldedVecEnv, lambda: make_sb3_vec_env("paper-random", 2), (2, 1)),
    ],
)
def test_interfaces__a_complex_action_is_refused(interface, make, shape):
    env = interface(make(), mode="step") if interface is HybridShield else interface(make())
    env.reset()
    with pytest.raises(InvalidInput, match="is not a number"):
        env.step({"vehicle_2": np.array([1j])} if shape is None else np.full(shape, 1j))


def others(interface):
    """Environments that a wrapper does not shield."""
    makers = {
        HybridShield: parallel_env,
        ShieldedEnv: lambda: gymnasium.make("EthBrake-v0"),
        ShieldedVectorEnv: lambda: gymnasium.make_vec("EthBrake-v0", num_envs=2),
        ShieldedVecEnv: lambda: make_sb3_vec_env("paper-random", 2),
    }
    return [gymnasium.make("CartPole-v1"), None, *(make() for each, make in makers.items() if each is not interface)]


@pytest.mark.parametrize("interface", [HybridShield, ShieldedEnv, ShieldedVectorEnv, ShieldedVecEnv])
def test_interfaces__an_environment_of_another_kind_is_refused_by_name(interface):
    settings = {"mode": "step"} if interface is HybridShield else {}
    for env in others(interface):
        with pytest.raises(InvalidInput, match=f"^{interface.__name__}: .* is not one of this package's environments"):
            interface(env, **settings)


@pytest.mark.parametrize("policy", [lambda observation: observation, dict, 5, "ppo@shipped", Speechless])
@pytest.mark.parametrize("mode", ["episode", "step", None])
def test_interfaces__a_policy_that_is_none_is_refused_at_once(policy, mode):
    with pytest.raises(InvalidInput, match="must be an agent or a policy"):
        if mode is None:
            ShieldedEnv(gymnasium.make("EthBrake-v0"), policy)
        else:
            HybridShield(parallel_env(), policy, mode=mode)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"allowance": 5.0}, "mode episode takes none"),
        ({"mode": "step", "bound": "pairwise"}, "mode step takes none"),
        ({"mode": "step", "allowance": "1"}, "allowance = '1': must be a number"),
        ({"mode": "step", "allowance": float("nan")}, "allowance = nan: must be a number"),
    ],
)
def test_parallel__settings_that_do_not_fit_are_refused(settings, message):
    with pytest.raises(InvalidInput, match=message):
        HybridShield(parallel_env(), make_agent("coast"), **settings)


@pytest.mark.parametrize("penalty", ["x", float("nan"), -5.0, None])
def test_gymnasium__a_penalty_that_is_none_is_refused(penalty):
    with pytest.raises(InvalidInput, match="ShieldedEnv: intervention_penalty = "):
        ShieldedEnv(gymnasium.make("EthBrake-v0"), intervention_penalty=penalty)


def test_learners__exactly_one_is_needed_against_an_uncertainty():
    with pytest.raises(InvalidInput, match=r"2 learners \(vehicle_2, vehicle_3\)"):
        ShieldedVecEnv(
            make_sb3_vec_env("paper-random", 2, learners=["vehicle_2", "vehicle_3"]), uncertainty="gaps_m=0.5"
        )
    with pytest.raises(InvalidInput, match="not one of this package's environments"):
        ShieldedEnv(None)


def test_close__lets_go_of_the_environment():
    env = gymnasium.make("EthBrake-v0").unwrapped
    shielded = ShieldedEnv(env)
    shielded.close()
    assert env.engine.guard is None


@pytest.mark.parametrize(
    "options", [{"mode": "step"}, {"mode": "episode"}, {"mode": "robust", "uncertainty": "gaps_m=0.2"}]
)
def test_infos__hold_the_bound_after_a_reset_already_with_the_keys_of_a_step(options):
    policy = make_agent("full_brake")
    parallel, single = HybridShield(parallel_env(), policy, **options), ShieldedEnv(EthBrakeEnv(), policy, **options)
    vector = ShieldedVectorEnv(EthBrakeVectorEnv(2), policy, **options)
    starts = [parallel.reset(seed=7)[1]["vehicle_2"]["shield"], single.reset(seed=7)[1]["shield"]]
    rows = vector.reset(seed=7)[1]
    assert rows["_shield"].all()
    starts.append({key: column[0] for key, column in rows["shield"].items()})
    action = np.array([0.5], np.float32)
    steps = [parallel.step({"vehicle_2": action})[4]["vehicle_2"]["shield"], single.step(action)[4]["shield"]]
    steps.append(vector.step(np.full((2, 1), 0.5, np.float32))[4]["shield"])
    for start, step in zip(starts, steps, strict=True):
        assert start.keys() == step.keys()
        assert start["bound_harm"] == starts[0]["bound_harm"] > 0.0
        assert not start["intervened"] and start["proposed_action"] == 0.0


def closed_shields():
    yield HybridShield(parallel_env(), mode="step"), lambda env: env.step({"vehicle_2": [0.0]})
    yield ShieldedEnv(EthBrakeEnv()), lambda env: env.step([0.0])
    yield ShieldedVectorEnv(EthBrakeVectorEnv(2)), lambda env: env.step(np.zeros((2, 1)))
    yield ShieldedVecEnv(make_sb3_vec_env("paper-random", 2)), lambda env: env.step(np.zeros((2, 1)))


@pytest.mark.parametrize("begun", [False, True])
def test_closed__a_shield_says_so_and_bounds_nothing_more(begun):
    for env, step in closed_shields():
        if begun:
            env.reset()
        env.close()
        for call in (lambda env=env: env.reset(), lambda env=env, step=step: step(env)):
            with pytest.raises(InvalidInput, match="this shield was closed; put a new one around the environment"):
                call()


def test_shield__of_an_environment_in_turns_points_to_its_own_maker():
    for make in (HybridShield, shielded_aec):
        with pytest.raises(InvalidInput, match=r"with agents acting in turn eb.shielded_aec\(that\)"):
            make(aec_env(), mode="step")


@pytest.mark.parametrize(
    ("first", "again", "between"),
    [
        (lambda: HybridShield(parallel_env(), mode="step"), HybridShield, BaseParallelWrapper),
        (lambda: HybridShield(parallel_env(), mode="step"), shielded_aec, BaseParallelWrapper),
        (lambda: shielded_aec(parallel_env(), mode="step"), shielded_aec, BaseWrapper),
        (lambda: shielded_aec(parallel_env(), mode="step"), HybridShield, BaseWrapper),
        (lambda: ShieldedEnv(EthBrakeEnv()), ShieldedEnv, gymnasium.wrappers.RecordEpisodeStatistics),
        (
            lambda: ShieldedVectorEnv(EthBrakeVectorEnv(2)),
            ShieldedVectorEnv,
            gymnasium.wrappers.vector.RecordEpisodeStatistics,
        ),
        (lambda: ShieldedVecEnv(make_sb3_vec_env("paper-random", 2)), ShieldedVecEnv, VecMonitor),
    ],
)
def test_shield__of_a_shielded_environment_is_refused_naming_the_first(first, again, between):
    shielded = first()
    name = "HybridShield" if isinstance(shielded, AECEnv) else type(shielded).__name__
    for inner in (shielded, between(shielded), shielded.unwrapped):
        with pytest.raises(InvalidInput, match=rf"a {name} \(mode step\) shields this environment already"):
            again(inner, mode="step")


def test_shield__of_an_environment_whose_shield_was_closed_is_another_one():
    env = EthBrakeEnv()
    ShieldedEnv(env).close()
    ShieldedEnv(env, mode="step").reset(seed=1)


def test_shielded_aec__refuses_an_unusable_proposal_in_its_own_turn():
    env = shielded_aec(parallel_env(), mode="step")
    env.reset(seed=7)
    env.step(None)
    with pytest.raises(InvalidInput, match="action of vehicle_2"):
        env.step([3.0])
    assert env.agent_selection == "vehicle_2"


@pytest.mark.parametrize(
    "make",
    [
        lambda policy: ShieldedVectorEnv(EthBrakeVectorEnv(8, autoreset_mode="SameStep"), policy, mode="episode"),
        lambda policy: ShieldedVecEnv(make_sb3_vec_env("paper-random", 8), policy, mode="episode"),
    ],
    ids=["vector", "sb3"],
)
def test_episode_mode__tells_the_bound_of_the_episode_that_ended(make):
    env = make(make_agent("full_brake"))
    env.reset()
    told = 0
    while told < 12:
        bound = env.attached.shield["bound_harm"].copy()
        found = env.step(np.zeros((8, 1)))
        ended = np.flatnonzero(found[2] if len(found) == 4 else found[2] | found[3])
        for k in ended:
            shown = found[3][k]["shield"]["bound_harm"] if len(found) == 4 else found[4]["shield"]["bound_harm"][k]
            assert shown == bound[k]
        told += len(ended)


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (parallel_env, HybridShield),
        (lambda: BaseParallelWrapper(parallel_env()), HybridShield),
        (lambda: gymnasium.wrappers.RescaleAction(EthBrakeEnv(), np.float32(-1.0), np.float32(1.0)), ShieldedEnv),
        (lambda: EthBrakeVectorEnv(2), ShieldedVectorEnv),
        (lambda: VecMonitor(make_sb3_vec_env("paper-random", 2)), ShieldedVecEnv),
    ],
)
def test_shield__chooses_the_wrapper_of_the_interface(make, kind):
    env = eb.shield(make(), make_agent("full_brake"), shares=True)
    assert isinstance(env, kind) and env.attached.options.mode == "step"
    env.reset()
    action = np.ones((2, 1) if kind in (ShieldedVectorEnv, ShieldedVecEnv) else 1, np.float32)
    infos = env.step({"vehicle_2": action} if kind is HybridShield else action)[-1]
    told = infos[0] if kind is ShieldedVecEnv else infos.get("vehicle_2", infos)
    assert "own_harm" in told["shield"]


def test_shield__of_agents_in_turns_is_put_around_the_parallel_environment():
    env = eb.shield(aec_env(), mode="step")
    env.reset(seed=7)
    for _ in range(3):
        env.step(np.ones(1, np.float32))
    assert env.infos["vehicle_2"]["shield"]["proposed_action"] == 1.0
    with pytest.raises(InvalidInput, match="put the shield inside it"):
        eb.shield(BaseWrapper(aec_env()))
    for none in (None, gymnasium.make("CartPole-v1"), make_agent("coast")):
        with pytest.raises(InvalidInput, match=r"has none of the interfaces|is not one of this package's environments"):
            eb.shield(none)


def test_shield__is_the_folder_and_the_function_whichever_is_asked_for_first():
    import ethbrake_marl.shield.guard as guard

    assert eb.shield.guard is guard and callable(eb.shield)


@pytest.mark.parametrize("believed", [False, True])
def test_policy_with_a_memory__is_asked_once_per_decision_whoever_proposes(believed):
    asked = []

    def remembering(observation, state):
        asked.append(float(state[0, 0]))
        return -np.minimum(state, 10.0) / 10.0, state + 1.0

    policy = eb.policy_agent(remembering, initial_state=lambda n: np.zeros((n, 1)))
    env = HybridShield(parallel_env(), policy, mode="step", believed=believed)
    env.reset(seed=7)
    for actions in ({"vehicle_2": [-0.3]}, {}, {"vehicle_2": [-0.9]}, {"vehicle_2": [1.0]}):
        env.step(actions)
    assert env.attached.memory.policies[1]["steps"].tolist() == [4]
    with pytest.raises(InvalidInput):
        env.step({"vehicle_2": [-0.3], "vehicle_9": [0.0]})
    env.step({})
    assert env.attached.memory.policies[1]["steps"].tolist() == [5]
