"""Gymnasium's vector interface: one learner in each of many worlds, which are advanced together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ethbrake_marl.engine.compiled_step import Step
from ethbrake_marl.envs.gymnasium import EthBrakeEnv, Specified
from ethbrake_marl.envs.infos import Begun, Report
from ethbrake_marl.envs.making import (
    INITIAL_STATE,
    LISTED_WORLD,
    RESET_MASK,
    AnyScenario,
    feature_box,
    learner_action_space,
    make_engine,
    only_learner,
    reward_box,
    warn_of_unknown,
)
from ethbrake_marl.envs.viewer import Viewer
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.game.actions import checked_action, own_actions
from ethbrake_marl.game.observations import Observation, Observations
from ethbrake_marl.game.reward_vector import RewardVector
from ethbrake_marl.game.rewards import Reward
from ethbrake_marl.physics.state import Bools, Floats


class CostEnv(gymnasium.Wrapper[Observations, NDArray[Any], Observations, NDArray[Any]]):
    """Wrapper with a separate cost: ``step`` returns observation, reward, cost, terminated, truncated, info.

    This is the format of Safety-Gymnasium, which OmniSafe expects. The cost is the harm that the step added to the line
    (m2/s2). It counts first impacts only, or all impacts, as the reward does; other terms of the reward do not enter.

    Args:
        env: ``EthBrakeEnv``, or a wrapper of one that passes its infos on.

    Raises ``InvalidInput`` for another environment, or one with a ``CostEnv`` inside.

    >>> import ethbrake_marl as eb
    >>> env = eb.CostEnv(eb.EthBrakeEnv("paper-random"))
    >>> observation, info = env.reset(seed=7)
    >>> observation, reward, cost, terminated, truncated, info = env.step(env.action_space.sample())

    """

    def __init__(self, env: gymnasium.Env[Observations, NDArray[Any]]) -> None:
        if not isinstance(getattr(env, "unwrapped", None), EthBrakeEnv):
            raise InvalidInput(f"CostEnv: {env!r:.80} reports no cost; must be an EthBrakeEnv, or a wrapper of one")
        within = env
        while isinstance(within, gymnasium.Wrapper):
            if isinstance(within, CostEnv):
                raise InvalidInput(f"CostEnv: {env!r:.80} already contains a CostEnv; use only one")
            within = within.env
        super().__init__(env)

    def step(  # type: ignore[override]  # six values, as safe-RL libraries have it
        self, action: NDArray[Any]
    ) -> tuple[Observations, float, float, bool, bool, dict[str, Any]]:
        """Advance by one time step; return observation, reward, cost, terminated, truncated and info.

        ``action`` is [1] in [-1, 1]. The cost is the harm that the step added to the line (m2/s2).
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if isinstance(reward, np.ndarray) and reward.ndim:
            raise InvalidInput(
                "CostEnv: needs a reward that is a number; mo_gymnasium's LinearReward makes one of a vector"
            )
        if "cost" not in info:
            raise InvalidInput(f"CostEnv: {self.env!r:.80} hands on no info['cost']; put CostEnv inside it")
        return observation, float(reward), info["cost"], terminated, truncated, info


class EthBrakeVectorEnv(Begun, Specified, VectorEnv[Observations, NDArray[Any], NDArray[Any]]):
    """Many worlds of ``EthBrakeEnv``: ``gymnasium.make_vec("EthBrake-v0", num_envs=4096, scenario=...)``.

    All worlds take their episodes from one stream: row k of ``reset(seed=s)`` is world k of seed s, and each new
    episode is the next world of that stream. All returned arrays are new.

    Args:
        num_envs: number of worlds that are advanced together, at least 1.
        scenario: a shipped name, the path of a YAML file, or a ``Scenario``.
        render_mode: ``rgb_array``, ``ansi``, or None; ``render`` returns one frame or text for each world.
        learners: the one vehicle that learns instead of the scenario's, by name (``vehicle_2``) or index from 0.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: what the learner observes; None: ``observation_for(scenario)``.
        autoreset_mode: Gymnasium's autoreset mode. ``NextStep``, the default, returns the last observation and uses the
            next step for the reset; that step's action is ignored and its reward is 0. ``SameStep`` returns the first
            observation of the new episode, with the old episode's last observation in ``infos["final_obs"]`` and its
            infos in ``infos["final_info"]``. ``Disabled`` never resets: the caller must reset ended rows before the
            next step.
        max_episode_steps: truncates an episode after this many steps; None: only at the horizon.
        actions: None: a learner acts by one number in [-1, 1]. A whole number K, at least 2: by an index of K evenly
            spaced numbers, from 0 (full braking capacity) to K - 1 (full driving capacity).
        reward_vector: None: rewards are [n]. ``vehicles``: they are [n, K], minus the harm of the step that each
            vehicle bears; a list: with these components (docs/environments.md).

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> env = eb.EthBrakeVectorEnv(num_envs=4, scenario="paper-random")
    >>> observations, infos = env.reset(seed=7)
    >>> observations, rewards, terminated, truncated, infos = env.step(np.full((4, 1), -1.0))
    >>> observations.shape, rewards.shape
    ((4, 27), (4,))

    """

    _known_options = (INITIAL_STATE, LISTED_WORLD, RESET_MASK)

    def __init__(
        self,
        num_envs: int = 1,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str | int] | None = None,
        reward: Reward = "harm",
        observation: Observation | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        actions: int | None = None,
        reward_vector: RewardVector | None = None,
    ) -> None:
        if max_episode_steps is not None:
            check_whole_number("max_episode_steps", max_episode_steps, 1)
        self.max_episode_steps = max_episode_steps
        self.autoreset_mode = _check_mode(autoreset_mode)
        self.engine = make_engine(
            scenario, num_envs, learners=learners, reward=reward, observation=observation, reward_vector=reward_vector
        )
        if self.engine.components:  # as MO-Gymnasium has it
            self.reward_space = reward_box(self.engine)
            self.reward_dim = len(self.engine.components)
        self.render_mode, self.viewer = render_mode, Viewer(self.engine, render_mode, batch=True)
        self.metadata = {"autoreset_mode": self.autoreset_mode, **self.viewer.metadata}
        self.learner = only_learner(self.engine)
        self.num_envs = num_envs
        self.single_observation_space = feature_box(self.engine.observations[self.learner].features)
        self.single_action_space, self.actions = learner_action_space(actions), actions
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode in every world; return observations [n, F] and infos.

        Args:
            seed: restart the stream of worlds from the first world of this seed; None: continue in the stream.
            options: ``initial_state`` or ``listed_world`` choose the worlds; ``reset_mask`` [n] restricts the reset to
                the worlds that it marks. See docs/environments.md.

        """
        rows = self._rows_to_reset(options)
        if rows.all():
            self._restart(seed, options)
        else:
            self._renew(rows, seed, options or {})
        info = Report.of(self.engine).batch_info(self.learner, rows, np.zeros(self.num_envs, np.bool_))
        return self.engine.observe(self.learner), info

    def step(self, actions: NDArray[Any]) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step with the actions [n, 1] in [-1, 1].

        Ended worlds start new episodes according to the autoreset mode. Returns observations [n, F], rewards,
        terminated, truncated (each [n]) and infos in Gymnasium's vector format.
        """
        if not self._started:
            raise InvalidInput("step: no episode is running; call reset first")
        engine, before = self.engine, self.engine.ended
        if self.autoreset_mode is AutoresetMode.DISABLED and before.any():
            over = ", ".join(str(row) for row in np.flatnonzero(before))
            raise InvalidInput(
                f"step: episodes are over in rows {over}; reset(options={{'reset_mask': ...}}) them first"
            )
        actions = self._fill_ignored(actions, before)
        if self.actions is not None:
            actions = checked_action(actions, (self.num_envs, 1), "the learners", self.actions)
        step = engine.step(actions)
        if self.max_episode_steps is not None:
            engine.cut(step, self.max_episode_steps)
        # includes worlds that an interrupted step left without renewal
        renewed = engine.ended if self.autoreset_mode is AutoresetMode.SAME_STEP else before
        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and renewed.any():
            infos = self._final_infos(step)
        engine.renew(np.flatnonzero(renewed))
        every = np.ones(self.num_envs, np.bool_)
        infos |= Report.of(engine, step).batch_info(self.learner, every, ~renewed)
        reward = (step.reward if step.vector is None else step.vector)[:, self.learner].copy()
        return engine.observe(self.learner), reward, step.terminated, step.truncated, infos

    def render(self) -> tuple[Any, ...]:
        """Return a tuple with the picture of every world: a frame [H, W, 3] uint8, or a text.

        A world whose episode has just been renewed shows the start of the new one.
        """
        return tuple(self.viewer.render())

    def _fill_ignored(self, actions: NDArray[Any], before: Bools) -> NDArray[Any]:
        """Return the actions with 0 for the worlds whose actions are ignored.

        In mode ``NextStep`` these are the worlds whose episodes had ended ``before`` [n] the step.
        """
        if self.autoreset_mode is not AutoresetMode.NEXT_STEP or not before.any():
            return actions
        heeded = own_actions(actions, "the learners", self.actions)
        if heeded.shape[:1] == (self.num_envs,):
            heeded[before] = 0
        return heeded

    def _rows_to_reset(self, options: Any) -> Bools:
        """Return the rows [n] that ``options["reset_mask"]`` marks, or all rows without a mask.

        Raises ``InvalidInput`` for an invalid mask.
        """
        if not isinstance(options, Mapping) or RESET_MASK not in options:
            return np.ones(self.num_envs, np.bool_)
        mask = options[RESET_MASK]
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        if not is_mask or np.ma.is_masked(mask) or not mask.any():
            raise InvalidInput(
                f"reset: {RESET_MASK} = {mask!r}: must be an array of {self.num_envs} truth values, one of them True"
            )
        return np.array(mask)

    def _renew(self, rows: Bools, seed: int | None, options: Mapping[str, Any]) -> None:
        """Start the next episodes of the stream in the worlds that ``rows`` [n] marks; the other worlds continue.

        Raises ``InvalidInput`` for a ``seed`` or an option that would choose the worlds, because these apply to all
        rows.
        """
        warn_of_unknown(options, self._known_options)
        starts = [name for name in (INITIAL_STATE, LISTED_WORLD) if name in options]
        starts += ["seed"] * (seed is not None)
        if starts or not self._goes_on:
            what = " and ".join(starts) or ("np_random" if self._started else "the first reset")
            raise InvalidInput(f"reset: {what} with a {RESET_MASK} that leaves rows out: must start all rows")
        self.engine.renew(np.flatnonzero(rows))

    def _final_infos(self, step: Step) -> dict[str, Any]:
        """Return the infos ``final_obs`` and ``final_info``, with masks, of the episodes that ended with this step."""
        ended = step.ended
        observations = self.engine.observe(self.learner)
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended):
            final[row] = observations[row].copy()
        info = Report.of(self.engine, step).batch_info(self.learner, ended, ended)
        return {"final_obs": final, "_final_obs": ended, "final_info": info, "_final_info": ended.copy()}


def _check_mode(mode: str | AutoresetMode) -> AutoresetMode:
    for known in AutoresetMode:
        if mode in (known, known.value):
            return known
    raise InvalidInput(f"autoreset_mode = {mode!r}: must be {' or '.join(repr(m.value) for m in AutoresetMode)}")
