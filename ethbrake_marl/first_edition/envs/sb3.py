"""Environment for Stable-Baselines3: a ``VecEnv`` with one row per learner. Importing this module imports torch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.compiled_step import Step
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.engine.memory import Arrays, renew_memory
from ethbrake_marl.first_edition.envs.draws import Columns
from ethbrake_marl.first_edition.envs.infos import Begun, Report, plain_rows, shield_columns
from ethbrake_marl.first_edition.envs.making import (
    INITIAL_STATE,
    AnyScenario,
    chosen_seed,
    feature_box,
    learner_action_space,
    make_engine,
    warn_of_unknown,
)
from ethbrake_marl.first_edition.envs.viewer import Viewer
from ethbrake_marl.first_edition.game.actions import checked_action, own_actions
from ethbrake_marl.first_edition.game.full_state import Appended, full_state, row_features
from ethbrake_marl.first_edition.game.observations import Observation, Observations
from ethbrake_marl.first_edition.game.rewards import Reward
from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.state import Bools, Ints, Worlds
from ethbrake_marl.first_edition.scenario.schema import as_scenario
from ethbrake_marl.first_edition.scenario.tables import worlds_from_state

Rewards = NDArray[np.float32]


def make_sb3_vec_env(
    scenario: AnyScenario,
    n_envs: int,
    seed: int | None = None,
    learners: Sequence[str | int] | None = None,
    reward: Reward = "harm",
    observation: Observation | None = None,
    horizon_is_end: bool = True,
    appended: Appended | None = None,
    step_infos: bool = False,
    render_mode: str | None = None,
    actions: int | None = None,
) -> EthBrakeVecEnv:
    """Return an environment for Stable-Baselines3 that simulates ``n_envs`` worlds together.

    Args:
        scenario: name of a shipped scenario, path of a YAML file, or a ``Scenario``.
        n_envs: number of worlds that are simulated together, at least 1.
        seed: seed of the stream of worlds; None: a random seed.
        learners: vehicles that learn, by name (``vehicle_2``) or index (0 = front); None: the learners of the scenario.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping with settings, or a ``RewardParams`` object.
        observation: features that the learners observe; None: the features that the scenario declares or, if it
            declares none, default features (``observation_for``).
        horizon_is_end: True: an episode that reaches the horizon is reported as ended, not as truncated, so that the
            algorithm does not add an estimate of the return after the horizon. Such an estimate could grow without
            limit, because harm after the horizon is not counted (see docs/train.md). False: an episode that reaches the
            horizon is reported as truncated (``TimeLimit.truncated`` is true).
        appended: numbers to append to each observation. ``number``: the learner's number, counted among the learners of
            its world from the front, from 0. ``state``: the full state of the line (``game.full_state.full_state``),
            for a central critic. None: no numbers.
        step_infos: True: every step returns all infos, as the other environments do; steps are then slower. False: only
            the last step of an episode returns all infos.
        render_mode: ``rgb_array`` or None. ``render`` and ``VecVideoRecorder`` show all worlds side by side.
        actions: None: an action is a number in [-1, 1]. A whole number K >= 2: actions are discrete; the indices
            0 to K - 1 stand for K evenly spaced numbers from -1 (full braking capacity) to 1 (full driving capacity).

    >>> import ethbrake_marl.first_edition as eb
    >>> eb.make_sb3_vec_env("paper-random", 4, seed=7).reset().shape
    (4, 27)

    """
    begin = chosen_seed(seed)
    engine = make_engine(scenario, n_envs, learners=learners, reward=reward, observation=observation)
    return EthBrakeVecEnv(
        engine,
        begin,
        horizon_is_end=horizon_is_end,
        appended=appended,
        step_infos=step_infos,
        render_mode=render_mode,
        actions=actions,
    )


class EthBrakeVecEnv(Begun, VecEnv):
    """``VecEnv`` with one row per learner and world: row ``k * L + l`` is learner l of L (front to rear) in world k.

    The rows of one world share one episode. Each new episode takes the next world of the stream. In the last step of an
    episode, the infos contain ``TimeLimit.truncated``, ``terminal_observation``, ``episode`` (return ``r``, number of
    steps ``l``, and ``t``, which is always 0), and all infos of the other environments. In other steps, the infos
    contain only a shield's infos, unless ``step_infos`` is true. ``get_attr`` and ``env_method`` act on this object.

    Args:
        engine: the engine that simulates the worlds; ``make_sb3_vec_env`` makes it.
        seed: seed of the stream of worlds.
        horizon_is_end: whether an episode that reaches the horizon is reported as ended, not as truncated; see
            ``make_sb3_vec_env``.
        appended: numbers to append to each observation: ``number``, ``state`` or None; see ``make_sb3_vec_env``.
        step_infos: True: every step returns all infos. False: only the last step of an episode returns all infos.
        render_mode: ``rgb_array`` or None.
        actions: number of discrete actions; None: an action is a number in [-1, 1].

    >>> import ethbrake_marl.first_edition as eb
    >>> import numpy as np
    >>> env = eb.make_sb3_vec_env("paper-random", 4, learners=["vehicle_2", "vehicle_3"])
    >>> env.num_envs
    8
    >>> observations = env.reset()
    >>> observations, rewards, dones, infos = env.step(np.full((8, 1), -1.0))
    >>> rewards.shape, dones.any()
    ((8,), np.False_)

    """

    def __init__(
        self,
        engine: Engine,
        seed: int,
        *,
        horizon_is_end: bool = True,
        appended: Appended | None = None,
        step_infos: bool = False,
        render_mode: str | None = None,
        actions: int | None = None,
    ) -> None:
        features = row_features(engine.observation.features, appended, engine.scenario)
        if not engine.learners:
            raise InvalidInput(f"scenario {engine.scenario.name!r} has no learner; pass learners=['vehicle_2']")
        self.engine = engine
        self.horizon_is_end = horizon_is_end
        self.appended = appended
        self.step_infos = step_infos
        if render_mode not in (None, "rgb_array"):
            raise InvalidInput(f"render_mode = {render_mode!r}: must be 'rgb_array' or None")
        self.render_mode, self.viewer = render_mode, Viewer(engine, render_mode, batch=True)
        self.actions, space = actions, learner_action_space(actions)
        self._set_seed(seed)
        self._learners = np.array(engine.learners, np.int64)
        self._actions: NDArray[Any] | None = None
        rows = engine.n * len(engine.learners)
        self._return = np.zeros(rows)
        self._steps = np.zeros(rows, np.int64)
        self._begun = np.zeros(0)  # ``Report.values`` at the beginning of each world's episode
        self._begun_shield: Columns = {}  # ``Report.shield`` at the beginning of each world's episode
        super().__init__(rows, feature_box(features), space)
        self.metadata = {**self.viewer.metadata, "render_modes": ["rgb_array"]}

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the worlds for the next reset; return a list that contains this seed once per row.

        If ``seed`` is None, the seed is random. All rows have the same seed, because they share one stream of worlds.
        """
        self._set_seed(chosen_seed(seed))
        self._goes_on = False
        return [self.np_random_seed] * self.num_envs

    def reset(self) -> Observations:
        """Start an episode in every world, and return the observations, float32 [rows, F].

        To choose the worlds, call ``seed`` or ``set_options`` before ``reset``. Options apply to the next reset only,
        even if this reset raises ``InvalidInput`` because the options are invalid.
        """
        try:
            worlds = self._read_options()
        finally:
            self._reset_options()
        self._begin(None, worlds)
        self._return[:], self._steps[:] = 0.0, 0
        report = Report.of(self.engine)
        self._begun, self._begun_shield = report.values, report.shield
        return self._observe()

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions for the next step: [rows, 1] in [-1, 1] or, if actions are discrete, indices [rows]."""
        self._actions = own_actions(actions, "the learners", self.actions)

    def step_wait(self) -> tuple[Observations, Rewards, Bools, list[dict[str, Any]]]:
        """Advance every world by one time step with the stored actions.

        If an episode ends, the next episode starts at once in the same rows. Returns observations [rows, F], rewards
        [rows], an array [rows] that is true where an episode has ended, and one dictionary of infos per row.
        """
        if not self._started or self._actions is None:
            raise InvalidInput("step: no episode is running; call reset first")
        actions, self._actions = self._actions, None
        engine, learners = self.engine, self._learners
        if actions.size != self.num_envs:
            raise InvalidInput(
                f"step: actions have the shape {actions.shape}; must have the shape ({self.num_envs}, 1), one action"
                " for each learner of each world"
            )
        if self.actions is not None:
            actions = checked_action(actions, actions.shape, "the learners", self.actions)
        step = engine.step(actions.reshape(engine.n, len(learners)))
        reward = step.reward.take(learners, axis=1).reshape(-1)
        self._return += reward
        self._steps += 1
        infos = (
            Report.of(engine, step).plain_infos(learners)
            if self.step_infos
            else plain_rows(shield_columns(engine), learners, self.num_envs)
        )
        over = engine.ended  # includes worlds that a step which was interrupted did not renew
        ended = np.flatnonzero(over)
        if len(ended):
            self._close_episodes(ended, step, infos)
            engine.renew(ended)
            report = Report.of(engine, rows=ended)
            self._begun[ended] = report.values
            self._begun_shield = renew_memory(self._begun_shield, ended, report.shield) if report.shield else {}
        return self._observe(), reward.astype(np.float32), self._by_row(over), infos

    def get_images(self) -> list[NDArray[np.uint8]]:
        """Return a picture of each world, as a list of frames [H, W, 3] uint8."""
        return list(self.viewer.render())

    def close(self) -> None:
        """Do nothing, because this environment has no resources to release."""

    def snapshot(self) -> Arrays:
        """Return a copy of the environment's state between two steps, as arrays by name, for ``restore``."""
        arrays = {f"engine.{name}": array for name, array in self.engine.snapshot().items()}
        return arrays | {"return": self._return.copy(), "steps": self._steps.copy(), "begun": self._begun.copy()}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore the state ``arrays``, which ``snapshot`` has returned; a reset is not needed.

        Raises ``InvalidInput`` if the snapshot is from an environment with another scenario or number of worlds.
        """
        prefix = "engine."
        self.engine.restore({n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)})
        rows = {"return": self._return, "steps": self._steps, "begun": Report.of(self.engine).values}
        for name, like in rows.items():
            have = arrays[name]
            if (have.shape, have.dtype) != (like.shape, like.dtype) or not np.isfinite(have).all():
                raise InvalidInput(
                    f"environment snapshot: {name}: must be finite numbers of type {like.dtype} and shape {like.shape}"
                )
        self._return, self._steps = arrays["return"].copy(), arrays["steps"].copy()
        self._begun, self._begun_shield = arrays["begun"].copy(), {}
        self._set_seed(self.engine.seed)
        self._started = self._goes_on = True

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return a list that contains the attribute ``attr_name`` of this environment once per requested row."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set the attribute ``attr_name`` to ``value``. Raises ``InvalidInput`` if ``indices`` omits a row."""
        self._refuse_some_rows("set_attr", indices)
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call the method ``method_name`` of this environment once; return a list that repeats the result for each row.

        ``args`` and ``kwargs`` are the method's arguments. Raises ``InvalidInput`` if ``indices`` omits a row.
        """
        self._refuse_some_rows("env_method", indices)
        return [getattr(self, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return a list with False once per requested row. The rows have no environments of their own to wrap."""
        return [False for _ in self._get_indices(indices)]

    def _close_episodes(self, ended: Ints, step: Step, infos: list[dict[str, Any]]) -> None:
        """Write the final infos of the episodes that have ended in the worlds ``ended`` (indices) into ``infos``.

        Call this method before the next episodes start.
        """
        rows, final = self._rows(ended), self._observe(ended)
        plain = Report.of(self.engine, step, ended).plain_infos(self._learners)
        truncated = self._by_row(step.truncated[ended]).tolist()
        gained, steps = self._return.take(rows).tolist(), self._steps.take(rows).tolist()
        for row, info, cut, seen, gain, count in zip(
            rows.tolist(), plain, truncated, final, gained, steps, strict=True
        ):
            info["TimeLimit.truncated"] = cut and not self.horizon_is_end
            info["terminal_observation"] = seen.copy()
            info["episode"] = {"r": gain, "l": count, "t": 0.0}
            infos[row] = info
        self._return[rows], self._steps[rows] = 0.0, 0

    def _rows(self, worlds: Ints) -> Ints:
        """Return the indices of the rows that belong to the worlds with the indices ``worlds``, world by world."""
        width = len(self.engine.learners)
        return (worlds[:, np.newaxis] * width + np.arange(width)).reshape(-1)

    @property
    def reset_infos(self) -> list[dict[str, Any]]:
        """List with one dictionary per row: the infos at the start of the row's running episode."""
        if not self._started:
            return [{} for _ in range(self.num_envs)]
        report = Report.of(self.engine)._replace(values=self._begun, shield=self._begun_shield)
        return report.plain_infos(self._learners)

    @reset_infos.setter
    def reset_infos(self, infos: list[dict[str, Any]]) -> None:
        """Ignore the empty infos that the constructor of Stable-Baselines3's ``VecEnv`` assigns."""

    def _observe(self, worlds: Ints | None = None) -> Observations:
        """Return the observations of all learners in ``worlds`` (indices; None: all worlds), a new array [rows, F]."""
        every = self.engine.observe_all(self._learners, worlds)
        rows = every.reshape(-1, every.shape[2])
        if self.appended is None:
            return rows
        count, width = every.shape[:2]
        if self.appended == "number":
            more = np.tile(np.arange(width, dtype=np.float32), count)[:, np.newaxis]
        else:
            state, params = self.engine.packed
            some = slice(None) if worlds is None else worlds
            more = full_state(Packed(state[some], params[some]).worlds(), self.engine.scenario).repeat(width, axis=0)
        return np.concatenate([rows, more], axis=1, dtype=np.float32)

    def _by_row(self, worlds: Bools) -> Bools:
        return worlds.repeat(len(self._learners))

    def _read_options(self) -> Worlds | None:
        """Return the worlds that the options of ``set_options`` choose; None if the stream supplies the worlds.

        Raises ``InvalidInput`` if some rows have an initial state and others do not, or if the rows of one world have
        different initial states.
        """

        def bytes_of(start: Worlds) -> list[bytes]:
            return [part.tobytes() for part in Packed.of(start)]

        options = [row or {} for row in self._options]
        if len(options) != self.num_envs:
            raise InvalidInput(
                f"set_options: the list has {len(options)} entries; must have {self.num_envs}, one for each learner of"
                " each world"
            )
        warn_of_unknown((name for row in options for name in row), (INITIAL_STATE,))
        if not any(INITIAL_STATE in row for row in options):
            return None
        width, starts = len(self.engine.learners), list[Worlds]()
        for k, row in enumerate(options):
            start = (
                worlds_from_state(as_scenario(self.engine.scenario), row[INITIAL_STATE])
                if INITIAL_STATE in row
                else None
            )
            if start is None or (k % width and bytes_of(start) != bytes_of(starts[-1])):
                raise InvalidInput(
                    f"set_options: entry {k} of the list is {row!r}; give {INITIAL_STATE} in all entries or in none,"
                    " and the same state for all learners of a world"
                )
            starts += [] if k % width else [start]
        return Worlds.concatenate(starts)

    def _refuse_some_rows(self, what: str, indices: VecEnvIndices) -> None:
        if list(self._get_indices(indices)) != list(range(self.num_envs)):
            raise InvalidInput(
                f"{what}: indices = {indices!r}: must not be passed, because all worlds are simulated by one object"
            )
