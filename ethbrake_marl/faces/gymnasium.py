"""Gymnasium: one learner, one world."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.action_scale import ActionForm
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import steps_to_horizon
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.faces.face import Face
from ethbrake_marl.faces.rendering import Metadata
from ethbrake_marl.faces.spaces import action_space, checked_actions, feature_box, reward_box
from ethbrake_marl.faces.stream import chosen_seed
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.scenario import plain


class OneLearner(Face):
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """How Gymnasium made the environment, as plain data."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        arguments = {} if spec is None else spec.kwargs
        plain_arguments = {
            name: plain([*value] if isinstance(value, Set) else value) for name, value in arguments.items()
        }
        self._spec = spec and replace(spec, kwargs=plain_arguments, max_episode_steps=self._longest())

    def _longest(self) -> int:
        first_s = min(self.scenario.bounds("latency_s")[i - 1][0] for i in self.game.deciders)
        settings = self.game.settings
        return int(min(steps_to_horizon(first_s, settings), settings.most_steps))

    def _open_one(
        self, game: tuple[Any, ...], render_mode: str | None, actions: ActionForm, most_steps: int | None
    ) -> tuple[Any, Any]:
        self._open(open_game(*game), render_mode, most_steps)
        self.bodies, self.actions = self.game.settings.learners, actions
        names = [self.scenario.vehicle_names[i - 1] for i in self.bodies]
        if len(names) != 1:
            raise InvalidInput(
                f"scenario {self.scenario.name!r} has {len(names)} learners ({', '.join(names) or 'none'}); this"
                " environment needs exactly one learner: pass learners=['vehicle_2'], or use parallel_env or"
                " make_sb3_vec_env"
            )
        (self.name,) = names
        if components := self.game.rewarding.components:  # as MO-Gymnasium has it
            self.reward_space, self.reward_dim = reward_box(components), len(components)
        return feature_box(self.game.views[self.bodies[0]].features), action_space(actions)

    def _observe(self, state: State) -> Observations:
        observations: Observations = self.game.observe_alike(state, self.bodies)[:, 0]
        return observations


class EthBrakeEnv(OneLearner, gymnasium.Env[NDArray[Any], NDArray[Any]]):
    """One learner in a line whose other vehicles follow scripts (``gymnasium.make("EthBrake-v3")``).

    Arguments, actions, ends, infos and options of ``reset`` are the same as in ``EthBrakeParallelEnv``. Its card,
    ``docs/reference/environment.md``, lists all observed numbers, terms of rewards, infos and arguments.

    >>> import ethbrake_marl as eb
    >>> env = eb.EthBrakeEnv("paper-random")
    >>> observation, info = env.reset(seed=7)
    >>> observation.shape, info["time_s"]
    ((27,), 0.5)
    >>> observation, reward, terminated, truncated, info = env.step([-1.0])
    >>> round(reward, 3), terminated, truncated
    (0.018, False, False)
    """

    metadata: Any = Metadata()

    def __init__(
        self,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str] | None = None,
        reward: Any = "shaped",
        observation: Any = None,
        actions: ActionForm = None,
        reward_vector: Any = None,
        report: Sequence[str] = (),
        max_cycles: int | None = None,
    ) -> None:
        game = scenario, learners, reward, observation, reward_vector, report
        self.observation_space, self.action_space = self._open_one(game, render_mode, actions, max_cycles)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observations, Any]:
        stream, state = self.stream.reset(1, None if seed is None else chosen_seed(seed), options)
        answer = self._observe(state)[0], self._infos(stream, state, None)[0]
        self._keep(stream, state, self.renderer.began)
        super().reset(seed=stream.seed if seed is not None else None)
        return answer

    def step(self, action: Any) -> tuple[Observations, Any, bool, bool, dict[str, Any]]:
        """Advance by one time step with an ``action`` [1]."""
        state, step = self.game.step(self._running(), checked_actions(action, (1, 1), self.name, self.actions))
        reward = self._rewards(step)[0, 0]
        ended = bool(step.terminated[0]), bool(step.truncated[0])
        number = float(reward) if step.vector is None else reward
        answer = self._observe(state)[0], number, *ended, self._infos(self.stream, state, step)[0]
        self._keep(self.stream, state, self.renderer.stepped)
        return answer
