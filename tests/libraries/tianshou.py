"""Tianshou."""

from __future__ import annotations

from typing import Any

from tests.libraries.library import Library

LIBRARY = Library(
    title="Tianshou",
    package="tianshou",
    requires=("tianshou[eval]==2.0.1",),
    about="Its high-level interface takes the id; it imports what the extra `eval` brings.",
)


@LIBRARY.way("its high-level interface", "PPO, 2 iterations of 2,048 steps in 8 worlds")
def high_level():
    from tianshou.highlevel.config import OnPolicyTrainingConfig
    from tianshou.highlevel.env import EnvFactoryRegistered, VectorEnvType
    from tianshou.highlevel.experiment import PPOExperimentBuilder

    worlds = EnvFactoryRegistered(
        task="ethbrake_marl:EthBrake-v0", venv_type=VectorEnvType.DUMMY, render_mode_watch=None
    )
    steps = {"max_epochs": 2, "epoch_num_steps": 2_048, "collection_step_num_env_steps": 2_048}
    config = OnPolicyTrainingConfig(**steps, num_training_envs=8, num_test_envs=2, update_step_num_repetitions=4)
    result = PPOExperimentBuilder(worlds, training_config=config).build().run()
    return act_by(result.world.algorithm.policy)


def act_by(policy: Any) -> Any:
    from tianshou.data import Batch

    policy.eval()
    return lambda observations: policy.map_action(policy(Batch(obs=observations, info=Batch())).act)
