"""Save the actors of your own training loop as a team, which the agent ``team@FOLDER`` loads."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from torch import Tensor, nn

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.store import write_file
from ethbrake_marl.first_edition.envs.pettingzoo import EthBrakeParallelEnv
from ethbrake_marl.first_edition.policies.network_spec import NetworkSpec
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.training.networks import ACTIVATIONS, copy_of, tensors_of_layers
from ethbrake_marl.first_edition.training.recipe import Scheme
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.team import TeamFile, bundle_of


class GaussianActor(Protocol):
    """Actor that draws its action from a normal distribution, whose mean a perceptron computes.

    The environment receives the action clipped to [-1, 1].
    """

    mean: nn.Sequential  # linear layers with ReLU or Tanh between them; the last layer has one output
    log_std: nn.Parameter  # [1] logarithm of the standard deviation of the action


def save_team(
    folder: str | os.PathLike[str],
    actors: Mapping[str, GaussianActor],
    env: EthBrakeParallelEnv,
    *,
    seed: int,
    steps: int,
) -> None:
    """Save the actors of several learners as a team, which the agent ``team@FOLDER`` loads.

    If all learners have the same actor object, it is saved once, as a shared policy. ``actors`` has the actor of each
    learner, by the vehicle's name. The team records the scenario, observations and reward of ``env``, in which the
    actors were trained, and the ``seed`` and number of decisions (``steps``) of the training.

    Raises ``InvalidInput`` if an actor is not a perceptron with ReLU or Tanh, or if learners that share an actor
    observe different features.
    """
    engine, names = env.unwrapped.engine, list(actors)
    scenario = engine.scenario
    shared = len(names) > 1 and all(actor is actors[names[0]] for actor in actors.values())
    scheme: Scheme = "shared" if shared else "independent" if len(names) > 1 else "single"
    drivers = {name: bundle_of(scheme, name) for name in names}
    for bundle in dict.fromkeys(drivers.values()):
        vehicles = tuple(name for name in names if drivers[name] == bundle)
        layers, log_std = actors[vehicles[0]].mean, actors[vehicles[0]].log_std
        place = scenario.vehicle_names.index(vehicles[0])
        Policy.make(
            {**tensors_of_layers("policy", layers), "policy.log_std": copy_of(log_std)},
            algorithm="ppo",
            network=network_of(layers),
            observation=engine.observation if shared else engine.observations[place],
            learners=vehicles,
            scenario=scenario.model_dump(mode="json"),
            reward=engine.reward.model_dump(mode="json"),
            seeds={"training": seed},
            steps=steps,
        ).save(Path(folder) / bundle)
    team = TeamFile(scheme=scheme, vehicles=scenario.vehicles, drivers=drivers)
    write_file(RunDirectory(Path(folder)).team, team.model_dump_json(indent=2).encode() + b"\n")


def network_of(layers: nn.Sequential) -> NetworkSpec:
    """Return the description of an actor's network; raise ``InvalidInput`` if ``layers`` are not a perceptron."""
    linear, between = list(layers)[::2], list(layers)[1::2]
    known = {kind: name for name, kind in ACTIVATIONS.items()}
    kinds = {type(layer) for layer in between}
    if not all(isinstance(layer, nn.Linear) for layer in linear) or len(kinds) != 1 or not kinds <= known.keys():
        raise InvalidInput(f"actor {layers}: must be linear layers with ReLU between them, or with Tanh between them")
    sizes: list[Tensor] = [layer.weight for layer in linear if isinstance(layer, nn.Linear)]
    return NetworkSpec(
        observation_size=sizes[0].shape[1],
        action_size=sizes[-1].shape[0],
        policy_hidden=tuple(weight.shape[0] for weight in sizes[:-1]),
        value_hidden=(),
        activation=known[kinds.pop()],
        output="clip",
    )
