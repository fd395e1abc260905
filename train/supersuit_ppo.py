"""Several learners share one policy: PettingZoo, SuperSuit and Stable-Baselines3's PPO. Read it from top to bottom.

    python train/supersuit_ppo.py --scenario cooperation-3-pair --steps 200000 --output runs/supersuit
    ethbrake evaluate --scenario cooperation-3-pair --agents full_brake,ppo@runs/supersuit

`ethbrake train --set scheme=shared` trains the same policy many times faster, and can resume after a crash. This file
is for programs that use PettingZoo. SuperSuit 3.11 has four pitfalls; comments with the word "trap" say how each is
avoided.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import supersuit
import torch
from pettingzoo.utils.wrappers import BaseParallelWrapper
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnvWrapper, VecMonitor

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import COUNTS
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.ppo import Ppo
from ethbrake_marl.training.training import Training

# 1. What to train: as in train/ppo.yaml, with smaller networks.

REWARD: dict[str, Any] = {
    "harm": 0.05,
    "harm_count": "honest",
    "terminal": 0.02,
    "shaping": 0.05,
    "shaping_discount": 0.995,
}
HIDDEN = [64, 64]
COPIES, STEPS_PER_ROLLOUT = 32, 64  # parallel worlds; decisions of each learner between two updates


# 2. The environment. Vehicles that follow scripts are agents, too, but their actions are ignored, so nothing can be
#    learned from them. Therefore SuperSuit gets only the learners. All learners end at the same time, so no agent
#    leaves early (trap: black_death_v3 would add an extra step for agents that leave early).


class LearnersOnly(BaseParallelWrapper):  # type: ignore[misc]  # PettingZoo is untyped
    """Environment whose only agents are the learners of a line."""

    def __init__(self, env: Any, learners: list[str]) -> None:
        super().__init__(env)
        self.possible_agents = learners

    @property
    def agents(self) -> list[str]:
        """The learners while an episode runs; empty after it."""
        return self.possible_agents if self.env.agents else []

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return tuple(self._of_learners(part) for part in self.env.reset(seed=seed, options=options))

    def step(self, actions: dict[str, Any]) -> Any:
        return tuple(self._of_learners(part) for part in self.env.step(actions))

    def _of_learners(self, part: dict[str, Any]) -> dict[str, Any]:
        return {name: part[name] for name in self.possible_agents}


# 3. Between SuperSuit and Stable-Baselines3.


class SeededAndTruncated(VecEnvWrapper):
    """Seeds SuperSuit's copies, and reports to PPO which episodes the horizon truncated.

    Trap: SuperSuit's vector environment has no `seed`, so `PPO(seed=...)` fails. Its copies are clones: without a seed
    per copy all copies have the same episodes. Here copy k uses seed + k.
    Trap: SuperSuit drops `truncated`, so PPO would treat the horizon as a real end.
    """

    def __init__(self, venv: Any) -> None:
        super().__init__(venv, venv.observation_space, venv.action_space)
        self._next_seed: int | None = None

    def seed(self, seed: int | None = None) -> list[int | None]:
        self._next_seed = seed
        return [seed] * self.num_envs

    def reset(self) -> Any:
        observations, self.reset_infos = self.venv.reset(seed=self._next_seed)
        self._next_seed = None
        return observations

    def step_async(self, actions: Any) -> None:
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Finish one time step of every copy. Where an episode ended, the next one begins."""
        observations, rewards, terminated, truncated, infos = self.venv.step_wait()
        terminated, truncated = np.asarray(terminated, bool), np.asarray(truncated, bool)
        for row in np.flatnonzero(truncated & ~terminated):
            infos[row]["TimeLimit.truncated"] = True
        return observations, rewards, terminated | truncated, infos

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.venv, attr_name)] * self.num_envs


def make_worlds(scenario: eb.Scenario, reward: dict[str, Any] = REWARD) -> SeededAndTruncated:
    """`COPIES` copies of a scenario's environment for Stable-Baselines3.

    Row k * L + l is learner l of L in copy k.
    """
    names = [scenario.vehicle_names[body - 1] for body in scenario.learners]
    learners = LearnersOnly(eb.parallel_env(scenario=scenario, reward=reward), names)
    rows = supersuit.pettingzoo_env_to_vec_env_v1(learners)
    # num_cpus=0: all copies in this process (trap: with more processes, SuperSuit uses seeds twice).
    copies = supersuit.concat_vec_envs_v1(rows, COPIES, num_cpus=0, base_class="stable_baselines3")
    return SeededAndTruncated(copies.venv)


# 4. Training. The policy is saved as a bundle, which `ethbrake evaluate` loads as ppo@FOLDER.


def train(scenario: eb.Scenario, steps: int, seed: int, output: Path, reward: dict[str, Any] = REWARD) -> None:
    """Train PPO for `steps` decisions of all learners together, and save its policy as `output`/policy.

    Raises `InvalidInput` for wrong steps or seeds and for a scenario without a learner, `AlreadyExists` if `output`
    exists.
    """
    Training.of("ppo", scenario, total_steps=steps, seed=seed)
    with new_folder(output) as folder:
        learn(scenario, steps, seed, reward).save(folder / "policy")


def learn(scenario: eb.Scenario, steps: int, seed: int, reward: dict[str, Any] = REWARD) -> Policy:
    torch.set_num_threads(1)
    worlds = VecMonitor(make_worlds(scenario, reward))
    model = PPO(
        "MlpPolicy",
        worlds,
        n_steps=STEPS_PER_ROLLOUT,
        batch_size=512,
        n_epochs=4,
        learning_rate=lambda left: 1e-3 * left + 1e-5,
        gamma=0.995,
        gae_lambda=0.8,
        policy_kwargs={"net_arch": {"pi": HIDDEN, "vf": HIDDEN}, "activation_fn": torch.nn.ReLU, "log_std_init": -0.5},
        seed=seed,
        device="cpu",
    )
    model.learn(steps)
    scenario, game = eb.open_game(scenario, reward=reward)
    view = game.views[scenario.learners[0]]
    network = NetworkSpec(
        observation_size=len(view.names),
        policy_hidden=tuple(HIDDEN),
        value_hidden=tuple(HIDDEN),
        activation="relu",
        output="clip",
    )
    return Policy.make(
        Ppo().tensors(model.policy, network),
        algorithm="ppo",
        network=network,
        observation=view,
        learners=tuple(scenario.vehicle_names[body - 1] for body in scenario.learners),
        scenario=scenario.content(),
        reward=game.rewarding.params.model_dump(mode="json"),
        seeds={"training": seed},
        steps=model.num_timesteps,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="cooperation-3-pair", help="a shipped scenario, or a YAML file")
    parser.add_argument("--steps", type=int, default=200_000, help="decisions of all learners together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--harm-count", choices=[*COUNTS], default=REWARD["harm_count"], help="what the reward counts")
    parser.add_argument("--output", type=Path, default=Path("runs/supersuit"), help="new folder")
    given = parser.parse_args()
    try:
        reward = {**REWARD, "harm_count": given.harm_count}
        train(eb.load_scenario(given.scenario), given.steps, given.seed, given.output, reward)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    print(
        f"trained: {given.output}; ethbrake evaluate --scenario {given.scenario} --agents full_brake,ppo@{given.output}"
    )
