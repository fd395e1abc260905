"""Gymnasium: many worlds with one learner each, simulated together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ethbrake_marl.episode.infos import arrays
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import ENDED
from ethbrake_marl.episode.step import TRUNCATED, Step
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.faces.actions import action_space, checked_actions
from ethbrake_marl.faces.gymnasium import OneLearner
from ethbrake_marl.faces.rendering import make_renderer, render_metadata
from ethbrake_marl.faces.spaces import FeatureBox
from ethbrake_marl.motion.layout import Bools, Floats
from ethbrake_marl.worlds.game import AnyScenario

OPTIONS = ("initial_state", "listed_world", "reset_mask")


class EthBrakeVectorEnv(OneLearner, VectorEnv[Observations, Any, Any]):
    """Many worlds, each as in ``EthBrakeEnv`` (``gymnasium.make_vec("EthBrake-v1", num_envs=4096)``).

    Row k begins with world k of the seed; every later episode, in any row, takes the next world.

    Args:
        num_envs: number of worlds.
        scenario: as in ``EthBrakeParallelEnv``; so are ``learners``, ``reward``, ``observation``, ``actions`` and
            ``reward_vector``.
        render_mode: a mode of ``metadata["render_modes"]``; ``render`` returns one picture per world.
        autoreset_mode: Gymnasium's: ``NextStep`` (the step after an episode's last one starts the next episode, ignores
            the action and rewards 0), ``SameStep``, or ``Disabled``.
        max_episode_steps: number of steps after which an episode is truncated; None: the horizon alone.

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
        learners: Sequence[str] | None = None,
        reward: Any = "harm",
        observation: Any = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        actions: int | None = None,
        reward_vector: Any = None,
    ) -> None:
        check_whole_number("num_envs", num_envs, 1)
        if max_episode_steps is not None:
            check_whole_number("max_episode_steps", max_episode_steps, 1)
        self.max_episode_steps, self.num_envs, self.actions = max_episode_steps, int(num_envs), actions
        self.autoreset_mode = _mode(autoreset_mode)
        self._open(scenario, learners, reward, observation, reward_vector)
        self.single_observation_space = FeatureBox(self.game.views[self.body].features)
        self.single_action_space = action_space(actions)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.render_mode, self.renderer = render_mode, make_renderer(self, render_mode)
        self.metadata = {**render_metadata(), "autoreset_mode": self.autoreset_mode}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Any]:
        """Start episodes in all rows, or in those of ``options["reset_mask"]``, a bool array [n]."""
        rows = self._rows_to_reset(options)
        if rows.all():
            self.episode = self._restart(self.num_envs, seed, options, OPTIONS)
            goes_on = seed is None and self._np_random is not None
            super().reset(seed=None if goes_on else self.stream.seed)
        else:
            asked = [name for name in OPTIONS[:2] if name in (options or {})] + ["seed"] * (seed is not None)
            if asked or not hasattr(self, "episode"):
                raise InvalidInput(
                    f"reset: reset_mask omits some rows, but {' and '.join(asked) or 'the first reset'} requires a"
                    " reset of all rows; remove reset_mask"
                )
            self._renew(rows)
        if self.renderer is not None:
            self.renderer.began(self.episode)
        return self._observe(), self._infos(None, rows, np.zeros(self.num_envs, np.bool_))

    def step(self, actions: Any) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step with ``actions`` [n, 1]."""
        if not hasattr(self, "episode"):
            raise InvalidInput("step: no episode is running; call reset first")
        before = self.episode.ended
        if self.autoreset_mode is AutoresetMode.DISABLED and before.any():
            over = ", ".join(str(row) for row in np.flatnonzero(before))
            raise InvalidInput(
                f"step: the episodes in rows {over} have ended; first reset these rows with"
                " reset(options={'reset_mask': ...})"
            )
        numbers = checked_actions(self._heeded(actions, before), (self.num_envs, 1), "the learners", self.actions)
        self.episode, step = self.game.step(self.episode, numbers, donate=True)
        if self.max_episode_steps is not None:
            self._cut(step, self.max_episode_steps)
        renewed, infos = before, dict[str, Any]()
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            renewed = self.episode.ended
            if renewed.any():
                infos = self._final_infos(step, renewed)
        terminated, truncated, row = step.terminated, step.truncated, self.body - 1
        reward = (step.reward if step.vector is None else step.vector)[:, row].copy()
        every = np.ones(self.num_envs, np.bool_)
        if renewed.any():
            self._renew(renewed)
        if self.renderer is not None:
            self.renderer.stepped(self.episode)
        return self._observe(), reward, terminated, truncated, infos | self._infos(step, every, ~renewed)

    def describe_worlds(self) -> dict[str, Any]:
        """Return what was drawn for each running world: a name such as ``gap_1_m`` or ``scenario`` -> [n]."""
        if not hasattr(self, "episode"):
            raise InvalidInput("describe_worlds: no episode has started; call reset first")
        return self.stream.describe(self.episode)

    def render(self) -> Any:
        """Return a tuple with a picture of every world."""
        return None if self.renderer is None else tuple(self.renderer.render())

    def close_extras(self, **kwargs: Any) -> None:
        """Give back what the render mode holds."""
        if self.renderer is not None:
            self.renderer.close()

    def _renew(self, rows: Bools) -> None:
        self.episode = self.episode.put(rows, self.stream.draw(int(rows.sum())), donate=True)

    def _cut(self, step: Step, most: int) -> None:
        """Truncate the episodes that have taken ``most`` steps, ended or not, like Gymnasium's ``TimeLimit``."""
        rows = (self.episode.steps >= most) & (step.terminated | ~self.episode.ended)
        self.episode.clock[rows, ENDED] = 1.0
        step.out[TRUNCATED, rows] = 1.0

    def _heeded(self, actions: Any, before: Bools) -> Any:
        """Return the actions, with 0 in rows whose action is ignored."""
        if self.autoreset_mode is not AutoresetMode.NEXT_STEP or not before.any():
            return actions
        heeded = np.array(actions)
        if heeded.shape[:1] == (self.num_envs,):
            heeded[before] = 0
        return heeded

    def _rows_to_reset(self, options: Any) -> Bools:
        if not isinstance(options, dict) or "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_)
        mask = options["reset_mask"]
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == (self.num_envs,)
        if not is_mask or np.ma.is_masked(mask) or not mask.any():
            raise InvalidInput(
                f"reset: reset_mask = {mask!r}: must be a bool array of shape ({self.num_envs},) with at least one True"
            )
        chosen: Bools = mask.copy()
        return chosen

    def _observe(self) -> Observations:
        seen: Observations = self.game.observe_alike(self.episode, [self.body])[:, 0]
        return seen

    def _infos(self, step: Step | None, rows: Bools, stepped: Bools) -> dict[str, Any]:
        """Return infos as Gymnasium's vector environments have them: values, and a mask of the rows that have one.

        The cost and the terms of rows that have not ``stepped`` are 0: the last step belongs to another episode.
        """
        infos: dict[str, Any] = {}
        for name, column in arrays(self.game, self.episode, step, self.stream.seed or 0, self.body).items():
            of_step = name == "cost" or name.startswith("reward_")
            told = rows & stepped if of_step else rows
            infos[name] = column.copy() if told.all() else np.where(told, column, np.zeros((), column.dtype))
            infos[f"_{name}"] = rows.copy()
        return infos

    def _final_infos(self, step: Step, ended: Bools) -> dict[str, Any]:
        observations, final = self._observe(), np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended):
            final[row] = observations[row].copy()
        info = self._infos(step, ended, ended)
        return {"final_obs": final, "_final_obs": ended, "final_info": info, "_final_info": ended.copy()}


def _mode(mode: str | AutoresetMode) -> AutoresetMode:
    for known in AutoresetMode:
        if mode in (known, known.value):
            return known
    raise InvalidInput(f"autoreset_mode = {mode!r}: must be {' or '.join(repr(m.value) for m in AutoresetMode)}")
