"""Multi-agent PPO (MAPPO) for several learners, in PettingZoo and torch. Read it from top to bottom.

    python train/mappo.py --scenario cooperation-3-pair --output runs/mappo
    ethbrake evaluate --scenario cooperation-3-pair --agents full_brake,e_v2x_bm,team@runs/mappo --set rules=honest

Each learner has its own actor, which observes what its vehicle knows. One critic observes the full state of the line,
`state()`, and predicts the return of each learner; it is used only in training. Everything else is as in
`train/ippo.py`. Letters: T time steps, C copies, L learners, F features, S size of the state.
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
from ethbrake_marl.episode.counts import IN_WORDS
from ethbrake_marl.errors import EthBrakeError, check_whole_number
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.training.own_team import save_team

# 1. Settings. Each is also an option of the command.


@dataclass(frozen=True)
class Settings:
    scenario: str = "cooperation-3-pair"  # a shipped name, or the path of a YAML file
    steps: int = 1_000_000  # decisions of all learners together
    seed: int = 0
    output: Path = Path("runs/mappo")  # a new folder
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


def perceptron(inputs: int, hidden: int, outputs: int, last_gain: float, last_bias: float = 0.0) -> nn.Sequential:
    """Network with two hidden layers and PPO's usual initial weights."""
    layers = [nn.Linear(inputs, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, outputs)]
    for layer, gain, bias in zip(layers, (2**0.5, 2**0.5, last_gain), (0.0, 0.0, last_bias), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.constant_(layer.bias, bias)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])


class Actor(nn.Module):
    """Actor of one vehicle: maps observations [..., F] to the distribution of actions [..., 1]."""

    def __init__(self, features: int, settings: Settings) -> None:
        super().__init__()
        self.mean = perceptron(features, settings.hidden, 1, last_gain=0.01, last_bias=settings.mean)
        self.log_std = nn.Parameter(torch.full((1,), settings.log_std))

    def forward(self, seen: Tensor) -> Normal:
        return Normal(self.mean(seen), self.log_std.exp())


# 3. Collect T time steps of C copies of the environment. When an episode ends, its copy starts the next one at once.


@dataclass
class Rollout:
    seen: dict[str, Tensor]  # learner -> observations [T, C, F]
    states: Tensor  # [T + 1, C, S]; the last row is the state after the last step
    actions: Tensor  # [T, C, L], before clipping
    rewards: Tensor  # [T, C, L]
    ended: Tensor  # [T, C, 1]; 1 if this step ended the episode, also at the horizon


class Copies:
    """Parallel copies of the environment, each with its own worlds. Only the learners are agents."""

    def __init__(self, settings: Settings) -> None:
        reward = {"harm": 0.05, "harm_count": settings.harm_count, "terminal": 0.02}  # returns are of order 1
        numbers = range(settings.seed * settings.copies, (settings.seed + 1) * settings.copies)
        self.envs = [eb.parallel_env(settings.scenario, agents="learners", reward=reward) for _ in numbers]
        self.seen = [env.reset(seed=k)[0] for k, env in zip(numbers, self.envs, strict=True)]
        self.costs = np.zeros(settings.copies)  # what the reward has counted of each running episode, m2/s2

    @torch.no_grad()
    def collect(self, actors: dict[str, Actor], steps: int) -> tuple[Rollout, list[float]]:
        """Rollout, and what the reward counts, summed over each episode that ended."""
        seen: dict[str, list[Tensor]] = {name: [] for name in actors}
        states, actions, rewards, ended, harms = [self.states()], [], [], [], []
        for _ in range(steps):
            for name in actors:
                seen[name].append(torch.from_numpy(np.stack([each[name] for each in self.seen])))
            actions.append(torch.cat([actor(seen[name][-1]).sample() for name, actor in actors.items()], dim=1))
            clipped = [dict(zip(actors, row[:, None], strict=True)) for row in actions[-1].clamp(-1.0, 1.0).numpy()]
            after = [env.step(each) for env, each in zip(self.envs, clipped, strict=True)]
            rewards.append(torch.tensor([list(each.values()) for _, each, *_ in after]))
            ended.append(torch.tensor([[float(not env.agents)] for env in self.envs]))
            self.costs += [each[4][name]["cost"] for each in after]
            over = np.array([not env.agents for env in self.envs])
            harms += self.costs[over].tolist()
            self.costs[over] = 0.0
            self.seen = [each[0] if env.agents else env.reset()[0] for env, each in zip(self.envs, after, strict=True)]
            states.append(self.states())
        stacked = {name: torch.stack(rows) for name, rows in seen.items()}
        return Rollout(stacked, *map(torch.stack, (states, actions, rewards, ended))), harms

    def states(self) -> Tensor:  # [C, S]
        return torch.from_numpy(np.stack([env.state() for env in self.envs]))


# 4. Update: generalised advantage estimation, and PPO's clipped loss (Schulman et al. 2016, 2017).


def advantages(rollout: Rollout, values: Tensor, settings: Settings) -> Tensor:
    """A_t = r_t - V_t + gamma (V_t+1 + lambda A_t+1), [T, C, L]; at the end of an episode the bracket is 0."""
    result, after = torch.zeros_like(rollout.rewards), torch.zeros_like(rollout.rewards[0])
    for t in reversed(range(len(result))):
        ahead = settings.gamma * (values[t + 1] + settings.gae_lambda * after)
        result[t] = after = rollout.rewards[t] - values[t] + (1.0 - rollout.ended[t]) * ahead
    return result


class Team:
    """The actors, the critic and their optimiser."""

    def __init__(self, copies: Copies, settings: Settings) -> None:
        self.actors = {name: Actor(seen.size, settings) for name, seen in copies.seen[0].items()}
        self.critic = perceptron(copies.states().shape[1], settings.hidden, len(self.actors), last_gain=1.0)
        self.networks = nn.ModuleList([*self.actors.values(), self.critic])
        self.optimiser = torch.optim.Adam(self.networks.parameters(), settings.learning_rate, eps=1e-5)

    def log_prob(self, seen: dict[str, Tensor], actions: Tensor, rows: Tensor) -> Tensor:  # [rows, L]
        own = zip(self.actors, torch.split(actions[rows], 1, dim=-1), strict=True)
        return torch.cat([self.actors[name](seen[name][rows]).log_prob(action) for name, action in own], dim=-1)

    def update(self, rollout: Rollout, settings: Settings) -> None:
        seen = {name: rows.flatten(0, 1) for name, rows in rollout.seen.items()}
        states, actions = rollout.states[:-1].flatten(0, 1), rollout.actions.flatten(0, 1)
        with torch.no_grad():
            values = self.critic(rollout.states)
            gains = advantages(rollout, values, settings)
            targets, gains = (gains + values[:-1]).flatten(0, 1), gains.flatten(0, 1)
            before = self.log_prob(seen, actions, torch.arange(len(actions)))
        for _ in range(settings.epochs):
            for rows in torch.split(torch.randperm(len(gains)), settings.minibatch):
                ratio = (self.log_prob(seen, actions, rows) - before[rows]).exp()
                gain = (gains[rows] - gains[rows].mean(0)) / (gains[rows].std(0, correction=0) + 1e-8)
                clipped = ratio.clamp(1.0 - settings.clip, 1.0 + settings.clip)
                actor_loss = -torch.minimum(ratio * gain, clipped * gain).mean(0).sum()
                critic_loss = nn.functional.mse_loss(self.critic(states[rows]), targets[rows])
                self.optimiser.zero_grad()
                (actor_loss + 0.5 * critic_loss).backward()
                nn.utils.clip_grad_norm_(self.networks.parameters(), 0.5)
                self.optimiser.step()


def train(settings: Settings, folder: Path) -> None:
    """Train for at least `settings.steps` decisions, and save the team in `folder`."""
    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    copies = Copies(settings)
    team = Team(copies, settings)
    decisions = settings.copies * settings.rollout * len(team.actors)  # between two updates
    updates = -(-settings.steps // decisions)
    for k in range(updates):
        rollout, harms = copies.collect(team.actors, settings.rollout)
        team.optimiser.param_groups[0]["lr"] = settings.learning_rate * (1.0 - k / updates)
        team.update(rollout, settings)
        if harms:
            what = IN_WORDS[settings.harm_count]
            print(f"{(k + 1) * decisions:,} decisions: mean {what} of an episode {np.mean(harms):.2f}", flush=True)
    save_team(folder, team.actors, copies.envs[0], seed=settings.seed, steps=updates * decisions)


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
