"""A policy out of a ``.zip`` that Stable-Baselines3 saved. Reading one runs whatever code it holds."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from stable_baselines3 import PPO, SAC

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.algorithms.networks import ACTIVATIONS, tensors_of
from ethbrake_marl.observations import observation_for
from ethbrake_marl.policies.manifest import (
    NetworkSpec,
    installed_versions,
    observation_schema,
    tensor_table,
)
from ethbrake_marl.policies.policy import Policy, make_policy
from ethbrake_marl.scenario import Scenario

Saved = Literal["ppo", "sac"]

_CLASSES: dict[Saved, Any] = {"ppo": PPO, "sac": SAC}


def import_legacy(file: Path, scenario: Scenario, *, algorithm: Saved = "ppo", trusted: bool = False) -> Policy:
    """The policy in ``file``, which was trained by ``algorithm`` on ``scenario`` with this package's observations.

    ``trusted`` says that the file may run code: Stable-Baselines3 unpickles parts of it, and a pickle can do anything
    that you can. Without it nothing of the file is read. Raises ``InvalidInput`` then, and for a file that is no such
    archive or whose spaces or network are not ours.
    """
    if not trusted:
        raise InvalidInput(
            f"{file}: reading a Stable-Baselines3 .zip runs the code inside it; if you wrote it yourself, or trust who"
            " did, say so with --i-trust-this-file"
        )
    if not zipfile.is_zipfile(file):
        raise InvalidInput(f"{file}: is no .zip archive of Stable-Baselines3")
    try:
        model = _CLASSES[algorithm].load(file, device="cpu")
    except Exception as error:  # whatever its unpickling raises
        raise InvalidInput(f"{file}: cannot be read as {algorithm.upper()} ({type(error).__name__}: {error})") from None
    observation = observation_for(scenario)
    _check_spaces(file, model, observation.size)
    network = _network(file, model, algorithm, observation.size)
    return make_policy(
        tensors_of(model.policy, network),
        algorithm=algorithm,
        network=network,
        observation=observation_schema(observation),
        learners=tuple(scenario.vehicle_names[vehicle] for vehicle in scenario.learners),
        scenario=scenario.model_dump(mode="json"),
        reward={"imported_from_sha256": hashlib.sha256(file.read_bytes()).hexdigest()},
        seeds={},
        steps=int(model.num_timesteps),
        versions=installed_versions(),
    )


def _check_spaces(file: Path, model: Any, size: int) -> None:
    seen, acting = model.observation_space, model.action_space
    if getattr(seen, "shape", None) != (size,):
        raise InvalidInput(f"{file}: takes observations of shape {getattr(seen, 'shape', None)}; ours are ({size},)")
    if getattr(acting, "shape", None) != (1,) or not (np.all(acting.low == -1.0) and np.all(acting.high == 1.0)):
        raise InvalidInput(f"{file}: its actions are {acting}; ours are one number in [-1, 1]")


def _network(file: Path, model: Any, algorithm: Saved, observation_size: int) -> NetworkSpec:
    """Our description of its network, read off its tensors."""
    state: dict[str, torch.Tensor] = model.policy.state_dict()
    actor = "mlp_extractor.policy_net" if algorithm == "ppo" else "actor.latent_pi"
    made = model.policy.activation_fn
    activation = next((name for name, known in ACTIVATIONS.items() if known is made), None)
    if activation is None:
        raise InvalidInput(f"{file}: activation {made.__name__}; only ReLU and Tanh are known")
    hidden, value = _widths(state, actor), _widths(state, "mlp_extractor.value_net") if algorithm == "ppo" else ()
    if not hidden:
        raise InvalidInput(f"{file}: its policy has no hidden layers of its own ({actor}.*)")
    spec = NetworkSpec(
        observation_size=observation_size,
        action_size=1,
        policy_hidden=hidden,
        value_hidden=value,
        activation=activation,
        output="clip" if algorithm == "ppo" else "tanh",
    )
    for row in tensor_table(spec):
        shape = tuple(state[row.sb3_name].shape) if row.sb3_name in state else None
        if shape != row.shape:
            raise InvalidInput(f"{file}: {row.sb3_name} has shape {shape}; {row.shape} is needed")
    return spec


def _widths(state: dict[str, torch.Tensor], name: str) -> tuple[int, ...]:
    layers = sorted(int(key.split(".")[-2]) for key in state if key.startswith(f"{name}.") and key.endswith(".weight"))
    return tuple(state[f"{name}.{layer}.weight"].shape[0] for layer in layers)
