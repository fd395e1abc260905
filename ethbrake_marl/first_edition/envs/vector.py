"""Vector environment for Gymnasium: many worlds, each with one learner, which are simulated together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.first_edition.engine.compiled_step import Step
from ethbrake_marl.first_edition.envs.gymnasium import EthBrakeEnv, Specified
from ethbrake_marl.first_edition.envs.infos import Begun, Report
from ethbrake_marl.first_edition.envs.making import (
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
from ethbrake_marl.first_edition.envs.viewer import Viewer
from ethbrake_marl.first_edition.game.actions import checked_action, own_actions
from ethbrake_marl.first_edition.game.observations import Observation, Observations
from ethbrake_marl.first_edition.game.reward_vector import RewardVector
from ethbrake_marl.first_edition.game.rewards import Reward
from ethbrake_marl.first_edition.physics.state import Bools, Floats


class CostEnv(gymnasium.Wrapper[Observations, NDArray[Any], Observations, NDArray[Any]]):
    """Wrapper whose ``step`` also returns a cost, as Safety-Gymnasium does, for example for OmniSafe.

    The cost is the harm (m2/s2) that the step added to the whole line: first-impact or total harm, whichever the reward
    uses.

    Args:
        env: an ``EthBrakeEnv``, or wrappers that pass on the infos of an ``EthBrakeEnv`` inside.

    Raises ``InvalidInput`` if ``env`` is neither an ``EthBrakeEnv`` nor a wrapper around one, or if ``env`` already
    contains a ``CostEnv``.

    >>> import ethbrake_marl.first_edition as eb
    >>> env = eb.CostEnv(eb.EthBrakeEnv("paper-random"))
    >>> observation, info = env.reset(seed=7)
    >>> observation, reward, cost, terminated, truncated, info = env.step(env.action_space.sample())

    """

    def __init__(self, env: gymnasium.Env[Observations, NDArray[Any]]) -> None:
        if not isinstance(getattr(env, "unwrapped", None), EthBrakeEnv):
            raise InvalidInput(f"CostEnv: env = {env!r:.80}: must be an EthBrakeEnv, or a wrapper around one")
        within = env
        while isinstance(within, gymnasium.Wrapper):
            if isinstance(within, CostEnv):
                raise InvalidInput(f"CostEnv: {env!r:.80} already contains a CostEnv; use only one")
            within = within.env
        super().__init__(env)

    def step(  # type: ignore[override]  # six values, as safe-RL libraries have it
        self, action: NDArray[Any]
    ) -> tuple[Observations, float, float, bool, bool, dict[str, Any]]:
        """Advance by one time step with an ``action`` [1] in [-1, 1].

        Returns observation, reward, cost, terminated, truncated and info.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if isinstance(reward, np.ndarray) and reward.ndim:
            raise InvalidInput(
                "CostEnv: the reward of the environment is a vector, but must be a number; wrap the environment in"
                " mo_gymnasium's LinearReward first"
            )
        if "cost" not in info:
            raise InvalidInput(
                f"CostEnv: the wrapper {self.env!r:.80} does not pass on info['cost']; put CostEnv inside this wrapper"
            )
        return observation, float(reward), info["cost"], terminated, truncated, info


class EthBrakeVectorEnv(Begun, Specified, VectorEnv[Observations, NDArray[Any], NDArray[Any]]):
    """Environment with many worlds, each as in ``EthBrakeEnv`` (``gymnasium.make_vec("EthBrake-v1", num_envs=4096)``).

    All arrays have one row per world. After ``reset(seed=s)``, row k is world k of seed s. Each later episode, in any
    row, takes the next world of seed s. Later steps do not change the arrays that a step has returned.

    Args:
        num_envs: number of worlds that are simulated together, at least 1.
        scenario: name of a shipped scenario, path of a YAML file, or a ``Scenario``.
        render_mode: ``rgb_array``: ``render`` returns one frame for each world; ``ansi``: one text for each world;
            None: no pictures.
        learners: a list with the one vehicle that learns, by name (``vehicle_2``) or index (0 = front); None: the
            learner of the scenario.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping with settings, or a ``RewardParams`` object.
        observation: features that the learner observes; None: the features that the scenario declares or, if it
            declares none, default features (``observation_for``).
        autoreset_mode: Gymnasium's autoreset mode: what happens in a row whose episode ends. ``NextStep`` (default):
            the step that ends an episode returns the last observation of this episode. The next step ignores the row's
            action, starts a new episode in the row, and returns the reward 0 for the row. ``SameStep``: the step that
            ends an episode also starts the next episode and returns its first observation; ``infos["final_obs"]`` and
            ``infos["final_info"]`` contain the last observation and infos of the old episode. ``Disabled``: no new
            episode starts; the caller must reset the row before the next step.
        max_episode_steps: number of steps after which an episode is truncated; None: at the horizon only.
        actions: None: an action is a number in [-1, 1]. A whole number K >= 2: actions are discrete; the indices
            0 to K - 1 stand for K evenly spaced numbers from -1 (full braking capacity) to 1 (full driving capacity).
        reward_vector: None: rewards are numbers, [n]. ``vehicles``: rewards are [n, N] and contain minus the harm that
            each vehicle bears in the step. A list of K components: rewards are [n, K] (see docs/environments.md).

    >>> import ethbrake_marl.first_edition as eb
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
        if self.engine.components:  # attributes of MO-Gymnasium
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
        """Start an episode in every world, and return observations [n, F] and infos.

        Args:
            seed: start the first n worlds of this seed; None: continue with the next n worlds of the current seed.
            options: to choose the worlds, the key ``initial_state`` or ``listed_world``; to reset only some rows, the
                key ``reset_mask`` with an array [n] that is true for these rows (see docs/environments.md).

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

        Returns observations [n, F], rewards [n], terminated [n], truncated [n], and infos in the format of Gymnasium's
        vector environments. ``autoreset_mode`` determines when a new episode starts after the end of an episode.
        """
        if not self._started:
            raise InvalidInput("step: no episode is running; call reset first")
        engine, before = self.engine, self.engine.ended
        if self.autoreset_mode is AutoresetMode.DISABLED and before.any():
            over = ", ".join(str(row) for row in np.flatnonzero(before))
            raise InvalidInput(
                f"step: the episodes in rows {over} have ended; first reset these rows with"
                " reset(options={'reset_mask': ...})"
            )
        actions = self._fill_ignored(actions, before)
        if self.actions is not None:
            actions = checked_action(actions, (self.num_envs, 1), "the learners", self.actions)
        step = engine.step(actions)
        if self.max_episode_steps is not None:
            engine.cut(step, self.max_episode_steps)
        # includes worlds that a step which was interrupted did not renew
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
        """Return a tuple with a picture of every world: a frame [H, W, 3] uint8, or a text.

        If a new episode has just started in a world, its picture shows the beginning of the new episode.
        """
        return tuple(self.viewer.render())

    def _fill_ignored(self, actions: NDArray[Any], before: Bools) -> NDArray[Any]:
        """Return ``actions`` with the action 0 in each world whose action is ignored.

        In the autoreset mode ``NextStep`` these are the worlds whose episode had ended before the step, for which
        ``before`` [n] is true.
        """
        if self.autoreset_mode is not AutoresetMode.NEXT_STEP or not before.any():
            return actions
        heeded = own_actions(actions, "the learners", self.actions)
        if heeded.shape[:1] == (self.num_envs,):
            heeded[before] = 0
        return heeded

    def _rows_to_reset(self, options: Any) -> Bools:
        """Return ``options["reset_mask"]``, the mask [n] of the rows to reset; without this key, a mask of all rows.

        Raises ``InvalidInput`` if the mask is not a bool array [n], or has no True.
        """
        if not isinstance(options, Mapping) or RESET_MASK not in options:
            return np.ones(self.num_envs, np.bool_)
        mask = options[RESET_MASK]
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        if not is_mask or np.ma.is_masked(mask) or not mask.any():
            raise InvalidInput(
                f"reset: {RESET_MASK} = {mask!r}: must be a bool array of shape ({self.num_envs},) with at least one"
                " True"
            )
        return np.array(mask)

    def _renew(self, rows: Bools, seed: int | None, options: Mapping[str, Any]) -> None:
        """Start new episodes in the rows for which the mask ``rows`` [n] is true; all other episodes continue.

        Raises ``InvalidInput`` for the first reset, or if ``seed``, an option or a new ``np_random`` chooses the
        worlds, because such a reset must include all rows.
        """
        warn_of_unknown(options, self._known_options)
        starts = [name for name in (INITIAL_STATE, LISTED_WORLD) if name in options]
        starts += ["seed"] * (seed is not None)
        if starts or not self._goes_on:
            what = " and ".join(starts) or ("np_random" if self._started else "the first reset")
            raise InvalidInput(
                f"reset: {RESET_MASK} omits some rows, but {what} requires a reset of all rows; remove {RESET_MASK}"
            )
        self.engine.renew(np.flatnonzero(rows))

    def _final_infos(self, step: Step) -> dict[str, Any]:
        """Return the infos ``final_obs`` and ``final_info`` of the episodes that ended in this step, with masks."""
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
