"""PettingZoo: the vehicles of a line are agents that act in parallel, or in turns (AEC)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec_wrapper
from pettingzoo.utils.wrappers import OrderEnforcingWrapper

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.agents.action_scale import ActionForm
from ethbrake_marl.episode.full_state import full_state, state_features
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.episode.state import ENDED, State
from ethbrake_marl.episode.step import TERMINATED, TRUNCATED
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.faces.face import Face
from ethbrake_marl.faces.rendering import Metadata
from ethbrake_marl.faces.spaces import action_space, checked_actions, feature_box, reward_box
from ethbrake_marl.faces.stream import chosen_seed
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.worlds.open_game import AnyScenario

Infos = dict[str, dict[str, Any]]


class EthBrakeParallelEnv(Face, ParallelEnv[str, Observations, Any]):  # type: ignore[misc]  # PettingZoo has no types
    """Emergency braking: N vehicles drive in one lane, Vehicle 1 brakes, and those behind it try to do little harm.

    The vehicles are the agents, ``vehicle_1`` (front) to ``vehicle_N``. Learners act; the others follow scripts.
    ``docs/reference/environment.md`` is the card: it lists all observed numbers, terms of rewards, infos and arguments.

    **Action space.** ``Box(-1, 1, (1,), float32)`` for every agent: -1 brakes with full capacity, 0 coasts, +1 drives
    with full capacity, once the vehicle's latency since the alert has elapsed. Every learner needs an action, unless
    the environment has a shield; actions of scripted vehicles are ignored. With ``actions=K`` a learner's space is
    ``Discrete(K)``.

    **Observation space.** A float32 box of the features that the vehicle observes, each with its bounds; the attribute
    ``features`` of the box has their names (``episode.features``). ``state()`` is the full state of the line as a
    vector; ``episode`` is the ``State`` object.

    **Rewards.** Minus 0.05 times the honest cost of the step (``episode.counts``), the same for all vehicles, and for
    learners a potential whose discounted sum is a constant of the world (``episode.shaping``). ``info["cost"]`` is
    the honest cost. Other counts of harm, objectives of single vehicles and other terms: ``reward``.

    **Start.** A world is drawn from the scenario at the alert, when Vehicle 1 begins to brake. The first observation
    comes when the first learner's latency has elapsed. ``reset(seed=...)`` begins with the first world of the seed, and
    ``reset()`` with the next world; the options of ``reset`` choose a world.

    **End.** All agents end together: *terminated* when every vehicle is at rest and no command would move it,
    *truncated* at the scenario's horizon. A step lasts ``time_step_s`` of the scenario, usually 0.1 s.

    **Infos.** Time, commands, harm so far, seed and number of the world, and values of the shield (``episode.infos``).

    Args:
        scenario: a shipped name, the path or content of a YAML file, or a ``Scenario``.
        render_mode: a mode of ``metadata["render_modes"]``; None: no pictures.
        learners: names of the vehicles that learn; None: the scenario's.
        reward: ``shaped``, ``honest`` (minus the honest cost, without scale and potential), ``first-impact-harm``
            (pushing is free), ``total-harm``, ``paper-reward``, a mapping of settings, or ``RewardParams``. A mapping
            counts the honest cost unless its ``harm_count`` says otherwise.
        observation: features that every vehicle observes, or vehicle -> features; None: the scenario's.
        agents: which vehicles are agents: ``all``, or the ``learners`` (for libraries that train every agent).
        max_cycles: number of steps after which an episode is truncated (info ``cut``); None: only at the horizon.
        actions: form of actions. None: numbers in [-1, 1]. K >= 2: indices of K evenly spaced numbers. Or an
            ``ActionScale``.
        reward_vector: components of array rewards, ``vehicles`` or a list of names (``episode.terms``); None: rewards
            are numbers.
        report: names of terms (``episode.terms``) whose value infos contain as ``reward_NAME``, with or without a
            weight in the reward.

    >>> import ethbrake_marl as eb
    >>> env = eb.parallel_env(scenario="paper-random")
    >>> observations, infos = env.reset(seed=7)
    >>> while env.agents:
    ...     observations, rewards, terminations, truncations, infos = env.step({"vehicle_2": [-1.0]})
    >>> terminations["vehicle_2"], round(infos["vehicle_2"]["world_honest_cost"], 2)
    (True, 39.95)

    """

    metadata: Any = Metadata(name="ethbrake_v3", is_parallelizable=True)

    def __init__(
        self,
        scenario: AnyScenario = "paper-random",
        render_mode: str | None = None,
        learners: Sequence[str] | None = None,
        reward: Any = "shaped",
        observation: Any = None,
        agents: str = "all",
        max_cycles: int | None = None,
        actions: ActionForm = None,
        reward_vector: Any = None,
        report: Sequence[str] = (),
    ) -> None:
        self._open(open_game(scenario, learners, reward, observation, reward_vector, report), render_mode, max_cycles)
        if agents not in ("all", "learners"):
            raise InvalidInput(f"agents = {agents!r}: must be 'all' or 'learners'")
        if agents == "learners" or actions is not None:
            self._need_learner()
        names, learning = self.scenario.vehicle_names, self.game.settings.learners
        self.actions, self.bodies = actions, np.arange(1, len(names) + 1) if agents == "all" else learning
        self._rows = {names[i - 1]: i - 1 for i in self.bodies}  # of an agent's vehicle in the arrays of a step
        self._learners = [names[i - 1] for i in learning]
        views = [self.game.views[i] for i in self.bodies]
        self._alike = len(set(views)) == 1
        self._observation_spaces = dict(zip(self._rows, (feature_box(view.features) for view in views), strict=True))
        self._action_spaces = {
            agent: action_space(actions if agent in self._learners else None) for agent in self._rows
        }
        self.state_space = feature_box(state_features(len(names), *self._of_state))
        components = self.game.rewarding.components
        self._reward_spaces = {agent: reward_box(components) for agent in self._rows if components}

    @cached_property
    def np_random(self) -> np.random.Generator:
        """Random numbers for wrappers that draw; the same ones after each reset to the same world of a seed."""
        seed = self.stream.seed
        return np.random.default_rng(None if seed is None else [seed, self.stream.next])

    # New lists and dictionaries: a caller may sort or change them

    @property
    def possible_agents(self) -> list[str]:
        return [*self._rows]

    @property
    def agents(self) -> list[str]:
        running = self.episode is not None and self.episode.clock[0, ENDED] == 0.0
        return self.possible_agents if running else []

    @property
    def observation_spaces(self) -> dict[str, Any]:
        return {**self._observation_spaces}

    @property
    def action_spaces(self) -> dict[str, Any]:
        return {**self._action_spaces}

    @property
    def reward_spaces(self) -> dict[str, Any]:
        """Empty if rewards are numbers."""
        return {**self._reward_spaces}

    def observation_space(self, agent: str) -> Any:
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> Any:
        return self._action_spaces[agent]

    def reward_space(self, agent: str) -> Any:
        """As MOMAland has it. Raises ``InvalidInput`` if rewards are numbers."""
        if not self._reward_spaces:
            raise InvalidInput("reward_space: rewards are numbers here; make the environment with reward_vector")
        return self._reward_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observations], Infos]:
        """Start an episode in the first world of ``seed``, or without a seed in the next world.

        Options choose the world: ``{"initial_state": {"gaps_m": [7, 7], ...}}``, or a world of an evaluation list,
        ``{"listed_world": {"seed": 7, "number": 3}}``.
        """
        stream, state = self.stream.reset(1, None if seed is None else chosen_seed(seed), options)
        answer = self._observations(state), self._by_agent(self._infos(stream, state, None))
        self._keep(stream, state, self.renderer.began)
        self.__dict__.pop("np_random", None)
        return answer

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[dict[str, Observations], dict[str, Any], dict[str, bool], dict[str, bool], Infos]:
        """Advance by one time step. Raises ``InvalidInput`` for a missing or bad action of a learner."""
        state, step = self.game.step(self._running(), self._columns(actions))
        rewards = step.reward[0].tolist() if step.vector is None else step.vector[0]
        answer = (
            self._observations(state),
            {agent: rewards[row] for agent, row in self._rows.items()},
            dict.fromkeys(self._rows, bool(step.out[TERMINATED, 0])),
            dict.fromkeys(self._rows, bool(step.out[TRUNCATED, 0])),
            self._by_agent(self._infos(self.stream, state, step)),
        )
        self._keep(self.stream, state, self.renderer.stepped)
        return answer

    def state(self) -> Observations:
        """Full state of the line, [S] float32, in ``state_space``."""
        state_vector: Observations = full_state(self._begun("state"), *self._of_state)[0]
        return state_vector

    def _columns(self, actions: Mapping[str, Any]) -> Floats:
        """Actions of the learners, [1, L]; NaN for a missing action, which is allowed only with a shield."""
        if not isinstance(actions, Mapping):
            raise InvalidInput(
                f"step: actions = {actions!r}: must be a mapping from agent to action, such as {{'vehicle_2': [-1.0]}}"
            )
        for agent in actions:
            if agent in self._rows:
                continue
            if agent in self.scenario.vehicle_names:
                raise InvalidInput(
                    f"step: {agent} follows the script {self.scenario.roles[agent]}, so it takes no action here; leave"
                    f" its action out, or make the environment with learners={[*self._learners, agent]}"
                )
            raise unknown_name("agent", agent, self._rows)
        columns = []
        for agent in self._learners:
            action = actions.get(agent)
            if action is None and self.game.shield is None:
                raise InvalidInput(f"step: the action of learner {agent} is missing")
            columns.append(math.nan if action is None else checked_actions(action, (1,), agent, self.actions).item())
        return np.array([columns])

    def _observations(self, state: State) -> dict[str, Observations]:
        if self._alike:
            return self._by_agent(self.game.observe_alike(state, self.bodies)[0])
        return self._by_agent([observation[0] for observation in self.game.observe(state, self.bodies)])

    def _by_agent(self, values: Any) -> dict[str, Any]:
        return dict(zip(self._rows, values, strict=True))


parallel_env = EthBrakeParallelEnv


class OrderedTurns(OrderEnforcingWrapper):  # type: ignore[misc]
    """PettingZoo's check, with a ``last`` that looks up fewer attributes."""

    def last(self, observe: bool = True) -> tuple[Any, ...]:
        return self.env.last(observe) if self._has_reset else super().last(observe)  # type: ignore[no-any-return]

    def __str__(self) -> str:
        return str(self.env)


def raw_env(scenario: AnyScenario = "paper-random", **settings: Any) -> Any:
    """Environment in PettingZoo's AEC form (agents act in turns, front to rear), with arguments of ``parallel_env``.

    A bad action is refused at the turn of the last agent.

    >>> import ethbrake_marl as eb
    >>> env = eb.raw_env("paper-random")
    >>> env.reset(seed=7)
    >>> env.agent_selection
    'vehicle_1'

    """
    return OrderedTurns(parallel_to_aec_wrapper(parallel_env(scenario, **settings)))


env = raw_env
