"""BenchMARL's MAPPO on a level of cooperation. Needs the extra `marl` (`.venv/bin/pip install -e '.[marl]'`).

    python train/benchmarl_mappo.py --scenario cooperation-3-pair --steps 200000 --output runs/mappo
    ethbrake evaluate --scenario cooperation-3-pair --agents full_brake,team@runs/mappo --set rules=honest

`ethbrake train --set scheme=centralised` trains the same kind of team (one shared actor, a critic on the state of the
line) without the extra, and with checkpoints and evaluations. This file is for users of BenchMARL.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import COUNTS
from ethbrake_marl.errors import EthBrakeError, InvalidInput, naming_extras
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.training.recipe import PpoRecipe
from ethbrake_marl.training.training import Training


def train(scenario: str, recipe: str, steps: int, seed: int, output: Path, harm_count: str | None = None) -> None:
    """Train MAPPO with the hyperparameters of a PPO recipe, and save the shared actor as `output`/policy.

    `harm_count` is what the reward counts; None: as in the recipe. The learning rate stays constant, because BenchMARL
    has no schedule. Raises `InvalidInput` if the recipe is not for PPO or nobody learns, `MissingExtra` without
    BenchMARL, and `AlreadyExists` if `output` exists.
    """
    plan = eb.load_recipe(recipe)
    if not isinstance(plan, PpoRecipe):
        raise InvalidInput(f"recipe {plan.name!r}: is for {plan.algorithm.upper()}; MAPPO needs one for PPO")
    if harm_count is not None:
        plan = plan.replace(reward={**plan.reward.model_dump(mode="json"), "harm_count": harm_count})
    training = Training.of(plan, scenario, total_steps=steps, seed=seed, scheme="centralised")
    with naming_extras():
        import benchmarl  # noqa: F401  # only here: an extra
    with new_folder(output) as folder, tempfile.TemporaryDirectory() as scratch:
        experiment = make_experiment(training, scratch)
        experiment.run()
        policy_of(experiment, training).save(folder / "policy")


def make_experiment(training: Training, scratch: str, algorithm: str = "mappo") -> Any:
    """BenchMARL experiment with a recipe's hyperparameters. BenchMARL writes its files to `scratch`.

    `algorithm`: "mappo", or "ippo", whose critic has the observation of the actor.
    """
    import torch
    from benchmarl.algorithms import algorithm_config_registry
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig

    from ethbrake_marl.extensions.benchmarl.task import LineTask

    recipe, learners = training.recipe, len(training.learners)
    assert isinstance(recipe, PpoRecipe)
    config = ExperimentConfig.get_from_yaml()
    config.gamma, config.lr = recipe.gamma, recipe.learning_rate.start
    config.clip_grad_val = recipe.max_grad_norm
    config.max_n_frames, config.max_n_iters = -(-recipe.total_steps // learners), None
    config.on_policy_n_envs_per_worker = recipe.n_envs
    config.on_policy_collected_frames_per_batch = recipe.n_envs * recipe.n_steps
    config.on_policy_n_minibatch_iters = recipe.n_epochs
    config.on_policy_minibatch_size = max(recipe.batch_size // learners, 1)
    config.save_folder = scratch
    config.evaluation, config.loggers, config.create_json = False, [], False
    learns = algorithm_config_registry[algorithm].get_from_yaml()
    learns.lmbda, learns.clip_epsilon = recipe.gae_lambda, recipe.clip_range
    learns.entropy_coef, learns.critic_coef = recipe.ent_coef, recipe.vf_coef
    models = [MlpConfig.get_from_yaml(), MlpConfig.get_from_yaml()]
    activation = torch.nn.ReLU if recipe.network.activation == "relu" else torch.nn.Tanh
    for model, cells in zip(models, (recipe.network.policy, recipe.network.value), strict=True):
        model.num_cells, model.activation_class = list(cells), activation
    scenario = training.scenario.replace(observation=list(training.row.names))
    task = LineTask(
        scenario.name, {"scenario": scenario, "reward": recipe.reward, "horizon_is_end": recipe.horizon_is_end}
    )
    return Experiment(task, learns, models[0], recipe.seed, config, critic_model_config=models[1])


def policy_of(experiment: Any, training: Training) -> Policy:
    """Shared actor as a policy. A hyperbolic tangent limits its mean to [-1, 1]."""
    from torchrl.modules import MultiAgentMLP

    recipe = training.recipe
    assert isinstance(recipe, PpoRecipe)
    (actor,) = (m for m in experiment.group_policies["learners"].modules() if isinstance(m, MultiAgentMLP))
    network = NetworkSpec(
        observation_size=len(training.row.names),
        policy_hidden=recipe.network.policy,
        value_hidden=(),
        activation=recipe.network.activation,
        output="tanh",
    )
    return Policy.make(
        tensors_of(actor, len(recipe.network.policy)),
        algorithm="ppo",
        network=network,
        observation=training.row,
        learners=training.learners,
        scenario=training.scenario.content(),
        reward=recipe.reward.model_dump(mode="json"),
        seeds={"training": recipe.seed},
        steps=int(experiment.total_frames) * len(training.learners),
    )


def tensors_of(actor: Any, hidden: int) -> dict[str, NDArray[np.float32]]:
    """Actor's weights by the names of `NetworkSpec.tensors`. The last layer gives mean and noise."""
    tensors: dict[str, NDArray[np.float32]] = {}
    for k in range(hidden + 1):
        for part in ("weight", "bias"):
            values = actor.params[str(2 * k), part].detach().cpu().numpy().astype(np.float32)
            if k < hidden:
                tensors[f"policy.{k}.{part}"] = values
            else:
                tensors[f"policy.output.{part}"], tensors[f"policy.log_std.{part}"] = values[:1], values[1:]
    return tensors


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="cooperation-3-pair", help="a shipped scenario, or a YAML file")
    parser.add_argument("--recipe", default="cooperation-ppo", help="a shipped PPO recipe, or a YAML file")
    parser.add_argument("--steps", type=int, default=200_000, help="decisions of all learners together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--harm-count", choices=COUNTS, help="what the reward counts (default: as in the recipe)")
    parser.add_argument("--output", type=Path, default=Path("runs/mappo"), help="new folder")
    given = parser.parse_args()
    try:
        train(given.scenario, given.recipe, given.steps, given.seed, given.output, given.harm_count)
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
    print(f"trained: ethbrake evaluate --scenario {given.scenario} --agents full_brake,team@{given.output}")
