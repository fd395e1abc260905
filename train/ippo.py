"""Independent PPO (IPPO) for several learners, in PettingZoo and torch. Read it from top to bottom.

    python train/ippo.py --scenario cooperation-3-pair --output runs/ippo
    ethbrake evaluate --scenario cooperation-3-pair --agents full_brake,e_v2x_bm,team@runs/ippo

Each learner has its own actor, critic and optimiser, and the other learners are part of its environment. All learners
learn at the same time, from the same episodes. Letters: T time steps, C copies, F features.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields
from pathlib import Path
from shlex import quote

import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Normal

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import COUNTS
from ethbrake_marl.errors import EthBrakeError, check_whole_number
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.training.own_team import save_team

# 1. Settings. Each is also an option of the command.


@dataclass(frozen=True)
class Settings:
    scenario: str = "cooperation-3-pair"  # a shipped name, or the path of a YAML file
    steps: int = 1_500_000  # decisions of all learners together
    seed: int = 0
    output: Path = Path("runs/ippo")  # a new folder
    harm_count: str = "honest"  # what the reward counts: "honest" cost, "first" impacts (the paper) or "total" harm
    copies: int = 64  # parallel copies of the environment
    rollout: int = 64  # time steps of each copy between two updates
    epochs: int = 4
    minibatch: int = 512
    hidden: int = 64  # width of each of the two hidden layers
    learning_rate: float = 2e-3  # at the start; decreases linearly to 0
    gamma: float = 1.0  # no discount: later harm counts fully
    gae_lambda: float = 0.95
    clip: float = 0.2
    mean: float = -0.7  # mean of the actions at the start: where actions do not matter, a vehicle keeps braking
    log_std: float = -0.5  # logarithm of the actions' standard deviation at the start


# 2. Networks. An actor returns a Gaussian. The environment accepts actions in [-1, 1]; collect() clips them.


def perceptron(inputs: int, hidden: int, last_gain: float, last_bias: float = 0.0) -> nn.Sequential:
    """Network with two hidden layers, one output and PPO's usual initial weights."""
    layers = [nn.Linear(inputs, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, 1)]
    for layer, gain, bias in zip(layers, (2**0.5, 2**0.5, last_gain), (0.0, 0.0, last_bias), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.constant_(layer.bias, bias)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])


class Learner(nn.Module):
    """Actor, critic and optimiser of one vehicle."""

    def __init__(self, features: int, settings: Settings) -> None:
        super().__init__()
        self.mean = perceptron(features, settings.hidden, last_gain=0.01, last_bias=settings.mean)
        self.log_std = nn.Parameter(torch.full((1,), settings.log_std))
        self.critic = perceptron(features, settings.hidden, last_gain=1.0)
        self.optimiser = torch.optim.Adam(self.parameters(), settings.learning_rate, eps=1e-5)

    def actions(self, seen: Tensor) -> Normal:
        """Distribution of the actions [..., 1] for observations [..., F]."""
        return Normal(self.mean(seen), self.log_std.exp())


# 3. Collect T time steps of C copies of the environment. When an episode ends, its copy starts the next one at once.
#    The horizon ends an episode, too: later harm does not count.


class Rollout:
    """Observations, actions and rewards of one learner."""

    def __init__(self, features: int, settings: Settings) -> None:
        steps, copies = settings.rollout, settings.copies
        self.seen = torch.zeros(steps + 1, copies, features)  # the last row is the observation after the last step
        self.actions = torch.zeros(steps, copies, 1)  # before clipping
        self.rewards = torch.zeros(steps, copies)
        self.ended = torch.zeros(steps, copies)  # 1 if this step ended the episode


class Copies:
    """Parallel copies of the environment, each with its own worlds. Only the learners are agents."""

    def __init__(self, settings: Settings) -> None:
        reward = {"harm": 0.05, "harm_count": settings.harm_count, "terminal": 0.02}  # returns are of order 1
        numbers = range(settings.seed * settings.copies, (settings.seed + 1) * settings.copies)
        self.envs = [eb.parallel_env(settings.scenario, agents="learners", reward=reward) for _ in numbers]
        self.seen = [env.reset(seed=k)[0] for k, env in zip(numbers, self.envs, strict=True)]
        self.costs = np.zeros(settings.copies)  # what the reward has counted of each running episode, m2/s2

    @torch.no_grad()
    def collect(self, learners: dict[str, Learner], settings: Settings) -> tuple[dict[str, Rollout], list[float]]:
        """Rollout per learner, and what the reward counts, summed over each episode that ended."""
        rollouts = {name: Rollout(self.seen[0][name].size, settings) for name in learners}
        harms: list[float] = []
        for t in range(settings.rollout):
            for name, own in rollouts.items():
                own.seen[t] = self.observations(name)
                own.actions[t] = learners[name].actions(own.seen[t]).sample()
            clipped = {name: own.actions[t].clamp(-1.0, 1.0).numpy() for name, own in rollouts.items()}
            after = [env.step({name: clipped[name][c] for name in learners}) for c, env in enumerate(self.envs)]
            for name, own in rollouts.items():
                own.rewards[t] = torch.tensor([rewards[name] for _, rewards, *_ in after])
                own.ended[t] = torch.tensor([not env.agents for env in self.envs])
            self.costs += [each[4][name]["cost"] for each in after]
            over = np.array([not env.agents for env in self.envs])
            harms += self.costs[over].tolist()
            self.costs[over] = 0.0
            self.seen = [each[0] if env.agents else env.reset()[0] for env, each in zip(self.envs, after, strict=True)]
        for name, own in rollouts.items():
            own.seen[-1] = self.observations(name)
        return rollouts, harms

    def observations(self, name: str) -> Tensor:
        """Learner's observations in all copies, [C, F]."""
        return torch.from_numpy(np.stack([seen[name] for seen in self.seen]))


# 4. Update: generalised advantage estimation, and PPO's clipped loss (Schulman et al. 2016, 2017).


def advantages(own: Rollout, values: Tensor, settings: Settings) -> Tensor:
    """A_t = r_t - V_t + gamma (V_t+1 + lambda A_t+1), [T, C]; at the end of an episode the bracket is 0."""
    result, after = torch.zeros_like(own.rewards), torch.zeros_like(own.rewards[0])
    for t in reversed(range(len(result))):
        ahead = settings.gamma * (values[t + 1] + settings.gae_lambda * after)
        result[t] = after = own.rewards[t] - values[t] + (1.0 - own.ended[t]) * ahead
    return result


def update(learner: Learner, own: Rollout, settings: Settings) -> None:
    seen, actions = own.seen[:-1].flatten(0, 1), own.actions.flatten(0, 1)
    with torch.no_grad():
        values = learner.critic(own.seen)[..., 0]
        gains = advantages(own, values, settings)
        targets, gains = (gains + values[:-1]).flatten(), gains.flatten()
        before = learner.actions(seen).log_prob(actions)[:, 0]
    for _ in range(settings.epochs):
        for rows in torch.split(torch.randperm(len(gains)), settings.minibatch):
            ratio = (learner.actions(seen[rows]).log_prob(actions[rows])[:, 0] - before[rows]).exp()
            gain = (gains[rows] - gains[rows].mean()) / (gains[rows].std(correction=0) + 1e-8)
            clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
            actor_loss = -torch.minimum(ratio * gain, clipped * gain).mean()
            critic_loss = nn.functional.mse_loss(learner.critic(seen[rows])[:, 0], targets[rows])
            learner.optimiser.zero_grad()
            (actor_loss + 0.5 * critic_loss).backward()
            nn.utils.clip_grad_norm_(learner.parameters(), 0.5)
            learner.optimiser.step()


# 5. Train all learners of the scenario, and save them.


def train(settings: Settings, folder: Path) -> None:
    """Train for at least `settings.steps` decisions, and save the team in `folder`."""
    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    copies = Copies(settings)
    learners = {name: Learner(seen.size, settings) for name, seen in copies.seen[0].items()}
    decisions = settings.copies * settings.rollout * len(learners)  # between two updates
    updates = -(-settings.steps // decisions)
    for k in range(updates):
        rollouts, harms = copies.collect(learners, settings)
        for name, learner in learners.items():
            learner.optimiser.param_groups[0]["lr"] = settings.learning_rate * (1.0 - k / updates)
            update(learner, rollouts[name], settings)
        if harms:
            what = COUNTS[settings.harm_count].words
            print(f"{(k + 1) * decisions:,} decisions: mean {what} of an episode {np.mean(harms):.2f}", flush=True)
    save_team(folder, learners, copies.envs[0], seed=settings.seed, steps=updates * decisions)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for field in fields(Settings):
        option = f"--{field.name.replace('_', '-')}"
        parser.add_argument(option, type=type(field.default), default=field.default, help=f"default: {field.default}")
    settings = Settings(**vars(parser.parse_args()))
    try:
        for name in ("steps", "copies", "rollout", "epochs", "minibatch", "hidden"):
            check_whole_number(name, getattr(settings, name), 1)
        with new_folder(settings.output) as folder:
            train(settings, folder)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    agents = quote(f"full_brake,e_v2x_bm,team@{settings.output}")
    count = f"--set harm_count={settings.harm_count}"
    print(f"ethbrake evaluate --scenario {quote(settings.scenario)} --agents {agents} {count}")
