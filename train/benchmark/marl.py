"""IPPO, MAPPO and IQL of BenchMARL, for tasks with several learners. Needs the extra `marl`.

    python train/benchmark/run.py --tasks benchmark-pair --methods ippo mappo iql --output runs/benchmark

IPPO: the critic of a learner has the observation of its actor. MAPPO: the critic has the state of the line. IQL: deep
Q-learning of each learner with 9 discrete actions. IPPO and MAPPO choose from a plain normal distribution. The last
batch is a whole one, so 200,000 decisions may be up to 203,840. What is not the library's default stands in
`experiment_of`. The defaults of `ippo`, `mappo` and `iql` are the best of their trials (`train/tune.py`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from benchmarl.algorithms import algorithm_config_registry
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.benchmark import START
from ethbrake_marl.extensions.benchmarl.drivers import drivers_of
from ethbrake_marl.extensions.benchmarl.task import GROUP, LineTask

WORLDS = 64
REWARD = {"harm": 0.05, "harm_count": "honest", "shaping": 0.05, "shaping_discount": 1.0}
ACTIONS = 9  # of IQL


def experiment_of(
    algorithm: str, task: eb.Scenario, seed: int, decisions: int, folder: Path,
    lr: float = 1e-3, passes: int = 10, more: Mapping[str, Any] = MappingProxyType({}),
) -> Experiment:  # fmt: skip
    if len(task.learners) < 2:
        raise InvalidInput(f"{algorithm}: {task.name} has one learner; needs several")
    learners = len(task.learners)
    config = ExperimentConfig.get_from_yaml()
    config.gamma, config.lr, config.share_policy_params = 1.0, lr, True
    config.max_n_frames, config.max_n_iters = -(-decisions // learners), None
    config.on_policy_n_envs_per_worker = config.off_policy_n_envs_per_worker = WORLDS
    config.on_policy_collected_frames_per_batch = -(-64 // learners) * WORLDS  # whole steps of all worlds
    config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = passes, 512 // learners
    config.off_policy_collected_frames_per_batch = WORLDS
    config.off_policy_n_optimizer_steps, config.off_policy_train_batch_size = passes, 256
    config.off_policy_init_random_frames = 2000
    config.save_folder = str(folder)
    config.evaluation, config.loggers, config.create_json = False, [], False
    models = MlpConfig.get_from_yaml(), MlpConfig.get_from_yaml()
    for model in models:
        model.num_cells, model.activation_class = [64, 64], torch.nn.Tanh
    kind = algorithm_config_registry[algorithm].get_from_yaml()
    for name, value in more.items():
        setattr(config if hasattr(config, name) else kind, name, value)
    actions = START._replace(choices=ACTIONS if algorithm == "iql" else None)
    line = LineTask(task.name, {"scenario": task, "reward": REWARD, "actions": actions})
    return Experiment(line, kind, models[0], seed, config, models[1])


def train(
    algorithm: str, task: eb.Scenario, seed: int, decisions: int, folder: Path, lr: float, passes: int, **more: Any
) -> dict[str, Any]:
    experiment = experiment_of(algorithm, task, seed, decisions, folder, lr, passes, more)
    experiment.run()
    torch.save(experiment.group_policies[GROUP].state_dict(), folder / "policy.pt")
    (folder / "algorithm.json").write_text(json.dumps([algorithm, more]))
    return {"start": "the task's", "decisions": experiment.total_frames * len(task.learners)}


def ippo(
    task: eb.Scenario, seed: int, decisions: int, folder: Path,
    lr: float = 2.34e-3, passes: int = 10, lmbda: float = 0.95,
) -> dict[str, Any]:  # fmt: skip
    return train("ippo", task, seed, decisions, folder, lr, passes, lmbda=lmbda, use_tanh_normal=False)


def mappo(
    task: eb.Scenario, seed: int, decisions: int, folder: Path,
    lr: float = 1.67e-3, passes: int = 20, lmbda: float = 1.0,
) -> dict[str, Any]:  # fmt: skip
    return train("mappo", task, seed, decisions, folder, lr, passes, lmbda=lmbda, use_tanh_normal=False)


def iql(
    task: eb.Scenario, seed: int, decisions: int, folder: Path, lr: float = 1.82e-3, passes: int = 4, eps: float = 0.8
) -> dict[str, Any]:
    return train("iql", task, seed, decisions, folder, lr, passes, exploration_eps_init=eps)


def make_agent(folder: str, settings: eb.AgentSettings) -> eb.Team:
    """Team with the policies that a training has saved in `folder`."""
    algorithm, more = json.loads((Path(folder) / "algorithm.json").read_text())
    experiment: Any = experiment_of(algorithm, settings.needed_scenario(), 0, 1, Path(folder), more=more)
    experiment.group_policies[GROUP].load_state_dict(torch.load(Path(folder) / "policy.pt", weights_only=True))
    return eb.Team.of(drivers_of(experiment), algorithm)
