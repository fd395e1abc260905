"""PettingZoo -> SuperSuit -> Stable-Baselines3's PPO, several learners sharing one policy. Read it from top to bottom.

    python train/supersuit_ppo.py --scenario cooperation-3-pair --steps 200000 --output runs/supersuit
    ethbrake evaluate --scenario cooperation-3-pair --agents full_brake,ppo@runs/supersuit

The native way, `ethbrake train --set scheme=shared`, does the same many times faster, and goes on after a crash; this
file is for those who build on PettingZoo. SuperSuit 3.11 has four traps on this way. Each is closed where it says
"trap".
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
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.game.rewards import reward_params
from ethbrake_marl.policies.network_spec import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.networks import tensors_of
from ethbrake_marl.training.training import Training

# 1. What to train: the same settings as train/ppo.yaml, in smaller networks.

REWARD = {"harm": 0.05, "terminal": 0.02, "shaping": 0.05, "shaping_discount": 0.995}
HIDDEN = [64, 64]
COPIES, STEPS_PER_ROLLOUT = 32, 64  # worlds side by side; decisions of each learner between two updates


# 2. The environment. A vehicle that follows a script is an agent too, but what it is told to do is ignored: learning
#    from its rows would be learning from noise. So only the learners are shown to SuperSuit. They all end together, so
#    no agent ever leaves early (trap: black_death_v3 would add a phantom step for those that do).


class LearnersOnly(BaseParallelWrapper):  # type: ignore[misc]  # PettingZoo is untyped
    """The learners of a line as the only agents."""

    def __init__(self, env: Any, learners: list[str]) -> None:
        super().__init__(env)
        self.possible_agents = learners

    @property
    def agents(self) -> list[str]:
        """The learners, while an episode runs."""
        return self.possible_agents if self.env.agents else []

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """As the environment does."""
        return tuple(self._of_learners(part) for part in self.env.reset(seed=seed, options=options))

    def step(self, actions: dict[str, Any]) -> Any:
        """As the environment does."""
        return tuple(self._of_learners(part) for part in self.env.step(actions))

    def _of_learners(self, part: dict[str, Any]) -> dict[str, Any]:
        return {name: part[name] for name in self.possible_agents}


# 3. Between SuperSuit and Stable-Baselines3.


class SeededAndTruncated(VecEnvWrapper):
    """Seeds SuperSuit's copies, and tells PPO which episodes the horizon cut off.

    Trap: its vector environment has no `seed`, so `PPO(seed=...)` fails on it, and its copies are clones: without
    a seed for each of them they all live through the same episodes. Here copy k starts the stream of seed + k.
    Trap: it drops `truncated`, so PPO takes the horizon for a real end.
    """

    def __init__(self, venv: Any) -> None:
        super().__init__(venv, venv.observation_space, venv.action_space)
        self._next_seed: int | None = None

    def seed(self, seed: int | None = None) -> list[int | None]:
        """The seed of the next reset."""
        self._next_seed = seed
        return [seed] * self.num_envs

    def reset(self) -> Any:
        """Start an episode in every copy."""
        observations, self.reset_infos = self.venv.reset(seed=self._next_seed)
        self._next_seed = None
        return observations

    def step_async(self, actions: Any) -> None:
        """Keep the actions, row by row."""
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """One time step of every copy; those that end start their next episode."""
        observations, rewards, terminated, truncated, infos = self.venv.step_wait()
        terminated, truncated = np.asarray(terminated, bool), np.asarray(truncated, bool)
        for row in np.flatnonzero(truncated & ~terminated):
            infos[row]["TimeLimit.truncated"] = True
        return observations, rewards, terminated | truncated, infos

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Nothing inside is wrapped."""
        return [False] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """SuperSuit's attribute, once per row."""
        return [getattr(self.venv, attr_name)] * self.num_envs


def make_worlds(scenario: eb.Scenario) -> SeededAndTruncated:
    """`COPIES` worlds of a scenario as rows for Stable-Baselines3: row k * L + l is learner l of copy k."""
    names = [scenario.vehicle_names[i] for i in scenario.learners]
    learners = LearnersOnly(eb.parallel_env(scenario=scenario, reward=REWARD), names)
    rows = supersuit.pettingzoo_env_to_vec_env_v1(learners)
    # num_cpus=0: all copies in this process (trap: with processes, SuperSuit gives seeds away twice).
    copies = supersuit.concat_vec_envs_v1(rows, COPIES, num_cpus=0, base_class="stable_baselines3")
    return SeededAndTruncated(copies.venv)


# 4. Training, and the policy as a bundle, which `ethbrake evaluate` takes as ppo@FOLDER.


def train(scenario: eb.Scenario, steps: int, seed: int, output: Path) -> None:
    """Train PPO for `steps` decisions of learners, and save its policy as `output`/policy.

    Refuses at once what cannot be: steps, a seed, a scenario in which nobody learns, an `output` that is there.
    """
    Training.of("ppo", scenario, total_steps=steps, seed=seed)
    with new_folder(output) as folder:
        learn(scenario, steps, seed).save(folder / "policy")


def learn(scenario: eb.Scenario, steps: int, seed: int) -> Policy:
    """The policy that PPO comes to."""
    torch.set_num_threads(1)
    worlds = VecMonitor(make_worlds(scenario))
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
    observation = eb.parallel_env(scenario=scenario).engine.observation
    network = NetworkSpec(
        observation_size=observation.size,
        action_size=1,
        policy_hidden=tuple(HIDDEN),
        value_hidden=tuple(HIDDEN),
        activation="relu",
        output="clip",
    )
    return Policy.make(
        tensors_of(model.policy, network),
        algorithm="ppo",
        network=network,
        observation=observation,
        learners=tuple(scenario.vehicle_names[i] for i in scenario.learners),
        scenario=scenario.model_dump(mode="json"),
        reward=reward_params(REWARD).model_dump(mode="json"),
        seeds={"training": seed},
        steps=model.num_timesteps,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="cooperation-3-pair", help="a shipped scenario, or a YAML file")
    parser.add_argument("--steps", type=int, default=200_000, help="decisions of learners")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("runs/supersuit"), help="new folder")
    given = parser.parse_args()
    try:
        train(eb.load_scenario(given.scenario), given.steps, given.seed, given.output)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    print(
        f"trained: {given.output}; ethbrake evaluate --scenario {given.scenario} --agents full_brake,ppo@{given.output}"
    )
