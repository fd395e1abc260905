"""CleanRL: its wrappers, and a PPO of the form of its single files."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.libraries.library import Library

LIBRARY = Library(
    title="CleanRL",
    package="gymnasium",
    version="Gymnasium {}",
    requires=("moviepy==2.2.1",),
    about=(
        "CleanRL is a folder of files to copy, not a package: `python cleanrl/ppo_continuous_action.py "
        "--env-id ethbrake_marl:EthBrake-v0 --capture-video`. Its `make_env` needs one more argument, for every "
        "environment, since Gymnasium 1.0 asks for the space in `TransformObservation`. The lines below are "
        "its `make_env` with it; the loop that is run here is a short PPO of that form. What "
        "`NormalizeObservation` has counted belongs to the policy: keep it with the network."
    ),
    in_ci=True,
)
STEPS, ROLLOUT, BATCH, EPOCHS, GAMMA, LAMBDA = 30_720, 2048, 64, 10, 0.99, 0.95


@LIBRARY.way("its `make_env`, with `capture_video`", "PPO, 30,720 steps, films of some episodes", learns=True)
def make_env():
    import gymnasium as gym

    env = gym.make("ethbrake_marl:EthBrake-v0", render_mode="rgb_array")
    env = gym.wrappers.RecordVideo(env, "videos/ethbrake")
    env = gym.wrappers.FlattenObservation(env)
    env = gym.wrappers.RecordEpisodeStatistics(env)
    env = gym.wrappers.ClipAction(env)
    env = gym.wrappers.NormalizeObservation(env)
    env = gym.wrappers.TransformObservation(env, lambda seen: np.clip(seen, -10, 10), env.observation_space)
    env = gym.wrappers.NormalizeReward(env, gamma=0.99)
    env = gym.wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))
    return train(env)


def train(env: Any) -> Any:
    """PPO; leaves ``cleanrl.pt``: the network, and mean and variance of what it saw."""
    import torch

    torch.manual_seed(1)
    networks = make_networks(env.observation_space.shape[0])
    optimiser = torch.optim.Adam(networks.parameters(), lr=3e-4, eps=1e-5)
    seen = torch.tensor(env.reset(seed=1)[0], dtype=torch.float32)
    for k in range(STEPS // ROLLOUT):
        optimiser.param_groups[0]["lr"] = 3e-4 * (1 - k * ROLLOUT / STEPS)
        rollout, seen = collect(env, networks, seen)
        learn(networks, optimiser, *rollout)
    env.close()
    counted = env.get_wrapper_attr("obs_rms")
    file = {"networks": networks.state_dict(), "mean": counted.mean, "var": counted.var}
    torch.save(file, "cleanrl.pt")
    act = policy_of(file)
    return act, lambda n: own_rollout(file, n)


def make_networks(width: int) -> Any:
    from torch import nn, zeros

    def layers(out_scale: float) -> Any:
        net = nn.Sequential(nn.Linear(width, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1))
        for layer, gain in zip(net[::2], (2**0.5, 2**0.5, out_scale), strict=True):
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)
        return net

    both = nn.ModuleDict({"actor_mean": layers(0.01), "critic": layers(1.0)})
    both.register_parameter("actor_logstd", nn.Parameter(zeros(1)))
    return both


def act_by(networks: Any, seen: Any) -> Any:
    import torch

    return torch.distributions.Normal(networks["actor_mean"](seen), networks.actor_logstd.exp())


def collect(env: Any, networks: Any, seen: Any) -> tuple[Any, Any]:
    """A rollout as (seen, actions, log probabilities, advantages, returns), and what is seen after it."""
    import torch

    rows: list[Any] = []
    with torch.no_grad():
        for _ in range(ROLLOUT):
            chance = act_by(networks, seen)
            action = chance.sample()
            following, reward, terminated, truncated, _ = env.step(action.numpy())
            ended = terminated or truncated
            told = (chance.log_prob(action).sum(), networks["critic"](seen).squeeze())
            rows.append((seen, action, *told, float(reward), ended))
            seen = torch.tensor(env.reset()[0] if ended else following, dtype=torch.float32)
        next_value, advantage, advantages = networks["critic"](seen).squeeze(), 0.0, []
        for *_, value, reward, ended in reversed(rows):
            running = 0.0 if ended else 1.0
            advantage = reward + GAMMA * running * next_value - value + GAMMA * LAMBDA * running * advantage
            advantages.insert(0, advantage)
            next_value = value
    states, actions, chances, values = (torch.stack([row[c] for row in rows]) for c in range(4))
    gained = torch.stack(advantages)
    return (states, actions, chances, gained, gained + values), seen


def learn(networks: Any, optimiser: Any, states: Any, actions: Any, chances: Any, gained: Any, returns: Any) -> None:
    import torch

    for _ in range(EPOCHS):
        for rows in torch.randperm(ROLLOUT).split(BATCH):
            ratio = (act_by(networks, states[rows]).log_prob(actions[rows]).sum(1) - chances[rows]).exp()
            advantage = (gained[rows] - gained[rows].mean()) / (gained[rows].std() + 1e-8)
            policy_loss = torch.max(-advantage * ratio, -advantage * ratio.clamp(0.8, 1.2)).mean()
            value_loss = 0.5 * (networks["critic"](states[rows]).squeeze(1) - returns[rows]).pow(2).mean()
            optimiser.zero_grad()
            (policy_loss + 0.5 * value_loss).backward()
            torch.nn.utils.clip_grad_norm_(networks.parameters(), 0.5)
            optimiser.step()


def policy_of(file: dict[str, Any]) -> Any:
    """Observations [n, F] -> mean actions [n, 1], seen as ``NormalizeObservation`` counted."""
    import torch

    networks = make_networks(len(file["mean"]))
    networks.load_state_dict(file["networks"])

    def cleanrl(observations: Any) -> Any:
        scaled = (observations - file["mean"]) / np.sqrt(file["var"] + 1e-8)
        return networks["actor_mean"](torch.tensor(scaled.clip(-10, 10), dtype=torch.float32)).detach().clamp(-1, 1)

    return cleanrl


def own_rollout(file: dict[str, Any], n: int) -> Any:
    """Harm [n] in CleanRL's way to evaluate: the same wrappers, the statistics held still."""
    import gymnasium as gym
    import torch

    networks = make_networks(len(file["mean"]))
    networks.load_state_dict(file["networks"])
    normalised = gym.wrappers.NormalizeObservation(gym.wrappers.ClipAction(gym.make("ethbrake_marl:EthBrake-v0")))
    normalised.update_running_mean = False
    normalised.obs_rms.mean, normalised.obs_rms.var = file["mean"], file["var"]
    env = gym.wrappers.TransformObservation(normalised, lambda o: np.clip(o, -10, 10), normalised.observation_space)
    harm = []
    for k in range(n):
        seen, infos = env.reset(seed=7 if k == 0 else None)
        ended = False
        while not ended:
            action = networks["actor_mean"](torch.tensor(seen, dtype=torch.float32)).detach().numpy()
            seen, _, terminated, truncated, infos = env.step(action)
            ended = terminated or truncated
        harm.append(infos["world_first_impact_harm"])
    return harm
