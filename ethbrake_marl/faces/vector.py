"""Gymnasium: many worlds with one learner each, simulated together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from ethbrake_marl.agents.action_scale import ActionForm
from ethbrake_marl.episode.infos import arrays
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.faces.gymnasium import OneLearner
from ethbrake_marl.faces.rendering import render_metadata
from ethbrake_marl.faces.spaces import checked_actions
from ethbrake_marl.faces.stream import Stream, exact_array
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.worlds.open_game import AnyScenario


class EthBrakeVectorEnv(OneLearner, VectorEnv[Observations, Any, Any]):
    """Many worlds, each as in ``EthBrakeEnv`` (``gymnasium.make_vec("EthBrake-v3", num_envs=4096)``).

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
        reward: Any = "shaped",
        observation: Any = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        actions: ActionForm = None,
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
        answer = self._observe(state), with_masks(self._columns(stream, state, None))
        self._keep(stream, state, self.renderer.began)
        super().reset(seed=None if seed is None else stream.seed if isinstance(stream.seed, int) else stream.seed[0])
        return answer

    def step(self, actions: Any) -> tuple[Observations, Floats, Bools, Bools, dict[str, Any]]:
        """Advance every world by one time step with ``actions`` [n, 1]."""
        same, before = self.autoreset_mode is AutoresetMode.SAME_STEP, self._running()
        numbers = checked_actions(actions, (self.num_envs, 1), "the learners", self.actions)
        rows = np.flatnonzero(before.ended)
        numbers[rows] = 0.0  # the action of a row that begins again is ignored
        state, step = self.game.step(before, numbers)
        stream, observations, columns = self.stream, self._observe(state), self._columns(self.stream, state, step)
        infos = with_masks(columns)
        if same:
            rows = np.flatnonzero(state.ended)
        if same and len(rows):
            infos |= final_infos(observations, columns, rows)
        if len(rows):
            stream, new = stream.next_episodes(rows)
            observations[rows] = self._observe(new)
            for name, column in self._columns(stream, new, None, rows).items():
                if name == "world_seed":
                    seeds = infos[name].astype(object)
                    seeds[rows] = column
                    infos[name] = exact_array(seeds.tolist())
                else:
                    infos[name][rows] = column
            state = state.put(rows, new, donate=self.render_mode is None)
        self._keep(stream, state, self.renderer.stepped)
        return observations, self._rewards(step)[:, 0], step.terminated, step.truncated, infos

    def render(self) -> Any:
        pictures = super().render()
        return None if pictures is None else tuple(pictures)

    def _columns(self, stream: Stream, state: State, step: Step | None, rows: Any = slice(None)) -> dict[str, Any]:
        return arrays(self.game, state, step, stream.seeds_of(state, rows), self.bodies)


def with_masks(columns: dict[str, Any], rows: Any = slice(None)) -> dict[str, Any]:
    """Infos in Gymnasium's vector form: the arrays ``columns`` [n], each with a mask [n] of its valid ``rows``."""
    infos, masks = {}, np.zeros((len(columns), len(columns["time_s"])), np.bool_)
    masks[:, rows] = True
    for mask, (name, column) in zip(masks, columns.items(), strict=True):
        infos[name], infos[f"_{name}"] = column, mask
    return infos


def final_infos(observations: Observations, columns: dict[str, Any], rows: Ints) -> dict[str, Any]:
    """Last observations and infos of the episodes that ended in ``rows``, in Gymnasium's vector form."""
    final, ended = np.full(len(observations), None, dtype=object), np.zeros(len(observations), np.bool_)
    for row in rows:
        final[row] = observations[row].copy()
    ended[rows] = True
    last = {name: np.where(ended, column, np.zeros((), column.dtype)) for name, column in columns.items()}
    infos = {"final_obs": final, "_final_obs": ended, "final_info": with_masks(last, rows)}
    return infos | {"_final_info": ended.copy()}
