"""Behaviour cloning: a network learns the commands of the best known profiles by squared error.

    python train/benchmark/run.py --tasks benchmark-pair --methods clone --output runs/benchmark

A search finds the profiles, in worlds of the training's seed. It knows the whole world and its future; the network has
only the observations of the learners, and one network drives all of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

import ethbrake_marl as eb
from ethbrake_marl.episode.commands import actions_of
from ethbrake_marl.extensions.search.best_harm import search_list
from ethbrake_marl.extensions.search.pricing import problem_of

CANDIDATES, BATCH = 500, 512


def demonstrations(task: eb.Scenario, seed: int, decisions: int) -> tuple[Tensor, Tensor]:
    """Observations [k, F] and actions [k, 1] of the best known profiles, at `decisions` decisions or a few more."""
    _, game = eb.open_game(task)
    learners, seen, actions = game.settings.learners, [], []
    first = 0
    while sum(map(len, actions)) < decisions:
        worlds = task.draw(200, seed, first=first, purpose="training").worlds
        table = search_list(game, worlds, harm_counts=("honest",), budget=CANDIDATES, seed=seed, threads=1)
        problem = problem_of(game, worlds)
        commands = table.profiles["honest"].stepwise(int(problem.last_step.max()))
        state = game.reset(worlds)
        for step in range(commands.shape[1]):
            action = actions_of(state, learners, commands[:, step]).astype(np.float32)
            running = ~state.ended
            seen.append(torch.from_numpy(game.observe_alike(state, learners)[running]).flatten(0, 1))
            actions.append(torch.from_numpy(action[running]).flatten()[:, None])
            state, _ = game.step(state, action.astype(np.float64))
        first += 200
    return torch.cat(seen)[:decisions], torch.cat(actions)[:decisions]


def network_of(features: int, hidden: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(features, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 1)
    )


def clone(
    task: eb.Scenario, seed: int, decisions: int, folder: Path,
    learning_rate: float = 1.06e-3, n_epochs: int = 40, hidden: int = 256,
) -> dict[str, Any]:  # fmt: skip
    torch.manual_seed(seed)
    seen, actions = demonstrations(task, seed, decisions)
    network = network_of(seen.shape[1], hidden)
    optimiser = torch.optim.Adam(network.parameters(), learning_rate)
    for _ in range(n_epochs):
        for rows in torch.split(torch.randperm(len(seen)), BATCH):
            loss = nn.functional.mse_loss(network(seen[rows]), actions[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    save_file(network.state_dict(), folder / "network.safetensors")
    # a search of each learner alone, then one of all together
    searches = len(task.learners) + (len(task.learners) > 1)
    return {"start": "none", "simulated": decisions * (1 + searches * CANDIDATES)}


def make_agent(folder: str, settings: eb.AgentSettings) -> eb.Agent:
    """Agent with the network that `clone` has saved in `folder`."""
    weights = load_file(Path(folder) / "network.safetensors")
    network = network_of(*weights["0.weight"].shape[::-1])
    network.load_state_dict(weights)
    return eb.policy_agent(network, name="clone", scenario=settings.needed_scenario(), clip=True)
