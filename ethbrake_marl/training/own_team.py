"""Save actors of your own training loop, for use as ``policy@FOLDER`` or ``team@FOLDER``."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.policies.bundle import save_drivers
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.algorithm import ACTIVATIONS, array_of, tensors_of

CONTRACT = (
    "must have the attributes mean, an nn.Sequential of linear layers with ReLU (or with Tanh) between them, from the"
    " observation to one action, and log_std, [1]; any other network drives without being saved, by"
    " eb.policy_agent(network)"
)


def save_team(
    folder: str | os.PathLike[str], actors: Mapping[str, Any], env: EthBrakeParallelEnv, *, seed: int, steps: int
) -> None:
    """Save actors, learner -> actor, as the policies of a run. Learners with the same actor object share one policy.

    An actor's action is drawn from a normal distribution and clipped to [-1, 1] by the environment. Its mean is the
    output of ``mean``, an ``nn.Sequential``; ``log_std`` [1] is the logarithm of the standard deviation.

    Args:
        folder: new folder, or one without policies.
        actors: the actor of each learner of ``env``, by the vehicle's name.
        env: environment of the training. Its scenario, observations and reward are recorded.
        seed: seed of the training.
        steps: number of decisions of the training.

    Raises ``InvalidInput`` if a learner lacks an actor, or for another vehicle or kind of actor; ``AlreadyExists``.

    """
    scenario, game = env.unwrapped.scenario, env.unwrapped.game
    views = {scenario.vehicle_names[body - 1]: game.views[body] for body in game.settings.learners.tolist()}
    if actors.keys() != views.keys():
        raise InvalidInput(
            f"save_team: has actors of {', '.join(actors) or 'nobody'}; must have one of each learner of the"
            f" environment, {', '.join(views)}"
        )
    policies: dict[str, Policy] = {}
    for name in views:
        actor = actors[name]
        sharing = tuple(learner for learner in views if actors[learner] is actor)
        policies[name] = policies.get(sharing[0]) or Policy.make(
            network=network_of(name, actor),
            tensors=tensors_of("policy", actor.mean) | {"policy.log_std": array_of(actor.log_std)},
            observation=views[name],
            algorithm="ppo",
            learners=sharing,
            scenario=scenario.content(),
            reward=game.rewarding.params.model_dump(mode="json"),
            seeds={"training": seed},
            steps=steps,
        )
    save_drivers(policies, Path(folder) / "policy")


def network_of(name: str, actor: Any) -> NetworkSpec:
    """Raises ``InvalidInput`` for a wrong actor."""
    mean, log_std = getattr(actor, "mean", None), getattr(actor, "log_std", None)
    layers: list[Any] = list(mean) if isinstance(mean, nn.Sequential) else []
    linear, between = layers[::2], layers[1::2]
    names = (key for key, kind in ACTIVATIONS.items() if between and all(isinstance(layer, kind) for layer in between))
    activation = next(names, None)
    fits = len(linear) == len(between) + 1 and all(isinstance(layer, nn.Linear) for layer in linear)
    has_one_output = fits and linear[-1].out_features == 1 and isinstance(log_std, Tensor) and log_std.shape == (1,)
    if activation is None or not has_one_output:
        raise InvalidInput(f"save_team: the actor of {name}, a {type(actor).__name__}, {CONTRACT}")
    return NetworkSpec(
        observation_size=linear[0].in_features,
        policy_hidden=tuple(layer.out_features for layer in linear[:-1]),
        value_hidden=(),
        activation=activation,
        output="clip",
    )
