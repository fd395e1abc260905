"""A scenario as a TorchRL environment and as a BenchMARL task; needs ``pip install ethbrake-marl[marl]``.

The learners of a world are one group of TorchRL, whose episode ends for all at the same time. ``state``, the input of a
central critic, is the full state of the line (``episode.full_state``). Letters in shapes: n worlds, L learners, F
features of an observation, S of the state.
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

from ethbrake_marl.episode.full_state import full_state, state_features
from ethbrake_marl.episode.reward import Reward
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.faces.actions import action_space, checked_actions
from ethbrake_marl.faces.shield import MODES
from ethbrake_marl.faces.spaces import FeatureBox
from ethbrake_marl.faces.stream import Stream
from ethbrake_marl.names import open_game
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario

GROUP = "learners"


class LineEnv(EnvBase):  # type: ignore[misc]  # EnvBase has no types if the extra is not installed
    """``n`` worlds of one scenario.

    Shapes: observation [n, L, F], action [n, L, 1] (with discrete actions [n, L]), reward [n, L, 1], state [n, S], done
    [n, 1].

    Args:
        scenario: must have a learner; all learners observe the same features.
        n: number of worlds.
        seed: of the stream of worlds.
        reward: a name such as ``harm``, or weights of terms.
        horizon_is_end: an episode at the horizon is terminated, not truncated.
        shield: mode of a shield around the learners, such as ``step``; None: no shield.
        actions: number of discrete actions, for algorithms such as QMIX; None: actions are numbers in [-1, 1].

    """

    episode: State

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
        self.scenario, self.game = open_game(scenario, reward=reward)
        if shield is not None:
            if shield not in MODES:
                raise unknown_name("shield mode", shield, MODES)
            self.game = self.game._replace(shield=MODES[shield](None))
        self.horizon_is_end, self.actions, self.learners = horizon_is_end, actions, self.game.rules.learners
        if not len(self.learners) or len({self.game.views[body] for body in self.learners}) > 1:
            raise InvalidInput(
                f"scenario {scenario.name!r}: must have at least one learner, and all learners must observe the same"
                " features"
            )
        self.stream, self._of_state = Stream(self.scenario, self.game), (scenario.horizon_s, scenario.has_obstacle)
        self.stream.seed, rows = seed, (n, len(self.learners))
        seen = _bound(FeatureBox(self.game.views[self.learners[0]].features), rows)
        state = _bound(FeatureBox(state_features(scenario.vehicles, *self._of_state)), (n,))
        self.observation_spec = Composite(
            {GROUP: Composite({"observation": seen}, shape=rows), "state": state}, shape=(n,)
        )
        space = action_space(actions)
        action = Bounded(-1.0, 1.0, shape=(*rows, 1)) if actions is None else Categorical(space.n, shape=rows)
        self.action_spec = Composite({GROUP: Composite({"action": action}, shape=rows)}, shape=(n,))
        reward_of_each = Composite({"reward": Unbounded(shape=(*rows, 1))}, shape=rows)
        self.reward_spec = Composite({GROUP: reward_of_each}, shape=(n,))
        flags = ("done", "terminated", "truncated")
        self.done_spec = Composite({name: Categorical(2, dtype=torch.bool, shape=(n, 1)) for name in flags}, shape=(n,))

    def _reset(self, tensordict: Any, **settings: Any) -> Any:
        """Begin the next episodes, in all worlds or where ``_reset`` in ``tensordict`` is True."""
        asked = None if tensordict is None else tensordict.get("_reset", None)
        if asked is None:
            self.episode = self.stream.draw(self.batch_size[0])
        elif asked.any():
            rows = np.flatnonzero(asked.numpy().reshape(-1))
            self.episode = self.episode.put(rows, self.stream.draw(len(rows)))
        return TensorDict(self._observe_all(), batch_size=self.batch_size)

    def _step(self, tensordict: Any) -> Any:
        given = tensordict[GROUP, "action"].numpy()
        if self.actions is None:
            given = given[:, :, 0].clip(-1.0, 1.0)
        actions = checked_actions(given, given.shape, "the learners", self.actions)
        self.episode, step = self.game.step(self.episode, actions, donate=True)
        content, ended = self._observe_all(), self.episode.ended
        reward = step.reward[:, self.learners - 1, np.newaxis].astype(np.float32)
        content[GROUP]["reward"] = torch.from_numpy(reward)
        terminated = ended & (self.episode.at_rest | self.horizon_is_end)
        for name, flag in (("done", ended), ("terminated", terminated), ("truncated", ended & ~terminated)):
            content[name] = torch.from_numpy(flag[:, np.newaxis])
        return TensorDict(content, batch_size=self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        """Let the next episodes be the first ones of another seed."""
        if seed is not None:
            self.stream.seed, self.stream.next = seed, 0

    def _observe_all(self) -> dict[str, Any]:
        seen = torch.from_numpy(self.game.observe_alike(self.episode, self.learners))
        own = TensorDict({"observation": seen}, batch_size=seen.shape[:2])
        return {GROUP: own, "state": torch.from_numpy(full_state(self.episode, *self._of_state))}


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
        return {GROUP: [scenario.vehicle_names[body - 1] for body in scenario.learners]}

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
