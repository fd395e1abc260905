"""The line as a TorchRL environment and a BenchMARL task; needs the extra ``marl``.

Every world of the batch is a row of one engine. The learners are one group, which ends together: ``done`` belongs to
the world, so nobody's end cuts off the others. The critic's ``state`` is the full state of the line
(``observations.state``).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchmarl.algorithms import MappoConfig
from benchmarl.environments.common import TaskClass
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.modules import MultiAgentMLP

from ethbrake_marl.envs.common import feature_box, make_engine, resolve_scenario
from ethbrake_marl.learning.checkpoint import own_random_state
from ethbrake_marl.learning.recipe import PpoRecipe
from ethbrake_marl.learning.training import create_run, resolve, team_content, write_status
from ethbrake_marl.observations import full_state, observation_for, state_features
from ethbrake_marl.policies.actor import Float32s, NetworkSpec, installed_versions, observation_schema
from ethbrake_marl.policies.bundle import Policy, make_policy, save_policy
from ethbrake_marl.rewards import Reward
from ethbrake_marl.scenario import Scenario

GROUP = "learners"


class LineEnv(EnvBase):  # type: ignore[misc]  # untyped where the extra is missing
    """``n`` worlds of ``scenario``: observation [n, L, F], action and reward [n, L, 1], state [n, S], done [n, 1].

    ``horizon_is_end``: an episode that the horizon cuts off counts as terminated, as in a recipe.
    """

    def __init__(self, scenario: Scenario, n: int, seed: int, reward: Reward, horizon_is_end: bool = False) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([n]))
        self.engine = make_engine(scenario, n, reward=reward, observation=observation_for(scenario), seed=seed)
        self.horizon_is_end = horizon_is_end
        self._learners = np.array(self.engine.learners, np.int64)
        rows = (n, len(self._learners))
        seen = _bound(feature_box(self.engine.observation.features), rows)
        state = _bound(feature_box(state_features(scenario)), (n,))
        self.observation_spec = Composite(
            {GROUP: Composite({"observation": seen}, shape=rows), "state": state}, shape=(n,)
        )
        action = Bounded(-1.0, 1.0, shape=(*rows, 1))
        self.action_spec = Composite({GROUP: Composite({"action": action}, shape=rows)}, shape=(n,))
        reward_of_each = Composite({"reward": Unbounded(shape=(*rows, 1))}, shape=rows)
        self.reward_spec = Composite({GROUP: reward_of_each}, shape=(n,))
        flags = ("done", "terminated", "truncated")
        flag = {name: Categorical(2, dtype=torch.bool, shape=(n, 1)) for name in flags}
        self.done_spec = Composite(flag, shape=(n,))

    def _reset(self, tensordict: Any, **settings: Any) -> Any:
        """Start an episode in every world, or in those that ``_reset`` names."""
        asked = None if tensordict is None else tensordict.get("_reset", None)
        if asked is None:
            self.engine.reset()
        else:
            self.engine.renew(np.flatnonzero(asked.numpy().reshape(-1)))
        return TensorDict(self._observe_all(), batch_size=self.batch_size)

    def _step(self, tensordict: Any) -> Any:
        action = tensordict[GROUP, "action"].numpy()[:, :, 0].clip(-1.0, 1.0)
        step = self.engine.step(action)
        reward = torch.from_numpy(step.reward[:, self._learners, np.newaxis].astype(np.float32))
        terminated, truncated = step.terminated.copy(), step.truncated.copy()
        if self.horizon_is_end:
            terminated, truncated = terminated | truncated, np.zeros_like(truncated)
        content = self._observe_all()
        content[GROUP]["reward"] = reward
        for name, flag in (("done", step.ended), ("terminated", terminated), ("truncated", truncated)):
            content[name] = torch.from_numpy(np.array(flag, np.bool_)[:, np.newaxis])
        return TensorDict(content, batch_size=self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        """Go on with the stream of ``seed``."""
        if seed is not None:
            self.engine.reset(seed=seed)

    def _observe_all(self) -> dict[str, Any]:
        every = torch.from_numpy(self.engine.observe_all(self._learners).copy())
        state = torch.from_numpy(full_state(self.engine.worlds, self.engine.scenario))
        own = TensorDict({"observation": every}, batch_size=every.shape[:2])
        return {GROUP: own, "state": state}


class LineTask(TaskClass):  # type: ignore[misc]
    """A scenario as a task.

    ``config``: ``scenario`` (a shipped name, a YAML file, its content, or a ``Scenario``), ``reward``,
    ``horizon_is_end``.
    """

    def __init__(self, name: str, config: dict[str, Any]) -> None:
        super().__init__(name, {**config, "scenario": resolve_scenario(config["scenario"])})

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Callable[[], Any]:
        """How to make the worlds."""
        config = self.config
        return lambda: LineEnv(config["scenario"], num_envs, seed or 0, config["reward"], config["horizon_is_end"])

    def supports_continuous_actions(self) -> bool:
        """Yes."""
        return True

    def supports_discrete_actions(self) -> bool:
        """No."""
        return False

    def max_steps(self, env: Any) -> int:
        """Decisions to the horizon."""
        scenario: Scenario = self.config["scenario"]
        return round(scenario.horizon_s / scenario.time_step_s) + 1

    def has_render(self, env: Any) -> bool:
        """Nothing is drawn."""
        return False

    def group_map(self, env: Any) -> dict[str, list[str]]:
        """All learners are one group."""
        scenario = self.config["scenario"]
        return {GROUP: [scenario.vehicle_names[vehicle] for vehicle in scenario.learners]}

    def observation_spec(self, env: Any) -> Any:
        """What each learner sees."""
        spec = env.full_observation_spec_unbatched.clone()
        del spec["state"]
        return spec

    def info_spec(self, env: Any) -> Any:
        """None."""
        return None

    def state_spec(self, env: Any) -> Any:
        """What the critic sees."""
        spec = env.full_observation_spec_unbatched.clone()
        del spec[GROUP]
        return spec

    def action_spec(self, env: Any) -> Any:
        """What each learner decides."""
        return env.full_action_spec_unbatched

    def action_mask_spec(self, env: Any) -> Any:
        """None."""
        return None

    @staticmethod
    def env_name() -> str:
        """Name of the environment."""
        return "ethbrake"


def train_mappo(recipe: PpoRecipe, scenario: Scenario, directory: str | Path, *, force: bool = False) -> Policy:
    """Train BenchMARL's MAPPO with the numbers of ``recipe``, and leave the shared actor in the new ``directory``.

    ``load_team`` and ``ppo@DIRECTORY`` take it. The learning rate stays at its start, as BenchMARL has no schedule;
    there are no checkpoints and nothing is measured on the way. Raises what ``learning.train.train`` raises.
    """
    recipe = recipe.replace(scheme="centralised")
    if recipe.observation is not None:
        scenario = scenario.replace(observation=list(recipe.observation))
    team = team_content(resolve(recipe, scenario).scheme, scenario)
    content = {"recipe": recipe.model_dump(mode="json"), "scenario": scenario.model_dump(mode="json")}
    run = create_run(Path(directory), {**content, "library": "benchmarl"}, team=team, force=force)
    with own_random_state(), tempfile.TemporaryDirectory() as scratch:
        experiment = _experiment(recipe, scenario, scratch)
        experiment.run()
        policy = policy_of(experiment, recipe, scenario)
    save_policy(policy, run.policy)
    write_status(run, "finished", {"steps": policy.manifest.steps})
    return policy


def _experiment(recipe: PpoRecipe, scenario: Scenario, scratch: str) -> Any:
    """An experiment with the numbers of ``recipe``; what BenchMARL writes of its own goes to the folder ``scratch``."""
    learners = len(scenario.learners)
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
    algorithm = MappoConfig.get_from_yaml()
    algorithm.lmbda, algorithm.clip_epsilon = recipe.gae_lambda, recipe.clip_range
    algorithm.entropy_coef, algorithm.critic_coef = recipe.ent_coef, recipe.vf_coef
    models = [MlpConfig.get_from_yaml(), MlpConfig.get_from_yaml()]
    activation = torch.nn.ReLU if recipe.network.activation == "relu" else torch.nn.Tanh
    for model, cells in zip(models, (recipe.network.policy, recipe.network.value), strict=True):
        model.num_cells, model.activation_class = list(cells), activation
    task = LineTask(
        scenario.name, {"scenario": scenario, "reward": recipe.reward, "horizon_is_end": recipe.horizon_is_end}
    )
    return Experiment(task, algorithm, models[0], recipe.seed, config, critic_model_config=models[1])


def policy_of(experiment: Any, recipe: PpoRecipe, scenario: Scenario) -> Policy:
    """The shared actor of an experiment as a policy; its mean is squashed by the hyperbolic tangent."""
    (actor,) = (m for m in experiment.group_policies[GROUP].modules() if isinstance(m, MultiAgentMLP))
    observation = observation_for(scenario)
    network = NetworkSpec(
        observation_size=observation.size,
        action_size=1,
        policy_hidden=recipe.network.policy,
        value_hidden=(),
        activation=recipe.network.activation,
        output="tanh",
    )
    return make_policy(
        _tensors(actor, len(recipe.network.policy)),
        algorithm="ppo",
        network=network,
        observation=observation_schema(observation),
        learners=tuple(scenario.vehicle_names[vehicle] for vehicle in scenario.learners),
        scenario=scenario.model_dump(mode="json"),
        reward=recipe.reward.model_dump(mode="json"),
        seeds={"training": recipe.seed},
        steps=int(experiment.total_frames) * len(scenario.learners),
        versions=installed_versions(),
    )


def _tensors(actor: Any, hidden: int) -> dict[str, Float32s]:
    """The actor's layers under the names of our table; its last one gives the mean, then the noise."""
    found: dict[str, Float32s] = {}
    for k in range(hidden + 1):
        for part in ("weight", "bias"):
            values = actor.params[str(2 * k), part].detach().cpu().numpy().astype(np.float32)
            if k < hidden:
                found[f"policy.{k}.{part}"] = values
            else:
                found[f"policy.output.{part}"], found[f"policy.log_std.{part}"] = values[:1], values[1:]
    return found


def _bound(box: Any, shape: tuple[int, ...]) -> Any:
    low, high = (torch.from_numpy(side).expand(*shape, len(side)) for side in (box.low, box.high))
    return Bounded(low, high, shape=low.shape, dtype=torch.float32)
