"""Behaviour cloning: a network learns from a dataset to act as an agent did. Read it from top to bottom.

    to_parquet("runs/ppo.parquet", "ppo", scenario="paper-random", episodes=10_000, seed=1)  # in Python
    python train/clone.py runs/ppo.parquet --output runs/clone
    ethbrake evaluate --agents full_brake,ppo,train/clone.py:make_agent:runs/clone,best_harm --episodes 2000

The dataset has the worlds of seed 1, and `ethbrake evaluate` uses other worlds (seed 7). How good a clone can be
depends on the agent: `ppo` has the same observations as the clone, but `best_harm` knows the whole world.
"""

from __future__ import annotations

import argparse
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import torch
from torch import Tensor, nn

import ethbrake_marl as eb
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.algorithm import tensors_of

HIDDEN = (128, 128)
EPOCHS, BATCH, LEARNING_RATE = 20, 512, 1e-3

# 1. The dataset: observations and actions of the only learner, and metadata with the scenario.


def read_dataset(path: Path) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Observations [k, F], actions [k, 1] and metadata of a Parquet file from `to_parquet`."""
    try:
        metadata = json.loads(pyarrow.parquet.read_metadata(path).metadata[b"ethbrake_marl"])
    except (KeyError, TypeError, pyarrow.ArrowInvalid):
        raise InvalidInput(f"{path}: must be a Parquet file from `to_parquet`") from None
    if len(metadata["learners"]) != 1:
        raise InvalidInput(f"{path}: has {len(metadata['learners'])} learners; it must have one")
    (learner,) = metadata["learners"]
    number = learner.removeprefix("vehicle_")
    seen = [f"observation_{number}.{feature}" for feature in metadata["observation"][learner]]
    table = pyarrow.parquet.read_table(path, columns=[*seen, f"action_{number}"])
    columns = np.stack([table[name].to_numpy() for name in table.column_names], axis=1).astype(np.float32)
    return torch.from_numpy(columns[:, :-1].copy()), torch.from_numpy(columns[:, -1:].copy()), metadata


# 2. Training minimises the squared difference of the actions.


def clone(seen: Tensor, actions: Tensor, seed: int) -> nn.Sequential:
    """Network [F] -> [1], trained to give `actions` [k, 1] for the observations `seen` [k, F]."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    sizes = [seen.shape[1], *HIDDEN]
    layers = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.ReLU())]
    network = nn.Sequential(*layers, nn.Linear(sizes[-1], 1))
    batches = EPOCHS * -(-len(seen) // BATCH)
    optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, batches)
    for _ in range(EPOCHS):
        for rows in torch.split(torch.randperm(len(seen)), BATCH):
            loss = nn.functional.mse_loss(network(seen[rows]), actions[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return network


# 3. The policy as a bundle of files, which needs no torch. (In Python the network itself can be an agent, too:
#    eb.policy_agent(network, clip=True).)


def as_policy(network: nn.Sequential, metadata: dict[str, Any], seed: int) -> Policy:
    """Network as a policy, with the scenario and the seeds of its dataset."""
    (learner,) = metadata["learners"]
    scenario, view = eb.Scenario(**metadata["scenario"]), eb.View(metadata["observation"][learner])
    return Policy.make(
        tensors_of("policy", network) | {"policy.log_std": np.zeros(1, np.float32)},
        algorithm="clone",
        network=NetworkSpec(
            observation_size=len(view.names), policy_hidden=HIDDEN, value_hidden=(), activation="relu", output="clip"
        ),
        observation=view,
        learners=(learner,),
        scenario=scenario.content(),
        reward=metadata["reward"],
        seeds={"training": seed, "list": metadata["seed"]},
        steps=0,
    )


def train(dataset: Path, seed: int, output: Path) -> None:
    """Clone the agent of the dataset, and save it as `output`/policy. Raises `AlreadyExists` if `output` exists."""
    with new_folder(output) as folder:
        seen, actions, metadata = read_dataset(dataset)
        as_policy(clone(seen, actions, seed), metadata, seed).save(folder / "policy")


# 4. The clone as an agent, for every command that takes agents.


def make_agent(argument: str | None, settings: eb.AgentSettings) -> eb.Agent:
    """Clone in the folder `argument` as an agent.

    Its name is `train/clone.py:make_agent:FOLDER`, or `train/clone.py:make_agent:FOLDER+step` with a shield.
    """
    if argument is None:
        raise InvalidInput(f"agent {settings.spec!r}: give the clone's folder: train/clone.py:make_agent:runs/clone")
    return eb.LearnedAgent(eb.load_policy(argument), name=settings.spec)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="a Parquet file from `to_parquet`")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/clone"), help="new folder for the policy")
    args = parser.parse_args()
    try:
        train(args.dataset, args.seed, args.output)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    print(f"cloned: {args.output}; ethbrake evaluate --agents ppo,{__file__}:make_agent:{args.output}")
