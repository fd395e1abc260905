"""Train adversaries of the shield: PPO behind the shield, rewarded for harm. Writes their weights to tests/shield.

``PYTHONPATH=. .venv/bin/python docs/studies/shield_adversary.py`` takes a minute for each number of vehicles. The
weights in the repository are plain arrays, and change only if this program is run.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

STEPS = 200_000
WORLDS, HIDDEN = 64, (64, 64)
FOLDER = Path(__file__).resolve().parents[2] / "tests" / "shield"


def train(N: int, steps: int) -> str:
    """Train against the shield on a line of ``N`` vehicles, save the actor's weights, and return a summary."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnvWrapper
    from tests.shield.attacks import line

    from ethbrake_marl.first_edition.envs.sb3 import make_sb3_vec_env
    from ethbrake_marl.first_edition.shields.sb3 import ShieldedVecEnv

    class PaidForHarm(VecEnvWrapper):
        def reset(self):
            return self.venv.reset()

        def step_wait(self):
            observation, reward, done, infos = self.venv.step_wait()
            return observation, -reward, done, infos

    torch.set_num_threads(1)
    env = PaidForHarm(
        ShieldedVecEnv(make_sb3_vec_env(line(N), WORLDS, seed=N, reward={"harm": 0.02}, horizon_is_end=False))
    )
    model = PPO(
        "MlpPolicy", env, n_steps=64, batch_size=1024, n_epochs=4, learning_rate=1e-3, gamma=1.0, gae_lambda=0.95,
        policy_kwargs={"net_arch": list(HIDDEN)}, seed=N, device="cpu",
    )  # fmt: skip
    model.learn(steps)
    state = model.policy.state_dict()
    weights = {}
    for k, name in enumerate([*(f"mlp_extractor.policy_net.{2 * k}" for k in range(len(HIDDEN))), "action_net"]):
        weights |= {f"weight{k}": state[f"{name}.weight"].numpy(), f"bias{k}": state[f"{name}.bias"].numpy()}
    np.savez(FOLDER / f"adversary-{N}.npz", **weights)
    paid = np.mean([episode["r"] for episode in model.ep_info_buffer])
    return f"N = {N}: {steps:,} steps, mean harm of the last episodes {-paid / 0.02:.2f} m2/s2"


if __name__ == "__main__":
    for vehicles in (3, 5):
        print(train(vehicles, STEPS))
