"""Gymnasium: one learner, one world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from ethbrake_marl.episode.infos import dictionaries
from ethbrake_marl.episode.observe import Observations, View
from ethbrake_marl.episode.reward import RewardParams
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput, check_one_learner
from ethbrake_marl.faces.actions import action_space, checked_actions
from ethbrake_marl.faces.rendering import make_renderer, render_metadata
from ethbrake_marl.faces.spaces import FeatureBox, reward_box
from ethbrake_marl.faces.stream import Stream
from ethbrake_marl.names import open_game
from ethbrake_marl.worlds.game import AnyScenario
from ethbrake_marl.worlds.scenario import Scenario


class OneLearner:
    """What both of Gymnasium's interfaces share: a game with one learner, and a ``spec`` of plain data."""

    max_episode_steps: int | None = None
    _spec: EnvSpec | None = None

    def _open(self, scenario: AnyScenario, learners: Any, reward: Any, observation: Any, vector: Any) -> None:
        self.scenario, self.game = open_game(scenario, learners, reward, observation, vector)
        check_one_learner(
            self.scenario.name,
            [self.scenario.vehicle_names[i - 1] for i in self.game.rules.learners],
            "this environment needs exactly one learner: pass learners=['vehicle_2'], or use parallel_env or"
            " make_sb3_vec_env",
        )
        (self.body,) = self.game.rules.learners.tolist()
        self.stream, self.name = Stream(self.scenario, self.game), self.scenario.vehicle_names[self.body - 1]
        if components := self.game.rewarding.components:  # as MO-Gymnasium has it
            self.reward_space, self.reward_dim = reward_box(components), len(components)

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's record of how this was made, all settings as plain data; None if ``make`` did not make it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            kwargs = {name: plain(value) for name, value in spec.kwargs.items()}
            if kwargs.get("learners") is not None:  # what was given may be an iterator that has ended
                kwargs["learners"] = [self.name]
            longest = int(np.ceil(self.scenario.horizon_s / self.scenario.time_step_s - 1e-9))
            spec = replace(spec, kwargs=kwargs, max_episode_steps=self.max_episode_steps or longest)
        self._spec = spec

    def _restart(self, n: int, seed: int | None, options: Any, known: tuple[str, ...]) -> State:
        """Return new episodes. A generator that the user has set draws the seed."""
        if seed is None and getattr(self, "_np_random_seed", None) == -1:
            seed = int(self.np_random.integers(2**63))  # type: ignore[attr-defined]  # of gymnasium's Env and VectorEnv
        return self.stream.restart(n, seed, options, known)


def plain(setting: Any) -> Any:
    """Return a setting of an environment as plain data."""
    if isinstance(setting, Scenario):
        return setting.declared()
    if isinstance(setting, RewardParams):
        return setting.model_dump(mode="json")
    if isinstance(setting, View):
        return list(setting.names)
    if isinstance(setting, Path):
        return str(setting)
    if isinstance(setting, Enum):
        return setting.value
    if isinstance(setting, np.generic | np.ndarray):
        return setting.tolist()
    if isinstance(setting, Mapping):
        return {name: plain(value) for name, value in setting.items()}
    return [plain(value) for value in setting] if isinstance(setting, list | tuple) else setting


class EthBrakeEnv(OneLearner, gymnasium.Env[NDArray[Any], NDArray[Any]]):
    """One learner in a line whose other vehicles follow scripts (``gymnasium.make("EthBrake-v1")``).

    Action, end, infos and options of ``reset`` are those of ``EthBrakeParallelEnv``, as are the arguments; there must
    be exactly one learner.

    >>> import ethbrake_marl as eb
    >>> env = eb.EthBrakeEnv("paper-random")
    >>> observation, info = env.reset(seed=7)
    >>> observation.shape, info["time_s"]
    ((27,), 0.5)
    >>> observation, reward, terminated, truncated, info = env.step([-1.0])
    >>> reward, terminated, truncated
    (0.0, False, False)

    """

    metadata: dict[str, Any] = render_metadata()  # as Gymnasium declares it

    def __init__(
        self,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str] | None = None,
        reward: Any = "harm",
        observation: Any = None,
        actions: int | None = None,
        reward_vector: Any = None,
    ) -> None:
        self.action_space, self.actions, self.render_mode = action_space(actions), actions, render_mode
        self._open(scenario, learners, reward, observation, reward_vector)
        self.observation_space = FeatureBox(self.game.views[self.body].features)
        self.renderer = make_renderer(self, render_mode)
        self._running = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Any]:
        """Start an episode; see ``EthBrakeParallelEnv.reset``."""
        self.episode = self._restart(1, seed, options, ("initial_state", "listed_world"))
        goes_on = seed is None and self._np_random is not None
        super().reset(seed=None if goes_on else self.stream.seed)
        self._running = True
        if self.renderer is not None:
            self.renderer.began(self.episode)
        return self._observe(), self._info(None)

    def step(self, action: Any) -> tuple[Observations, Any, bool, bool, dict[str, Any]]:
        """Advance by one time step with an ``action`` [1]."""
        if not self._running:
            raise InvalidInput("step: no episode is running; call reset first")
        number = checked_actions(action, (1, 1), self.name, self.actions)
        self.episode, step = self.game.step(self.episode, number)
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._running = not (terminated or truncated)
        if self.renderer is not None:
            self.renderer.stepped(self.episode)
        vector, row = step.vector, self.body - 1
        reward = float(step.reward[0, row]) if vector is None else vector[0, row].copy()
        return self._observe(), reward, terminated, truncated, self._info(step)

    def describe_world(self) -> dict[str, Any]:
        """Return what was drawn for this world: a name such as ``gap_1_m`` or ``scenario`` -> its value."""
        if not hasattr(self, "episode"):
            raise InvalidInput("describe_world: no episode has started; call reset first")
        return {name: column[0].item() for name, column in self.stream.describe(self.episode).items()}

    def render(self) -> Any:
        """Return a picture, as the render mode has it."""
        return None if self.renderer is None else self.renderer.render()

    def close(self) -> None:
        """Give back what the render mode holds."""
        if self.renderer is not None:
            self.renderer.close()

    def _observe(self) -> Observations:
        seen: Observations = self.game.observe_alike(self.episode, [self.body])[0, 0]
        return seen

    def _info(self, step: Any) -> dict[str, Any]:
        return dictionaries(self.game, self.episode, step, self.stream.seed or 0, np.array([self.body]))[0]
