"""RLlib."""

from __future__ import annotations

from tests.libraries.library import Library

LIBRARY = Library(
    title="RLlib",
    package="ray",
    requires=("ray[rllib]==2.60.0",),
    about=(
        "`ray[rllib]` 2.60 asks for exactly Gymnasium 1.2.2 ([RLlib's own "
        "issue](https://github.com/ray-project/ray/issues/53776)), which this project takes."
    ),
)


@LIBRARY.way("by the id", "PPO, 2 iterations of 2,000 steps")
def by_id():
    from ray.rllib.algorithms.ppo import PPOConfig

    config = PPOConfig().environment("ethbrake_marl:EthBrake-v0").env_runners(num_env_runners=0)
    config.training(train_batch_size=2_000, minibatch_size=128, num_epochs=4)
    ppo = config.build_algo()
    for _ in range(2):
        ppo.train()
    ppo.stop()


@LIBRARY.way("several learners, by PettingZoo's interface", "PPO, 2 iterations of 2,000 steps, two learners")
def several():
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
    from ray.tune import register_env

    import ethbrake_marl as eb

    made = lambda _: ParallelPettingZooEnv(eb.parallel_env("cooperation-3-pair", agents="learners"))  # noqa: E731
    register_env("line", made)
    config = PPOConfig().environment("line").env_runners(num_env_runners=0).training(train_batch_size=2_000)
    config.multi_agent(policies={"all"}, policy_mapping_fn=lambda *_, **__: "all")
    ppo = config.build_algo()
    return train_twice(ppo)


def train_twice(ppo: object) -> None:
    for _ in range(2):
        ppo.train()
    ppo.stop()
