"""Recurrent PPO: a policy with a memory (GRU), shared by all learners, for late and lost messages.

    python train/recurrent.py --scenario benchmark-blocked --output gru
    ethbrake evaluate --scenario benchmark-blocked --agents full_brake,train/recurrent.py:make_agent:gru
    python train/benchmark/run.py --tasks benchmark-blocked --methods train/recurrent.py:train --output runs/recurrent

Information about other vehicles grows old between two messages. A memory can use earlier observations, too. The
training is PPO on whole episodes, on arrays of all learners (docs/environments.md). ``--memoryless`` trains the same
policy without a memory, for comparison. Read it from top to bottom.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.numpy import save_file
from torch import Tensor, nn

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import COUNTS
from ethbrake_marl.evaluation.benchmark import START
from ethbrake_marl.files.store import new_folder

# 1. Default observation, if the scenario has none: also the age of the news, and the vehicle's place in the line.

OBSERVATION = ["own", "front_1", "rear_1", "front_1.age", "rear_1.age", "place"]
HIDDEN, WORLDS, CLIP, TRACE, RATIO = 64, 64, 0.5, 0.95, 0.2
REWARD = {"harm": 0.05, "shaping": 0.05, "shaping_discount": 1.0}


# 2. The network: observation [rows, F] and memory [rows, H] -> mean of the number [rows], value [rows], new memory.


class Recurrent(nn.Module):
    """A GRU cell and a linear head. With `remembers=False` the memory is set to 0 before each step."""

    def __init__(self, features: int, remembers: bool) -> None:
        super().__init__()
        self.cell, self.head, self.remembers = nn.GRUCell(features, HIDDEN), nn.Linear(HIDDEN, 2), remembers

    def forward(self, seen: Tensor, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        memory = self.cell(seen, memory if self.remembers else torch.zeros_like(memory))
        mean, value = self.head(memory).unbind(1)
        return mean, value, memory


# 3. Training: every update simulates the next episodes, and then learns from all their decisions.


def train(
    task: eb.Scenario, seed: int, decisions: int, folder: Path,
    learning_rate: float = 1.2e-3, epochs: int = 10, noise: float = 0.5, harm_count: str = "honest",
    memoryless: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Train with at most so many decisions, and save the network in `folder`."""
    torch.manual_seed(seed)
    observation = list(task.observation or OBSERVATION)
    _, game = eb.open_game(task, observation=observation, reward={**REWARD, "harm_count": harm_count})
    learners = game.settings.learners
    network = Recurrent(len(eb.View(observation).names), not memoryless)
    optimiser = torch.optim.Adam(network.parameters(), lr=learning_rate)
    used, spent, first = 0, 0, 0
    while first == 0 or used + spent <= decisions:  # as many again still fit
        optimiser.param_groups[0]["lr"] = learning_rate * (1 - used / decisions)
        state = game.reset(game.draw(WORLDS, seed, first=first))
        memory, steps = torch.zeros(WORLDS * len(learners), HIDDEN), []
        while not state.ended.all():
            running = torch.from_numpy(~state.ended).repeat_interleave(len(learners))
            seen = torch.from_numpy(game.observe_alike(state, learners)).flatten(0, 1)
            with torch.no_grad():
                mean, value, memory = network(seen, memory)
            policy: Any = torch.distributions.Normal(mean, noise)  # torch's distributions are untyped
            number = policy.sample()
            actions = START.actions(number.view(WORLDS, -1).double().numpy())
            state, step = game.step(state, actions)
            reward = torch.from_numpy(step.reward[:, learners - 1]).float().flatten()
            steps.append((seen, number, policy.log_prob(number), value, reward * running, running))
        improve(network, optimiser, steps, epochs, noise)
        spent, first = sum(int(each[5].sum()) for each in steps), first + WORLDS
        used += spent
    content = {"observation": observation, "remembers": network.remembers}
    arrays = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    save_file(arrays, folder / "network.safetensors", {"content": json.dumps(content)})
    return {"start": "the task's", "simulated": used}


def improve(network: Recurrent, optimiser: Any, steps: list[Any], epochs: int, noise: float) -> None:
    """PPO on whole episodes: generalised advantages, and the clipped ratio of probabilities."""
    seen, number, before, value, reward, running = map(torch.stack, zip(*steps, strict=True))
    following = torch.cat([value[1:] * running[1:], torch.zeros_like(value[:1])])
    advantage = reward + following - value
    for step in range(len(steps) - 2, -1, -1):
        advantage[step] += TRACE * advantage[step + 1] * running[step + 1]
    target, gain = advantage + value, advantage[running]
    advantage = (advantage - gain.mean()) / (gain.std() + 1e-8)
    for _ in range(epochs):
        memory, means, values = torch.zeros(seen.shape[1], HIDDEN), [], []
        for observations in seen:
            mean, guess, memory = network(observations, memory)
            means.append(mean)
            values.append(guess)
        policy: Any = torch.distributions.Normal(torch.stack(means), noise)
        ratio = (policy.log_prob(number) - before).exp()
        gained = torch.minimum(ratio * advantage, ratio.clamp(1 - RATIO, 1 + RATIO) * advantage)[running].mean()
        loss: Any = 0.5 * ((torch.stack(values) - target)[running] ** 2).mean() - gained
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), CLIP)
        optimiser.step()


# 4. The agent that the command line makes from this file and the folder. Its memory is an array with a row per world.


def make_agent(folder: str, settings: eb.AgentSettings) -> eb.Agent:
    """Agent that uses the network in `folder`."""
    with safe_open(Path(folder) / "network.safetensors", "numpy") as file:
        content = json.loads(file.metadata()["content"])
        tensors = {name: torch.from_numpy(file.get_tensor(name)) for name in file.keys()}  # noqa: SIM118  # no mapping
    network = Recurrent(tensors["cell.weight_ih"].shape[1], content["remembers"])
    network.load_state_dict(tensors)

    def decide(seen: Any, memory: Any) -> tuple[Any, Any]:
        with torch.no_grad():
            mean, _, memory = network(torch.from_numpy(seen.copy()), torch.from_numpy(memory.copy()))
        return mean[:, None].numpy(), memory.numpy()

    return eb.policy_agent(
        decide,
        name="recurrent",
        observation=content["observation"],
        initial_state=lambda n: torch.zeros(n, HIDDEN).numpy(),
        clip=True,
        actions=START,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="benchmark-blocked")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--decisions", type=int, default=200_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--harm-count", choices=[*COUNTS], default="honest", help="what the reward counts")
    parser.add_argument("--memoryless", action="store_true")
    args = parser.parse_args()
    with new_folder(args.output) as folder:
        train(
            eb.load_scenario(args.scenario), args.seed, args.decisions, folder,
            harm_count=args.harm_count, memoryless=args.memoryless,
        )  # fmt: skip
