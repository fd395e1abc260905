"""PettingZoo: the vehicles of a line are agents that act in parallel, or in turns (AEC)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from ethbrake_marl.episode.full_state import full_state, state_features
from ethbrake_marl.episode.infos import dictionaries
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import LARGEST_ACTION, Step
from ethbrake_marl.errors import InvalidInput, check_whole_number, unknown_name
from ethbrake_marl.faces.actions import action_space, checked_actions
from ethbrake_marl.faces.rendering import make_renderer, render_metadata
from ethbrake_marl.faces.spaces import FeatureBox, reward_box
from ethbrake_marl.faces.stream import Stream
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.names import open_game
from ethbrake_marl.worlds.game import AnyScenario

Infos = dict[str, dict[str, Any]]


class IgnoredAction(UserWarning):
    """Warning: an action was given for a vehicle that follows a script, and is ignored."""


class EthBrakeParallelEnv(ParallelEnv[str, Observations, Any]):  # type: ignore[misc]  # PettingZoo has no types
    """The vehicles of a line as agents, ``vehicle_1`` (front) to ``vehicle_N``.

    - Action: each learner's, [1] in [-1, 1]: -1 brakes with full capacity, 0 coasts, +1 drives with full capacity.
      Actions of scripted vehicles are ignored.
    - End: all episodes end together, *terminated* when every vehicle is at rest and no command would move it,
      *truncated* at the horizon.
    - ``state()`` is the full state of the line, ``episode`` the ``State`` behind it. Infos: ``episode.infos``.

    Args:
        scenario: a shipped name, the path of a YAML file, the content of one, or a ``Scenario``.
        render_mode: a mode of ``metadata["render_modes"]``; None: no pictures.
        learners: names of the vehicles that learn; None: the scenario's.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        observation: features that every vehicle observes, or vehicle -> features; None: the scenario's.
        agents: which vehicles are agents: ``all``, or the ``learners`` (for libraries that train every agent).
        max_cycles: number of steps after which an episode is truncated; None: the horizon alone.
        actions: None: numbers in [-1, 1]. K >= 2: indices of K evenly spaced ones.
        reward_vector: None: rewards are numbers. ``vehicles``, or a list of components (``episode.terms``): arrays.

    >>> import ethbrake_marl as eb
    >>> env = eb.parallel_env(scenario="paper-random")
    >>> observations, infos = env.reset(seed=7)
    >>> while env.agents:
    ...     observations, rewards, terminations, truncations, infos = env.step({"vehicle_2": [-1.0]})
    >>> terminations["vehicle_2"], round(infos["vehicle_2"]["world_total_harm"], 2)
    (True, 39.95)

    """

    metadata: dict[str, Any] = {"name": "ethbrake_v1", "is_parallelizable": True, **render_metadata()}  # noqa: RUF012
    episode: State

    def __init__(
        self,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str] | None = None,
        reward: Any = "harm",
        observation: Any = None,
        agents: str = "all",
        max_cycles: int | None = None,
        actions: int | None = None,
        reward_vector: Any = None,
    ) -> None:
        if max_cycles is not None:
            check_whole_number("max_cycles", max_cycles, 1)
        self.max_cycles, self.actions, self.render_mode = max_cycles, actions, render_mode
        self.scenario, self.game = open_game(scenario, learners, reward, observation, reward_vector)
        self.stream, self.renderer = Stream(self.scenario, self.game), make_renderer(self, render_mode)
        names, learning = self.scenario.vehicle_names, self.game.rules.learners
        if agents not in ("all", "learners"):
            raise InvalidInput(f"agents = {agents!r}: must be 'all' or 'learners'")
        if not len(learning) and (agents == "learners" or actions is not None):
            raise InvalidInput(
                f"scenario {self.scenario.name!r} has no learner, which agents='learners' and actions need; pass"
                " learners=['vehicle_2']"
            )
        self._bodies = np.arange(1, len(names) + 1) if agents == "all" else learning
        self.possible_agents = [names[i - 1] for i in self._bodies]
        self.agents: list[str] = []
        self._learners = {names[i - 1]: c for c, i in enumerate(learning)}
        self._scripted = [agent for agent in self.possible_agents if agent not in self._learners]
        views = [self.game.views[i] for i in self._bodies]
        self._alike = len(set(views)) == 1
        self.observation_spaces = dict(zip(self.possible_agents, (FeatureBox(v.features) for v in views), strict=True))
        self.action_spaces = {a: action_space(actions if a in self._learners else None) for a in self.possible_agents}
        self._of_state = self.scenario.horizon_s, self.scenario.has_obstacle
        self.state_space = FeatureBox(state_features(len(names), *self._of_state))
        if components := self.game.rewarding.components:  # as MOMAland has it
            self.reward_spaces = {agent: reward_box(components) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> Any:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Return the space of an agent's actions."""
        return self.action_spaces[agent]

    def reward_space(self, agent: str) -> Any:
        """Return the space of an agent's vector rewards. Raises ``InvalidInput`` if rewards are numbers."""
        if not self.game.rewarding.components:
            raise InvalidInput("reward_space: rewards are numbers here; make the environment with reward_vector")
        return self.reward_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], Infos]:
        """Start an episode: the first world of a seed, or the next one.

        Options: ``{"initial_state": ...}``, or ``{"listed_world": {"seed": 7, "number": 3}}`` of an evaluation list.
        """
        self.episode = self.stream.restart(1, seed, options)
        self.agents = self.possible_agents[:]
        if self.renderer is not None:
            self.renderer.began(self.episode)
        return self._observations(), self._infos(None)

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Observations], dict[str, Any], dict[str, bool], dict[str, bool], Infos]:
        """Advance by one time step. Raises ``InvalidInput`` for a missing or bad action of a learner."""
        if not self.agents:
            raise InvalidInput("step: no episode is running; call reset first")
        self.episode, step = self.game.step(self.episode, self._columns(actions))
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        if self.max_cycles is not None and not terminated:
            truncated = truncated or int(self.episode.steps[0]) >= self.max_cycles
        if terminated or truncated:
            self.agents = []
        if self.renderer is not None:
            self.renderer.stepped(self.episode)
        agents, rows = self.possible_agents, self._bodies - 1
        rewards = step.reward[0, rows].tolist() if step.vector is None else [*step.vector[0, rows]]
        return (
            self._observations(),
            dict(zip(agents, rewards, strict=True)),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            self._infos(step),
        )

    def state(self) -> Observations:
        """Return the full state of the line, in the space ``state_space``."""
        self._check_started("state")
        whole: Observations = full_state(self.episode, *self._of_state)[0]
        return whole

    def describe_world(self) -> dict[str, Any]:
        """Return what was drawn for this world: a name such as ``gap_1_m`` or ``scenario`` -> its value."""
        self._check_started("describe_world")
        return {name: column[0].item() for name, column in self.stream.describe(self.episode).items()}

    def render(self) -> Any:
        """Return a picture, as the render mode has it."""
        return None if self.renderer is None else self.renderer.render()

    def close(self) -> None:
        """Give back what the render mode holds."""
        if self.renderer is not None:
            self.renderer.close()

    def _columns(self, actions: Mapping[str, Any]) -> Floats:
        """Return the learners' actions, [1, L]. Behind a shield, a missing one is NaN."""
        if not isinstance(actions, Mapping):
            raise InvalidInput(
                f"step: actions = {actions!r}: must be a mapping from agent to action, such as {{'vehicle_2': [-1.0]}}"
            )
        for agent in actions:
            if agent not in self.action_spaces:
                raise unknown_name("agent", agent, self.possible_agents)
        if self._scripted:
            self._warn_of_ignored(actions)
        columns = np.empty((1, len(self._learners)))
        for agent, c in self._learners.items():
            action = actions.get(agent)
            if action is None and self.game.shield is None:
                raise InvalidInput(f"step: the action of learner {agent} is missing")
            columns[0, c] = np.nan if action is None else checked_actions(action, (1,), agent, self.actions)[0]
        return columns

    def _warn_of_ignored(self, actions: Mapping[str, Any]) -> None:
        ignored = [agent for agent in self._scripted if actions.get(agent) is not None]
        if ignored:
            self._scripted = []  # once
            learners = ", ".join(self._learners)
            right = "no vehicle is a learner; name learners, for instance learners=['vehicle_2']"
            if learners:
                right = f"create the environment with agents='learners' if only {learners} should be agents"
            warnings.warn(
                f"step: actions of {', '.join(ignored)} are ignored, because scripts drive these vehicles; {right}",
                IgnoredAction,
                stacklevel=4,
            )

    def _observations(self) -> dict[str, Observations]:
        if self._alike:
            return dict(zip(self.possible_agents, self.game.observe_alike(self.episode, self._bodies)[0], strict=True))
        each = self.game.observe(self.episode, self._bodies)
        return {agent: seen[0] for agent, seen in zip(self.possible_agents, each, strict=True)}

    def _infos(self, step: Step | None) -> Infos:
        infos = dictionaries(self.game, self.episode, step, self.stream.seed or 0, self._bodies)
        return dict(zip(self.possible_agents, infos, strict=True))

    def _check_started(self, what: str) -> None:
        if not hasattr(self, "episode"):
            raise InvalidInput(f"{what}: no episode has started; call reset first")


parallel_env = EthBrakeParallelEnv


class InTurns(parallel_to_aec_wrapper):  # type: ignore[misc]  # PettingZoo has no types
    """PettingZoo's wrapper from parallel to turns, which also checks an action when it is given.

    After a bad action it is the same agent's turn again.
    """

    def step(self, action: Any) -> None:
        """Store the action of the agent whose turn it is; after the last agent, all vehicles advance."""
        agent, inner = self.agent_selection, self.env.unwrapped
        if self.terminations[agent] or self.truncations[agent]:
            if action is not None:
                raise InvalidInput(f"step: the episode of {agent} has ended; pass the action None, or call reset")
        elif agent in inner._learners and not (action is None and inner.game.shield is not None):
            number = checked_actions(np.nan if action is None else action, (), agent, inner.actions)
            if not -LARGEST_ACTION <= number <= LARGEST_ACTION:
                raise InvalidInput(
                    f"action of {agent} = {float(number)!r}: must be from -1 (full braking) to 1 (full driving)"
                )
        super().step(action)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Start an episode, as in ``EthBrakeParallelEnv``."""
        super().reset(seed, options)
        self._clear_rewards()
        self._cumulative_rewards = {agent: self._no_reward() for agent in self.agents}

    def reward_space(self, agent: str) -> Any:
        """Return the space of an agent's vector rewards."""
        return self.unwrapped.reward_space(agent)

    @property
    def reward_spaces(self) -> Any:
        """Spaces of vector rewards by agent, as MOMAland has them."""
        return self.unwrapped.reward_spaces

    def _clear_rewards(self) -> None:
        for agent in self.rewards:
            self.rewards[agent] = self._no_reward()

    def _no_reward(self) -> Any:
        components = self.env.unwrapped.game.rewarding.components
        return np.zeros(len(components)) if components else 0


def raw_env(scenario: AnyScenario = "paper-random", **settings: Any) -> Any:
    """Return the environment in which agents act in turns, front to rear; settings as in ``parallel_env``.

    >>> import ethbrake_marl as eb
    >>> env = eb.raw_env("paper-random")
    >>> env.reset(seed=7)
    >>> env.agent_selection
    'vehicle_1'

    """
    return OrderEnforcingWrapper(InTurns(parallel_env(scenario, **settings)))


env = raw_env
