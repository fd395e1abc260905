"""Gymnasium's interface: one learner, one world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from ethbrake_marl.envs.drawing.viewer import CLASS_METADATA, Viewer, render_metadata
from ethbrake_marl.envs.drawn import describe_world
from ethbrake_marl.envs.infos import plain_infos, report
from ethbrake_marl.envs.setup import (
    AnyScenario,
    action_box,
    check_seed,
    feature_box,
    fresh_seed,
    learner_columns,
    make_engine,
    only_learner,
    plain_spec,
    restart,
)
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import Observation, Observations
from ethbrake_marl.rewards import Reward


class EthBrakeEnv(gymnasium.Env[Observations, NDArray[Any]]):
    """One learner brakes in a line of vehicles that follow their scripts: ``gymnasium.make("EthBrake-v0")``.

    Observation: float32 [F], the features of ``ObservationSpec``. Action: [1] in [-1, 1]; -1 full braking capacity, 0
    coasts, +1 full driving capacity. Terminated: all at rest and no command that would move one. Truncated: the
    horizon. Infos: see ``envs.infos``. ``reset(seed=s)`` starts the stream of worlds of s, ``reset()`` goes on in it;
    ``options={"initial_state": {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}}`` starts from there. Raises
    ``InvalidInput`` for more or fewer than one learner, an action outside [-1, 1], a step without an episode.

    Args:
        scenario: a shipped name, the path of a YAML file, or a ``Scenario``.
        render_mode: ``human``, ``rgb_array``, ``rgb_array_list``, ``ansi``, or None (docs/environment.md, Watching).
        learners: the one vehicle that learns instead of the scenario's, by name (``vehicle_2``) or index from 0.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: what the learner observes; None: ``observation_for(scenario)``.

    >>> import ethbrake_marl as eb
    >>> env = eb.EthBrakeEnv("paper-random")
    >>> observation, info = env.reset(seed=7)
    >>> observation.shape, info["time_s"]
    ((27,), 0.5)
    >>> observation, reward, terminated, truncated, info = env.step([-1.0])
    >>> reward, terminated, truncated
    (0.0, False, False)

    """

    _spec: EnvSpec | None = None
    metadata: dict[str, Any] = dict(CLASS_METADATA)  # noqa: RUF012  # as Gymnasium declares it

    def __init__(
        self,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str | int] | None = None,
        reward: Reward = "harm",
        observation: Observation | None = None,
    ) -> None:
        self.engine = make_engine(scenario, 1, learners=learners, reward=reward, observation=observation)
        self.render_mode, self.viewer = render_mode, Viewer(self.engine, render_mode)
        self.metadata = {**self.metadata, **render_metadata(self.engine)}
        self.learner = only_learner(self.engine)
        self._column = np.array([self.learner])
        self._name = self.engine.scenario.vehicle_names[self.learner]
        self.observation_space = feature_box(self.engine.observation.features)
        self.action_space = action_box()
        self._running = self._started = False

    @property
    def spec(self) -> EnvSpec | None:
        """How it was made, in plain settings; None where no id was used."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = plain_spec(spec)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; see ``envs.setup``."""
        check_seed(seed)
        if seed is None and self._np_random_seed is None:
            seed = fresh_seed()  # kept by Gymnasium: reset(seed=env.np_random_seed) repeats it
        restart(self.engine, seed, options)
        super().reset(seed=seed)
        self._running = self._started = True
        self.viewer.began()
        return self._observe(), plain_infos(report(self.engine), self._column)[0]

    def step(self, action: NDArray[Any]) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Advance by one time step."""
        if not self._running:
            raise InvalidInput("step: no episode is running; call reset first")
        step = self.engine.step(learner_columns((self._name,), {self._name: action}))
        self._running = not step.ended[0]
        if self.render_mode is not None:
            self.viewer.play()
        info = plain_infos(report(self.engine, step), self._column)[0]
        reward = float(step.reward[0, self.learner])
        return self._observe(), reward, bool(step.terminated[0]), bool(step.truncated[0]), info

    def describe_world(self) -> dict[str, Any]:
        """What the running world was drawn as: flat numbers and texts by name; see ``envs.drawn``."""
        if not self._started:
            raise InvalidInput("describe_world: no episode was started; call reset first")
        return describe_world(self.engine)

    def render(self) -> Any:
        """What the render mode says: a frame [H, W, 3] uint8, a list of new ones, a text, or None for ``human``."""
        return self.viewer.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self.viewer.close()

    def _observe(self) -> Observations:
        observation: Observations = self.engine.observe(self.learner)[0].copy()
        return observation
