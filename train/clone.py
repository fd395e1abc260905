"""Behaviour cloning: a network that does what an agent did, learnt from a dataset alone. Read it from top to bottom.

    write_dataset("runs/ppo.parquet", "ppo", scenario="paper-random", episodes=10_000, seed=1)  # in Python
    python train/clone.py runs/ppo.parquet --output runs/clone
    ethbrake evaluate --agents full_brake,ppo,train/clone.py:make_agent:runs/clone,best_harm --episodes 2000

The worlds of the list of seed 1 are others than those of seed 7, on which `ethbrake evaluate` measures. What a clone
can reach depends on whom it watches: ppo sees what the clone sees; best_harm chose with hindsight.
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
from numpy.typing import NDArray
from torch import Tensor, nn

import ethbrake_marl as eb
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.policies.network_spec import NetworkSpec
from ethbrake_marl.policies.policy import Policy

HIDDEN = (128, 128)
EPOCHS, BATCH, LEARNING_RATE = 20, 512, 1e-3

# 1. The dataset: what the one learner saw, and what was done. Its metadata say all about the scenario.


def read_dataset(path: Path) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Observations [k, F], actions [k, 1] and the metadata of a Parquet file of `write_dataset`."""
    try:
        told = json.loads(pyarrow.parquet.read_metadata(path).metadata[b"ethbrake_marl"])
    except (KeyError, TypeError, pyarrow.ArrowInvalid):
        raise InvalidInput(f"{path}: is no dataset of `write_dataset`") from None
    if len(told["learners"]) != 1:
        raise InvalidInput(f"{path}: holds {len(told['learners'])} learners, one is needed")
    number = told["learners"][0].removeprefix("vehicle_")
    seen = [f"observation_{number}.{feature}" for feature in told["observation"]]
    table = pyarrow.parquet.read_table(path, columns=[*seen, f"action_{number}"])
    columns = np.stack([table[name].to_numpy() for name in table.column_names], axis=1).astype(np.float32)
    return torch.from_numpy(columns[:, :-1].copy()), torch.from_numpy(columns[:, -1:].copy()), told


# 2. Training: the squared difference of actions, nothing else.


def clone(seen: Tensor, done: Tensor, seed: int) -> nn.Sequential:
    """A network [F] -> [1] that does what was done."""
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
            loss = nn.functional.mse_loss(network(seen[rows]), done[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return network


# 3. The policy as a bundle: plain files, run without torch. (In Python the network itself drives, too:
#    eb.policy_agent(network, clip=True).)


def as_policy(network: nn.Sequential, told: dict[str, Any], seed: int) -> Policy:
    """The network as a bundle that says where it comes from."""
    scenario, spec = eb.Scenario(**told["scenario"]), eb.choose_observation(told["observation"])
    linear = [layer for layer in network if isinstance(layer, nn.Linear)]
    names = [*(f"policy.{k}" for k in range(len(HIDDEN))), "policy.output"]
    tensors: dict[str, NDArray[np.float32]] = {"policy.log_std": np.zeros(1, np.float32)}
    for name, layer in zip(names, linear, strict=True):
        tensors[f"{name}.weight"] = layer.weight.detach().numpy()
        tensors[f"{name}.bias"] = layer.bias.detach().numpy()
    return Policy.make(
        tensors,
        algorithm="clone",
        network=NetworkSpec(
            observation_size=spec.size,
            action_size=1,
            policy_hidden=HIDDEN,
            value_hidden=(),
            activation="relu",
            output="clip",
        ),
        observation=spec,
        learners=tuple(told["learners"]),
        scenario=scenario.model_dump(mode="json"),
        reward=told["reward"],
        seeds={"training": seed, "list": told["seed"]},
        steps=0,
    )


def train(dataset: Path, seed: int, output: Path) -> None:
    """Clone what the dataset holds into `output`/policy; refuses an `output` that is there."""
    with new_folder(output) as folder:
        seen, done, told = read_dataset(dataset)
        as_policy(clone(seen, done, seed), told, seed).save(folder / "policy")


# 4. Who drives by it, on every command that takes agents.


def make_agent(argument: str | None, settings: eb.AgentSettings) -> eb.Agent:
    """The clone in the folder `argument`: `train/clone.py:make_agent:runs/clone` or `...:runs/clone+step`."""
    if argument is None:
        raise InvalidInput(f"agent {settings.spec!r}: say which clone drives: train/clone.py:make_agent:runs/clone")
    return eb.LearnedAgent(eb.load_policy(argument), name=settings.spec)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="a Parquet file of `write_dataset`")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/clone"), help="new folder")
    given = parser.parse_args()
    try:
        train(given.dataset, given.seed, given.output)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    print(f"cloned: {given.output}; ethbrake evaluate --agents ppo,{__file__}:make_agent:{given.output}")
