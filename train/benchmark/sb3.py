"""PPO and SAC of Stable-Baselines3. One policy drives all learners of a task, each by its own observation.

    python train/benchmark/run.py --tasks benchmark-pair --methods sb3-ppo sb3-sac --output runs/benchmark

What is not the library's default stands here: 64 parallel worlds, updates that suit them, and no discount. The defaults
of `ppo` and `sac` are the best of their trials (`train/tune.py`). The last rollout is a whole one, so 200,000 decisions
may be up to 208,896.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

import ethbrake_marl as eb
from ethbrake_marl.evaluation.benchmark import START

WORLDS = 64
REWARD = {"harm": 0.05, "harm_count": "honest", "shaping": 0.05, "shaping_discount": 1.0}


def ppo(
    task: eb.Scenario, seed: int, decisions: int, folder: Path,
    learning_rate: float = 2.32e-3, n_epochs: int = 20, gae_lambda: float = 0.9,
) -> dict[str, Any]:  # fmt: skip
    settings = {"learning_rate": learning_rate, "n_epochs": n_epochs, "gae_lambda": gae_lambda}
    fixed = {"n_steps": 64, "batch_size": 512, "gamma": 1.0, "seed": seed, "device": "cpu"}
    return finish(PPO("MlpPolicy", env_of(task, seed), **fixed, **settings), decisions, folder)


def sac(
    task: eb.Scenario, seed: int, decisions: int, folder: Path,
    learning_rate: float = 8.19e-4, gradient_steps: int = 4, ent_coef: float = 0.01,
) -> dict[str, Any]:  # fmt: skip
    settings = {"learning_rate": learning_rate, "gradient_steps": gradient_steps, "ent_coef": ent_coef}
    fixed = {"learning_starts": 2000, "gamma": 1.0, "seed": seed, "device": "cpu"}
    return finish(SAC("MlpPolicy", env_of(task, seed), **fixed, **settings), decisions, folder)


def env_of(task: eb.Scenario, seed: int) -> eb.EthBrakeVecEnv:
    return eb.make_sb3_vec_env(task, WORLDS, seed=seed, reward=REWARD, actions=START)


def finish(model: BaseAlgorithm, decisions: int, folder: Path) -> dict[str, Any]:
    model.learn(decisions)
    model.save(folder / f"{type(model).__name__.lower()}.zip")
    return {"start": "the task's", "decisions": model.num_timesteps}


def make_agent(folder: str, settings: eb.AgentSettings) -> eb.Agent:
    """Agent with the model that `ppo` or `sac` has saved in `folder`."""
    (file,) = Path(folder).glob("*.zip")
    model = {"ppo": PPO, "sac": SAC}[file.stem].load(file, device="cpu")
    return eb.policy_agent(model, name=file.stem, scenario=settings.needed_scenario())
