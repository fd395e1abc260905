"""Save the actors of your own training loop as a run folder, which the agent ``team@FOLDER`` loads.

Without files, ``{"vehicle_2": policy_agent(network), ...}`` drives in ``evaluate`` as it is, whatever the network.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.algorithm import ACTIVATIONS
from ethbrake_marl.training.run import RunFolder


def save_team(
    folder: str | os.PathLike[str], actors: Mapping[str, Any], env: EthBrakeParallelEnv, *, seed: int, steps: int
) -> None:
    """Save one actor per learner, ``{"vehicle_2": actor, ...}``. An actor that all learners share is saved once.

    An actor has ``mean``, an ``nn.Sequential`` of linear layers with ReLU or Tanh between them and one output, and
    ``log_std`` [1], the logarithm of the noise in training. Its action is the mean, clipped to [-1, 1]. Scenario,
    observations and reward are those of ``env``, in which the actors were trained for ``steps`` decisions.

    Raises ``InvalidInput`` for another kind of actor, vehicles that are not the learners of ``env``, and learners that
    share an actor and observe different features.
    """
    base: Any = env.unwrapped
    learners = [f"vehicle_{body}" for body in base.game.rules.learners]
    if sorted(actors) != sorted(learners):
        raise InvalidInput(f"save_team: actors of {', '.join(actors)}; must be those of {', '.join(learners)}")
    shared = len(learners) > 1 and all(actor is actors[learners[0]] for actor in actors.values())
    views = [base.game.views[body] for body in base.game.rules.learners]
    if shared and len(set(views)) > 1:
        raise InvalidInput(f"save_team: {', '.join(learners)} share an actor, but observe different features")
    scheme = "shared" if shared else "independent" if len(learners) > 1 else "single"
    drivers = {name: f"policy/{name}" if scheme == "independent" else "policy" for name in learners}
    for k, name in enumerate(learners[:1] if shared else learners):
        network, tensors = _perceptron(name, actors[name])
        policy = Policy.make(
            tensors,
            network=network,
            observation=views[k],
            algorithm="ppo",
            learners=tuple(learners) if shared else (name,),
            scenario=base.scenario.content(),
            reward=base.game.rewarding.params.model_dump(mode="json"),
            seeds={"training": seed},
            steps=steps,
        )
        policy.save(Path(folder) / drivers[name])
    RunFolder(folder).write_team(scheme, base.scenario.vehicles, drivers)


def _perceptron(name: str, actor: Any) -> tuple[NetworkSpec, dict[str, Float32s]]:
    mean, log_std = getattr(actor, "mean", None), getattr(actor, "log_std", None)
    layers: list[Any] = list(mean) if isinstance(mean, nn.Sequential) else []
    linear, between = layers[::2], {type(layer) for layer in layers[1::2]}
    known = {kind: activation for activation, kind in ACTIVATIONS.items()}
    is_perceptron = len(linear) > 1 and all(isinstance(layer, nn.Linear) for layer in linear)
    if not is_perceptron or len(between) != 1 or not between <= known.keys() or log_std is None:
        raise InvalidInput(
            f"save_team: actor of {name} = {type(actor).__name__}: must have mean, an nn.Sequential of linear layers"
            " with ReLU or Tanh between them, and log_std, a parameter of shape [1]; another network drives without"
            f" files: evaluate(scenario, {{'mine': {{{name!r}: policy_agent(network)}}}})"
        )
    tensors = {"policy.log_std": _array(log_std)}
    for k, layer in enumerate(linear):
        place = "output" if k == len(linear) - 1 else str(k)
        tensors |= {f"policy.{place}.weight": _array(layer.weight), f"policy.{place}.bias": _array(layer.bias)}
    network = NetworkSpec(
        observation_size=linear[0].in_features,
        action_size=linear[-1].out_features,
        policy_hidden=tuple(layer.out_features for layer in linear[:-1]),
        value_hidden=(),
        activation=known[between.pop()],
        output="clip",
    )
    return network, tensors


def _array(parameter: Any) -> Float32s:
    return parameter.detach().cpu().numpy().astype(np.float32)  # type: ignore[no-any-return]  # torch is untyped here
