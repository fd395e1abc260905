"""From a training to its environment, its model, and from a model's present weights to policies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import CSVOutputFormat, KVWriter, TensorBoardOutputFormat
from tensorboard.compat.proto.event_pb2 import Event, SessionLog

from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.policies.network_spec import Float32s, NetworkSpec
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.teams import PolicyTeam, Trained
from ethbrake_marl.scenario.observed import Appended
from ethbrake_marl.training.algorithm import Algorithm
from ethbrake_marl.training.checkpoint import TrainingState
from ethbrake_marl.training.recipe import Scheme
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.training import Training

Model = BaseAlgorithm  # of Stable-Baselines3


def make_environment(training: Training) -> EthBrakeVecEnv:
    """The worlds of a training, in which its learners are the rows."""
    recipe = training.recipe
    appended: dict[Scheme, Appended] = {"independent": "number", "centralised": "state"}
    return make_sb3_vec_env(
        training.scenario,
        recipe.n_envs,
        recipe.seed,
        reward=recipe.reward,
        observation=training.observation,
        horizon_is_end=recipe.horizon_is_end,
        appended=appended.get(training.scheme),
    )


def make_model(algorithm: Algorithm, training: Training, environment: EthBrakeVecEnv) -> Model:
    """The model of a training, whose optimisers refuse gradients that are not finite."""
    model = algorithm.build(training, environment)
    if getattr(model, "get_vec_normalize_env", lambda: None)() is not None:
        raise InvalidInput(
            f"algorithm {training.recipe.algorithm!r}: its model is trained under VecNormalize, whose statistics are no"
            " part of a policy bundle; observations here are scaled already"
        )
    hint = "learning_rate or max_grad_norm" if hasattr(model, "max_grad_norm") else "learning_rate"

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        sums = [p.grad.sum() for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        if not torch.isfinite(torch.stack(sums)).all():
            raise TrainingDiverged(
                f"training: the gradient of the loss is not finite at step {model.num_timesteps}; try a smaller {hint}"
            )

    for optimizer in algorithm.optimizers(model).values():
        optimizer.register_step_pre_hook(check)
    return model


def make_policies(
    training: Training, steps: int, tensors: Callable[[int, NetworkSpec], Mapping[str, Float32s]]
) -> Trained:
    """One policy for all learners, or one for each; ``tensors(k, network)`` are those of the k-th."""
    recipe, scenario = training.recipe, training.scenario
    names = tuple(training.drivers)
    apart = training.scheme == "independent"
    policies = []
    for k, learners in enumerate([(name,) for name in names] if apart else [names]):
        observation = training.observations[learners[0]]
        network = recipe.network_spec(observation.size)
        if training.scheme == "centralised":
            network = network.model_copy(update={"value_hidden": ()})  # its critic sees what no vehicle sees
        policy = Policy.make(
            tensors(k, network),
            algorithm=recipe.algorithm,
            network=network,
            observation=observation,
            learners=learners,
            scenario=scenario.model_dump(mode="json"),
            reward=recipe.reward.model_dump(mode="json"),
            seeds={"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            steps=steps,
        )
        policies.append(policy)
    return PolicyTeam(dict(zip(names, policies, strict=True))) if apart else policies[0]


def open_logs(run: RunDirectory, state: TrainingState | None) -> list[KVWriter]:
    """``progress.csv`` and TensorBoard's events, which go on after the rows of ``state``; None: from the beginning."""
    run.progress.unlink(missing_ok=True)  # it may be a link
    if state is None:
        for left in run.tensorboard.glob("events.out.tfevents.*"):
            left.unlink()
    table = CSVOutputFormat(str(run.progress))
    events: Any = TensorBoardOutputFormat(str(run.tensorboard))  # whose writer torch declares as None
    if state is not None:
        table.file.write(state.numbers["progress"])
        table.file.flush()
        table.keys = [name for name in state.numbers["progress"].partition("\n")[0].split(",") if name]
        restart = Event(step=state.steps + 1, session_log=SessionLog(status=SessionLog.START))
        events.writer.file_writer.add_event(restart)  # TensorBoard forgets what was written from this step on
    return [table, events]


class TrainingDiverged(EthBrakeError, ArithmeticError):
    """A reward, a loss or a weight is no longer a finite number; the last good policy was kept."""


def weights_are_finite(model: Model, algorithm: Algorithm) -> bool:
    """Whether every weight is finite, and the exploration noise a usable one."""
    logarithm = algorithm.log_noise(model)
    noise = torch.ones(1) if logarithm is None else torch.exp(logarithm)
    usable = torch.isfinite(noise) & (noise > 0.0)
    return bool(usable.all()) and all(bool(torch.isfinite(p).all()) for p in model.policy.parameters())
