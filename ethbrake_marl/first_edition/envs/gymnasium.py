"""Environment for Gymnasium, with one learner and one world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.envs.infos import OneWorld, Report
from ethbrake_marl.first_edition.envs.making import (
    AnyScenario,
    feature_box,
    learner_action_space,
    learner_actions,
    make_engine,
    only_learner,
    reward_box,
)
from ethbrake_marl.first_edition.envs.viewer import Viewer
from ethbrake_marl.first_edition.game.observations import Observation, Observations, ObservationSpec
from ethbrake_marl.first_edition.game.reward_vector import RewardVector
from ethbrake_marl.first_edition.game.rewards import Reward, RewardParams
from ethbrake_marl.first_edition.physics.episode import Decisions
from ethbrake_marl.first_edition.scenario.schema import Scenario


class Specified:
    """Mixin for environments of ``gymnasium.make``: the attribute ``spec`` stores all settings as plain data for JSON.

    For instance, ``spec`` stores a scenario object as a mapping, and a path as a text.
    """

    engine: Engine  # engine that moves the worlds, set by the environment
    max_episode_steps: int | None = None  # largest number of steps of an episode; None: an episode ends at the horizon
    _spec: EnvSpec | None = None  # value of the property ``spec``

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's record of how ``gymnasium.make`` made the environment; None if it was made in another way.

        ``spec.max_episode_steps`` is an upper bound of the number of steps of an episode.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            kwargs = {name: _plain(value) for name, value in spec.kwargs.items()}
            if kwargs.get("learners") is not None:  # the setting may be an iterator that is already exhausted
                kwargs["learners"] = [self.engine.scenario.vehicle_names[i] for i in self.engine.learners]
            scenario = self.engine.scenario
            from_alert = int(Decisions(np.zeros(1), scenario.time_step_s).before(scenario.horizon_s)[0])
            spec = replace(spec, kwargs=kwargs, max_episode_steps=self.max_episode_steps or from_alert)
        self._spec = spec


def _plain(setting: Any) -> Any:
    """Convert a setting of an environment to plain data for JSON."""
    if isinstance(setting, Scenario):
        return setting.declared()
    if isinstance(setting, RewardParams):
        return setting.model_dump(mode="json")
    if isinstance(setting, ObservationSpec):
        return asdict(setting)
    if isinstance(setting, Path):
        return str(setting)
    if isinstance(setting, AutoresetMode):
        return setting.value
    if isinstance(setting, np.generic | np.ndarray):
        return setting.tolist()
    if isinstance(setting, Mapping):
        return {name: _plain(value) for name, value in setting.items()}
    return [_plain(value) for value in setting] if isinstance(setting, list | tuple) else setting


class EthBrakeEnv(OneWorld, Specified, gymnasium.Env[Observations, NDArray[Any]]):
    """Environment with one learner in a line of vehicles that follow scripts (``gymnasium.make("EthBrake-v1")``).

    - Observation: the features of ``ObservationSpec``, float32 [F].
    - Action: an array [1] in [-1, 1]. -1 brakes with full capacity, 0 coasts, +1 drives with full capacity.
    - End: an episode is *terminated* when all vehicles are at rest and no command would move one. Otherwise the episode
      is *truncated* at the horizon.
    - Infos and options of ``reset``: see docs/environments.md.

    Args:
        scenario: name of a shipped scenario, path of a YAML file, or a ``Scenario``.
        render_mode: ``human``, ``rgb_array``, ``rgb_array_list`` or ``ansi`` (see docs/environments.md); None: no
            pictures.
        learners: a list with the one vehicle that learns, by name (``vehicle_2``) or index (0 = front); None: the
            learner of the scenario.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping with settings, or a ``RewardParams`` object.
        observation: features that the learner observes; None: the features that the scenario declares or, if it
            declares none, default features (``observation_for``).
        actions: None: an action is a number in [-1, 1]. A whole number K >= 2: actions are discrete; the indices
            0 to K - 1 stand for K evenly spaced numbers from -1 (full braking capacity) to 1 (full driving capacity).
        reward_vector: None: a reward is a number. ``vehicles``: a reward is an array [N] that contains minus the harm
            that each vehicle bears in the step. A list of components: a reward is an array with these components (see
            docs/environments.md).

    Raises ``InvalidInput`` if the number of learners is not one.

    >>> import ethbrake_marl.first_edition as eb
    >>> env = eb.EthBrakeEnv("paper-random")
    >>> observation, info = env.reset(seed=7)
    >>> observation.shape, info["time_s"]
    ((27,), 0.5)
    >>> observation, reward, terminated, truncated, info = env.step([-1.0])
    >>> reward, terminated, truncated
    (0.0, False, False)

    """

    metadata: dict[str, Any] = dict(Viewer.METADATA)  # noqa: RUF012  # as Gymnasium declares it

    def __init__(
        self,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str | int] | None = None,
        reward: Reward = "harm",
        observation: Observation | None = None,
        actions: int | None = None,
        reward_vector: RewardVector | None = None,
    ) -> None:
        self.action_space, self.actions = learner_action_space(actions), actions
        self.engine = make_engine(
            scenario, 1, learners=learners, reward=reward, observation=observation, reward_vector=reward_vector
        )
        if self.engine.components:  # attributes of MO-Gymnasium
            self.reward_space = reward_box(self.engine)
            self.reward_dim = len(self.engine.components)
        self.render_mode, self.viewer = render_mode, Viewer(self.engine, render_mode)
        self.metadata = {**self.metadata, **self.viewer.metadata}
        self.learner = only_learner(self.engine)
        self._column = np.array([self.learner])
        self._name = self.engine.scenario.vehicle_names[self.learner]
        self.observation_space = feature_box(self.engine.observations[self.learner].features)
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode, and return observation and info.

        Args:
            seed: start the first world of this seed; None: continue with the next world of the current seed.
            options: to choose the world, ``{"initial_state": ...}`` or ``{"listed_world": {"seed": 7, "number": 3}}``
                (see docs/environments.md).

        """
        self._restart(seed, options)
        self._running = True
        self.viewer.began()
        return self._observe(), Report.of(self.engine).plain_infos(self._column)[0]

    def step(self, action: NDArray[Any]) -> tuple[Observations, Any, bool, bool, dict[str, Any]]:
        """Advance by one time step with an ``action`` [1] in [-1, 1].

        Returns observation, reward, terminated, truncated and info.
        """
        if not self._running:
            raise InvalidInput("step: no episode is running; call reset first")
        step = self.engine.step(learner_actions(self.engine, {self._name: action}, self.actions))
        self._running = not step.ended[0]
        if self.render_mode is not None:
            self.viewer.play()
        info = Report.of(self.engine, step).plain_infos(self._column)[0]
        each = step.vector
        reward = float(step.reward[0, self.learner]) if each is None else each[0, self.learner].copy()
        return self._observe(), reward, bool(step.terminated[0]), bool(step.truncated[0]), info

    def _observe(self) -> Observations:
        observation: Observations = self.engine.observe(self.learner)[0].copy()
        return observation
