"""Stable-Baselines3: a ``VecEnv`` with one row per learner and world. Importing this module imports torch."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from ethbrake_marl.episode.features import Feature
from ethbrake_marl.episode.full_state import full_state, state_features
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.infos import NUMBERS, dictionaries, numbers, per_body
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.faces.actions import action_space, checked_actions
from ethbrake_marl.faces.rendering import make_renderer
from ethbrake_marl.faces.spaces import FeatureBox
from ethbrake_marl.faces.stream import OPTIONS, Stream, checked_options, chosen_seed
from ethbrake_marl.motion.layout import Bools
from ethbrake_marl.names import open_game
from ethbrake_marl.worlds.game import AnyScenario
from ethbrake_marl.worlds.given import worlds_from_state
from ethbrake_marl.worlds.scenario import Scenario

Appended = Literal["number", "state"]


def make_sb3_vec_env(
    scenario: AnyScenario,
    n_envs: int,
    seed: int | None = None,
    learners: Sequence[str] | None = None,
    reward: Any = "harm",
    observation: Any = None,
    horizon_is_end: bool = True,
    appended: Appended | None = None,
    step_infos: bool = False,
    render_mode: str | None = None,
    actions: int | None = None,
) -> EthBrakeVecEnv:
    """Return ``n_envs`` worlds for Stable-Baselines3, which are simulated together.

    ``scenario``, ``learners``, ``reward``, ``observation`` and ``actions`` are as in ``EthBrakeParallelEnv``.

    - ``seed``: of the stream of worlds; None: a random one.
    - ``horizon_is_end``: report an episode at the horizon as ended, not as truncated: the harm after the horizon is not
      counted, so a bootstrapped estimate of it could grow without limit.
    - ``appended``: numbers after each observation: the learner's ``number`` in its world, from 0, or the full
      ``state``.
    - ``step_infos``: infos at every step, not only at the last one.
    - ``render_mode``: ``ansi`` or ``rgb_array``; None: no pictures.

    >>> import ethbrake_marl as eb
    >>> eb.make_sb3_vec_env("paper-random", 4, seed=7).reset().shape
    (4, 27)

    """
    check_whole_number("n_envs", n_envs, 1)
    opened = open_game(scenario, learners, reward, observation)
    return EthBrakeVecEnv(*opened, int(n_envs), seed, horizon_is_end, appended, step_infos, render_mode, actions)


class EthBrakeVecEnv(VecEnv):
    """Row ``k L + l`` is learner l of L (front to rear) in world k; the rows of a world share an episode.

    The last step of an episode has the infos ``TimeLimit.truncated``, ``terminal_observation``, ``episode`` (return
    ``r``, steps ``l``, and ``t``, always 0) and all others.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> env = eb.make_sb3_vec_env("paper-random", 4, learners=["vehicle_2", "vehicle_3"])
    >>> observations = env.reset()
    >>> observations, rewards, dones, infos = env.step(np.full((8, 1), -1.0))
    >>> rewards.shape
    (8,)

    """

    episode: State

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
        actions: int | None = None,
    ) -> None:
        self.scenario, self.game, self.n, self.learners = scenario, game, n, game.rules.learners
        if not len(self.learners):
            raise InvalidInput(f"scenario {scenario.name!r} has no learner; pass learners=['vehicle_2']")
        self.horizon_is_end, self.appended, self.step_infos = horizon_is_end, appended, step_infos
        self.actions, self.render_mode = actions, render_mode
        self.stream = Stream(scenario, game)
        self.stream.seed = chosen_seed(seed)
        self._next_seed: int | None = None
        self._given: Any = None
        rows = n * len(self.learners)
        self._return, self._steps, self._begun = np.zeros(rows), np.zeros(rows, np.int64), np.zeros(0)
        self._begun_own: list[dict[str, Any]] = []
        self._of_state = scenario.horizon_s, scenario.has_obstacle
        super().__init__(rows, FeatureBox(self._features()), action_space(actions))
        self.renderer = make_renderer(self, render_mode)

    def _features(self) -> tuple[Feature, ...]:
        views = {self.game.views[i] for i in self.learners}
        if len(views) > 1:
            raise InvalidInput(
                f"observation: the learners of {self.scenario.name!r} observe different features, but must observe the"
                " same here; give one list of features for all vehicles, use a single learner, or use parallel_env"
            )
        own: tuple[Feature, ...] = views.pop().features
        last = len(self.learners) - 1
        if self.appended is None:
            return own
        if self.appended == "state":
            return (*own, *state_features(self.scenario.vehicles, *self._of_state))
        if self.appended == "number":
            return (*own, Feature("learner", "1", 1.0, 0.0, float(max(last, 1)), "number of the learner, from 0"))
        raise InvalidInput(f"appended = {self.appended!r}: must be 'number', 'state' or None")

    def seed(self, seed: int | None = None) -> Sequence[int]:
        """Set the seed of the worlds for the next reset. All rows share one stream of worlds."""
        self._next_seed = chosen_seed(seed)
        return [self._next_seed] * self.num_envs

    def reset(self) -> Observations:
        """Start an episode in every world: the next ones, or those of ``set_options``."""
        try:
            worlds = self._optional_worlds()
        finally:
            self._reset_options()
        if self._next_seed is not None:
            self.stream.seed, self.stream.next, self._next_seed = self._next_seed, 0, None
        self.episode = self.stream.draw(self.n) if worlds is None else self.game.begin(worlds)
        self._return[:], self._steps[:] = 0.0, 0
        self._begun, self._begun_own = numbers(self.episode, self.learners), self._own_infos(self.episode)
        if self.renderer is not None:
            self.renderer.began(self.episode)
        return self._observe(self.episode)

    def step_async(self, actions: Any) -> None:
        """Store the actions of the next step, [rows, 1]."""
        self._given = np.array(actions, subok=True)  # a mask is refused, not lost

    def step_wait(self) -> tuple[Observations, Any, Bools, list[dict[str, Any]]]:
        """Advance every world by one time step; where an episode ends, the next one begins in the same rows."""
        if self._given is None or not hasattr(self, "episode"):
            raise InvalidInput("step: no episode is running; call reset first")
        given, self._given = self._given, None
        if given.size != self.num_envs:
            raise InvalidInput(
                f"step: actions have the shape {given.shape}; must have the shape ({self.num_envs}, 1), one action for"
                " each learner of each world"
            )
        L = len(self.learners)
        actions = checked_actions(given.reshape(self.n, L), (self.n, L), "the learners", self.actions)
        self.episode, step = self.game.step(self.episode, actions, donate=True)
        reward = step.reward.take(self.learners - 1, axis=1).reshape(-1)
        self._return += reward
        self._steps += 1
        infos = self._infos(self.episode, step) if self.step_infos else self._step_infos()
        over = self.episode.ended
        ended = np.flatnonzero(over)
        if len(ended):
            self._close(ended, step, infos)
            new = self.stream.draw(len(ended))
            self.episode = self.episode.put(ended, new, donate=True)
            self._begun[ended] = numbers(new, self.learners)
            if self._begun_own:
                rows = (ended[:, np.newaxis] * L + np.arange(L)).reshape(-1).tolist()
                for row, own in zip(rows, self._own_infos(new), strict=True):
                    self._begun_own[row] = own
        if self.renderer is not None:
            self.renderer.stepped(self.episode)
        return self._observe(self.episode), reward.astype(np.float32), over.repeat(L), infos

    def _close(self, ended: Any, step: Step, infos: list[dict[str, Any]]) -> None:
        """Write the last infos of the episodes that have ended."""
        L, last = len(self.learners), self.episode.take(ended)
        rows = (ended[:, np.newaxis] * L + np.arange(L)).reshape(-1).tolist()
        of_last = step._replace(
            reward=step.reward[ended], out=step.out[:, ended], terms={k: v[ended] for k, v in step.terms.items()}
        )
        plain, seen = self._infos(last, of_last), self._observe(last)
        truncated = of_last.truncated.repeat(L).tolist()
        for row, info, cut, final in zip(rows, plain, truncated, seen, strict=True):
            info["TimeLimit.truncated"] = cut and not self.horizon_is_end
            info["terminal_observation"] = final.copy()
            info["episode"] = {"r": self._return[row].item(), "l": self._steps[row].item(), "t": 0.0}
            infos[row] = info
        self._return[rows], self._steps[rows] = 0.0, 0

    def _infos(self, state: State, step: Step | None) -> list[dict[str, Any]]:
        return dictionaries(self.game, state, step, self.stream.seed or 0, self.learners)

    def _step_infos(self) -> list[dict[str, Any]]:
        return [{} for _ in range(self.num_envs)] if self.game.shield is None else self._own_infos(self.episode)

    def _own_infos(self, state: State) -> list[dict[str, Any]]:
        """Return the infos that only this game has; an empty list if it has none."""
        columns = self.game.own_infos(state)
        return per_body(columns, state.n, self.learners) if columns else []

    @property
    def reset_infos(self) -> list[dict[str, Any]]:
        """Infos at the start of each row's running episode."""
        if not hasattr(self, "episode"):
            return [{} for _ in range(self.num_envs)]
        infos = self._infos(self.episode, None)
        begun = self._begun.reshape(-1, len(NUMBERS)).tolist()
        infos = [info | dict(zip(NUMBERS, row, strict=True)) for info, row in zip(infos, begun, strict=True)]
        return [info | own for info, own in zip(infos, self._begun_own, strict=True)] if self._begun_own else infos

    @reset_infos.setter
    def reset_infos(self, infos: list[dict[str, Any]]) -> None:
        """Ignore the empty infos of Stable-Baselines3's constructor."""

    def _observe(self, state: State) -> Observations:
        every = self.game.observe_alike(state, self.learners)
        rows: Observations = every.reshape(-1, every.shape[2])
        if self.appended is None:
            return rows
        L = len(self.learners)
        more = np.tile(np.arange(L, dtype=np.float32), state.n)[:, np.newaxis]
        if self.appended == "state":
            more = full_state(state, *self._of_state).repeat(L, axis=0)
        return np.concatenate([rows, more], axis=1, dtype=np.float32)

    def _optional_worlds(self) -> State | None:
        """Return the worlds of ``set_options``; None: there are none."""
        each = {id(row): row for row in self._options}  # often one for all, of which to warn once
        checked = {number: checked_options(row, OPTIONS[:1]) for number, row in each.items()}
        given = [checked[id(row)] for row in self._options]
        options = [{name: row[name] for name in OPTIONS[:1] if name in row} for row in given]
        if not any(options):
            return None
        L = len(self.learners)
        if len(options) != self.num_envs or any(
            options[k] != options[k - k % L] or not options[k] for k in range(len(options))
        ):
            raise InvalidInput(
                "set_options: give initial_state in all entries or in none, one for each learner of each world, and the"
                " same for all learners of a world"
            )
        return State.join([worlds_from_state(self.scenario, options[k * L]["initial_state"]) for k in range(self.n)])

    def snapshot(self) -> dict[str, Any]:
        """Return what a restored environment needs, between two steps, as arrays and numbers."""
        return {
            "state": [each.copy() for each in self.episode[:5]],
            "memories": {str(name): copy.deepcopy(memory) for name, memory in self.episode.memories.items()},
            "rows": [self._return.copy(), self._steps.copy(), self._begun.copy()],
            "own_infos": [dict(own) for own in self._begun_own],
            "stream": [self.stream.seed, self.stream.next],
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Go on from a ``snapshot``, which can be restored again."""
        saved = copy.deepcopy(saved)
        memories = {int(name) if name.isdigit() else name: memory for name, memory in saved["memories"].items()}
        line, car, clock, know, wanted = saved["state"]
        self.episode = State(line, car, clock, know, wanted, memories)
        self._return, self._steps, self._begun = saved["rows"]
        self._begun_own = saved["own_infos"]
        self.stream.seed, self.stream.next = saved["stream"]

    def render(self, mode: str | None = None) -> Any:
        """Return the texts of all worlds (``ansi``), or one picture of all of them."""
        return self.get_images() if self.render_mode == "ansi" else super().render(mode)

    def get_images(self) -> list[Any]:
        """Return a picture of each world."""
        return [] if self.renderer is None else list(self.renderer.render())

    def close(self) -> None:
        """Give back what the render mode holds."""
        if self.renderer is not None:
            self.renderer.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of this environment, once per row."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of this environment, for all rows."""
        self._refuse_some_rows("set_attr", indices)
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of this environment once; return its result once per row."""
        self._refuse_some_rows("env_method", indices)
        return [getattr(self, method_name)(*args, **kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False once per row: there are no environments of their own to wrap."""
        return [False for _ in self._get_indices(indices)]

    def _refuse_some_rows(self, what: str, indices: Any) -> None:
        if list(self._get_indices(indices)) != list(range(self.num_envs)):
            raise InvalidInput(
                f"{what}: indices = {indices!r}: must not be passed, because all worlds are simulated by one object"
            )
