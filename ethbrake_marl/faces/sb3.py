"""Stable-Baselines3: a ``VecEnv`` with one row per learner and world. Importing this module imports torch."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.action_scale import ActionForm
from ethbrake_marl.episode.features import Feature
from ethbrake_marl.episode.full_state import full_state, state_features
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.infos import by_body
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import State, put_rows
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.faces.face import Face
from ethbrake_marl.faces.spaces import action_space, checked_actions, feature_box
from ethbrake_marl.faces.stream import chosen_seed
from ethbrake_marl.motion.layout import Bools
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.scenario import Scenario

Appended = Literal["number", "state"]
SAVED = ("episode", "_first", "_return", "_steps")  # attributes of a snapshot


def make_sb3_vec_env(
    scenario: AnyScenario,
    n_envs: int,
    seed: int | None = None,
    learners: Sequence[str] | None = None,
    reward: Any = "shaped",
    observation: Any = None,
    horizon_is_end: bool = True,
    appended: Appended | None = None,
    step_infos: bool = False,
    render_mode: str | None = None,
    actions: ActionForm = None,
    report: Sequence[str] = (),
    max_cycles: int | None = None,
) -> EthBrakeVecEnv:
    """Environment for Stable-Baselines3 with ``n_envs`` worlds, simulated together.

    It has one row for each learner of each world, world by world: ``num_envs`` is ``n_envs`` times the number of
    learners. ``scenario``, ``learners``, ``reward``, ``observation``, ``actions``, ``report`` and ``max_cycles`` are as
    in ``EthBrakeParallelEnv``.

    - ``seed``: seed of the training worlds; None: a random one.
    - ``horizon_is_end``: report an episode that reaches the horizon as terminated, not as truncated. Harm after the
      horizon is not counted, so values bootstrapped beyond it could grow without limit. An end by ``max_cycles`` before
      the horizon is always truncated.
    - ``appended``: numbers after each observation: the learner's ``number`` in its world, from 0, or the full
      ``state``.
    - ``step_infos``: return infos at every step, not only at the last one.
    - ``render_mode``: ``ansi`` or ``rgb_array``; None: no pictures.

    >>> import ethbrake_marl as eb
    >>> eb.make_sb3_vec_env("paper-random", 4, seed=7).reset().shape
    (4, 27)
    """
    check_whole_number("n_envs", n_envs, 1)
    scenario_and_game = open_game(scenario, learners, reward, observation, report=report)
    return EthBrakeVecEnv(
        *scenario_and_game, int(n_envs), seed, horizon_is_end, appended, step_infos, render_mode, actions, max_cycles
    )


class EthBrakeVecEnv(Face, VecEnv):
    """Vector environment of Stable-Baselines3: row ``k L + l`` is learner l of L (front to rear) in world k.

    The rows of a world share an episode. Infos at the last step of an episode include ``TimeLimit.truncated``,
    ``terminal_observation`` and ``episode`` (return ``r``, steps ``l``, and ``t``, always 0). ``reset_infos`` belong to
    the first decision of each running episode. All rows have the same seed, options and attributes.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> env = eb.make_sb3_vec_env("paper-random", 4, learners=["vehicle_2", "vehicle_3"])
    >>> observations = env.reset()
    >>> observations, rewards, dones, infos = env.step(np.full((8, 1), -1.0))
    >>> rewards.shape
    (8,)
    """

    begins_again = True

    def __init__(
        self,
        scenario: Scenario,
        game: Game,
        n: int,
        seed: int | None = None,
        horizon_is_end: bool = True,
        appended: Appended | None = None,
        step_infos: bool = False,
        render_mode: str | None = None,
        actions: ActionForm = None,
        max_cycles: int | None = None,
    ) -> None:
        self.bodies = game.settings.learners
        self.n, self.num_envs, self.actions = n, n * len(self.bodies), actions
        self.horizon_is_end, self.appended, self.step_infos = horizon_is_end, appended, step_infos
        self._open((scenario, game), render_mode, max_cycles)
        self._need_learner()
        self._first: State | None = None  # each running episode at its first decision
        self._return, self._steps = np.zeros(self.num_envs), np.zeros(self.num_envs, np.int64)
        super().__init__(self.num_envs, feature_box(self._features()), action_space(actions))
        self.seed(seed)

    def _features(self) -> tuple[Feature, ...]:
        """Those that all learners observe, and the appended numbers."""
        views = {self.game.views[i] for i in self.bodies}
        if len(views) > 1:
            raise InvalidInput(
                f"observation: the learners of {self.scenario.name!r} observe different features, but must observe the"
                " same here; give one list of features for all vehicles, use a single learner, or use parallel_env"
            )
        features: tuple[Feature, ...] = views.pop().features
        if self.appended is None:
            return features
        if self.appended == "state":
            return (*features, *state_features(self.scenario.vehicles, *self._of_state))
        if self.appended == "number":
            last = float(max(len(self.bodies) - 1, 1))
            return (*features, Feature("learner", "1", 1.0, 0.0, last, "number of the learner, from 0"))
        raise InvalidInput(f"appended = {self.appended!r}: must be 'number', 'state' or None")

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        self._seeds = [chosen_seed(seed)] * self.num_envs
        return self._seeds[:]

    def reset(self) -> Observations:
        options = self._options
        if options != options[:1] * self.num_envs:
            self._reset_options()
            raise InvalidInput("set_options: all worlds are simulated together; give the same options to every row")
        stream, state = self.stream.reset(self.n, self._seeds[0], options[0])
        observations = self._observe(state)
        self._keep(stream, state, self.renderer.began)
        self._reset_options()
        self._reset_seeds()
        self._first = copy.deepcopy(state)
        self._return, self._steps = np.zeros(self.num_envs), np.zeros(self.num_envs, np.int64)
        return observations

    def step_async(self, actions: Any) -> None:
        self._given = actions

    def step_wait(self) -> tuple[Observations, Any, Bools, list[dict[str, Any]]]:
        """Where an episode ends, the next one begins in the same rows."""
        before = self._running()
        actions = checked_actions(self._given, (self.num_envs, 1), "the learners", self.actions)
        state, step = self.game.step(before, actions.reshape(self.n, -1))
        stream, observations, over = self.stream, self._observe(state), state.ended
        ended = np.flatnonzero(over)
        reward = self._rewards(step).reshape(-1)
        first, returns, steps = self._first, self._return + reward, self._steps + 1
        if self.step_infos:
            infos = self._infos(stream, state, step)
        elif self.game.shield is not None:
            lists = {name: value.tolist() for name, value in by_body(self.game.extra_infos(state), self.bodies).items()}
            infos = [{name: column[k] for name, column in lists.items()} for k in range(self.num_envs)]
        else:
            infos = [{} for _ in range(self.num_envs)]
        if len(ended):
            rows = (ended[:, np.newaxis] * len(self.bodies) + np.arange(len(self.bodies))).reshape(-1)
            sums = returns[rows].tolist(), steps[rows].tolist()
            last = zip(rows.tolist(), self._last_infos(state, step, ended), observations[rows], *sums, strict=True)
            for row, info, observation, gained, length in last:
                info["terminal_observation"], info["episode"] = observation, {"r": gained, "l": length, "t": 0.0}
                infos[row] = info
            stream, new = stream.next_episodes(ended)
            observations[rows], returns[rows], steps[rows] = self._observe(new), 0.0, 0
            state, first = (put_rows(states, ended, new, donate=self.render_mode is None) for states in (state, first))
        self._keep(stream, state, self.renderer.stepped)
        self._first, self._return, self._steps = first, returns, steps
        return observations, reward.astype(np.float32), over.repeat(len(self.bodies)), infos

    def _last_infos(self, state: State, step: Step, ended: Any) -> list[dict[str, Any]]:
        """``step``: last step of all worlds, which led to ``state``."""
        terms = {name: term[ended] for name, term in step.terms.items()}
        step = step._replace(reward=step.reward[ended], out=step.out[:, ended], terms=terms)
        infos = self._infos(self.stream, state.take(ended), step)
        for info, truncated in zip(infos, step.truncated.repeat(len(self.bodies)).tolist(), strict=True):
            info["TimeLimit.truncated"] = truncated and (info["cut"] or not self.horizon_is_end)
        return infos

    @property
    def reset_infos(self) -> list[dict[str, Any]]:
        """Infos at the first decision of each row's running episode."""
        return [] if self._first is None else self._infos(self.stream, self._first, None)

    @reset_infos.setter
    def reset_infos(self, infos: list[dict[str, Any]]) -> None:
        """Ignore the empty infos of Stable-Baselines3's constructor."""

    def _observe(self, state: State) -> Observations:
        """All rows, [n L, F] float32."""
        L, every = len(self.bodies), self.game.observe_alike(state, self.bodies)
        rows: Observations = every.reshape(-1, every.shape[2])
        if self.appended is None:
            return rows
        more = np.tile(np.arange(L, dtype=np.float32), state.n)[:, np.newaxis]
        if self.appended == "state":
            more = full_state(state, *self._of_state).repeat(L, axis=0)
        return np.concatenate([rows, more], axis=1, dtype=np.float32)

    def snapshot(self) -> dict[str, Any]:
        stream = [self.stream.seed, self.stream.next]
        return copy.deepcopy({"stream": stream, **{name: getattr(self, name) for name in SAVED}})

    def restore(self, saved: dict[str, Any]) -> None:
        """The same snapshot can be restored several times."""
        saved = copy.deepcopy(saved)
        seed, following = saved["stream"]
        self.stream = self.stream._replace(seed=seed, next=following)
        for name in SAVED:
            setattr(self, name, saved[name])

    def render(self, mode: str | None = None) -> Any:
        """One text per world (``ansi``), or one picture of all worlds."""
        return self.get_images() if self.render_mode == "ansi" else VecEnv.render(self, mode)

    def get_images(self) -> list[Any]:
        return self.renderer.render() or []

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        self._refuse_some_rows("set_attr", indices)
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """The result once per row. Raises ``InvalidInput`` if ``indices`` omit a row."""
        self._refuse_some_rows("env_method", indices)
        return [getattr(self, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def _refuse_some_rows(self, what: str, indices: Any) -> None:
        if list(self._get_indices(indices)) != list(range(self.num_envs)):
            raise InvalidInput(
                f"{what}: indices = {indices!r}: must not be passed, because all worlds are simulated by one object"
            )
