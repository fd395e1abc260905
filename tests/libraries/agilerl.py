"""AgileRL."""

from __future__ import annotations

from typing import Any

from tests.libraries.library import Library

LIBRARY = Library(
    title="AgileRL",
    package="agilerl",
    requires=("agilerl==2.7.1",),
    about=(
        "Its training loop takes the vector environment. (Without one, its loop for PPO in 2.7.1 goes on "
        "stepping after an episode has ended, in any environment.) It gives a single environment actions "
        "without axes, which are taken as one action."
    ),
)


def act_by(agent: Any) -> Any:
    agent.set_training_mode(False)
    return lambda observations: agent.get_action(observations)[0].reshape(-1, 1)


@LIBRARY.way("`train_on_policy` with the vector environment", "PPO, 2 iterations of 2,048 steps in 8 worlds")
def on_vector():
    import gymnasium as gym
    from agilerl.algorithms import PPO
    from agilerl.training.train_on_policy import train_on_policy

    env = gym.make_vec("ethbrake_marl:EthBrake-v0", num_envs=8, autoreset_mode="SameStep")
    ppo = PPO(env.single_observation_space, env.single_action_space, num_envs=8, learn_step=256)
    train_on_policy(env, "EthBrake-v0", "PPO", [ppo], max_steps=4_096, evo_steps=2_048, eval_steps=100)
    ppo.test(gym.make("EthBrake-v0"), max_steps=100)
    return act_by(ppo)
