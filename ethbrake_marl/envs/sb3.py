"""Stable-Baselines3's face: a native ``VecEnv`` whose rows are learners. Importing this file imports torch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.utils.env_checker import data_equivalence
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from ethbrake_marl.actions import checked_action
from ethbrake_marl.engine import Engine, Step
from ethbrake_marl.envs.build import make_engine
from ethbrake_marl.envs.infos import row_info, state_table
from ethbrake_marl.envs.restart import INITIAL_STATE, check_seed, fresh_seed, restart_from, warn_of_unknown
from ethbrake_marl.envs.spaces import action_box, feature_box
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.observations import Observations, ObservationSpec, observe
from ethbrake_marl.physics import Bools, Worlds, concatenate
from ethbrake_marl.rewards import RewardParams
from ethbrake_marl.scenario import Scenario, initial_state_worlds

Rewards = NDArray[np.float32]


def make_sb3_vec_env(
    scenario: str | Path | Scenario,
    n_envs: int,
    seed: int | None = 0,
    learners: Sequence[str | int] | None = None,
    reward: str | RewardParams = "harm",
    observation: ObservationSpec | None = None,
) -> EthBrakeVecEnv:
    """``n_envs`` worlds for Stable-Baselines3; arguments as ``parallel_env``. ``seed=None``: fresh entropy."""
    check_seed(seed)
    engine = make_engine(scenario, n_envs, learners=learners, reward=reward, observation=observation)
    return EthBrakeVecEnv(engine, fresh_seed() if seed is None else seed)


class EthBrakeVecEnv(VecEnv):
    """Rows are learners: row ``k * L + l`` is learner l (front to rear) of world k, for L learners in each world.

    With one learner rows are worlds; with several, all rows share one policy (parameter sharing), and the rows of a
    world end together. All worlds take their episodes from one stream, as in ``EthBrakeVectorEnv``.

    Infos hold ``TimeLimit.truncated``; at the end of an episode also ``terminal_observation``, ``episode`` (return
    ``r``, steps ``l``; ``t`` is always 0, no clock is read), and harm under both counts as in ``envs.infos``.
    There are no environments inside: attributes and methods belong to the whole batch.
    """

    render_mode: str | None = None

    def __init__(self, engine: Engine, seed: int) -> None:
        if not engine.learners:
            raise InvalidInput(f"scenario {engine.scenario.name!r} has no learner; pass learners=['vehicle_2']")
        self.engine = engine
        self._next_seed: int | None = seed
        self._actions: NDArray[Any] | None = None
        rows = engine.n * len(engine.learners)
        self._return = np.zeros(rows)
        self._steps = np.zeros(rows, np.int64)
        self._started = False
        super().__init__(rows, feature_box(engine.observation.features), action_box())

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Start the stream of ``seed`` at the next reset (None: fresh entropy); one stream serves all rows."""
        check_seed(seed)
        self._next_seed = fresh_seed() if seed is None else int(seed)
        return [self._next_seed] * self.num_envs

    def reset(self) -> Observations:
        """Start an episode in every world, with the seed and options set before (``seed``, ``set_options``)."""
        restart_from(self.engine, self._next_seed, self._given_worlds())
        self._next_seed = None
        self._reset_options()
        self._return[:], self._steps[:] = 0.0, 0
        self._started = True
        table = state_table(self.engine)
        self.reset_infos = [row_info(table, *self._place(row)) for row in range(self.num_envs)]
        return self._observe(self.engine.worlds)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep actions [rows, 1] for ``step_wait``."""
        self._actions = np.array(actions)

    def step_wait(self) -> tuple[Observations, Rewards, Bools, list[dict[str, Any]]]:
        """Advance every world by one time step; worlds that end start their next episode at once."""
        if not self._started or self._actions is None:
            raise InvalidInput("step: no episode is running; call reset first")
        actions, self._actions = self._actions, None
        engine, learners = self.engine, self.engine.learners
        checked = checked_action(actions, (self.num_envs, 1), "the rows")
        step = engine.step(checked.reshape(engine.n, len(learners)))
        reward = step.reward[:, list(learners)].reshape(-1)
        self._return += reward
        self._steps += 1
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": False} for _ in range(self.num_envs)]
        if step.ended.any():
            self._close_episodes(step, infos)
        return self._observe(engine.worlds), reward.astype(np.float32), self._by_row(step.ended), infos

    def close(self) -> None:
        """Nothing to release."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The batch's attribute, once per row asked for."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set the batch's attribute; for some rows only is an ``InvalidInput``."""
        self._refuse_some_rows("set_attr", indices)
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call the batch's method once, and return its result once per row; for some rows only is an error."""
        self._refuse_some_rows("env_method", indices)
        return [getattr(self, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """False for every row: nothing is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def _close_episodes(self, step: Step, infos: list[dict[str, Any]]) -> None:
        """Fill in the infos of rows whose episode has ended, then start the next episodes of their worlds."""
        engine = self.engine
        ended = np.flatnonzero(step.ended)
        final = self._observe(engine.worlds.take(ended))
        table = state_table(engine)
        rows = np.flatnonzero(self._by_row(step.ended))
        for row, observation in zip(rows.tolist(), final, strict=True):
            world, vehicle = self._place(row)
            episode = {"r": float(self._return[row]), "l": int(self._steps[row]), "t": 0.0}
            infos[row] = row_info(table, world, vehicle) | {
                "TimeLimit.truncated": bool(step.truncated[world]),
                "terminal_observation": observation.copy(),
                "episode": episode,
            }
        self._return[rows], self._steps[rows] = 0.0, 0
        engine.renew(ended)
        table = state_table(engine)
        for row in rows.tolist():
            self.reset_infos[row] = row_info(table, *self._place(row))

    def _observe(self, worlds: Worlds) -> Observations:
        """Observations of all learners of ``worlds`` by row, in their own memory."""
        spec = self.engine.observation
        columns = [observe(worlds, vehicle, spec) for vehicle in self.engine.learners]
        return columns[0] if len(columns) == 1 else np.stack(columns, axis=1).reshape(-1, spec.size).copy()

    def _by_row(self, worlds: Bools) -> Bools:
        return np.repeat(worlds, len(self.engine.learners))

    def _place(self, row: int) -> tuple[int, int]:
        """World and vehicle index of a row."""
        world, learner = divmod(row, len(self.engine.learners))
        return world, self.engine.learners[learner]

    def _given_worlds(self) -> Worlds | None:
        """The worlds that the options of the rows ask for; None for the stream's."""
        options = [row or {} for row in self._options]
        if len(options) != self.num_envs:
            raise InvalidInput(f"set_options: {len(options)} entries; one for each of {self.num_envs} rows is needed")
        warn_of_unknown(name for row in options for name in row)
        if not any(INITIAL_STATE in row for row in options):
            return None
        width = len(self.engine.learners)
        for k, row in enumerate(options):
            first = options[k - k % width]
            if INITIAL_STATE not in row or not data_equivalence(row, first, exact=True):
                raise InvalidInput(
                    f"set_options: row {k} has {row!r}; if one row has an {INITIAL_STATE}, every row needs one, and the"
                    " learners of a world the same options"
                )
        return concatenate([initial_state_worlds(row[INITIAL_STATE], self.engine.scenario) for row in options[::width]])

    def _refuse_some_rows(self, what: str, indices: VecEnvIndices) -> None:
        if list(self._get_indices(indices)) != list(range(self.num_envs)):
            raise InvalidInput(f"{what}: indices {indices!r}; rows share one batch, so leave indices out")
