"""The layer of messages: vehicles observe what they know and estimate, and scripts act on it."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np

from ethbrake_marl.episode.departures import SHOWN
from ethbrake_marl.episode.features import GROUPS, side_of
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import Layer, LayeredScript, observe_through
from ethbrake_marl.episode.observe import Observations, View
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.extensions.messages.belief import (
    ages_s,
    belief_of,
    known_pieces,
    predictable_belief_of,
    require_pieces,
)
from ethbrake_marl.extensions.messages.links import (
    MESSAGES_KEY,
    P_ACCELERATION,
    P_BRAKING,
    P_INTENT,
    P_LATENCY,
    P_MASS,
    P_PLACE,
    P_SPEED,
    PIECES,
    MessageMemory,
    after_step,
    begin_messages,
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


class MessagesLayer(Layer):
    """According to the ``MessageMemory`` in the state."""

    stage = 1

    def first_decision(self, game: Game, alert: State, state: State) -> State:
        require(alert, "v2x: messages with content", SHOWN)
        if not alert.memories[MESSAGES_KEY].is_periodic:
            return state
        sent = partial(game.seen, body=0, before=self)
        return _with_memory(state, begin_messages(alert, state.time_s, game.settings.time_step_s, sent))

    def after(self, game: Game, before: State, state: State) -> State:
        if not before.memories[MESSAGES_KEY].is_periodic:
            return state
        return _with_memory(state, after_step(before, state, partial(game.seen, body=0, before=self)))

    def seen(self, state: State, body: int) -> State:
        return belief_of(state, body)

    def predictable(self, state: State, body: int) -> State:
        return predictable_belief_of(state, body)

    def hides(self, alert: State, body: int) -> Bools:
        """Bodies (0: obstacle) of which vehicle ``body`` does not know everything at its first decision, [n, N + 1]."""
        memory: MessageMemory = alert.memories[MESSAGES_KEY]
        unseen = memory.seen_s[:, body] > alert.car[:, LATENCY, body, np.newaxis]
        lacks = ~memory.contents[:, :, [P_BRAKING, P_LATENCY, P_MASS]].all(axis=2)
        old = memory.is_periodic | ~memory.contents[:, :, [P_PLACE, P_SPEED, P_ACCELERATION]].all(axis=2)
        return np.asarray(lacks | (old & unseen))

    def infos(self, state: State) -> dict[str, Any]:
        """Infos of messages: name -> [n, N], one value for each vehicle.

        ``known_from_s_vehicle_2``: time from which the vehicle reacts to messages of Vehicle 2 (s; infinite: never).
        ``age_s_vehicle_2``: age of its newest sample of Vehicle 2, only with periodic messages (s; infinite: none).
        """
        infos: dict[str, Any] = {}
        reports = {"known_from_s": state.know}
        if state.memories[MESSAGES_KEY].is_periodic:
            reports["age_s"] = ages_s(state)
        for name, values in reports.items():
            infos |= {f"{name}_vehicle_{j}": values[:, 1:, j] for j in range(1, values.shape[2])}
        return infos

    def observe(
        self, later: tuple[Layer, ...], view: View, state: State, body: int, time_step_s: float
    ) -> Observations:
        """Observations of what vehicle ``body`` estimates, [n, F].

        A feature is 0 if it needs a quantity that the vehicle does not know. Feature groups of other packages show a
        vehicle only if the observer knows all of its quantities but the intent.
        """
        observations = np.empty((state.n, len(view.names)), np.float32)
        known, (parts, needs) = known_pieces(state, body), _parts_and_needs(view)
        for part, columns, belief in parts:
            observations[:, columns] = observe_through(later, part, belief(state, body), body, time_step_s)
        for column, offset, pieces in needs:
            if 0 < body + offset < known.shape[1]:
                observations[~known[:, body + offset, pieces].all(axis=1), column] = 0.0
        return observations

    def script(self, script: Any) -> Any:
        return Believer(self, script)


MESSAGES_LAYER = MessagesLayer()


def _with_memory(state: State, memory: MessageMemory) -> State:
    return state._replace(memories={**state.memories, MESSAGES_KEY: memory})


@cache
def _parts_and_needs(view: View) -> tuple[list[tuple[View, Ints, Any]], list[tuple[int, int, list[int]]]]:
    """Parts of a view with their columns and beliefs; and the columns that need pieces, with the sender's offset."""
    names, columns = view.names, np.arange(len(view.names))
    far = np.array([name.partition(".")[0] in GROUPS for name in names])
    parts = [
        (View([names[c] for c in columns[rows]]), columns[rows], belief)
        for rows, belief in ((~far, belief_of), (far, predictable_belief_of))
        if rows.any()
    ]
    split = [name.partition(".") for name in names]
    needs = [
        (column, offset, NEEDS[feature])
        for column, (side, _, feature) in enumerate(split)
        if (offset := side_of(side)) is not None and feature in NEEDS
    ]
    return parts, needs


class Believer(LayeredScript):
    """A script that acts on what its vehicle knows from messages and sensors."""

    def begin(self, alert: State, body: int) -> Any:
        """Memory of the script at the alert.

        Raises ``InvalidInput`` if the vehicle may never learn what the script needs. A script may have ``needs_ahead``:
        quantities of the vehicle ahead that messages must contain unless that vehicle comes into sight.
        """
        if self.needs_ahead and body > 1 and np.isinf(alert.memories[MESSAGES_KEY].seen_s[:, body, body - 1]).any():
            require_pieces(alert, [body], f"agent {self.name!r}", self.needs_ahead, [body - 1])
        return super().begin(alert, body)

    def act(self, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
        """Commands, [n] m/s2, and the new memory.

        Raises ``InvalidInput`` if a command is not finite because the script needs a quantity that messages do not
        contain.
        """
        commands, memory = super().act(state, memory, body)
        if not np.isfinite(commands).all():
            require_pieces(state, [body], f"script of vehicle_{body}", PIECES[:P_INTENT])
        return commands, memory
