"""Gymnasium: many worlds with one learner each, simulated together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ethbrake_marl.episode.infos import arrays
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import State, put_rows
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.faces.gymnasium import OneLearner
from ethbrake_marl.faces.rendering import render_metadata
from ethbrake_marl.faces.spaces import checked_actions
from ethbrake_marl.faces.stream import Stream
from ethbrake_marl.motion.layout import Bools, Floats
from ethbrake_marl.worlds.game import AnyScenario


class EthBrakeVectorEnv(OneLearner, VectorEnv[Observations, Any, Any]):
    """Many worlds, each as in ``EthBrakeEnv`` (``gymnasium.make_vec("EthBrake-v2", num_envs=4096)``).

    Row k begins with world k of the seed; every later episode, in any row, takes the next world.

    Args:
        num_envs: number of worlds.
        scenario: as in ``EthBrakeParallelEnv``; so are ``learners``, ``reward``, ``observation``, ``actions``,
            ``reward_vector`` and ``report``.
        render_mode: a mode of ``metadata["render_modes"]``; ``render`` returns one picture per world.
        autoreset_mode: Gymnasium's ``NextStep`` (the step after the last one of an episode starts the next episode,
            ignores the action and has reward 0) or ``SameStep``.
        max_episode_steps: as ``max_cycles`` in ``EthBrakeParallelEnv``.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> env = eb.EthBrakeVectorEnv(num_envs=4, scenario="paper-random")
    >>> observations, infos = env.reset(seed=7)
    >>> observations, rewards, terminated, truncated, infos = env.step(np.full((4, 1), -1.0))
    >>> observations.shape, rewards.shape
    ((4, 27), (4,))

    """

    begins_again = True

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
        report: Sequence[str] = (),
    ) -> None:
        check_whole_number("num_envs", num_envs, 1)
        if autoreset_mode not in ("NextStep", "SameStep", AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
            raise InvalidInput(f"autoreset_mode = {autoreset_mode!r}: must be 'NextStep' or 'SameStep'")
        self.num_envs, self.autoreset_mode = int(num_envs), AutoresetMode(autoreset_mode)
        self.metadata = {**render_metadata(many=True), "autoreset_mode": self.autoreset_mode}
        game = scenario, learners, reward, observation, reward_vector, report
        spaces = self._open_one(game, render_mode, actions, max_episode_steps)
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space, self.action_space = (batch_space(space, self.num_envs) for space in spaces)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Observations, Any]:
        """Start an episode in every world.

        With an int, row k begins with world k of the seed. With a list of seeds, row k has the episodes of
        ``EthBrakeEnv`` with the k-th seed. Options: ``initial_state`` is the same world in every row; with
        ``{"listed_world": {"seed": 7, "number": 3}}`` row k has world 3 + k of the list.
        """
        stream, state = self.stream.reset(self.num_envs, seed, options)
        answer = self._observe(state), with_masks(self._columns(stream, state, None), np.ones(self.num_envs, np.bool_))
        self._keep(stream, state, self.renderer.began)
        super().reset(seed=None if seed is None else int(np.ravel(stream.seed)[0]))
        return answer

    def step(self, actions: Any) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step with ``actions`` [n, 1]."""
        same, before = self.autoreset_mode is AutoresetMode.SAME_STEP, self._running()
        numbers = checked_actions(actions, (self.num_envs, 1), "the learners", self.actions)
        renewed = before.ended
        numbers[renewed] = 0.0  # the action of a row that begins again is ignored
        state, step = self.game.step(before, numbers)
        stream, observations, columns = self.stream, self._observe(state), self._columns(self.stream, state, step)
        infos = with_masks(columns, np.ones(self.num_envs, np.bool_))
        if same and state.ended.any():
            renewed, final = state.ended, np.full(self.num_envs, None, dtype=object)
            for row, last in zip(np.flatnonzero(renewed), observations[renewed], strict=True):
                final[row] = last
            infos |= {"final_obs": final, "_final_obs": renewed}
            infos |= {"final_info": with_masks(columns, renewed), "_final_info": renewed.copy()}
        if renewed.any():
            stream, new = stream.next_episodes(np.flatnonzero(renewed))
            observations[renewed] = self._observe(new)
            fresh = self._columns(stream, new, None, renewed)
            put_rows({name: infos[name] for name in fresh}, renewed, fresh, donate=True)
            state = state.put(renewed, new, donate=self.render_mode is None)
        self._keep(stream, state, self.renderer.stepped)
        return observations, self._rewards(step)[:, 0], step.terminated, step.truncated, infos

    def render(self) -> Any:
        pictures = super().render()
        return None if pictures is None else tuple(pictures)

    def _columns(self, stream: Stream, state: State, step: Step | None, rows: Any = slice(None)) -> dict[str, Any]:
        return arrays(self.game, state, step, stream.seeds_of(state, rows), self.bodies[0])


def with_masks(columns: dict[str, Any], rows: Bools) -> dict[str, Any]:
    """Infos in Gymnasium's vector form: arrays of values, each with the mask ``rows`` [n] of its valid rows."""
    infos: dict[str, Any] = {}
    for name, column in columns.items():
        infos[name] = column.copy() if rows.all() else np.where(rows, column, np.zeros((), column.dtype))
        infos[f"_{name}"] = rows.copy()
    return infos
