"""Stable-Baselines3."""

from __future__ import annotations

from typing import Any

from tests.libraries.library import Library

LIBRARY = Library(
    title="Stable-Baselines3",
    package="stable-baselines3",
    requires=("stable-baselines3==2.9.2",),
    about=(
        "The native `VecEnv` is the fast way: all worlds are advanced together, with no environment in between. "
        "`VecNormalize` and sb3-contrib's recurrent models drive as they were trained ([a policy of another "
        "library](extending.md#a-policy-of-another-library)): load a saved model with its `VecNormalize`, which no zip "
        "holds. Statistics of Gymnasium's `NormalizeObservation` belong into a function around the model."
    ),
    in_ci=True,
)


def own_rollout(model: Any, n: int) -> Any:
    """Harm [n] by its own ``evaluate_policy``: the reward is minus the harm."""
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    returns, _ = evaluate_policy(
        model, make_vec_env("EthBrake-v0", seed=7), n, deterministic=True, return_episode_rewards=True
    )
    return [-value for value in returns]


@LIBRARY.way("by its id", "PPO as it is, 30,000 steps", learns=True)
def by_id():
    from stable_baselines3 import PPO

    import ethbrake_marl as eb

    model = PPO("MlpPolicy", "EthBrake-v0", seed=0)
    model.learn(30_000)
    agent = eb.policy_agent(model)
    return agent, lambda n: own_rollout(model, n)


@LIBRARY.way("`make_vec_env`, by id and by class", "PPO, 40,000 steps in 8 worlds", learns=True)
def by_class():
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    import ethbrake_marl as eb

    worlds = make_vec_env("EthBrake-v0", n_envs=8)
    same = make_vec_env(eb.EthBrakeEnv, n_envs=8, env_kwargs={"scenario": "paper-random"})
    model = PPO("MlpPolicy", worlds, n_steps=256, batch_size=256, seed=0).learn(20_000)
    model.set_env(same)
    model.learn(20_000)
    agent = eb.policy_agent(model)
    return agent, lambda n: own_rollout(model, n)


@LIBRARY.way("the native `VecEnv`", "PPO, 200,000 steps in 64 worlds", learns=True)
def native():
    from stable_baselines3 import PPO

    import ethbrake_marl as eb

    reward = {"harm": 0.05, "shaping": 0.05, "shaping_discount": 0.99}
    worlds = eb.make_sb3_vec_env("paper-random", n_envs=64, reward=reward)
    model = PPO("MlpPolicy", worlds, n_steps=64, batch_size=512, learning_rate=1e-3, seed=0)
    model.learn(200_000)
    model.save("sb3")
    agent = eb.policy_agent(model)
    return agent, lambda n: own_rollout(model, n)
