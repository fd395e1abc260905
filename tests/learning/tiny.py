"""A training of a second, for tests of what surrounds the training."""

from __future__ import annotations

from ethbrake_marl.learning.training import load_recipe

TINY_PPO = load_recipe("ppo").replace(
    n_envs=8,
    n_steps=16,
    batch_size=64,
    n_epochs=2,
    network={"policy": [8], "value": [8, 4]},
    reward={"harm": 0.05, "shaping": 0.02, "shaping_discount": 0.995},
    evaluation={"every_updates": 3, "worlds": 10, "seed": 7},
    checkpoint_every_updates=2,
)
