"""Wrappers under which a model was trained: what may change what it sees or does is refused by name."""

import functools

import gymnasium
import numpy as np
import pytest
import stable_baselines3 as stable
import supersuit
from gymnasium import wrappers
from gymnasium.spaces import Box, Discrete
from pettingzoo.utils import BaseParallelWrapper
from pettingzoo.utils.conversions import aec_to_parallel
from pettingzoo.utils.wrappers import AssertOutOfBoundsWrapper, OrderEnforcingWrapper
from stable_baselines3.common import vec_env
from stable_baselines3.common.monitor import Monitor

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.envs.pettingzoo import InTurns

SCENARIO = eb.load_scenario("paper-random")
WORLDS = SCENARIO.sample(4, 7).worlds
UNIT = Box(-1.0, 1.0, (1,), np.float32)


def model_in(env, algorithm=stable.PPO):
    return algorithm("MlpPolicy", env, policy_kwargs={"net_arch": [4]})


def refusal(env, **settings):
    with pytest.raises(InvalidInput) as caught:
        eb.policy_agent(model_in(env), **settings)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def harms(agent):
    return drive(WORLDS, agent, SCENARIO, 1).ledger.world_harm("first").tolist()


class Negated(gymnasium.ActionWrapper):
    def action(self, action):
        return -action


class Stepping(gymnasium.Wrapper):
    def step(self, action):
        return self.env.step(0.5 * action)


class Resetting(gymnasium.Wrapper):
    def reset(self, **settings):
        observation, info = self.env.reset(**settings)
        return observation * 0.0, info


class OwnReward(gymnasium.RewardWrapper):
    def reward(self, reward):
        return 2.0 * reward


class Titled(gymnasium.Wrapper):
    title = "says nothing of actions or observations"


class OwnEnv(eb.EthBrakeEnv):
    def step(self, action):
        return super().step(-action)


class Outside(gymnasium.Env):
    """An environment that only looks like ours, with ours inside."""

    def __init__(self):
        self.env, self.venv = eb.EthBrakeEnv(), "a name that means something else here"
        self.observation_space, self.action_space = self.env.observation_space, UNIT

    def reset(self, **settings):
        return self.env.reset(**settings)

    def step(self, action):
        return self.env.step(-action)


class Turned(vec_env.VecEnvWrapper):
    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()

    def step_async(self, actions):
        self.venv.step_async(-actions)


class OwnParallel(BaseParallelWrapper):
    def step(self, actions):
        return super().step({agent: -action for agent, action in actions.items()})


def rescaled(env):
    return wrappers.RescaleAction(env, np.float32(0), np.float32(1))


CHANGING = {
    "RescaleAction": rescaled,
    "TransformObservation": lambda env: wrappers.TransformObservation(env, lambda seen: seen * 0.5, None),
    "NormalizeObservation": wrappers.NormalizeObservation,
    "Negated": Negated,
    "Stepping": Stepping,
    "Resetting": Resetting,
}
HARMLESS = {
    "OrderEnforcing": wrappers.OrderEnforcing,
    "PassiveEnvChecker": wrappers.PassiveEnvChecker,
    "TimeLimit": lambda env: wrappers.TimeLimit(env, 50),
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: reward * 0.1),
    "NormalizeReward": wrappers.NormalizeReward,
    "OwnReward": OwnReward,
    "Titled": Titled,
    "Monitor": Monitor,
    "ShieldedEnv": eb.ShieldedEnv,
}


def gym_env():
    return eb.EthBrakeEnv(render_mode="rgb_array")


def dummy(*wraps):
    """Copies in one process, each under the wrapper of its place."""
    return vec_env.DummyVecEnv([lambda wrap=wrap: wrap(gym_env()) for wrap in wraps])


def in_suits(wrap, *, cpus=0):
    rows = supersuit.pettingzoo_env_to_vec_env_v1(wrap(eb.parallel_env(agents="learners")))
    return supersuit.concat_vec_envs_v1(rows, 2, num_cpus=cpus, base_class="stable_baselines3")


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize("name", CHANGING)
def test_changing_wrapper__is_refused_by_name_wherever_it_stands(name, clip):
    wrap = CHANGING[name]
    said = refusal(wrap(gym_env()), clip=clip)
    assert f"was trained under {name}," in said and "ignore_wrappers=True" in said
    outer = functools.reduce(lambda env, each: HARMLESS[each](env), ("OwnReward", "Monitor"), wrap(gym_env()))
    assert f"under {name}," in refusal(outer, clip=clip)
    inner = wrap(wrappers.OrderEnforcing(wrappers.RecordEpisodeStatistics(gym_env())))
    assert f"under {name}," in refusal(inner, clip=clip)


@pytest.mark.parametrize("name", HARMLESS)
def test_harmless_wrapper__leaves_what_the_model_does(name):
    model = model_in(HARMLESS[name](gym_env()))
    by_hand = eb.policy_agent(lambda seen: model.predict(seen, deterministic=True)[0])
    assert harms(eb.policy_agent(model)) == harms(by_hand)


def test_harmless_wrappers__all_around_each_other():
    wraps = [wrap for name, wrap in HARMLESS.items() if name != "Monitor"]  # which VecMonitor takes the place of
    env = functools.reduce(lambda env, wrap: wrap(env), wraps, gym_env())
    around = vec_env.VecNormalize(vec_env.VecCheckNan(vec_env.VecMonitor(dummy(lambda _: env))))
    assert eb.policy_agent(model_in(around)).observation == eb.EthBrakeEnv().engine.observation


@pytest.mark.parametrize("k", [0, 2])
def test_copies_that_differ__are_each_looked_at(k):
    wraps = [Titled] * 3
    wraps[k] = Negated
    assert "under Negated," in refusal(vec_env.VecMonitor(dummy(*wraps)))


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("Turned", lambda: vec_env.VecMonitor(Turned(eb.make_sb3_vec_env("paper-random", 2)))),
        ("VecFrameStack", lambda: vec_env.VecFrameStack(eb.make_sb3_vec_env("paper-random", 2), 1)),
        ("VecNormalize inside another VecNormalize", lambda: vec_env.VecNormalize(vec_env.VecNormalize(dummy(Titled)))),
        ("OwnEnv", OwnEnv),
        ("Outside", Outside),
        ("PendulumEnv", lambda: gymnasium.make("Pendulum-v1")),
        ("OwnParallel", lambda: in_suits(OwnParallel)),
        ("FrameStackModifier", lambda: in_suits(lambda env: supersuit.frame_stack_v1(env, 1))),
        ("ProcConcatVec", lambda: in_suits(Same, cpus=2)),
    ],
)  # fmt: skip
def test_other_layers__are_walked_through(name, make):
    assert f"was trained under {name}," in refusal(make(), clip=True)


class Same(BaseParallelWrapper):
    """Changes nothing."""


@pytest.mark.parametrize(
    "wrap",
    [
        Same,
        lambda env: aec_to_parallel(OrderEnforcingWrapper(AssertOutOfBoundsWrapper(InTurns.around(env)))),
        eb.HybridShield,
    ],
)
def test_harmless_pettingzoo_wrappers__show_the_environment_inside(wrap):
    spec = eb.ObservationSpec(front=2, rear=0)  # as many features as the usual ones
    rows = supersuit.pettingzoo_env_to_vec_env_v1(wrap(eb.parallel_env(agents="learners", observation=spec)))
    model = model_in(supersuit.concat_vec_envs_v1(rows, 2, base_class="stable_baselines3"))
    assert eb.policy_agent(model).observation == spec


def in_processes(*wraps):
    return vec_env.SubprocVecEnv([lambda wrap=wrap: wrap(gym_env()) for wrap in wraps], "fork")


def test_other_processes__are_asked():
    plain, odd = in_processes(Titled, Titled), in_processes(Titled, lambda env: Monitor(Negated(env)))
    assert eb.policy_agent(model_in(plain)).observation == eb.ObservationSpec()
    assert "<Monitor<Negated<" in refusal(vec_env.VecMonitor(odd), clip=True)
    assert odd.reset().shape == (2, 27)  # still alive
    model = model_in(plain)
    for env in (plain, odd):
        env.close()
    with pytest.raises(InvalidInput, match="environment runs in other processes, which do not answer"):
        eb.policy_agent(model)


def test_who_knows_better__drives_by_it_all_the_same():
    model = model_in(Negated(gym_env()))
    assert harms(eb.policy_agent(model, ignore_wrappers=True)) == harms(eb.policy_agent(model.policy))
    for env in (rescaled(gym_env()), Outside(), gymnasium.wrappers.FlattenObservation(OwnEnv())):
        assert eb.policy_agent(model_in(env), ignore_wrappers=True).name == "PPO"


@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize(
    "space", [Box(0.0, 1.0, (1,)), Box(-2.0, 2.0, (1,)), Box(-1.0, 1.0, (2,)), Discrete(3)], ids=str
)
def test_action_space__is_checked_with_clip_too(space, clip):
    policy = Spaced(space)
    with pytest.raises(InvalidInput, match=r"actions of the policy are in .*; must be"):
        eb.policy_agent(policy, clip=clip)
    assert eb.policy_agent(policy, clip=clip, ignore_wrappers=True).name == "Spaced"


class Spaced:
    def __init__(self, space):
        self.action_space = space

    def predict(self, seen, deterministic):
        return np.zeros((len(seen), 1))


# A model from a file.


@pytest.mark.parametrize("algorithm", [stable.PPO, stable.A2C, stable.SAC, stable.TD3])
def test_model_from_a_file__needs_the_statistics_it_was_trained_under(algorithm, tmp_path):
    rows = {"n_steps": 32} if algorithm in (stable.PPO, stable.A2C) else {"learning_starts": 8, "buffer_size": 100}
    plain, normalised = (
        eb.make_sb3_vec_env("paper-random", 2),
        vec_env.VecNormalize(eb.make_sb3_vec_env("paper-random", 2)),
    )
    for env in (plain, normalised):
        model = algorithm("MlpPolicy", env, seed=1, policy_kwargs={"net_arch": [4]}, **rows).learn(128)
        model.save(tmp_path / "model.zip")
        loaded = algorithm.load(tmp_path / "model.zip")
        if env is plain:
            assert harms(eb.policy_agent(loaded)) == harms(eb.policy_agent(model))
            continue
        with pytest.raises(InvalidInput, match="was trained under VecNormalize, whose statistics are missing"):
            eb.policy_agent(loaded, clip=True)
        assert harms(eb.policy_agent(loaded, ignore_wrappers=True)) != harms(eb.policy_agent(model))
        normalised.save(str(tmp_path / "statistics.pkl"))
        statistics = vec_env.VecNormalize.load(str(tmp_path / "statistics.pkl"), eb.make_sb3_vec_env("paper-random", 2))
        loaded.set_env(statistics)
        assert harms(eb.policy_agent(loaded)) == harms(eb.policy_agent(model))
        if isinstance(model, stable.PPO | stable.A2C):  # the others forget what they saw last
            with pytest.raises(InvalidInput, match="was trained under VecNormalize"):
                eb.policy_agent(algorithm.load(tmp_path / "model.zip", env=plain))
