"""Trainings of a second, by algorithms of this extension."""

import ethbrake_marl as eb

TINY_VINE = eb.load_recipe("counterfactual").replace(
    start=None,
    observation=None,
    n_envs=8,
    n_steps=4,
    counterfactuals=16,
    batch_size=8,
    network={"policy": [8]},
    total_steps=256,
    evaluation={"every_updates": 4, "worlds": 10, "seed": 7},
    checkpoint_every_updates=3,
)
TINY_ROLLOUTS = eb.load_recipe("options").replace(
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
MODES = {
    "networks": 2,
    "gate": [4],
    "worlds": 64,
    "templates": 20,
    "gain": 0.0,
    "margin": 5.0,
    "imitation_epochs": 2,
    "gate_states": 32,
    "gate_memory": 100,
    "gate_steps": 4,
    "tie_break": 0.05,
    "together_rate": 0.5,
    "shares": {"alone": 0.25, "further": 0.25, "gate": 0.25, "together": 0.25},
}
TINY_EXPERTS = TINY_VINE.replace(modes=MODES)
