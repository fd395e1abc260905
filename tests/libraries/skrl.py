"""skrl."""

from __future__ import annotations

from typing import Any

from tests.libraries.library import Library

LIBRARY = Library(
    title="skrl", package="skrl", requires=("skrl==2.1.1",), about="`wrap_env` takes the native vector environment."
)


def make_models(env: Any) -> dict[str, Any]:
    """Policy and value as skrl's own instantiators make them."""
    from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": env.device}
    network = [{"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"}]
    return {
        "policy": gaussian_model(**spaces, network=network, output="ACTIONS", clip_actions=True),
        "value": deterministic_model(**spaces, network=network, output="ONE"),
    }


@LIBRARY.way("PPO on the native vector environment", "PPO, 122,880 steps in 32 worlds", learns=True)
def vector():
    import gymnasium as gym
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.trainers.torch import SequentialTrainer

    env = wrap_env(gym.make_vec("ethbrake_marl:EthBrake-v0", num_envs=32, reward={"harm": 0.05, "shaping": 0.05}))
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    memory, cfg = RandomMemory(memory_size=64, num_envs=32), PPO_CFG(rollouts=64, mini_batches=8)
    agent = PPO(models=make_models(env), memory=memory, cfg=cfg, **spaces)
    SequentialTrainer(env=env, agents=agent, cfg={"timesteps": 3_840, "headless": True}).train()
    return act_by(agent)


def act_by(agent: Any) -> Any:
    import torch

    def skrl(observations: Any) -> Any:
        with torch.no_grad():
            _, told = agent.policy.act({"observations": torch.tensor(observations)}, role="policy")
        return told["mean_actions"].clamp(-1, 1)

    return skrl
