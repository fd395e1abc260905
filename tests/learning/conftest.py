from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from ethbrake_marl.learning.bundle import Policy, make_policy
from ethbrake_marl.learning.manifest import observation_schema
from ethbrake_marl.learning.networks import NetworkSpec, tensor_table
from ethbrake_marl.observations import ObservationSpec


def _small_network(observation_size: int) -> NetworkSpec:
    return NetworkSpec(
        observation_size=observation_size,
        action_size=1,
        policy_hidden=(13, 9),
        value_hidden=(5,),
        activation="relu",
        output="clip",
    )


def _random_tensors(spec: NetworkSpec, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        row.name: (rng.normal(size=row.shape) / np.sqrt(row.shape[-1])).astype(np.float32) for row in tensor_table(spec)
    }


@pytest.fixture
def random_tensors() -> Callable[[NetworkSpec], dict[str, np.ndarray]]:
    return _random_tensors


@pytest.fixture
def policy() -> Policy:
    observation = ObservationSpec()
    network = _small_network(observation.size)
    return make_policy(
        _random_tensors(network),
        algorithm="ppo",
        network=network,
        observation=observation_schema(observation),
        learners=("vehicle_2",),
        scenario={"name": "paper-random"},
        reward={"harm": 1.0},
        seeds={"training": 3},
        steps=1024,
        versions={"ethbrake-marl": "0.1.0"},
    )
