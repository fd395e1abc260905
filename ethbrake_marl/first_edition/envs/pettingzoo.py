"""Environments for PettingZoo: the agents are vehicles, which act in parallel or one after another (AEC)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from ethbrake_marl.errors import InvalidInput, check_whole_number, unknown_name
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.envs.infos import OneWorld, Report
from ethbrake_marl.first_edition.envs.making import (
    AnyScenario,
    IgnoredAction,
    action_box,
    feature_box,
    learner_action_space,
    learner_actions,
    make_engine,
    reward_box,
)
from ethbrake_marl.first_edition.envs.viewer import Viewer
from ethbrake_marl.first_edition.game.actions import checked_action
from ethbrake_marl.first_edition.game.full_state import full_state, state_features
from ethbrake_marl.first_edition.game.observations import Observation, Observations
from ethbrake_marl.first_edition.game.reward_vector import RewardVector
from ethbrake_marl.first_edition.game.rewards import Reward
from ethbrake_marl.first_edition.physics.state import Ints


class SeededInside:
    """Mixin for wrappers: ``np_random`` and ``np_random_seed`` are those of the innermost environment."""

    unwrapped: Any  # the innermost environment

    @property
    def np_random(self) -> np.random.Generator:
        """Random generator of the innermost environment (``EthBrakeParallelEnv.np_random``)."""
        generator: np.random.Generator = self.unwrapped.np_random
        return generator

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        self.unwrapped.np_random = generator

    @property
    def np_random_seed(self) -> int:
        """Seed of the innermost environment (``EthBrakeParallelEnv.np_random_seed``)."""
        seed: int = self.unwrapped.np_random_seed
        return seed


class Ordered(SeededInside, OrderEnforcingWrapper):  # type: ignore[misc]  # PettingZoo is untyped
    """PettingZoo's ``OrderEnforcingWrapper`` with the random generator of the innermost environment."""

    def __str__(self) -> str:
        return str(self.env)


class InTurns(SeededInside, parallel_to_aec_wrapper):  # type: ignore[misc]  # PettingZoo is untyped
    """PettingZoo's wrapper from parallel to AEC, which also checks the action of an agent when it is the agent's turn.

    If an action is invalid, the same agent must act again.
    """

    @classmethod
    def around(cls, env: ParallelEnv[str, Observations, NDArray[Any]]) -> AECEnv[str, Observations, NDArray[Any]]:
        """Return an AEC environment around ``env``, a parallel environment of this package with or without wrappers.

        The methods of the AEC environment raise an error if they are called before ``reset`` (PettingZoo's
        ``OrderEnforcingWrapper``).
        """
        return Ordered(cls(env))

    def step(self, action: Any) -> None:
        """Store the action [1] of the agent whose turn it is (``agent_selection``).

        When the last agent has acted, all vehicles advance by one time step. Raises ``InvalidInput`` for an invalid
        action of a learner, and for any action except None after the end of the agent's episode.
        """
        agent, engine, count = self.agent_selection, self.env.unwrapped.engine, self.env.unwrapped.actions
        assert isinstance(engine, Engine)
        if self.terminations[agent] or self.truncations[agent]:
            if action is not None:
                raise InvalidInput(f"step: the episode of {agent} has ended; pass the action None, or call reset")
        elif engine.scenario.vehicle_names.index(agent) in engine.learners and not (action is None and engine.guard):
            checked_action(action, (1,), agent, count)  # behind a shield, an action may be omitted
        super().step(action)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Start an episode; ``seed`` and ``options`` have the same meaning as in ``EthBrakeParallelEnv.reset``."""
        super().reset(seed, options)
        self._clear_rewards()
        self._cumulative_rewards = {agent: self._no_reward() for agent in self.agents}

    def reward_space(self, agent: str) -> Any:
        """Return the space of the vector rewards of ``agent``, a float64 box [K]."""
        return self.unwrapped.reward_space(agent)

    @property
    def reward_spaces(self) -> dict[str, Any]:
        """Mapping from the name of each agent to the space of its vector rewards, for the library MOMAland."""
        spaces: dict[str, Any] = self.unwrapped.reward_spaces
        return spaces

    def _clear_rewards(self) -> None:
        for agent in self.rewards:
            self.rewards[agent] = self._no_reward()

    def _no_reward(self) -> Any:
        """Return a reward of zero: the number 0 or, with vector rewards, a new array [K] of zeros."""
        components = self.env.unwrapped.engine.components
        return np.zeros(len(components)) if components else 0


Infos = dict[str, dict[str, Any]]

WhoIsAgent = Literal["all", "learners"]


class EthBrakeParallelEnv(OneWorld, ParallelEnv[str, Observations, NDArray[Any]]):  # type: ignore[misc]  # PettingZoo is untyped
    """Environment in which the vehicles of a line, ``vehicle_1`` (front) to ``vehicle_N``, are agents.

    - Action: in each step, each learner needs an array [1] in [-1, 1]. -1 brakes with full capacity, 0 coasts, +1
      drives with full capacity. Actions for scripted agents are ignored; ``infos[agent]`` contains the script's
      commands.
    - End: the episodes of all agents end together, *terminated* when all vehicles are at rest and no command would move
      one, or *truncated* at the horizon.
    - ``state()`` returns the full state of the line, for central critics.

    Observations, rewards, infos and ``reset`` are as in ``EthBrakeEnv``.

    Args:
        scenario: name of a shipped scenario, path of a YAML file, content of such a file as a mapping, or a
            ``Scenario``.
        render_mode: ``human``, ``rgb_array``, ``rgb_array_list`` or ``ansi`` (see docs/environments.md); None: no
            pictures.
        learners: vehicles that learn, by name (``vehicle_2``) or index (0 = front); None: the learners of the scenario.
        reward: ``harm``, ``total-harm``, ``paper``, a mapping with settings, or a ``RewardParams`` object.
        observation: features that every vehicle observes, or a mapping from the names of some vehicles to their
            features. By default, a vehicle observes the features that the scenario declares or, if it declares none,
            default features (``observation_for``).
        agents: which vehicles are agents: ``all`` vehicles or only the ``learners``. Choose ``learners`` for training
            libraries that train every agent.
        max_cycles: number of steps after which an episode is truncated; None: at the horizon only.
        actions: None: an action is a number in [-1, 1]. A whole number K >= 2: actions are discrete; the indices
            0 to K - 1 stand for K evenly spaced numbers from -1 (full braking capacity) to 1 (full driving capacity).
        reward_vector: None: a reward is a number. ``vehicles``: a reward is an array [N] that contains minus the harm
            that each vehicle bears in the step. A list of components: a reward is an array with these components (see
            docs/environments.md).

    >>> import ethbrake_marl.first_edition as eb
    >>> env = eb.parallel_env(scenario="paper-random")
    >>> observations, infos = env.reset(seed=7)
    >>> while env.agents:
    ...     observations, rewards, terminations, truncations, infos = env.step({"vehicle_2": [-1.0]})
    >>> terminations["vehicle_2"], round(infos["vehicle_2"]["world_total_harm"], 2)
    (True, 39.95)

    """

    metadata: dict[str, Any] = {"name": "ethbrake_v1", "is_parallelizable": True, **Viewer.METADATA}  # noqa: RUF012

    def __init__(
        self,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str | int] | None = None,
        reward: Reward = "harm",
        observation: Observation | None = None,
        agents: WhoIsAgent = "all",
        max_cycles: int | None = None,
        actions: int | None = None,
        reward_vector: RewardVector | None = None,
    ) -> None:
        if max_cycles is not None:
            check_whole_number("max_cycles", max_cycles, 1)
        self.render_mode, self.max_cycles = render_mode, max_cycles
        self.engine = make_engine(
            scenario, 1, learners=learners, reward=reward, observation=observation, reward_vector=reward_vector
        )
        self.viewer = Viewer(self.engine, render_mode)
        self.metadata = {**self.metadata, **self.viewer.metadata}
        names = self.engine.scenario.vehicle_names
        self._vehicles = _agent_vehicles(self.engine, agents)
        self.possible_agents = [names[i] for i in self._vehicles.tolist()]
        self.agents: list[str] = []
        learners = [names[i] for i in self.engine.learners]
        self._scripted = [agent for agent in self.possible_agents if agent not in learners]  # emptied after a warning
        seen = self.engine.observations
        self._alike = len({seen[i] for i in self._vehicles.tolist()}) == 1
        self.observation_spaces = {names[i]: feature_box(seen[i].features) for i in self._vehicles.tolist()}
        if actions is not None and not learners:
            raise InvalidInput(
                f"actions = {actions!r}: scenario {self.engine.scenario.name!r} has no learner; omit actions, or pass"
                " learners=['vehicle_2']"
            )
        self.actions = actions
        self.action_spaces = {
            agent: learner_action_space(actions) if agent in learners else action_box()
            for agent in self.possible_agents
        }
        self.state_space = feature_box(state_features(self.engine.scenario))
        if self.engine.components:  # attribute of MOMAland
            self.reward_spaces = {agent: reward_box(self.engine) for agent in self.possible_agents}

    def observation_space(self, agent: str) -> Any:
        """Return the observation space of ``agent``, a float32 box [F]. Every call returns the same object."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        """Return the action space of ``agent``. Every call returns the same object.

        The space is a float32 box [1] or, for a learner with discrete actions, ``Discrete(actions)``.
        """
        return self.action_spaces[agent]

    def reward_space(self, agent: str) -> Any:
        """Return the space of the vector rewards of ``agent``, a float64 box [K]."""
        if not self.engine.components:
            raise InvalidInput(
                "reward_space: the rewards of this environment are numbers; create the environment with reward_vector"
            )
        return self.reward_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], Infos]:
        """Start an episode, and return two mappings: from each agent's name to its observation, and to its infos.

        Args:
            seed: start the first world of this seed; None: continue with the next world of the current seed.
            options: to choose the world, ``{"initial_state": ...}`` or ``{"listed_world": {"seed": 7, "number": 3}}``
                (see docs/environments.md).

        """
        self._restart(seed, options)
        self.agents = self.possible_agents[:]
        self.viewer.began()
        return self._observations(), self._infos(Report.of(self.engine))

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Observations], dict[str, Any], dict[str, bool], dict[str, bool], Infos]:
        """Advance by one time step; return observations, rewards, terminations, truncations and infos of all agents.

        ``actions`` and the five results are mappings from the names of agents; each action is [1] in [-1, 1]. Raises
        ``InvalidInput``, which names the learner, if the action of a learner is missing or invalid.
        """
        if not self.agents:
            raise InvalidInput("step: no episode is running; call reset first")
        if not isinstance(actions, (dict, Mapping)):  # dict first, because the check for dict is faster
            raise InvalidInput(
                f"step: actions = {actions!r}: must be a mapping from agent to action, such as {{'vehicle_2': [-1.0]}}"
            )
        for agent in actions:
            if agent not in self.action_spaces:
                raise unknown_name("agent", agent, self.possible_agents)
        if self._scripted:
            self._warn_of_ignored(actions)
        step = self.engine.step(learner_actions(self.engine, actions, self.actions))
        agents = self.possible_agents
        if step.vector is None:
            (rewards,) = step.reward.take(self._vehicles, axis=1).tolist()
        else:
            rewards = [*step.vector[0, self._vehicles]]
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        if self.max_cycles is not None and not terminated:
            truncated = truncated or int(self.engine.steps[0]) >= self.max_cycles
        infos = self._infos(Report.of(self.engine, step))
        if terminated or truncated:
            self.agents = []
        if self.render_mode is not None:
            self.viewer.play()
        return (
            self._observations(),
            dict(zip(agents, rewards, strict=True)),
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            infos,
        )

    def state(self) -> Observations:
        """Return the full state of the line, a float32 array [S] in the space ``state_space``."""
        self._check_started("state")
        state: Observations = full_state(self.engine.worlds, self.engine.scenario)[0].copy()
        return state

    def _warn_of_ignored(self, actions: Mapping[str, Any]) -> None:
        """Warn, only once in each environment, if actions are ignored because the vehicles follow scripts."""
        ignored = [agent for agent in self._scripted if actions.get(agent) is not None]
        if not ignored:
            return
        self._scripted = []
        learners = [self.engine.scenario.vehicle_names[i] for i in self.engine.learners]
        right = "no vehicle is a learner; name learners, for instance learners=['vehicle_2']"
        if learners:
            right = f"create the environment with agents='learners' if only {', '.join(learners)} should be agents"
        text = f"step: actions of {', '.join(ignored)} are ignored, because scripts drive these vehicles; {right}"
        warnings.warn(text, IgnoredAction, stacklevel=3)

    def _observations(self) -> dict[str, Observations]:
        if not self._alike:
            each = (self.engine.observe(vehicle)[0] for vehicle in self._vehicles.tolist())
            return dict(zip(self.possible_agents, each, strict=True))
        every = self.engine.observe_all(self._vehicles)
        return {agent: every[0, i] for i, agent in enumerate(self.possible_agents)}

    def _infos(self, report: Report) -> Infos:
        return dict(zip(self.possible_agents, report.plain_infos(self._vehicles), strict=True))


def _agent_vehicles(engine: Engine, agents: WhoIsAgent) -> Ints:
    """Return the indices of the vehicles that are agents; raise ``InvalidInput`` for an invalid value of ``agents``."""
    if agents not in get_args(WhoIsAgent):
        raise InvalidInput(f"agents = {agents!r}: must be 'all' or 'learners'")
    if agents == "all":
        return np.arange(engine.scenario.vehicles)
    if not engine.learners:
        raise InvalidInput(
            f"agents = 'learners': scenario {engine.scenario.name!r} has no learner; pass learners=['vehicle_2'], or"
            " agents='all'"
        )
    return np.array(engine.learners)


parallel_env = EthBrakeParallelEnv


def raw_env(scenario: AnyScenario = "paper-random", **settings: Any) -> AECEnv[str, Observations, NDArray[Any]]:
    """Return the environment in which agents act one after another, from front to rear (AEC).

    ``scenario`` and ``settings`` have the same meaning as in ``parallel_env``.

    >>> import ethbrake_marl.first_edition as eb
    >>> env = eb.raw_env("paper-random")
    >>> env.reset(seed=7)
    >>> env.agent_selection
    'vehicle_1'

    """
    return InTurns.around(parallel_env(scenario, **settings))


def env(scenario: AnyScenario = "paper-random", **settings: Any) -> AECEnv[str, Observations, NDArray[Any]]:
    """Return the same AEC environment as ``raw_env``: agents act one after another, from front to rear.

    ``scenario`` and ``settings`` have the same meaning as in ``parallel_env``. An invalid action raises
    ``InvalidInput``. After this error the episode goes on, and it is the same agent's turn again.
    """
    return raw_env(scenario, **settings)
