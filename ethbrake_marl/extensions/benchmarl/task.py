"""A scenario as a TorchRL environment and as a BenchMARL task; needs ``pip install ethbrake-marl[marl]``.

In TorchRL all learners of a world form one group, and the episode of a world ends for all of them at once. ``state``,
the input of a central critic, is the full state of the line (``episode.full_state``).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.action_scale import ActionForm, count_in
from ethbrake_marl.episode.full_state import full_state, state_features
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, naming_extras
from ethbrake_marl.faces.rendering import RENDERERS, make_renderer
from ethbrake_marl.faces.shield import NO_TEAM, guard_team
from ethbrake_marl.faces.spaces import action_space, checked_actions, feature_box
from ethbrake_marl.faces.stream import Stream, chosen_seed
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.scenario import Scenario

with naming_extras():
    import torch
    from benchmarl.environments.common import TaskClass
    from tensordict import TensorDict
    from torchrl.data import Bounded, Categorical, Composite, Unbounded
    from torchrl.envs import EnvBase

GROUP = "learners"


class LineEnv(EnvBase):  # type: ignore[misc]  # EnvBase has no types if the extra is not installed
    """TorchRL environment with ``n`` worlds of one scenario and ``L`` learners.

    F: features of an observation, S: features of the state. Shapes: observation [n, L, F], action [n, L, 1] (with
    discrete actions [n, L]), reward [n, L, 1], state [n, S], done [n, 1].

    Args:
        scenario: must have a learner; all its learners must observe the same features.
        n: number of worlds.
        seed: seed of the worlds.
        reward: a name such as ``shaped``, or the weights of the reward's terms.
        horizon_is_end: True: an episode that reaches the horizon is terminated; False: it is truncated.
        shield: mode of the learners' shield, such as ``step``. None: no shield.
        actions: number of discrete actions, for algorithms such as QMIX, or an ``ActionScale``; None: numbers in
            [-1, 1].

    """

    episode: State
    renderer: Any = None  # of the first world; None until `render` is called

    def __init__(
        self,
        scenario: AnyScenario,
        n: int,
        seed: int,
        reward: Any = "shaped",
        horizon_is_end: bool = True,
        shield: str | None = None,
        actions: ActionForm = None,
    ) -> None:
        super().__init__(device="cpu", batch_size=torch.Size([n]))
        loaded, game = open_game(scenario, reward=reward)
        self.learners, self.horizon_is_end, self.actions = game.settings.learners, horizon_is_end, actions
        self.of_state = loaded.horizon_s, loaded.has_obstacle
        views = {game.views[i] for i in self.learners}
        if len(views) != 1:
            raise InvalidInput(
                f"scenario {loaded.name!r}: its {len(self.learners)} learners have {len(views)} different observations;"
                " must have one or more learners, which all observe the same features"
            )
        if shield is not None:
            game = game._replace(shield=guard_team(NO_TEAM, shield, loaded, game.settings.harm_count, {}).shield)
        self.game = game
        self.stream = Stream(loaded, self.game, chosen_seed(seed))
        rows = n, len(self.learners)
        observation_bound = _bound(feature_box(views.pop().features), rows)
        state_bound = _bound(feature_box(state_features(loaded.vehicles, *self.of_state)), (n,))
        self.observation_spec = Composite(
            {GROUP: Composite({"observation": observation_bound}, shape=rows), "state": state_bound}, shape=(n,)
        )
        space = action_space(actions)
        action = _bound(space, rows) if count_in(actions) is None else Categorical(space.n, shape=rows)
        self.action_spec = Composite({GROUP: Composite({"action": action}, shape=rows)}, shape=(n,))
        rewards = Composite({"reward": Unbounded(shape=(*rows, 1))}, shape=rows)
        self.reward_spec = Composite({GROUP: rewards}, shape=(n,))
        flags = ("done", "terminated", "truncated")
        flag = {name: Categorical(2, dtype=torch.bool, shape=(n, 1)) for name in flags}
        self.done_spec = Composite(flag, shape=(n,))

    def _reset(self, tensordict: Any, **settings: Any) -> Any:
        """Start new episodes: in all worlds or, if ``tensordict`` has a mask ``_reset``, where the mask is True."""
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = np.arange(self.batch_size[0]) if mask is None else np.flatnonzero(mask.numpy().reshape(-1))
        stream, new = self.stream.next_episodes(rows)
        state = new if mask is None else self.episode.put(rows, new)
        content = self._observe(state)
        self.stream, self.episode = stream, state
        return TensorDict(content, batch_size=self.batch_size)

    def _step(self, tensordict: Any) -> Any:
        shape = self.batch_size[0], len(self.learners)
        actions = checked_actions(tensordict[GROUP, "action"].numpy(), shape, "the learners", self.actions)
        state, step = self.game.step(self.episode, actions)
        terminated, truncated = step.terminated, step.truncated
        if self.horizon_is_end:
            terminated, truncated = terminated | truncated, np.zeros_like(truncated)
        content = self._observe(state)
        content[GROUP]["reward"] = torch.from_numpy(step.reward[:, self.learners - 1, np.newaxis].astype(np.float32))
        for name, flag in (("done", state.ended), ("terminated", terminated), ("truncated", truncated)):
            content[name] = torch.from_numpy(flag[:, np.newaxis])
        self.episode = state
        return TensorDict(content, batch_size=self.batch_size)

    def render(self, mode: str = "rgb_array") -> Any:
        """What the render mode ``mode`` shows of the first world, by default a picture.

        Later calls ignore ``mode``: the mode of the first call stays.
        """
        if self.renderer is None:
            self.renderer = make_renderer(self, mode)
            self.renderer.began(self.episode.take([0]))
        return self.renderer.render()

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.stream = self.stream._replace(seed=chosen_seed(seed), next=0)

    def _observe(self, state: State) -> dict[str, Any]:
        if self.renderer is not None:
            self.renderer.stepped(state.take([0]))
        observation = torch.from_numpy(self.game.observe_alike(state, self.learners))
        group = TensorDict({"observation": observation}, batch_size=observation.shape[:2])
        return {GROUP: group, "state": torch.from_numpy(full_state(state, *self.of_state))}


class LineTask(TaskClass):  # type: ignore[misc]
    """BenchMARL task of one scenario.

    ``config``: arguments of ``LineEnv`` except ``n`` and ``seed``; only ``scenario`` is required.
    """

    def __init__(self, name: str, config: dict[str, Any]) -> None:
        super().__init__(name, {**config, "scenario": load_scenario(config["scenario"])})

    @property
    def scenario(self) -> Scenario:
        return load_scenario(self.config["scenario"])

    def get_env_fun(self, num_envs: int, continuous_actions: bool, seed: int | None, device: Any) -> Callable[[], Any]:
        """``device`` is unused.

        Raises ``InvalidInput`` if ``continuous_actions`` contradicts ``actions`` in the task's ``config``.
        """
        actions = count_in(self.config.get("actions"))
        if continuous_actions != (actions is None):
            raise InvalidInput(
                f"task {self.name}: continuous_actions = {continuous_actions} contradicts actions = {actions}; for"
                " continuous actions, set actions to None; for discrete actions, set actions to the number of actions"
                " (at least 2)"
            )
        return partial(LineEnv, n=num_envs, seed=seed or 0, **self.config)

    def supports_continuous_actions(self) -> bool:
        return count_in(self.config.get("actions")) is None

    def supports_discrete_actions(self) -> bool:
        return not self.supports_continuous_actions()

    def max_steps(self, env: Any) -> int:
        return round(self.scenario.horizon_s / self.scenario.time_step_s) + 1

    def has_render(self, env: Any) -> bool:
        return "rgb_array" in RENDERERS

    def group_map(self, env: Any) -> dict[str, list[str]]:
        return {GROUP: [self.scenario.vehicle_names[body - 1] for body in self.scenario.learners]}

    def observation_spec(self, env: Any) -> Any:
        spec = env.full_observation_spec_unbatched.clone()
        del spec["state"]
        return spec

    def info_spec(self, env: Any) -> Any:
        return None

    def state_spec(self, env: Any) -> Any:
        spec = env.full_observation_spec_unbatched.clone()
        del spec[GROUP]
        return spec

    def action_spec(self, env: Any) -> Any:
        return env.full_action_spec_unbatched

    def action_mask_spec(self, env: Any) -> Any:
        return None

    @staticmethod
    def env_name() -> str:
        return "ethbrake"


def _bound(box: Any, shape: tuple[int, ...]) -> Any:
    low, high = (torch.from_numpy(side).expand(*shape, len(side)) for side in (box.low, box.high))
    return Bounded(low, high, shape=low.shape, dtype=torch.float32)
