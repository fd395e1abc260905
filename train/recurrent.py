"""A policy with a memory (GRU), shared by all learners, for late and lost messages. Read it from top to bottom.

    ethbrake scenario new lossy --based-on cooperation-3-pair     # then: v2x: {preset: blocked, persistence: periodic}
    python train/recurrent.py --scenario lossy.yaml --output gru
    ethbrake evaluate --scenario lossy.yaml --agents full_brake,train/recurrent.py:make_agent:gru

Information about other vehicles grows old between two messages. A memory can use earlier observations, too. The
training is a plain policy gradient on whole episodes, on arrays of all learners (docs/environments.md).
``--memoryless`` trains the same policy without a memory, for comparison. In these trainings the memory did not help, so
the ages of the messages seem to be enough. First-impact harm after ``--harm-count first``, on 2,000 worlds of seed 7
(one thread, AMD EPYC, 2026-11-24):

    agent                                              with memory     without memory
    after ``--updates 500``                            23.32           22.66
    after ``--updates 200``, seeds 0 and 1             27.01, 27.07    25.98, 25.33
    full braking                                                       44.83
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
from ethbrake_marl.files.store import new_folder

# 1. Default observation, if the scenario has none: also the age of the news, and the vehicle's place in the line.

OBSERVATION = ["own", "front_1", "rear_1", "front_1.age", "rear_1.age", "place"]
HIDDEN, NOISE, RATE = 64, 0.3, 3e-3


# 2. The network: observation [rows, F] and memory [rows, H] -> mean of the action [rows] and new memory [rows, H].


class Recurrent(nn.Module):
    """A GRU cell and a linear head. With `remembers=False` the memory is set to 0 before each step."""

    def __init__(self, features: int, remembers: bool) -> None:
        super().__init__()
        self.cell, self.head, self.remembers = nn.GRUCell(features, HIDDEN), nn.Linear(HIDDEN, 1), remembers

    def forward(self, seen: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Mean of the action [rows] and the new memory [rows, H]."""
        memory = self.cell(seen, memory if self.remembers else torch.zeros_like(memory))
        return self.head(memory)[:, 0], memory


# 3. Training: every update simulates the next n episodes, and then learns from all their decisions.


def train(scenario: eb.Scenario, observation: list[str], args: argparse.Namespace) -> Recurrent:
    """Trained network. Every ten updates, print the mean of what the reward counts."""
    torch.manual_seed(args.seed)
    _, game = eb.open_game(scenario, observation=observation, reward={"harm_count": args.harm_count})
    learners = game.settings.learners
    n, shape = args.worlds, (args.worlds, len(learners))
    network = Recurrent(len(eb.View(observation).names), not args.memoryless)
    optimiser = torch.optim.Adam(network.parameters(), lr=RATE)
    for update in range(args.updates):
        optimiser.param_groups[0]["lr"] = RATE * (1 - update / args.updates)
        state = game.reset(game.draw(n, args.seed, first=n * update))
        memory, chosen, gained = torch.zeros(n * len(learners), HIDDEN), [], []
        while not state.ended.all():
            running = torch.from_numpy(~state.ended)[:, None]
            seen = torch.from_numpy(game.observe_alike(state, learners)).flatten(0, 1)
            mean, memory = network(seen, memory)
            policy: Any = torch.distributions.Normal(mean.view(shape), NOISE)  # torch's distributions are untyped
            actions = policy.sample()
            state, step = game.step(state, actions.clamp(-1, 1).numpy())
            chosen.append(policy.log_prob(actions) * running)
            gained.append(torch.from_numpy(step.reward[:, learners - 1]))
        to_go = torch.stack(gained).flip(0).cumsum(0).flip(0)
        advantage = (to_go - to_go.mean(1, keepdim=True)) / (to_go.std() + 1e-8)
        loss: Any = -(torch.stack(chosen) * advantage).sum() / sum(shape)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        optimiser.step()
        if update % 10 == 9:
            mean = state.harm(args.harm_count).mean()
            print(f"update {update + 1}: {COUNTS[args.harm_count].words} {mean:.2f} m2/s2", flush=True)
    return network


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
            mean, memory = network(torch.from_numpy(seen.copy()), torch.from_numpy(memory.copy()))
        return mean[:, None].numpy(), memory.numpy()

    return eb.policy_agent(
        decide,
        name="recurrent",
        observation=content["observation"],
        initial_state=lambda n: torch.zeros(n, HIDDEN).numpy(),
        clip=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="cooperation-3-congested")
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--updates", type=int, default=200)
    parser.add_argument("--worlds", type=int, default=256)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--harm-count", choices=[*COUNTS], default="honest", help="what the reward counts")
    parser.add_argument("--memoryless", action="store_true")
    args = parser.parse_args()
    scenario = eb.load_scenario(args.scenario)
    observation = list(scenario.observation or OBSERVATION)
    with new_folder(args.output) as folder:
        network = train(scenario, observation, args)
        content = {"observation": observation, "remembers": network.remembers}
        arrays = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
        save_file(arrays, folder / "network.safetensors", {"content": json.dumps(content)})


if __name__ == "__main__":
    main()
