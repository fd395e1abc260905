"""A game with messages: vehicles observe what they believe, and scripts act on it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from ethbrake_marl.agents.drive import MESSAGES, SENSORS
from ethbrake_marl.agents.policy_agent import LearnedAgent, PolicyAgent
from ethbrake_marl.episode.features import GROUPS, Own, side_of
from ethbrake_marl.episode.game import Game, Script
from ethbrake_marl.episode.observe import Observations, Plan, View
from ethbrake_marl.episode.state import State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.extensions.messages.belief import ages_s, believed, believed_whole, known_pieces, require_pieces
from ethbrake_marl.extensions.messages.links import (
    NAME,
    P_ACCELERATION,
    P_BRAKING,
    P_LATENCY,
    P_MASS,
    P_PLACE,
    P_SPEED,
    PIECES,
    Memory,
    after_step,
    begin,
)
from ethbrake_marl.motion.layout import LATENCY, Bools, Floats, Ints

STOPS = [P_PLACE, P_SPEED, P_BRAKING, P_LATENCY]
NEEDS = {  # feature of a neighbour -> pieces without which it reads 0
    "gap": [P_PLACE],
    "closing_speed": [P_SPEED],
    "acceleration": [P_ACCELERATION],
    "braking_capacity": [P_BRAKING],
    "mass": [P_MASS],
    "latency_left": [P_LATENCY],
    "stopping_margin": STOPS,
    "fitting_deceleration": STOPS,
}


class GameWithMessages(Game):
    """A game whose states contain the ``Memory`` of messages."""

    __slots__ = ()

    @classmethod
    def of(cls, game: Game) -> GameWithMessages:
        views = tuple(believed_view(view) for view in game.views)
        return cls(*game._replace(views=views, scripts={i: Believer(script) for i, script in game.scripts.items()}))

    def first_decision(self, alert: State) -> State:
        state = super().first_decision(alert)
        if not state.memories[NAME].is_periodic:
            return state
        return _remembering(state, begin(alert, state.time_s, self.settings.time_step_s))

    def follow(self, state: State, actions: Floats | None, *, donate: bool = False) -> tuple[State, Step]:
        after, step = super().follow(state, actions)
        return believed_after(state, after), step

    def agents(self, drivers: Mapping[int, Any]) -> Mapping[int, Any]:
        return {body: believing(agent) for body, agent in drivers.items()}

    def hides(self, alert: State, body: int) -> Bools:
        """Bodies (0: obstacle) that vehicle ``body`` does not fully know at its first decision, [n, N + 1]."""
        memory: Memory = alert.memories[NAME]
        unseen = memory.seen_s[:, body] > alert.car[:, LATENCY, body, np.newaxis]
        lacks = ~memory.contents[:, :, [P_BRAKING, P_LATENCY, P_MASS]].all(axis=2)
        old = memory.is_periodic | ~memory.contents[:, :, [P_PLACE, P_SPEED, P_ACCELERATION]].all(axis=2)
        return np.asarray(super().hides(alert, body) | lacks | (old & unseen))

    def own_infos(self, state: State) -> dict[str, Any]:
        """Infos of messages, and those of the shield: name -> [n, N], one value for each vehicle that acts.

        ``known_from_s_vehicle_2``: time from which a vehicle acts on news of Vehicle 2 (s; infinite: never).
        ``age_s_vehicle_2``: age of its newest sample of Vehicle 2, with periodic messages (s; infinite: none).
        """
        infos = super().own_infos(state)
        reports = {"known_from_s": state.know}
        if state.memories[NAME].is_periodic:
            reports["age_s"] = ages_s(state)
        for name, values in reports.items():
            infos |= {f"{name}_vehicle_{j}": values[:, 1:, j] for j in range(1, values.shape[2])}
        return infos


def believed_after(before: State, after: State) -> State:
    return _remembering(after, after_step(before, after)) if before.memories[NAME].is_periodic else after


def _remembering(state: State, memory: Memory) -> State:
    return state._replace(memories={**state.memories, NAME: memory})


def believing(agent: Any) -> Any:
    """Agent that acts on what its vehicle estimates, if ``agent`` uses only sensors and messages.

    Any other agent is returned unchanged.
    """
    view = agent.policy.observation if isinstance(agent, LearnedAgent) else getattr(agent, "observation", None)
    if isinstance(agent, LearnedAgent | PolicyAgent):
        return replace(agent, observation=believed_view(view))
    return Believer(agent) if getattr(agent, "knows", None) in (SENSORS, MESSAGES) else agent


@cache
def believed_view(view: View) -> BelievedView:
    return BelievedView(view)


class BelievedView(View):
    """A view of what the observer estimates. A feature is 0 if it needs a quantity that the observer does not know.

    Feature groups of other packages show a vehicle only if the observer knows all of its quantities but the intent.
    """

    def __init__(self, view: View) -> None:
        super().__init__(view.names)
        columns = np.arange(len(self.names))
        far = np.array([name.partition(".")[0] in GROUPS for name in self.names])
        self.parts = [
            (kind([self.names[c] for c in columns[rows]]), columns[rows], belief)
            for kind, rows, belief in ((PieceView, ~far, believed), (View, far, believed_whole))
            if rows.any()
        ]
        split = [name.partition(".") for name in self.names]
        self.needs = [
            (column, offset, NEEDS[last])
            for column, (side, _, last) in enumerate(split)
            if (offset := side_of(side)) is not None and last in NEEDS
        ]

    def observe(self, state: State, observers: Ints, time_step_s: float) -> Observations:
        seen = np.empty((state.n, len(observers), len(self.names)), np.float32)
        for o, body in enumerate(observers.tolist()):
            known = known_pieces(state, body)
            for view, columns, belief in self.parts:
                seen[:, o, columns] = view.observe(belief(state, body), np.array([body]), time_step_s)[:, 0]
            for column, offset, pieces in self.needs:
                if 0 < body + offset < known.shape[1]:
                    seen[~known[:, body + offset, pieces].all(axis=1), o, column] = 0.0
        return seen


class PieceView(View):
    """A view that replaces NaN, for a quantity not received, by the feature's value for an unknown neighbour."""

    @cached_property
    def plan(self) -> Plan:
        plan = View(self.names).plan
        return plan._replace(own=tuple((column, _or_unknown(own), offset) for column, own, offset in plan.own))


def _or_unknown(own: Own) -> Own:
    def function(state: State, body: int, other: int) -> Floats:
        value = np.asarray(own.function(state, body, other))
        return np.where(np.isnan(value) & _is_partly_known(state, other), own.unknown, value)

    return own if own.of == "own" else own._replace(function=function)


def _is_partly_known(state: State, other: int) -> Bools:
    parts = (state.line[:, :, other], state.car[:, :, other], state.wanted[:, [other]])
    return np.asarray(np.isnan(np.concatenate(parts, axis=1)).any(axis=1))


class Believer:
    def __init__(self, script: Script) -> None:
        self.script = script

    @property
    def name(self) -> str:
        return str(getattr(self.script, "name", type(self.script).__name__))

    def begin(self, alert: State, body: int) -> Any:
        """Memory of the script at the alert. Raises ``InvalidInput`` if it will not know what it needs.

        A script may have ``needs_ahead``: quantities of the vehicle ahead that messages must contain until it is in
        sight.
        """
        needs = getattr(self.script, "needs_ahead", ())
        if needs and body > 1 and np.isinf(alert.memories[NAME].seen_s[:, body, body - 1]).any():
            require_pieces(alert, [body], f"agent {self.name!r}", needs, [body - 1])
        return self.script.begin(believed(alert, body), body)

    def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
        """Commands of the script, [n] m/s2, and its new memory; it acts on what vehicle ``body`` knows.

        Raises ``InvalidInput`` for a script that needs more.
        """
        commands, memory = self.script.act(believed(state, body), memory, body)
        if not np.isfinite(commands).all():
            require_pieces(state, [body], f"script of vehicle_{body}", PIECES[:-1])
        return commands, memory
