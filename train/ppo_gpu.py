"""PPO whose environments run on the GPU, beside the networks. Read it from top to bottom.

    python train/ppo_gpu.py --scenario paper-random --output runs/ppo-gpu
    ethbrake evaluate --scenario paper-random --agents full_brake,ppo,team@runs/ppo-gpu

All learners share one actor and one critic. On a GPU a rollout and an update are recorded as CUDA graphs and replayed.
A processor runs the same code (`--device cpu --n 256`). Letters: T time steps, n copies, L learners, F features.
"""

from __future__ import annotations

import argparse
import math
import time
from copy import deepcopy
from dataclasses import dataclass, fields
from pathlib import Path
from shlex import quote

import torch
from torch import Tensor, nn

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import COUNTS, IN_WORDS
from ethbrake_marl.errors import EthBrakeError, InvalidInput, check_whole_number
from ethbrake_marl.extensions.cuda.device import enough_memory
from ethbrake_marl.extensions.cuda.graphs import Graphed
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.training.own_team import save_team

# 1. Settings. Each is also an option of the command.


@dataclass(frozen=True)
class Settings:
    scenario: str = "paper-random"  # a shipped name, or the path of a YAML file
    device: str = "cuda"  # or "cuda:1", or "cpu"
    steps: int = 5_000_000  # decisions of all learners together
    seed: int = 0
    output: Path = Path("runs/ppo-gpu")  # a new folder
    harm_count: str = "honest"  # what the reward counts: "honest" cost, "first" impacts (the paper) or "total" harm
    n: int = 1024  # parallel copies of the environment; a GPU is fastest with 8192 or more
    pool: int = 100_000  # training worlds; the copies take them in turn
    rollout: int = 32  # time steps of each copy between two updates
    epochs: int = 4
    minibatches: int = 16  # in each epoch
    hidden: int = 64  # width of each of the two hidden layers
    learning_rate: float = 2e-3  # at the start; decreases to 0 as a cosine does
    gamma: float = 1.0  # no discount: later harm counts fully
    gae_lambda: float = 0.95
    clip: float = 0.2
    mean: float = -0.9  # mean of the actions at the start: near full braking, training does not get stuck
    log_std: float = -0.5  # logarithm of the actions' standard deviation at the start
    every: int = 10  # updates between two evaluations
    worlds: int = 2000  # of an evaluation: the first ones of the list with seed 1007


# 2. Networks. The actor returns the mean of a Gaussian; the environment clips the actions to [-1, 1].


def perceptron(inputs: int, hidden: int, last_gain: float, last_bias: float = 0.0) -> nn.Sequential:
    """Network with two hidden layers, one output and PPO's usual initial weights."""
    layers = [nn.Linear(inputs, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, 1)]
    for layer, gain, bias in zip(layers, (2**0.5, 2**0.5, last_gain), (0.0, 0.0, last_bias), strict=True):
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.constant_(layer.bias, bias)
    return nn.Sequential(layers[0], nn.Tanh(), layers[1], nn.Tanh(), layers[2])


class Actor(nn.Module):
    """A policy: `mean` maps observations [..., F] to the means of actions [..., 1]; all have one standard deviation."""

    def __init__(self, features: int, settings: Settings) -> None:
        super().__init__()
        self.mean = perceptron(features, settings.hidden, last_gain=0.01, last_bias=settings.mean)
        self.log_std = nn.Parameter(torch.full((1,), settings.log_std))

    def log_prob(self, seen: Tensor, actions: Tensor) -> Tensor:
        """Actions' log density up to a constant, [...]. torch's `Normal` would wait for the GPU."""
        noise = (actions - self.mean(seen)[..., 0]) / self.log_std.exp()
        return -0.5 * noise.square() - self.log_std


# 3. Generalised advantage estimation (Schulman et al. 2016).


def advantages(rewards: Tensor, ended: Tensor, values: Tensor, gamma: float, gae_lambda: float) -> Tensor:
    """A_t = r_t - V_t + gamma (V_t+1 + lambda A_t+1), [T, n, L]; at the end of an episode the bracket is 0.

    `rewards` and `ended` (1 if the step ended the episode) are [T, n, 1] or [T, n, L], `values` [T + 1, n, L].
    """
    result, after = torch.zeros_like(values[:-1]), torch.zeros_like(values[0])
    for t in reversed(range(len(result))):
        ahead = gamma * (values[t + 1] + gae_lambda * after)
        result[t] = after = rewards[t] - values[t] + (1.0 - ended[t]) * ahead
    return result


# 4. The learner: its tensors keep their places in memory, as a CUDA graph demands.


class Ppo:
    """Networks, optimiser, and a rollout: T time steps of n copies. An episode that ends is replaced at once."""

    def __init__(self, worlds: eb.cuda.Worlds, settings: Settings) -> None:
        self.worlds, self.settings = worlds, settings
        steps, device, (n, learners, features) = settings.rollout, worlds.device, worlds.reset().shape
        self.actor = Actor(features, settings).to(device)
        self.critic = perceptron(features, settings.hidden, last_gain=1.0).to(device)
        self.networks = nn.ModuleList([self.actor, self.critic])
        self.rate = torch.tensor(settings.learning_rate, device=device)  # a tensor, so that a graph reads it anew
        self.optimiser = torch.optim.Adam(self.networks.parameters(), self.rate, eps=1e-5, capturable=self.rate.is_cuda)
        self.seen = torch.zeros(steps + 1, n, learners, features, device=device)
        self.rewards, self.ended = torch.zeros(2, steps, n, 1, device=device)
        self.stored = torch.zeros(4, steps, n, learners, device=device)
        # actions before clipping, the logarithms of their densities, advantages, and what the critic should return
        self.actions, self.before, self.gains, self.targets = self.stored
        self.rows = torch.zeros(self.actions.numel() // settings.minibatches, dtype=torch.int64, device=device)
        self.graphs = Graphed(self.collect, device), Graphed(self.update, device)  # on a processor they are no graphs

    @torch.no_grad()
    def collect(self) -> None:
        """Collect a rollout, which continues the last one, and compute its advantages."""
        self.seen[0].copy_(self.seen[-1])
        for t in range(self.settings.rollout):
            mean, std = self.actor.mean(self.seen[t])[..., 0], self.actor.log_std.exp()
            self.actions[t].copy_(mean + std * torch.randn_like(mean))
            step = self.worlds.step(self.actions[t])
            self.rewards[t, :, 0].copy_(step.reward)
            self.ended[t, :, 0].copy_(step.terminated | step.truncated)  # the horizon is an end: later harm is no harm
            self.seen[t + 1].copy_(step.observations)
        self.before.copy_(self.actor.log_prob(self.seen[:-1], self.actions))
        values = self.critic(self.seen)[..., 0]
        gains = advantages(self.rewards, self.ended, values, self.settings.gamma, self.settings.gae_lambda)
        self.targets.copy_(gains + values[:-1])
        self.gains.copy_((gains - gains.mean()) / (gains.std() + 1e-8))

    def update(self) -> None:
        """Update the networks with the minibatch `rows` by PPO's clipped loss (Schulman et al. 2017)."""
        seen = self.seen[:-1].flatten(0, 2)[self.rows]
        actions, before, gains, targets = self.stored.flatten(1)[:, self.rows]
        ratio = (self.actor.log_prob(seen, actions) - before).exp()
        clipped = ratio.clamp(1.0 - self.settings.clip, 1.0 + self.settings.clip)
        actor_loss = -torch.minimum(ratio * gains, clipped * gains).mean()
        critic_loss = nn.functional.mse_loss(self.critic(seen)[:, 0], targets)
        self.optimiser.zero_grad(set_to_none=False)
        (actor_loss + 0.5 * critic_loss).backward()
        for network in self.networks:  # each by itself: a critic of large returns must not slow the actor down
            nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        self.optimiser.step()

    def learn(self) -> None:
        """Collect a rollout and learn from it. Raises the errors of `Worlds.check`."""
        collect, update = self.graphs
        torch.set_float32_matmul_precision("high" if self.rate.is_cuda else "highest")  # high: TF32
        collect()
        for _ in range(self.settings.epochs):
            order = torch.randperm(self.actions.numel(), device=self.rows.device)
            for rows in order.split(len(self.rows))[: self.settings.minibatches]:
                self.rows.copy_(rows)
                update()
        torch.set_float32_matmul_precision("highest")  # evaluations are exact to float32
        self.worlds.check()


# 5. Evaluate the means of the actions, keep the best policy, and save it.


@torch.no_grad()
def evaluate(actor: Actor, worlds: eb.cuda.Worlds) -> dict[str, float]:
    """Let the actor drive every world of a list once; return the mean of each count of harm (m2/s2)."""
    seen = worlds.reset()
    for _ in range(worlds.longest):
        seen = worlds.step(actor.mean(seen)[..., 0], renew=False).observations
    worlds.check()
    last = worlds.state()
    return {count: float(last.harm(count).mean()) for count in COUNTS}


def in_words(means: dict[str, float]) -> str:
    return "mean " + ", ".join(f"{IN_WORDS[count]} {value:.2f}" for count, value in means.items())


def train(settings: Settings, folder: Path) -> dict[str, float]:
    """Train for at least `settings.steps` decisions, save the best policy in `folder`, and return its evaluation."""
    torch.set_num_threads(1)
    torch.manual_seed(settings.seed)
    reward = {"harm": 0.05, "harm_count": settings.harm_count, "terminal": 0.02}  # returns are of order 1
    scenario, where = eb.load_scenario(settings.scenario), {"device": settings.device, "reward": reward}
    copies = eb.cuda.Worlds(scenario, settings.n, settings.pool, seed=settings.seed, **where)
    listed = eb.cuda.Worlds(scenario, settings.worlds, scenario.sample(settings.worlds, seed=1007), **where)
    env = eb.parallel_env(scenario, agents="learners", reward=reward)  # not driven: says what `save_team` records
    ppo = Ppo(copies, settings)
    ppo.seen[-1].copy_(copies.reset())
    updates = -(-settings.steps // ppo.actions.numel())
    best, actor, start = evaluate(ppo.actor, listed), deepcopy(ppo.actor), time.perf_counter()
    for k in range(1, updates + 1):
        ppo.rate.fill_(settings.learning_rate * 0.5 * (1.0 + math.cos(math.pi * (k - 1) / updates)))
        ppo.learn()
        if k % settings.every == 0 or k == updates:
            spent, decisions, means = time.perf_counter() - start, k * ppo.actions.numel(), evaluate(ppo.actor, listed)
            if means[settings.harm_count] <= best[settings.harm_count]:
                best, actor = means, deepcopy(ppo.actor)
            print(f"{decisions:,} decisions, {spent:.1f} s: {in_words(means)}", flush=True)
    save_team(folder, dict.fromkeys(env.possible_agents, actor), env, seed=settings.seed, steps=decisions)
    return best


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for field in fields(Settings):
        option = f"--{field.name.replace('_', '-')}"
        parser.add_argument(option, type=type(field.default), default=field.default, help=f"default: {field.default}")
    settings = Settings(**vars(parser.parse_args()))
    try:
        for name in ("steps", "n", "pool", "rollout", "epochs", "minibatches", "hidden", "every", "worlds"):
            check_whole_number(name, getattr(settings, name), 1)
        if settings.minibatches > (most := settings.n * settings.rollout):
            raise InvalidInput(f"minibatches = {settings.minibatches}: must be at most n * rollout = {most}")
        sizes = f"n = {settings.n}, pool = {settings.pool}, rollout = {settings.rollout}"
        with new_folder(settings.output) as folder, enough_memory(sizes):
            print(f"saved the best policy: {in_words(train(settings, folder))}")
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    agents = f"--agents {quote(f'full_brake,e_v2x_bm,team@{settings.output}')} --set harm_count={settings.harm_count}"
    print(f"ethbrake evaluate --scenario {quote(settings.scenario)} {agents}")
