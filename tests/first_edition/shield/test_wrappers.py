"""The shield on every interface: what it tells, takes off the reward, lets go of, and that nothing interferes."""

import gymnasium
import numpy as np
import pytest
from pettingzoo import AECEnv
from pettingzoo.utils import BaseParallelWrapper
from stable_baselines3.common.vec_env import VecMonitor

import ethbrake_marl.first_edition as eb
from tests.first_edition.shield.plays import INSIDE, PLAYS, WRAPPERS, disturbed, reported, wrapped
from tests.first_edition.shield.test_infos import of_row
from tests.first_edition.shield.test_step_shield import speechless

PAPER = eb.load_scenario("paper-random")
MAKERS = {
    eb.HybridShield: lambda: eb.parallel_env(agents="learners"),
    eb.ShieldedEnv: eb.EthBrakeEnv,
    eb.ShieldedVectorEnv: lambda: eb.EthBrakeVectorEnv(2),
    eb.ShieldedVecEnv: lambda: eb.make_sb3_vec_env(PAPER, 2),
}
DRIVE = {
    eb.HybridShield: {"vehicle_2": np.ones(1)},
    eb.ShieldedEnv: np.ones(1, np.float32),
    eb.ShieldedVectorEnv: np.ones((2, 1)),
    eb.ShieldedVecEnv: np.ones((2, 1), np.float32),
}
MODES = {
    "episode": {"mode": "episode"},
    "episode:pairwise": {"mode": "episode", "bound": "pairwise"},
    "step": {"mode": "step", "allowance": 1.0, "logging": True},
}
CODES = {"episode": 0, "episode:pairwise": 0, "step": 1}
KEYS = {
    "mode", "proposed_action", "applied_action", "intervened", "reason", "bound_harm", "margin", "trusted", "settles",
}  # fmt: skip


def reset(env, interface):
    """What is told of each world at the start of its episode, in list 3."""
    if interface is eb.ShieldedVecEnv:
        env.seed(3)
        env.reset()
        return rows_told(interface, env.reset_infos)
    return rows_told(interface, env.reset(seed=3)[1])


def rows_told(interface, infos):
    """What the infos of an interface tell of each world."""
    if interface is eb.ShieldedVectorEnv:
        return [{key: column[k] for key, column in reported(infos).items()} for k in range(2)]
    return [reported(info) for info in (infos if interface is eb.ShieldedVecEnv else [infos.get("vehicle_2", infos)])]


@pytest.mark.parametrize("interface", [*MAKERS, eb.shield])
def test_interfaces__have_the_same_default_mode(interface):
    env = interface(MAKERS.get(interface, eb.EthBrakeEnv)())
    assert env.attached.options.mode == "step"
    env.attached.close()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("interface", MAKERS)
def test_interfaces__have_every_mode_and_the_penalty_and_tell_the_bound_after_a_reset_already(interface, mode):
    pays(interface, MODES[mode], CODES[mode], KEYS if mode == "step" else None)


def pays(interface, options, code, keys=None):
    paid = []
    for penalty in (0.0, 7.0):
        env = interface(MAKERS[interface](), eb.make_agent("full_brake"), intervention_penalty=penalty, **options)
        starts, rewards, intervened = reset(env, interface), [], []
        for _ in range(3):
            _, reward, *_, infos = env.step(DRIVE[interface])
            told = rows_told(interface, infos)
            assert keys is None or set(told[0]) == keys
            rewards.append(reward["vehicle_2"] if interface is eb.HybridShield else reward)
            intervened.append([bool(each["intervened"]) for each in told])
            for start, step in zip(starts, told, strict=True):
                assert start.keys() == step.keys() and step["mode"] == code
        assert all(each["bound_harm"] > 0.0 == each["proposed_action"] and not each["intervened"] for each in starts)
        paid.append(np.array(rewards).reshape(3, -1))
    assert np.any(intervened) and paid[0] - paid[1] == pytest.approx(7.0 * np.array(intervened), abs=1e-5)


def test_policy__proposes_where_nobody_does_and_is_replaced_where_it_says_no_number():
    told = []
    for policy in (eb.make_agent("constant:5"), speechless):
        env = eb.HybridShield(eb.parallel_env(), policy, mode="step")
        env.reset(seed=1)
        told += [reported(env.step({})[-1]["vehicle_2"]) for _ in range(8)]
    assert told[0]["proposed_action"] == pytest.approx(-5.0 / 7.0)
    silent = [each for each in told if np.isnan(each["proposed_action"])]
    assert silent and all(each["intervened"] and each["reason"] == eb.ShieldReason.NOT_A_NUMBER for each in silent)


BATCHES = {
    "same step": lambda *given, **options: eb.ShieldedVectorEnv(
        eb.EthBrakeVectorEnv(8, autoreset_mode="SameStep"), *given, **options
    ),
    "next step": lambda *given, **options: eb.ShieldedVectorEnv(
        eb.EthBrakeVectorEnv(8, autoreset_mode="NextStep"), *given, **options
    ),
    "sb3": lambda *given, **options: eb.ShieldedVecEnv(eb.make_sb3_vec_env(PAPER, 8), *given, **options),
}


@pytest.mark.parametrize("mode", ["step", "episode"])
@pytest.mark.parametrize("name", BATCHES)
def test_batch__tells_of_every_row_the_episode_that_ended(name, mode):
    shares = {"shares": True} if mode == "step" else {}
    env = BATCHES[name](eb.make_agent("full_brake"), mode=mode, logging=mode == "step", **shares)
    env.reset()
    ended, intervened, rng = 0, 0, np.random.default_rng(0)
    for _ in range(120):
        running, shield = ~env.attached.engine.ended, env.attached.shield
        before = shield["bound_harm"].copy() if mode == "episode" else shield.memory.first_bound.copy()
        found = env.step(rng.uniform(-1.0, 1.0, (8, 1)).astype(np.float32))
        over, infos = (found[2], found[3]) if name == "sb3" else (found[2] | found[3], found[4])
        for k in np.flatnonzero(over):
            final = infos[k] if name == "sb3" else of_row(infos.get("final_info", infos), k)
            told, harm = reported(final), final["first_impact_harm"]
            assert told["own_harm"] == harm if mode == "step" else told["bound_harm"] == before[k]
            assert mode == "episode" or (told["trusted"] and told["bound_harm"] <= before[k])
        ended += int(over.sum())
        intervened += int((env.attached.guard.intervened(env.attached.engine.ruling)[:, 0] & running).sum())
    assert ended > 8
    if mode == "step":  # over resets too, and episodes are told apart
        log = env.attached.shield.log
        assert len({(entry.world, entry.episode, entry.step) for entry in log}) == len(log) == intervened > 30


# Samples of the gate "interference".


@pytest.mark.parametrize("name", PLAYS)
def test_disturbed__calls_that_fail_or_are_interrupted_change_nothing_and_no_episode_gets_above_its_bound(name):
    found = disturbed(name, 8 if any(each in name for each in ("vector", "sb3", "evaluation")) else 5, seed=3)
    assert found.refused > 5 and found.interrupted > 3
    assert (found.above, found.broken) == (0, 0)


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("name", INSIDE)
def test_wrapped__whatever_reaches_the_engine_is_shielded_and_no_episode_gets_above_its_bound(name, wrapper):
    found = wrapped(name, wrapper, 3 if wrapper == "frame skip 80" else 100, seed=5)
    assert found.episodes > 0 and (found.above, found.broken) == (0, 0)


@pytest.mark.parametrize(
    ("make", "kind"),
    [
        (eb.parallel_env, eb.HybridShield),
        (eb.env, eb.HybridShield),
        (lambda: BaseParallelWrapper(eb.parallel_env()), eb.HybridShield),
        (lambda: gymnasium.wrappers.RescaleAction(eb.EthBrakeEnv(), np.float32(-1.0), np.float32(1.0)), eb.ShieldedEnv),
        (lambda: eb.EthBrakeVectorEnv(2), eb.ShieldedVectorEnv),
        (lambda: VecMonitor(eb.make_sb3_vec_env("paper-random", 2)), eb.ShieldedVecEnv),
    ],
)
def test_shield__chooses_the_wrapper_of_the_interface(make, kind):
    env = eb.shield(make(), eb.make_agent("full_brake"), shares=True)
    env.reset(**{} if kind is eb.ShieldedVecEnv else {"seed": 7})
    if isinstance(env, AECEnv):
        for agent in env.possible_agents:
            env.step(np.ones(1, np.float32) if agent == "vehicle_2" else None)
        infos = env.infos
    else:
        assert isinstance(env, kind) and env.attached.options.mode == "step"
        action = np.ones((2, 1) if kind in (eb.ShieldedVectorEnv, eb.ShieldedVecEnv) else 1, np.float32)
        infos = env.step({"vehicle_2": action} if kind is eb.HybridShield else action)[-1]
    told = reported(infos[0] if kind is eb.ShieldedVecEnv else infos.get("vehicle_2", infos))
    assert "own_harm" in told and np.all(told["proposed_action"] == 1.0)


@pytest.mark.parametrize(
    ("name", "mode"), [("paper-random", "step"), ("paper-random", "episode"), ("cooperation-3-pair", "step")]
)
def test_shield__around_an_agent_is_that_of_its_spec(name: str, mode: str) -> None:
    coast, scenario = eb.make_agent("coast"), eb.load_scenario(name)
    agents = {
        "object": eb.shield(coast, scenario=name, mode=mode),
        "spec": eb.make_agent(f"coast+{mode}", scenario=scenario),
    }
    found = eb.evaluate(agents=agents, scenario=name, episodes=30)
    plain = eb.evaluate(agents={"plain": coast}, scenario=name, episodes=30).outcome("plain").first_impact_harm
    ours, theirs = (found.outcome(agent).first_impact_harm for agent in agents)
    assert np.array_equal(ours, theirs) and ours.sum() < plain.sum()


@pytest.mark.parametrize("interface", MAKERS)
def test_closed__a_shield_lets_go_of_the_environment(interface):
    env = MAKERS[interface]()
    shielded = interface(env, mode="step")
    reset(shielded, interface)
    shielded.close()
    assert (env if interface is eb.ShieldedVecEnv else env.unwrapped).engine.guard is None
    interface(env, mode="step").reset()
