"""A scenario as a TorchRL environment and as a BenchMARL task; needs ``pip install ethbrake-marl[marl]``.

The environment runs ``n`` worlds in one engine. All learners of a world form one group in TorchRL, and the episode of a
world ends for all its learners at the same time. ``state``, the input of a central critic, is the full state of the
line (``game.full_state.full_state``).

Letters in shapes: ``n`` worlds, ``L`` learners, ``F`` features of an observation, ``S`` features of the state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from benchmarl.environments.common import TaskClass
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.envs.making import feature_box, learner_action_space, make_engine
from ethbrake_marl.first_edition.game.discrete_actions import index_to_action
from ethbrake_marl.first_edition.game.full_state import full_state, state_features
from ethbrake_marl.first_edition.game.observed import observation_for
from ethbrake_marl.first_edition.game.rewards import Reward
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.shields.attach import guard_of
from ethbrake_marl.first_edition.shields.options import ShieldOptions

GROUP = "learners"


class LineEnv(EnvBase):  # type: ignore[misc]  # EnvBase has no types if the extra is not installed
    """TorchRL environment with ``n`` worlds of one scenario and ``L`` learners.

    Shapes: observation [n, L, F], action [n, L, 1] (with discrete actions [n, L]), reward [n, L, 1], state [n, S], done
    [n, 1].

    Args:
        scenario: the scenario, which must have at least one learner.
        n: number of worlds.
        seed: seed from which the worlds are drawn.
        reward: reward of the learners: a name such as ``harm``, or the weights of the reward's terms.
        horizon_is_end: True: an episode that reaches the horizon is terminated; False: it is truncated.
        shield: mode of the learners' shield, which must be ``step`` if there are several learners. None: no shield.
        actions: number of discrete actions, for algorithms such as QMIX; None: actions are numbers in [-1, 1].

    """

    def __init__(
        self,
        scenario: Scenario,
        n: int,
        seed: int,
        reward: Reward,
        horizon_is_end: bool = True,
        shield: str | None = None,
        actions: int | None = None,
    ) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([n]))
        self.engine = make_engine(scenario, n, reward=reward, observation=observation_for(scenario), seed=seed)
        if shield is not None:
            self.engine.protect(guard_of(self.engine, None, ShieldOptions(shield)))
        self.horizon_is_end = horizon_is_end
        self._learners = np.array(self.engine.learners, np.int64)
        rows = (n, len(self._learners))
        seen = _bound(feature_box(self.engine.observation.features), rows)
        state = _bound(feature_box(state_features(scenario)), (n,))
        self.observation_spec = Composite(
            {GROUP: Composite({"observation": seen}, shape=rows), "state": state}, shape=(n,)
        )
        self.actions, space = actions, learner_action_space(actions)
        action = Bounded(-1.0, 1.0, shape=(*rows, 1)) if actions is None else Categorical(space.n, shape=rows)
        self.action_spec = Composite({GROUP: Composite({"action": action}, shape=rows)}, shape=(n,))
        reward_of_each = Composite({"reward": Unbounded(shape=(*rows, 1))}, shape=rows)
        self.reward_spec = Composite({GROUP: reward_of_each}, shape=(n,))
        flags = ("done", "terminated", "truncated")
        flag = {name: Categorical(2, dtype=torch.bool, shape=(n, 1)) for name in flags}
        self.done_spec = Composite(flag, shape=(n,))

    def _reset(self, tensordict: Any, **settings: Any) -> Any:
        """Start a new episode in all worlds, or in the worlds where the mask ``_reset`` in ``tensordict`` is True."""
        asked = None if tensordict is None else tensordict.get("_reset", None)
        if asked is None:
            self.engine.reset()
        else:
            self.engine.renew(np.flatnonzero(asked.numpy().reshape(-1)))
        return TensorDict(self._observe_all(), batch_size=self.batch_size)

    def _step(self, tensordict: Any) -> Any:
        given = tensordict[GROUP, "action"].numpy()
        step = self.engine.step(
            given[:, :, 0].clip(-1.0, 1.0) if self.actions is None else index_to_action(given, self.actions)
        )
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
        """Start new episodes in worlds that are drawn from ``seed``; do nothing if ``seed`` is None."""
        if seed is not None:
            self.engine.reset(seed=seed)

    def _observe_all(self) -> dict[str, Any]:
        every = torch.from_numpy(self.engine.observe_all(self._learners).copy())
        state = torch.from_numpy(full_state(self.engine.worlds, self.engine.scenario))
        own = TensorDict({"observation": every}, batch_size=every.shape[:2])
        return {GROUP: own, "state": state}


class LineTask(TaskClass):  # type: ignore[misc]
    """BenchMARL task for one scenario.

    Args:
        name: name of the task in BenchMARL, such as ``PAPER_RANDOM``.
        config: mapping with the keys ``scenario``, ``reward`` and ``horizon_is_end``, and optionally ``shield`` and
            ``actions``. ``scenario`` is the name of a shipped scenario, the path of a scenario file, a mapping with the
            content of such a file, or a ``Scenario``. The other values are passed to ``LineEnv``.

    """

    def __init__(self, name: str, config: dict[str, Any]) -> None:
        super().__init__(name, {**config, "scenario": load_scenario(config["scenario"])})

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Callable[[], Any]:
        """Return a function without arguments that creates a ``LineEnv`` with ``num_envs`` worlds.

        If ``seed`` is None, the seed is 0. ``device`` is unused.

        Raises ``InvalidInput`` if the task has continuous actions and BenchMARL wants discrete actions, or the other
        way round.
        """
        config, actions = self.config, self.config.get("actions")
        if continuous_actions != (actions is None):
            raise InvalidInput(
                f"task {self.name}: continuous_actions = {continuous_actions} contradicts actions = {actions}; for"
                " continuous actions, set actions to None; for discrete actions, set actions to the number of actions"
                " (at least 2)"
            )
        settings = config["reward"], config["horizon_is_end"], config.get("shield"), actions
        return lambda: LineEnv(config["scenario"], num_envs, seed or 0, *settings)

    def supports_continuous_actions(self) -> bool:
        """Return True if the key ``actions`` in ``config`` is None or missing."""
        return self.config.get("actions") is None

    def supports_discrete_actions(self) -> bool:
        """Return True if the key ``actions`` in ``config`` is a number."""
        return self.config.get("actions") is not None

    def max_steps(self, env: Any) -> int:
        """Return the largest number of decisions in an episode; ``env`` is unused."""
        scenario: Scenario = self.config["scenario"]
        return round(scenario.horizon_s / scenario.time_step_s) + 1

    def has_render(self, env: Any) -> bool:
        """Return False, because the environment cannot be drawn."""
        return False

    def group_map(self, env: Any) -> dict[str, list[str]]:
        """Return ``{"learners": names}``: one group with the names of all learners. ``env`` is unused."""
        scenario = self.config["scenario"]
        return {GROUP: [scenario.vehicle_names[vehicle] for vehicle in scenario.learners]}

    def observation_spec(self, env: Any) -> Any:
        """Return the TorchRL spec of the learners' observations in ``env``, for a single world."""
        spec = env.full_observation_spec_unbatched.clone()
        del spec["state"]
        return spec

    def info_spec(self, env: Any) -> Any:
        """Return None, because the environment has no ``info``."""
        return None

    def state_spec(self, env: Any) -> Any:
        """Return the TorchRL spec of the state in ``env``, for a single world."""
        spec = env.full_observation_spec_unbatched.clone()
        del spec[GROUP]
        return spec

    def action_spec(self, env: Any) -> Any:
        """Return the TorchRL spec of the learners' actions in ``env``, for a single world."""
        return env.full_action_spec_unbatched

    def action_mask_spec(self, env: Any) -> Any:
        """Return None, because every action is always allowed."""
        return None

    @staticmethod
    def env_name() -> str:
        """Return ``ethbrake``, the first part of the names of this package's tasks."""
        return "ethbrake"


def _bound(box: Any, shape: tuple[int, ...]) -> Any:
    low, high = (torch.from_numpy(side).expand(*shape, len(side)) for side in (box.low, box.high))
    return Bounded(low, high, shape=low.shape, dtype=torch.float32)
