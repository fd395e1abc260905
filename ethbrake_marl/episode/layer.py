"""Layers between the true state and what vehicles see of it, such as messages or noisy reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ethbrake_marl.episode.observe import Observations, View
from ethbrake_marl.episode.script_calls import UserScript, name_of
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import EthBrakeError, InvalidInput, describe_error
from ethbrake_marl.motion.layout import Bools, Floats

if TYPE_CHECKING:
    from ethbrake_marl.episode.game import Game

# what an agent says that it `knows`
SENSORS = "own sensors"  # its own vehicle, and the neighbours that its sensors see
MESSAGES = "messages"  # also the messages that the vehicle has received
ESTIMATED = "estimated model"  # also what the scenario says about all worlds: ranges of values, scripts, physics
STATE = "true state"  # also gaps, speeds, capacities and latencies of all vehicles, whether received or not
MODEL = "true model"  # also masses, restitution and scripts: everything that an exact simulation needs
KNOWLEDGE = (SENSORS, MESSAGES, ESTIMATED, STATE, MODEL)
UNSTATED = "not stated"
UNFILTERED = (STATE, MODEL)  # only who says so sees the true state; layers filter all other agents
TRUE_STATE = "true state"  # memory (None) of the true state of a game with layers; what vehicles see has none


class Layer:
    """Changes what vehicles see of the true state. Override the methods that should do more than nothing.

    Each layer of a game sees what the layers before it let through. A layer object has no state: what the layer
    remembers is in ``State.memories``. Physics, rewards and shields use the true state.

    >>> import ethbrake_marl as eb
    >>> from ethbrake_marl.motion.layout import GAP
    >>> class Fog(eb.Layer):
    ...     def seen(self, state, body):
    ...         line = state.line.copy()
    ...         line[:, GAP, 1:-1] *= 1.1
    ...         return state._replace(line=line)
    >>> scenario, game = eb.open_game("paper-random", observation=["front_1.gap"])
    >>> state, foggy = game.reset(scenario.sample(1, seed=7)), game.with_layers([Fog()])
    >>> round(float(foggy.seen(state, 2).gaps_m[0, 0] / state.gaps_m[0, 0]), 3)
    1.1
    >>> bool(foggy.observe_alike(state, [2]) > game.observe_alike(state, [2]))
    True

    """

    # order of the layers that keys of ``v2x`` add: a lower stage first, and within a stage by the names of their keys;
    # stage 0 changes what is sent or measured, stage 1 what arrives (``Game.with_layers`` ignores the stage)
    stage = 0

    def first_decision(self, game: Game, alert: State, state: State) -> State:
        """The state at the first decision, with this layer's memory of what has happened since the ``alert``."""
        return state

    def after(self, game: Game, before: State, state: State) -> State:
        """The state after one step from ``before``, with this layer's new memory."""
        return state

    def seen(self, state: State, body: int) -> State:
        """The state as vehicle ``body`` sees it; ``body`` 0 stands for an observer outside all vehicles.

        ``state`` is what the layers before this one let through. Do not change it in place.
        """
        return state

    def predictable(self, state: State, body: int) -> State:
        """The state for a forecast by vehicle ``body``: as ``seen``, but without vehicles that it cannot predict."""
        return self.seen(state, body)

    def hides(self, alert: State, body: int) -> Bools:
        """For each body of the line: whether this layer hides something about it from vehicle ``body``, [n, N + 1]."""
        return np.zeros((alert.n, alert.vehicles + 1), np.bool_)

    def infos(self, state: State) -> dict[str, Any]:
        """Values that this layer adds to the infos: name -> [n] or [n, N]."""
        return {}

    def measures(self, last: State) -> Mapping[str, Any]:
        """What evaluations report of this layer after the episodes: name -> a value as that of a measure."""
        return {}

    def observe(
        self, later: tuple[Layer, ...], view: View, state: State, body: int, time_step_s: float
    ) -> Observations:
        """Observations of vehicle ``body`` through this layer and the ``later`` ones, [n, F]."""
        return observe_through(later, view, see_through(self, state, body), body, time_step_s)

    def script(self, script: Any) -> Any:
        """Script that acts like ``script`` on the state that this layer lets through to its vehicle."""
        return LayeredScript(self, script)


class LayeredScript:
    """A script that acts on the state that a layer lets through to its vehicle."""

    def __init__(self, layer: Layer, script: Any) -> None:
        self.layer, self.inner, self.name = layer, script, name_of(script)
        self.needs_ahead = getattr(script, "needs_ahead", ())

    def begin(self, alert: State, body: int) -> Any:
        return self.inner.begin(see_through(self.layer, alert, body), body)

    def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
        answer: tuple[Floats, Any] = self.inner.act(see_through(self.layer, state, body), memory, body)
        return answer


@dataclass(frozen=True, kw_only=True)
class Observer:
    """Base class of agents that act on the observations of a view. The agent observes the state through ``layers``."""

    layers: tuple[Layer, ...] = ()

    def predictable(self, state: State, body: int) -> State:
        """The state for a forecast by vehicle ``body``, through all layers."""
        check_seen(self, state, body)
        for layer in self.layers:
            state = see_through(layer, state, body, "predictable")
        return state


def check_seen(agent: Any, state: State, body: int) -> None:
    """Raise ``InvalidInput`` if an agent that has no layers would act on the true state of a game with layers."""
    if TRUE_STATE in state.memories and not getattr(agent, "layers", ()):
        raise InvalidInput(
            f"agent {name_of(agent)!r}: this is the true state, of which vehicle_{body} sees only a part; call"
            f" game.agents({{{body}: agent}})[{body}].act(state, memory, {body}), which sees what the vehicle sees"
        )


def see_through(layer: Layer, state: State, body: int, method: str = "seen") -> State:
    """State as vehicle ``body`` sees it through one layer. Raises ``InvalidInput`` if the layer fails."""
    what = f"layer {type(layer).__name__}"
    try:
        view = getattr(layer, method)(state, body)
    except EthBrakeError:
        raise
    except Exception as error:
        raise InvalidInput(f"{what}: {method} fails: {describe_error(error)}") from error
    if not isinstance(view, State) or view.line.shape != state.line.shape:
        raise InvalidInput(f"{what}: {method} must return a State of the same {state.n} worlds and vehicles")
    return view._replace(memories={name: memory for name, memory in view.memories.items() if name != TRUE_STATE})


def observe_through(layers: tuple[Layer, ...], view: View, state: State, body: int, time_step_s: float) -> Observations:
    """Observations of vehicle ``body``, [n, F]. The first layer is the nearest to the true ``state``."""
    if not layers:
        return view.observe(state, np.array([body]), time_step_s)[:, 0]
    return layers[0].observe(layers[1:], view, state, body, time_step_s)


def script_through(layers: tuple[Layer, ...], script: Any) -> Any:
    for layer in reversed(layers):
        script = layer.script(script)
    return script


def agent_through(layers: tuple[Layer, ...], agent: Any) -> Any:
    """``agent`` behind all ``layers``. An agent that claims to know more (``UNFILTERED``) is unchanged."""
    if isinstance(agent, UserScript):
        return UserScript(agent_through(layers, agent.script), agent.is_agent, agent.first_alerts)
    if isinstance(agent, Observer):
        return replace(agent, layers=layers)
    return agent if getattr(agent, "knows", UNSTATED) in UNFILTERED else script_through(layers, agent)
