"""Gymnasium's interface: one learner, one world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ethbrake_marl.engine import Step
from ethbrake_marl.envs.common import (
    AnyScenario,
    action_box,
    batch_info,
    check_seed,
    describe_world,
    describe_worlds,
    feature_box,
    fresh_seed,
    learner_actions,
    make_engine,
    only_learner,
    plain_infos,
    plain_spec,
    report,
    restart,
)
from ethbrake_marl.envs.drawing import Viewer
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import Observation, Observations
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.rewards import Reward


class EthBrakeEnv(gymnasium.Env[Observations, NDArray[Any]]):
    """One learner brakes in a line of vehicles that follow their scripts: ``gymnasium.make("EthBrake-v0")``.

    Observation: float32 [F], the features of ``ObservationSpec``. Action: [1] in [-1, 1]; -1 full braking capacity, 0
    coasts, +1 full driving capacity. Terminated: all at rest and no command that would move one. Truncated: the
    horizon. Infos: see ``envs.common``. ``reset(seed=s)`` starts the stream of worlds of s, ``reset()`` goes on in it;
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
    metadata: dict[str, Any] = dict(Viewer.METADATA)  # noqa: RUF012  # as Gymnasium declares it

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
        self.metadata = {**self.metadata, **self.viewer.metadata}
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
        """Start an episode; see ``envs.common``."""
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
        step = self.engine.step(learner_actions(self.engine, {self._name: action}))
        self._running = not step.ended[0]
        if self.render_mode is not None:
            self.viewer.play()
        info = plain_infos(report(self.engine, step), self._column)[0]
        reward = float(step.reward[0, self.learner])
        return self._observe(), reward, bool(step.terminated[0]), bool(step.truncated[0]), info

    def describe_world(self) -> dict[str, Any]:
        """What the running world was drawn as: flat numbers and texts by name; see ``envs.common``."""
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


# Gymnasium's vector interface: one learner, many worlds, advanced together.

_MODES = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)


class EthBrakeVectorEnv(VectorEnv[Observations, NDArray[Any], NDArray[Any]]):
    """Many worlds of ``EthBrakeEnv``: ``gymnasium.make_vec("EthBrake-v0", num_envs=4096, scenario=...)``.

    All worlds take their episodes from one stream: row k of ``reset(seed=s)`` is world k of s, and each new episode is
    the next world of it. Every array that is returned has its own memory.

    Args:
        num_envs: worlds that are advanced together, at least 1.
        scenario: a shipped name, the path of a YAML file, or a ``Scenario``.
        render_mode: ``rgb_array``, ``ansi``, or None; ``render`` gives one frame or text for each world.
        learners: the one vehicle that learns instead of the scenario's, by name (``vehicle_2``) or index from 0.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: what the learner observes; None: ``observation_for(scenario)``.
        autoreset_mode: Gymnasium's. ``NextStep``, its default and ours, returns the last observation and spends the
            next step, whose action is ignored and whose reward is 0, on the reset. ``SameStep`` returns the first
            observation of the new episode, with the last one of the old in ``infos["final_obs"]`` and its infos in
            ``infos["final_info"]``.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> env = eb.EthBrakeVectorEnv(num_envs=4, scenario="paper-random")
    >>> observations, infos = env.reset(seed=7)
    >>> observations, rewards, terminated, truncated, infos = env.step(np.full((4, 1), -1.0))
    >>> observations.shape, rewards.shape
    ((4, 27), (4,))

    """

    def __init__(
        self,
        num_envs: int = 1,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str | int] | None = None,
        reward: Reward = "harm",
        observation: Observation | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.autoreset_mode = _check_mode(autoreset_mode)
        self.engine = make_engine(scenario, num_envs, learners=learners, reward=reward, observation=observation)
        self.render_mode, self.viewer = render_mode, Viewer(self.engine, render_mode, batch=True)
        self.metadata = {"autoreset_mode": self.autoreset_mode, **self.viewer.metadata}
        self.learner = only_learner(self.engine)
        self.num_envs = num_envs
        self.single_observation_space = feature_box(self.engine.observation.features)
        self.single_action_space = action_box()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._started = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in every world; see ``envs.common``."""
        check_seed(seed)
        if seed is None and self._np_random_seed is None:
            seed = fresh_seed()  # kept by Gymnasium: reset(seed=env.np_random_seed) repeats it
        restart(self.engine, seed, options)
        super().reset(seed=seed)
        self._started = True
        every = np.ones(self.num_envs, np.bool_)
        return self.engine.observe(self.learner), batch_info(report(self.engine), self.learner, every, ~every)

    def step(self, actions: NDArray[Any]) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step, and start new episodes as the autoreset mode says."""
        if not self._started:
            raise InvalidInput("step: no episode is running; call reset first")
        engine, before = self.engine, self.engine.ended
        step = engine.step(self._fill_ignored(actions, before))
        # all that have ended: an interrupted step may have left some that nobody renewed
        renewed = engine.ended if self.autoreset_mode is AutoresetMode.SAME_STEP else before
        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and renewed.any():
            infos = self._final_infos(step)
        engine.renew(np.flatnonzero(renewed))
        every = np.ones(self.num_envs, np.bool_)
        infos |= batch_info(report(engine, step), self.learner, every, ~renewed)
        reward = step.reward[:, self.learner].copy()
        return engine.observe(self.learner), reward, step.terminated, step.truncated, infos

    def describe_worlds(self) -> dict[str, NDArray[Any]]:
        """What each running world was drawn as: columns by name, each [worlds]; see ``envs.common``."""
        if not self._started:
            raise InvalidInput("describe_worlds: no episode was started; call reset first")
        return describe_worlds(self.engine)

    def render(self) -> tuple[Any, ...]:
        """A frame [H, W, 3] uint8, or a text, of every world; of a world that has just been renewed, its start."""
        return tuple(self.viewer.render())

    def _fill_ignored(self, actions: NDArray[Any], before: Bools) -> NDArray[Any]:
        """The actions with those that the autoreset mode ignores replaced: their worlds had ended ``before``."""
        ignoring = self.autoreset_mode is AutoresetMode.NEXT_STEP and before.any()
        if not ignoring or np.shape(actions)[:1] != (self.num_envs,):
            return actions
        heeded = np.array(actions)
        heeded[before] = 0.0
        return heeded

    def _final_infos(self, step: Step) -> dict[str, Any]:
        """The last observation and infos of the episodes that ended with this step."""
        ended = step.ended
        observations = self.engine.observe(self.learner)
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended):
            final[row] = observations[row].copy()
        info = batch_info(report(self.engine, step), self.learner, ended, ended)
        return {"final_obs": final, "_final_obs": ended, "final_info": info, "_final_info": ended.copy()}


def _check_mode(mode: str | AutoresetMode) -> AutoresetMode:
    if isinstance(mode, AutoresetMode) and mode in _MODES:
        return mode
    for known in _MODES:
        if mode == known.value:
            return known
    raise InvalidInput(f"autoreset_mode = {mode!r}: must be {' or '.join(repr(m.value) for m in _MODES)}")
