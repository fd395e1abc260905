"""PPO and SAC of Stable-Baselines3. One policy drives all learners of a task, each by its own observation.

    python train/benchmark/run.py --tasks benchmark-pair --methods sb3-ppo sb3-sac --output runs/benchmark

What is not the library's default stands here: 64 parallel worlds, updates that suit them, and no discount.
"""

from __future__ import annotations

from pathlib import Path

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

import ethbrake_marl as eb

WORLDS = 64
REWARD = {"harm": 0.05, "harm_count": "honest", "shaping": 0.05, "shaping_discount": 1.0}


def ppo(task: eb.Scenario, seed: int, decisions: int, folder: Path) -> None:
    settings = {"n_steps": 64, "batch_size": 512, "learning_rate": 1e-3}
    finish(PPO("MlpPolicy", env_of(task, seed), gamma=1.0, seed=seed, device="cpu", **settings), decisions, folder)


def sac(task: eb.Scenario, seed: int, decisions: int, folder: Path) -> None:
    settings = {"learning_starts": 2000, "ent_coef": "auto_0.05", "learning_rate": 1e-3}
    finish(SAC("MlpPolicy", env_of(task, seed), gamma=1.0, seed=seed, device="cpu", **settings), decisions, folder)


def env_of(task: eb.Scenario, seed: int) -> eb.EthBrakeVecEnv:
    return eb.make_sb3_vec_env(task, WORLDS, seed=seed, reward=REWARD)


def finish(model: BaseAlgorithm, decisions: int, folder: Path) -> None:
    model.learn(decisions)
    model.save(folder / f"{type(model).__name__.lower()}.zip")


def make_agent(folder: str, settings: eb.AgentSettings) -> eb.Agent:
    """Agent with the model that `ppo` or `sac` has saved in `folder`."""
    (file,) = Path(folder).glob("*.zip")
    model = {"ppo": PPO, "sac": SAC}[file.stem].load(file, device="cpu")
    return eb.policy_agent(model, name=file.stem, scenario=settings.needed_scenario())
