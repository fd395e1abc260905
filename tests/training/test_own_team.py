"""Actors of a training loop of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.policies.bundle import load_drivers
from ethbrake_marl.training.own_team import save_team
from tests.refused import refused
from tests.training.tiny import PAIR

FEATURES = 27


class Actor:
    """An actor as the scripts of ``train/`` have it."""

    def __init__(self, *layers: nn.Module) -> None:
        self.mean = nn.Sequential(*layers)
        self.log_std = nn.Parameter(torch.full((1,), -0.5))


def actor(between: nn.Module) -> Actor:
    made = Actor(nn.Linear(FEATURES, 4), between, nn.Linear(4, 1))
    nn.init.normal_(made.mean[-1].weight, std=30.0)
    return made


@pytest.mark.parametrize("between", [nn.ReLU(), nn.Tanh()])
@pytest.mark.parametrize("shared", [True, False])
def test_save_team__drives_as_the_actors_do(between: nn.Module, shared: bool, tmp_path: Path) -> None:
    torch.manual_seed(0)
    front, rear = actor(between), actor(between)
    actors = {"vehicle_2": front, "vehicle_3": front if shared else rear}
    env = EthBrakeParallelEnv(PAIR, reward={"harm": 0.5})
    save_team(tmp_path, actors, env, seed=3, steps=5)
    seen = make_sb3_vec_env(PAIR, 50, seed=1).reset() * 5.0
    policies = load_drivers(tmp_path / "policy")
    for name, policy in policies.items():
        theirs = actors[name].mean(torch.from_numpy(seen)).clamp(-1.0, 1.0).detach().numpy()
        np.testing.assert_allclose(policy(seen), theirs, atol=1e-5)
        assert np.abs(theirs).max() == 1.0 and policy.tensors["policy.log_std"] == np.float32(-0.5)
        assert policy.manifest.learners == (tuple(actors) if shared else (name,))
        assert (policy.manifest.seeds, policy.manifest.steps) == ({"training": 3}, 5)
        assert policy.manifest.reward["harm"] == 0.5
    assert [*policies] == [*actors]
    with pytest.raises(AlreadyExists):
        save_team(tmp_path, actors, env, seed=3, steps=5)


BAD: dict[str, Any] = {
    "no mean": nn.Linear(FEATURES, 1),
    "another activation": Actor(nn.Linear(FEATURES, 4), nn.GELU(), nn.Linear(4, 1)),
    "two actions": Actor(nn.Linear(FEATURES, 4), nn.ReLU(), nn.Linear(4, 2)),
}


@pytest.mark.parametrize("kind", BAD)
def test_save_team__another_actor_is_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    actors = {"vehicle_2": actor(nn.ReLU()), "vehicle_3": BAD[kind]}
    with refused("save_team: the actor of vehicle_3, a "):
        save_team(tmp_path, actors, EthBrakeParallelEnv(PAIR), seed=0, steps=0)
    assert not list(tmp_path.iterdir())


def test_save_team__other_learners_are_refused(tmp_path: Path) -> None:
    with refused("save_team: has actors of vehicle_2; must have one of each learner of the environment, vehicle_2, v"):
        save_team(tmp_path, {"vehicle_2": actor(nn.ReLU())}, EthBrakeParallelEnv(PAIR), seed=0, steps=0)
