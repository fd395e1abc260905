"""A game: everything of an episode that is not its state. It never changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np

from ethbrake_marl.episode import step as one_step
from ethbrake_marl.episode.observe import Observations, View
from ethbrake_marl.episode.reward import Rewarding
from ethbrake_marl.episode.state import State, check_exact
from ethbrake_marl.episode.step import Rules, Step
from ethbrake_marl.motion.layout import LATENCY, Bools, Floats, Ints


class Script(Protocol):
    """Drives one vehicle: a script, a policy, a search. It sees the whole state, and decides when the learners do."""

    def begin(self, alert: State, body: int) -> Any:
        """Memory for new episodes: None, an array with one row per world, or a tuple of memories."""

    def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
        """Commands of vehicle ``body`` (1: Vehicle 1), [n] m/s2, and the new memory."""


class Shield(Protocol):
    """Decides which of the proposed actions are applied."""

    def begin(self, game: Game, alert: State, state: State) -> Any:
        """Memory for new episodes, whose first decision is ``state``."""

    def decide(self, game: Game, state: State, proposed: Floats | None, *, donate: bool) -> tuple[Floats, Any]:
        """Actions to apply, [n, L], and the new memory.

        ``proposed`` [n, L] are in [-1, 1]; NaN: nothing is proposed. None: its own agents propose.
        """

    def infos(self, game: Game, state: State) -> dict[str, Any]:
        """Values to report: name -> [n]."""


class Game(NamedTuple):
    """Worlds to draw, rules, scripts, what is observed and rewarded, and perhaps a shield.

    ``draw`` returns worlds at the alert, ``reset`` their episodes at the first decision, ``step`` the next decision.
    Environments, evaluation, search and shields share one game and its one step.

    >>> import numpy as np
    >>> import ethbrake_marl as eb
    >>> scenario, game = eb.open_game("paper-random")
    >>> state = game.reset(scenario.sample(2, seed=7))
    >>> after, step = game.step(state, -np.ones((2, 1)))
    >>> state.time_s, after.time_s, step.reward.shape
    (array([0.5, 0.5]), array([0.6, 0.6]), (2, 3))

    """

    draw: Callable[[int, int, int], State]  # (n, seed, first) -> worlds of the training stream at the alert
    name: str  # of the scenario
    rules: Rules
    rewarding: Rewarding
    views: tuple[View, ...]  # what each body observes; entry 0 belongs to the obstacle and is not used
    deciders: Ints  # bodies whose shortest latency is the time of the first decision
    scripts: Mapping[int, Script] = MappingProxyType(
        {}
    )  # body -> script that looks at the state; all others hold their first command
    shield: Shield | None = None

    def reset(self, alert: State) -> State:
        """Episodes of these worlds at their first decision. Scripts have decided once, at the alert."""
        wanted, memories = alert.wanted, dict(alert.memories)
        if self.scripts:
            wanted = wanted.copy()
            for body, script in self.scripts.items():
                memory = one_step.begin(script, alert, body)
                wanted[:, body], memories[body] = one_step.asked(script, alert, memory, body)
        state = self.first_decision(alert._replace(wanted=wanted, memories=memories))
        memories = dict(state.memories)
        if self.rewarding.shaping is not None:
            memories["shaping"] = self.rewarding.shaping.begin(state)
        if self.shield is not None:
            memories["shield"] = self.shield.begin(self, alert, state)
        return state._replace(memories=memories)

    def step(self, state: State, actions: Floats | None, *, donate: bool = False) -> tuple[State, Step]:
        """State after one step of all worlds, and what the step did.

        ``actions`` [n, L] of the learners, in [-1, 1]; behind a shield they are proposals, NaN where there is none,
        and None lets the shield's own agents propose. ``donate``: the memory of ``state`` may be reused. An error
        leaves ``state`` as it was. Raises ``InvalidInput`` for bad actions.
        """
        if self.shield is not None:
            if actions is not None:
                actions = one_step.proposals(self.rules, actions, state.n)
            actions, memory = self.shield.decide(self, state, actions, donate=donate)
            state = state._replace(memories={**state.memories, "shield": memory})
        if self.rewarding.is_compiled:
            return self.follow(state, actions, donate=donate)
        after, step = self.follow(state, actions)
        return self.rewarding.complete(state, step, after)

    def first_decision(self, alert: State) -> State:
        """Episodes at their first decision, before shaping and shield. Scripts have decided.

        Raises ``InvalidInput`` for worlds of a scenario with another physics.
        """
        check_exact(alert, f"scenario {self.name!r}")
        return one_step.first_decision(alert, self.deciders, self.rules.time_step_s, self.rules.horizon_s)

    def follow(self, state: State, actions: Floats | None, *, donate: bool = False) -> tuple[State, Step]:
        """``step`` without shield and without terms of the reward."""
        return one_step.step(self.rules, self.scripts, state, actions, donate=donate)

    def agents(self, drivers: Mapping[int, Any]) -> Mapping[int, Any]:
        """Agents of some vehicles, body -> agent, so that each sees what it may see."""
        return drivers

    def hides(self, alert: State, body: int) -> Bools:
        """Bodies of which vehicle ``body`` does not know everything at its first decision, [n, N + 1]."""
        return alert.know[:, body] > alert.car[:, LATENCY, body, np.newaxis]

    def own_infos(self, state: State) -> dict[str, Any]:
        """Infos that only this game has: name -> [n] or [n, N]."""
        if self.shield is None:
            return {}
        return {f"shield_{name}": value for name, value in self.shield.infos(self, state).items()}

    def observe(self, state: State, bodies: Ints) -> list[Observations]:
        """Observation of each of the ``bodies``, [n, F] each."""
        return [self.views[i].observe(state, np.array([i]), self.rules.time_step_s)[:, 0] for i in bodies.tolist()]

    def observe_alike(self, state: State, bodies: Sequence[int] | Ints) -> Observations:
        """Observations of the ``bodies``, which have one view, [n, len(bodies), F]."""
        bodies = np.asarray(bodies, np.int64)
        return self.views[bodies[0]].observe(state, bodies, self.rules.time_step_s)
