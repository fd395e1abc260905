"""The keys ``persistence`` and ``tells`` of ``v2x``: whether messages are repeated, and what they contain."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, Tag

from ethbrake_marl.episode.layer import Layer
from ethbrake_marl.extensions.messages.game import MESSAGES_LAYER
from ethbrake_marl.extensions.messages.links import (
    CHANNEL_COLUMNS,
    DELAY,
    KEY,
    LOSS_BEGINS,
    LOSS_ENDS,
    P_INTENT,
    PERIOD,
    PIECES,
    MessageMemory,
    Piece,
    memory_at_alert,
    samples_kept,
)
from ethbrake_marl.files.model import UNSHOWN, require
from ethbrake_marl.motion.layout import Bools, Floats
from ethbrake_marl.worlds.channel import PER_LINK, V2X, ChannelKey
from ethbrake_marl.worlds.counters import Numbers
from ethbrake_marl.worlds.quantities import NEWS, OF_WORLD
from ethbrake_marl.worlds.quantity import ScenarioPart
from ethbrake_marl.worlds.scenario import Scenario

LATER_LOSSES = (5,)  # stream of the numbers that decide which messages after the first are lost
MOST_SAMPLES = 1_000  # that a vehicle may keep for delayed messages
DEFAULT_CONTENT = PIECES[:P_INTENT]  # what a message contains unless the scenario says otherwise


def _in_order(pieces: list[Piece]) -> list[Piece]:
    require(len(set(pieces)) == len(pieces), (), pieces, "must not list an item twice")
    return [piece for piece in PIECES if piece in pieces]


Contents = Annotated[
    list[Piece], Field(strict=False, json_schema_extra={"uniqueItems": True}), AfterValidator(_in_order)
]


class MessageKeys(ScenarioPart):
    persistence: Literal["first", "periodic"] | None = Field(
        default=None,
        description="what a receiver knows after the first message: first: always the present state of the sender;"
        " periodic: the state in the newest message that arrived; by default first",
    )
    tells: (
        Annotated[
            Annotated[Contents, Tag("#list")] | Annotated[dict[str, Contents], Field(min_length=1), Tag("#mapping")],
            Discriminator(lambda value: "#mapping" if isinstance(value, Mapping) else "#list"),
        ]
        | None
    ) = Field(
        default=None,
        description="contents of messages, for all vehicles or by vehicle name: place, speed, acceleration,"
        " braking_capacity, latency, mass, intent, plan; by default all but intent and plan",
    )


class Messages(ChannelKey):
    name, keys = "messages", MessageKeys

    def uses(self, v2x: V2X) -> tuple[str, ...]:
        """Keys of ``v2x`` that affect messages after the first.

        Raises an error if one of these keys is set but has no effect.
        """
        tells = _value(v2x, "tells")
        right = "needs a channel with separate messages; use a preset that generates messages, such as nominal"
        sent = v2x.hears != "none" and v2x.timing != "latency"
        require(sent or not _is_periodic(v2x), ("persistence",), "periodic", right)
        right = "has no effect, because hears: none means that no vehicle gets messages; leave it out"
        require(tells is None or v2x.hears != "none", ("tells",), tells, right)
        return ("message_period_s", "loss_begins", "loss_ends") if _is_periodic(v2x) else ()

    def is_random(self, v2x: V2X) -> bool:
        return _is_periodic(v2x) and v2x.loss_begins > 0.0

    def check(self, scenario: Scenario) -> None:
        v2x, tells = scenario.v2x, _value(scenario.v2x, "tells")
        for name in tells if isinstance(tells, Mapping) else ():
            right = f"unknown vehicle; this scenario has vehicle_1 ... vehicle_{scenario.vehicles}"
            require(name in scenario.vehicle_names, ("v2x", "tells", name), UNSHOWN, right)
        count = _sample_count(scenario)
        right = (
            f"a message takes {count - 3} time steps; at most {MOST_SAMPLES - 3} are possible, so shorten the delay of"
            " messages or lengthen time_step_s"
        )
        require(count <= MOST_SAMPLES, ("v2x",), v2x, right)

    def at_alert(self, scenario: Scenario, numbers: Numbers, unheard: Bools, n: int) -> MessageMemory:
        """``unheard`` [n or 1, N, N]: whether vehicle i never receives messages of vehicle j."""
        N, v2x = scenario.vehicles, scenario.v2x
        heard_s, seen_s = v2x.heard_and_seen(numbers(PER_LINK * N * N, NEWS), unheard)
        channel: Floats = np.zeros((n, CHANNEL_COLUMNS))
        if _is_periodic(v2x):
            channel[:, PERIOD], channel[:, DELAY] = v2x.message_period_s, _delay_s(v2x)
            channel[:, LOSS_BEGINS], channel[:, LOSS_ENDS] = v2x.loss_begins, v2x.loss_ends
            if self.is_random(v2x):
                channel[:, KEY] = numbers(OF_WORLD, LATER_LOSSES)[:, 0] * 2.0**53
        return memory_at_alert(_contents(scenario), heard_s, seen_s, channel, _sample_count(scenario))

    def layer(self, v2x: V2X) -> Layer:
        return MESSAGES_LAYER


def _value(v2x: V2X, key: str) -> Any:
    return (v2x.model_extra or {}).get(key)


def _is_periodic(v2x: V2X) -> bool:
    return bool(_value(v2x, "persistence") == "periodic")


def _delay_s(v2x: V2X) -> float:
    on_the_way = v2x.radio_s + v2x.processing_s + v2x.actuation_s
    return on_the_way if v2x.link_latency_s is None else v2x.link_latency_s


def _sample_count(scenario: Scenario) -> int:
    return samples_kept(_delay_s(scenario.v2x), scenario.time_step_s) if _is_periodic(scenario.v2x) else 0


def _contents(scenario: Scenario) -> Bools:
    tells = _value(scenario.v2x, "tells")
    contents = (
        tells
        if isinstance(tells, Mapping)
        else dict.fromkeys(scenario.vehicle_names, DEFAULT_CONTENT if tells is None else tells)
    )
    return np.array(
        [[piece in contents.get(name, DEFAULT_CONTENT) for piece in PIECES] for name in scenario.vehicle_names]
    )


DEFAULT_MESSAGES = Messages()
