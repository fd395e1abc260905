"""A game: everything that stays the same during an episode. What changes is a ``State``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

import numpy as np

from ethbrake_marl.episode import step as one_step
from ethbrake_marl.episode.commands import proposal_array
from ethbrake_marl.episode.departures import departures_of
from ethbrake_marl.episode.layer import TRUE_STATE, Layer, agent_through, observe_through, see_through
from ethbrake_marl.episode.observe import Observations, View
from ethbrake_marl.episode.reward import Rewarding
from ethbrake_marl.episode.script_calls import ask_scripts, begin_script
from ethbrake_marl.episode.state import HORIZON, State, mark, require
from ethbrake_marl.episode.step import Step, StepSettings
from ethbrake_marl.motion.layout import SCRIPTED, Floats, Ints


class Script(Protocol):
    """Controls one vehicle, by rules, a policy or a search. A script sees the whole state.

    It decides at the alert, and then whenever the learners do. A script remembers nothing in the object, only in
    ``memory``: simulations call the same object, and one script may control several vehicles.
    """

    def begin(self, alert: State, body: int) -> Any:
        """Memory of the script at the alert: None, an array with a row per world, or a tuple or mapping of these."""

    def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
        """Commands of vehicle ``body`` (1: Vehicle 1), [n] m/s2, and the script's new memory."""


class Shield(Protocol):
    """Decides which proposed actions are applied, and which are replaced.

    An optional method ``measures(game, last)`` returns what evaluations report of the shield after the episodes, beside
    the usual measures: name -> a value as that of a measure (``evaluation.measures``).

    >>> import numpy as np
    >>> import ethbrake_marl as eb
    >>> class NeverDrives:
    ...     def begin(self, game, alert, state):
    ...         return None
    ...     def decide(self, game, state, proposed, *, donate):
    ...         return np.minimum(proposed, 0.0), None
    ...     def infos(self, game, state):
    ...         return {}
    >>> scenario, game = eb.open_game("paper-random")
    >>> game = game._replace(shield=NeverDrives())
    >>> state, step = game.step(game.reset(scenario.sample(1, seed=7)), np.ones((1, 1)))
    >>> state.commands_mps2[:, 1]
    array([0.])

    """

    def begin(self, game: Game, alert: State, state: State) -> Any:
        """Memory of the shield for new episodes.

        ``alert`` holds the worlds at the alert, ``state`` the same worlds at their first decision.
        """

    def decide(self, game: Game, state: State, proposed: Floats | None, *, donate: bool) -> tuple[Floats, Any]:
        """Actions to apply to the L learners, [n, L], and the shield's new memory.

        ``proposed`` [n, L] are actions in [-1, 1], or NaN where a learner proposes nothing. If ``proposed`` is None,
        the shield's own agents propose. ``donate``: the arrays of ``state`` may be overwritten.
        """

    def infos(self, game: Game, state: State) -> dict[str, Any]:
        """Values that the shield adds to the infos: name -> [n] or [n, N]."""


class Physics(Protocol):
    """Replaces the exact physics of a game: how vehicles move and collide.

    An optional attribute ``departures`` names how its worlds depart from the plain game (``episode.departures``);
    without it they depart by the name of the class, and all features that predict the exact physics refuse them. If
    ``departures`` is empty, the physics claims to move vehicles exactly, and keeps these features.

    >>> import numpy as np
    >>> import ethbrake_marl as eb
    >>> class Ice:
    ...     def check(self, scenario):
    ...         pass
    ...     def rewarding(self, game):
    ...         return game.rewarding
    ...     def first_decision(self, game, alert):
    ...         return game._replace(physics=None).first_decision(alert)
    ...     def follow(self, game, state, actions):  # learners brake half as hard
    ...         return game._replace(physics=None).follow(state, 0.5 * actions)
    >>> scenario, game = eb.open_game("paper-random", reward="total-harm")
    >>> game = game._replace(physics=Ice())
    >>> state, step = game.step(game.reset(scenario.sample(1, seed=7)), -np.ones((1, 1)))
    >>> state.commands_mps2[:, 1]
    array([-3.5])

    """

    def check(self, scenario: Any) -> None:
        """Refuse (``files.model.refuse``) a scenario that this physics cannot simulate."""

    def rewarding(self, game: Game) -> Rewarding:
        """Rewards of a ``game`` with this physics. Raises ``InvalidInput`` for terms that it cannot compute."""

    def first_decision(self, game: Game, alert: State) -> State:
        """Episodes at their first decision, from worlds at the ``alert``; called by ``Game.first_decision``."""

    def follow(self, game: Game, state: State, actions: Floats | None) -> tuple[State, Step]:
        """State after one step, and what happened in the step; called by ``Game.follow``."""


class Draw(Protocol):
    def __call__(self, n: int, seed: int, first: int) -> State:
        """Worlds ``first`` to ``first + n - 1`` of the training stream of a seed, at the alert."""


class Game(NamedTuple):
    """A source of worlds, settings, scripts, observations, rewards; perhaps layers, other physics and a shield.

    ``draw`` returns worlds at the alert; ``reset`` moves them to the first decision, and ``step`` to the next
    decision. Environments, evaluation, search and shields all use this ``step``.

    >>> import numpy as np
    >>> import ethbrake_marl as eb
    >>> scenario, game = eb.open_game("paper-random")
    >>> state = game.reset(scenario.sample(2, seed=7))
    >>> after, step = game.step(state, -np.ones((2, 1)))
    >>> state.time_s, after.time_s, step.reward.shape
    (array([0.5, 0.5]), array([0.6, 0.6]), (2, 3))

    """

    draw: Draw
    name: str  # of the scenario
    settings: StepSettings
    rewarding: Rewarding
    views: tuple[View, ...]  # what each body observes; entry 0 belongs to the obstacle and is not used
    deciders: Ints  # bodies; the first decision is when the shortest of their latencies has elapsed
    # body -> script that looks at the state; a vehicle that is neither here nor a learner holds its first command
    scripts: Mapping[int, Script] = MappingProxyType({})
    shield: Shield | None = None
    layers: tuple[Layer, ...] = ()  # what vehicles see goes through them; `with_layers` adds some
    physics: Physics | None = None  # None: exact impacts

    def with_layers(self, layers: Sequence[Layer]) -> Game:
        """Copy of this game with further ``layers``, in the order listed, after those that it has already.

        Each layer sees what the layers before it let through. Observations, scripts and agents see what the last lets
        through.
        """
        return self._replace(layers=(*self.layers, *layers))

    def marked(self, alert: State) -> State:
        """The worlds ``alert`` with this game's horizon, scripted vehicles and departures (``episode.departures``).

        Raises ``InvalidInput`` for worlds of another physics, or in which the count of harm in the reward is undefined.
        """
        departures = departures_of(self.physics)
        require(alert, f"scenario {self.name!r}", departures, simulates=True)
        car, clock = alert.car.copy(), alert.clock.copy()
        car[:, SCRIPTED, 1:] = 1.0
        car[:, SCRIPTED, self.settings.learners] = 0.0
        clock[:, HORIZON] = self.settings.horizon_s
        worlds = mark(alert._replace(car=car, clock=clock), departures)
        worlds.defined(self.settings.harm_count)
        return worlds

    def reset(self, alert: State) -> State:
        """Episodes at their first decision, from worlds at the alert. Scripts decide at the alert.

        Raises ``InvalidInput`` for worlds of another physics (``marked``).
        """
        decided = alert = self.marked(alert)
        if self.scripts:
            scripts = self.agents(self.scripts)
            script_memories = {body: begin_script(script, alert, body) for body, script in scripts.items()}
            decided = ask_scripts(scripts, alert._replace(memories={**alert.memories, **script_memories}))
        state = self.first_decision(decided)
        memories = dict(state.memories)
        if self.rewarding.shaping is not None:
            memories["shaping"] = self.rewarding.shaping.begin(state)
        if self.shield is not None:
            memories["shield"] = self.shield.begin(self, alert, state)
        return state._replace(memories=memories)

    def step(self, state: State, actions: Floats | None, *, donate: bool = False) -> tuple[State, Step]:
        """State after one step of all worlds, and what happened in the step.

        Environments, evaluation and simulations make a step in this order::

            state, step = game.step(state, actions)  # a shield may replace actions; then the vehicles move
            observations = game.observe(state, bodies)
            rewards = step.reward[:, bodies - 1]
            terminated, truncated = step.terminated, step.truncated
            infos = dictionaries(game, state, step, seed, bodies)  # of ``episode.infos``

        Within ``step``: the shield decides, scripts choose commands, learners' actions become commands, the physics
        moves every line to the next decision, and harm, end and reward follow from the motion.

        ``actions`` [n, L] are the learners' actions, in [-1, 1]. With a shield they are proposals: NaN is no proposal,
        and if ``actions`` is None, the shield's own agents propose. ``donate``: the arrays of ``state`` may be
        overwritten. Raises ``InvalidInput`` for bad actions; after any error ``state`` is unchanged.
        """
        if self.shield is not None:
            if actions is not None:
                actions = proposal_array(self.settings.learners, actions, state.n)
            actions, memory = self.shield.decide(self, state, actions, donate=donate)
            state = state._replace(memories={**state.memories, "shield": memory})
        if self.rewarding.is_compiled:
            return self.follow(state, actions, donate=donate)
        after, step = self.follow(state, actions)
        return self.rewarding.complete(state, step, after)

    def first_decision(self, alert: State) -> State:
        """Episodes at their first decision, without the memories of shaping and shield, which ``reset`` adds.

        In ``alert`` the scripts have already decided.
        """
        if self.physics is not None:
            state = self.physics.first_decision(self._replace(layers=()), alert)
        else:
            state = one_step.first_decision(alert, self.deciders, self.settings)
        if self.layers:
            state = state._replace(memories={**state.memories, TRUE_STATE: None})
        for layer in self.layers:
            state = layer.first_decision(self, alert, state)
        return state

    def follow(self, state: State, actions: Floats | None, *, donate: bool = False) -> tuple[State, Step]:
        """State after one step, and what happened in the step, without the shield; arguments as in ``step``.

        The reward contains only the two terms that the compiled step computes: ``harm`` of the line and ``terminal``.
        """
        if self.physics is not None:
            # the layers follow below; the physics asks the scripts, which see through them
            plain = self._replace(scripts=self.agents(self.scripts), layers=())
            after, step = self.physics.follow(plain, state, actions)
        else:
            scripts, donate = self.agents(self.scripts), donate and not self.layers
            after, step = one_step.step(self.settings, scripts, state, actions, donate=donate)
        for layer in self.layers:
            after = layer.after(self, state, after)
        return after, step

    def seen(self, state: State, body: int, before: Layer | None = None) -> State:
        """The state as vehicle ``body`` sees it through all layers, or through those before the layer ``before``."""
        for layer in self.layers:
            if layer is before:
                break
            state = see_through(layer, state, body)
        return state

    def agents(self, drivers: Mapping[int, Any]) -> Mapping[int, Any]:
        """The agents or scripts ``drivers``, body -> agent, behind the layers.

        They see what the layers let through to their vehicles. Only an agent that claims more (``layer.UNFILTERED``)
        sees the true state.
        """
        if not self.layers:
            return drivers
        return {body: agent_through(self.layers, agent) for body, agent in drivers.items()}

    def extra_infos(self, state: State) -> dict[str, Any]:
        """Infos of this game's shield and layers: name -> [n] or [n, N]."""
        shield_infos = {} if self.shield is None else self.shield.infos(self, state)
        infos = {f"shield_{name}": value for name, value in shield_infos.items()}
        for layer in self.layers:
            infos |= layer.infos(state)
        return infos

    def observe(self, state: State, bodies: Ints) -> list[Observations]:
        """Observations of each body: a list of arrays [n, F], with the F features that this body observes."""
        step_s = self.settings.time_step_s
        return [observe_through(self.layers, self.views[i], state, i, step_s) for i in bodies.tolist()]

    def observe_alike(self, state: State, bodies: Sequence[int] | Ints) -> Observations:
        """Observations of ``bodies`` that all observe the same F features, [n, len(bodies), F]."""
        bodies = np.asarray(bodies, np.int64)
        if self.layers:
            return np.stack(self.observe(state, bodies), axis=1)
        return self.views[bodies[0]].observe(state, bodies, self.settings.time_step_s)
