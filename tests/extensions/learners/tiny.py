"""Trainings of a second, by algorithms of this extension."""

import ethbrake_marl.first_edition as eb

TINY_VINE = eb.load_recipe("vine").replace(
    start=None,
    observation=None,
    n_envs=8,
    n_steps=4,
    tried=16,
    batch_size=8,
    network={"policy": [8]},
    total_steps=256,
    evaluation={"every_updates": 4, "worlds": 10, "seed": 7},
    checkpoint_every_updates=3,
)
TINY_ROLLOUTS = eb.load_recipe("rollout-classification").replace(
    observation=None,
    n_envs=8,
    n_steps=4,
    tried=16,
    memory=40,  # fills up on the way
    gradient_steps=3,
    batch_size=8,
    network={"policy": [8], "choices": 9},
    total_steps=256,
    evaluation={"every_updates": 4, "worlds": 10, "seed": 7},
    checkpoint_every_updates=3,
)
EXPERTS = {
    "networks": 2,
    "gating": [4],
    "worlds": 64,
    "templates": 20,
    "gain": 0.0,
    "margin": 5.0,
    "imitation_epochs": 2,
    "gating_states": 32,
    "gating_memory": 100,
    "gating_steps": 4,
    "tie_break": 0.05,
    "joint_rate": 0.5,
    "shares": {"pretraining_first": 0.25, "pretraining_others": 0.25, "gating": 0.25, "joint": 0.25},
}
TINY_EXPERTS = TINY_VINE.replace(experts=EXPERTS)
