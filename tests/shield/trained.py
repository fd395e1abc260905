"""A policy that was trained to do as much harm as the shield lets it: PPO under the shield, paid for harm.

``python -m tests.shield.trained`` trains both (N = 3 and 5, about a minute each) and writes their weights beside this
file, as plain arrays. Reward: the harm of each step, so an episode pays what it did.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from ethbrake_marl.engine import Engine

STEPS, WORLDS, HIDDEN = 200_000, 64, (64, 64)
FOLDER = Path(__file__).resolve().parent


def weights_file(N: int) -> Path:
    return FOLDER / f"adversary-{N}.npz"


@cache
def layers(N: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights and biases, in order."""
    with np.load(weights_file(N), allow_pickle=False) as kept:
        return [(kept[f"weight{k}"], kept[f"bias{k}"]) for k in range(len(HIDDEN) + 1)]


def trained(rng: np.random.Generator, engine: Engine, k: int) -> np.ndarray:
    """What the trained adversary proposes now, with a little noise, so that no two lists are attacked alike."""
    value = engine.observe(engine.learners[0])
    *hidden, (weight, bias) = layers(engine.scenario.vehicles)
    for w, b in hidden:
        value = np.tanh(value @ w.T + b)
    action = (value @ weight.T + bias)[:, 0].astype(np.float64)
    return np.clip(action + rng.normal(0.0, 0.05, len(action)), -1.0, 1.0)


def train(N: int) -> None:
    """Train against the shield on ``line(N)`` and keep the actor's weights."""
    import torch  # torch takes seconds to load, and the adversary itself needs none of it
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnvWrapper

    from ethbrake_marl.envs.sb3 import make_sb3_vec_env
    from ethbrake_marl.shield.sb3 import ShieldedVecEnv
    from tests.shield.lines import line

    class PaidForHarm(VecEnvWrapper):
        def reset(self):
            return self.venv.reset()

        def step_wait(self):
            observation, reward, done, infos = self.venv.step_wait()
            return observation, -reward, done, infos

    torch.set_num_threads(1)
    env = PaidForHarm(ShieldedVecEnv(make_sb3_vec_env(line(N), WORLDS, seed=N, reward={"harm": 0.02})))
    model = PPO(
        "MlpPolicy", env, n_steps=64, batch_size=1024, n_epochs=4, learning_rate=1e-3, gamma=1.0, gae_lambda=0.95,
        policy_kwargs={"net_arch": list(HIDDEN)}, seed=N, device="cpu",
    )  # fmt: skip
    model.learn(STEPS)
    state = model.policy.state_dict()
    names = [f"mlp_extractor.policy_net.{2 * k}" for k in range(len(HIDDEN))] + ["action_net"]
    kept = {}
    for k, name in enumerate(names):
        kept |= {f"weight{k}": state[f"{name}.weight"].numpy(), f"bias{k}": state[f"{name}.bias"].numpy()}
    np.savez(weights_file(N), **kept)
    paid = np.mean([episode["r"] for episode in model.ep_info_buffer])
    print(f"N={N}: {STEPS:,} steps, mean harm of the last episodes {-paid / 0.02:.2f} m2/s2, {weights_file(N).name}")


if __name__ == "__main__":
    for vehicles in (3, 5):
        train(vehicles)
