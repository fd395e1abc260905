"""The step shield is as good as version 0.5's was: recorded sums of harm, bounds and decisions of 300 worlds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.shields.step import StepShield

N = 300
RECORDED = [  # scenario, count, who proposes, harm, bound, number of replaced proposals
    ("paper-random", "first", "random", 4047.37, 4319.08, 6259),
    ("paper-random", "first", "drive", 4189.30, 4319.08, 7171),
    ("paper-random", "first", "brake", 3607.36, 4319.08, 3556),
    ("paper-random", "first", "ppo", 1815.88, 1815.88, 0),
    ("paper-random-obstacle", "total", "random", 12106.43, 12574.41, 8087),
    ("paper-random-obstacle", "total", "drive", 11675.69, 12574.41, 9332),
    ("paper-random-obstacle", "total", "brake", 12287.72, 12574.41, 3000),
    ("paper-random-obstacle", "total", "ppo", 11745.30, 12440.30, 2934),
    ("cooperation-3-pair", "first", "brake", 3787.97, 4319.08, 3779),
    pytest.param("cooperation-3-pair", "first", "ppo", 2444.67, 2512.62, 5502, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("name", "count", "way", "harm", "bound", "replaced"), RECORDED)
def test_shield__is_not_worse_than_recorded(
    name: str, count: str, way: str, harm: float, bound: float, replaced: int
) -> None:
    scenario, game = open_game(name)
    learners, rng = game.settings.learners.tolist(), np.random.default_rng(0)
    drivers: Any = dict.fromkeys(learners, LearnedAgent(load_shipped("ppo"))) if way == "ppo" else None
    game = game._replace(shield=StepShield(drivers, harm_count=count))
    state, shape = game.reset(scenario.sample(N, 7)), (N, len(learners))
    while not state.ended.all():
        drawn = rng.uniform(-1.0, 1.0, shape)
        actions = {"random": drawn, "drive": np.ones(shape), "brake": -np.ones(shape), "ppo": None}[way]
        state, _ = game.step(state, actions, donate=True)
    memory = state.memories["shield"]
    assert state.harm(count).sum() <= 1.01 * harm
    assert memory.first.sum() <= 1.001 * bound
    assert memory.replaced.sum() <= 1.01 * replaced
