"""The channel between vehicles: V2X messages on each link, losses, and on-board sensing as the fall-back.

A message carries its sender's state, capacities and latency, or the pieces that ``tells`` names. On the link from
vehicle j to vehicle i, i can use it from this time on:

    tau_ij = U(0, T) + k T + L_radio + t_proc + t_act        (T the message period)

``U(0, T)`` is the wait for the next message. ``k`` is the number of periods lost to a burst (Gilbert-Elliott channel:
``P(k >= m) = (p / (p + r)) (1 - r)^(m - 1)``). On the share ``lost`` of the links no message ever arrives. Sensors see
the direct neighbours, with a delay of ``sensing_s``, called a hop. Vehicle i can react from

    latency_i = max(own latency_i, min(tau_i1, latency_(i-1) + hop_(i, i-1)))

on, because nobody reacts to an emergency before learning of it: by Vehicle 1's own message, or by seeing the vehicle
ahead brake. Vehicle i knows of vehicle j from ``max(latency_i, tau_ij)``, or for a direct neighbour in sight from
``max(latency_i, hop_ij)`` if that is earlier. Of latencies a vehicle observes only the own parts: delays that the
channel draws become visible only when they end. Under the preset ``paper``, the paper's rule, a vehicle knows
everything from its own latency on.

With ``persistence: first`` that is all: from its first message on, the present state of j is known. With ``periodic``
messages follow every T, each lost or not by the same Gilbert-Elliott channel. What i knows of j is then as old as the
newest message that arrived (``physics.messages``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import not_
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, GetJsonSchemaHandler, ValidationError, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.model import FileModel, Wording, explain, require, suggestion
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.physics.messages import PIECES, USUAL_PIECES, Messages, Piece
from ethbrake_marl.physics.state import Bools, Floats, Ints, Vehicles, Worlds

PER_LINK = 4  # uniform numbers per link: wait, burst, loss, hop; the output of one Philox counter

Hears = Literal["all", "front", "none"]

Senses = Literal["both", "front", "none"]

Persistence = Literal["first", "periodic"]

Tells = tuple[Piece, ...] | Mapping[str, tuple[Piece, ...]]  # for all vehicles, or by name

Seconds = Annotated[float, Field(ge=0.0, le=60.0, allow_inf_nan=False)]

Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Equipage(FileModel):
    """V2X equipment of one vehicle or of a type of vehicles."""

    sends: bool = Field(default=True, description="whether others can hear of it")
    hears: Hears = Field(default="all", description="whose messages it gets, of those that the channel brings")


class Equipped(NamedTuple):
    """V2X equipment of the vehicles in n worlds.

    It has a single row (n = 1) if all worlds share it, or if it says what every vehicle has at least in all worlds.
    """

    sends: Bools  # [n, N] whether vehicle i sends messages
    hears: Ints  # [n, N] whose messages vehicle i gets: 0 everybody's, 1 only those from ahead, 2 nobody's

    @classmethod
    def of(cls, equipage: Sequence[Equipage]) -> Equipped:
        """Return the equipment of one world whose vehicle i has ``equipage[i]``, [1, N]."""
        hears = [get_args(Hears).index(each.hears) for each in equipage]
        return cls(np.array([[each.sends for each in equipage]]), np.array([hears]))

    @property
    def unheard(self) -> Bools:
        """Whether vehicle i never gets a message from vehicle j, [n, N, N]."""
        receiver, sender = np.indices((self.sends.shape[1],) * 2)
        hears = self.hears[:, :, np.newaxis]
        unheard: Bools = ~self.sends[:, np.newaxis] | (hears == 2) | ((hears == 1) & (sender >= receiver))
        return unheard


class Channel(NamedTuple):
    """All settings that decide what each vehicle knows, and when; symbols as at the top of this file."""

    # delay tau of a link: "latency": none beyond the receiver's own latency; "fixed": link_latency_s; "messages": drawn
    # from the settings of messages and losses below
    timing: Literal["latency", "fixed", "messages"]
    hears: Hears = "all"  # whose messages a vehicle receives: everybody's, only from vehicles ahead, nobody's
    senses: Senses = "both"  # which direct neighbours are in sight
    link_latency_s: float = 0.0  # delay tau of every link for timing "fixed" (s)
    loss_begins: float = 0.0  # p, probability per message period that a burst of losses begins
    loss_ends: float = 1.0  # r, probability per message period that it ends; mean burst 1 / r periods
    lost: float = 0.0  # share of links on which no message ever arrives
    message_period_s: float = 0.1  # T
    radio_s: float = 0.02  # L_radio
    processing_s: float = 0.1  # t_proc
    actuation_s: float = 0.2  # t_act
    sensing_s: tuple[float, float] = (0.8, 1.1)  # range from which a hop is drawn uniformly
    persistence: Persistence = "first"  # after the first message, the present is known, or the newest message
    tells: Tells | None = None  # pieces that a message contains; None: USUAL_PIECES

    def contents(self, vehicles: int) -> Bools | None:
        """Return whether messages of each vehicle contain each of ``PIECES``, [N, len(PIECES)]; None: as usual."""
        if self.tells is None:
            return None
        each: list[tuple[Piece, ...]] = [USUAL_PIECES] * vehicles
        for i in range(vehicles):
            each[i] = self.tells.get(f"vehicle_{i + 1}", each[i]) if isinstance(self.tells, Mapping) else self.tells
        return np.array([[piece in told for piece in PIECES] for told in each])

    @property
    def delay_s(self) -> float:
        """Time from sending a message to its use (s); infinite if no messages are sent."""
        if self.timing == "messages":
            return self.radio_s + self.processing_s + self.actuation_s
        return self.link_latency_s if self.timing == "fixed" else math.inf

    def samples(self, time_step_s: float) -> int:
        """Return how many samples of its state a vehicle stores for delayed messages; 0 without periodic messages.

        ``time_step_s``: time between two samples, which is the time between two decisions (s).
        """
        return Messages.ring_length(self.delay_s, time_step_s) if self.persistence == "periodic" else 0


CHANNELS = {
    "paper": Channel("latency", senses="none"),
    "clear": Channel("messages", loss_begins=0.01, loss_ends=0.5),
    "nominal": Channel("messages", loss_begins=0.05, loss_ends=0.5),
    "congested": Channel("messages", loss_begins=0.10, loss_ends=0.30, lost=0.05),
    "blocked": Channel("messages", loss_begins=0.20, loss_ends=0.20, lost=0.20),
    "sensors-only": Channel("messages", hears="none"),
}

PRESETS = tuple(CHANNELS)  # names of the built-in presets; ``register_preset`` adds more to CHANNELS

_LATEST = np.array([[1.0, 0.0, 1.0, 1.0]])  # uniform numbers of the latest possible message that is not lost

_OF_LATER = ("message_period_s", "loss_begins", "loss_ends")  # settings that apply to messages after the first

_OF_MESSAGES = ("message_period_s", "loss_begins", "loss_ends", "radio_s", "processing_s", "actuation_s")


def _known_preset(name: str) -> str:
    *names, last = CHANNELS
    require(name in CHANNELS, (), name, f"must be {', '.join(names)} or {last}")
    return name


class _PresetSchema:
    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"enum": list(CHANNELS), "type": "string"}


Preset = Annotated[str, AfterValidator(_known_preset), _PresetSchema]


def _pieces(value: Any) -> Tells | None:
    """Check and sort what messages contain: a list of pieces for all vehicles, or one for each named vehicle."""
    if value is None:
        return None
    by_name = isinstance(value, Mapping)
    right = f"must be a list of {', '.join(PIECES)}, or such a list for each vehicle by name"
    require(isinstance(value, list | tuple) or (by_name and len(value) > 0), (), value, right)
    pieces: dict[str, tuple[Piece, ...]] = {}
    for name, listed in value.items() if by_name else [("", value)]:
        at = (name,) if by_name else ()
        require(isinstance(name, str) and isinstance(listed, list | tuple), at, listed, right)
        for k, piece in enumerate(listed):
            hint = suggestion(piece, PIECES) if isinstance(piece, str) else ""
            require(piece in PIECES, (*at, k), piece, f"{hint}; known: {', '.join(PIECES)}".removeprefix("; "))
        require(len(set(listed)) == len(listed), at, listed, "names a piece twice")
        pieces[name] = tuple(piece for piece in PIECES if piece in listed)
    return pieces if by_name else pieces[""]


class _TellsSchema:
    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        listed = {"type": "array", "items": {"enum": list(PIECES)}, "uniqueItems": True}
        by_name = {"type": "object", "minProperties": 1, "additionalProperties": listed}
        return {"anyOf": [listed, by_name]}


class V2X(FileModel):
    """The V2X channel of a scenario: a preset and the settings that differ from it; see ``docs/cooperation.md``.

    In YAML it is written as the preset's name alone, or as a mapping.
    """

    preset: Preset = Field(
        default="paper", description="where to start from; the other keys take the place of its values"
    )
    hears: Hears | None = Field(
        default=None, description="whose messages a vehicle gets: everybody's, only those from ahead, nobody's"
    )
    senses: Senses | None = Field(default=None, description="which direct neighbours are in sight")
    link_latency_s: Seconds | None = Field(
        default=None, description="fixed delay of every link, in place of the generated one"
    )
    lost: Share | None = Field(
        default=None, description="share of links, not of vehicles, on which nothing ever arrives"
    )
    message_period_s: Annotated[float, Field(gt=0.0, le=60.0, allow_inf_nan=False)] | None = Field(
        default=None, description="T, time between two messages"
    )
    loss_begins: Share | None = Field(
        default=None, description="p, chance per message period that a burst of losses begins"
    )
    loss_ends: Annotated[float, Field(ge=0.01, le=1.0, allow_inf_nan=False)] | None = Field(
        default=None, description="r, chance per message period that it ends"
    )
    radio_s: Seconds | None = Field(default=None, description="L_radio, time on the air")
    processing_s: Seconds | None = Field(default=None, description="t_proc, time until the receiver has read it")
    actuation_s: Seconds | None = Field(default=None, description="t_act, time until the brakes answer")
    sensing_s: Annotated[tuple[Seconds, Seconds], Field(strict=False)] | None = Field(
        default=None, description="[low, high]: the delay of sight, a hop, is drawn evenly from it"
    )
    persistence: Persistence | None = Field(
        default=None,
        exclude_if=not_,
        description="whether what was once heard stays present, or grows old until the next message",
    )
    tells: Annotated[Any, BeforeValidator(_pieces), _TellsSchema] = Field(
        default=None,
        exclude_if=lambda tells: tells is None,
        description="what a message contains, for all vehicles or by name: place, speed, acceleration,"
        " braking_capacity, latency, mass, intent; by default all but intent",
    )
    vehicles: dict[str, Equipage] | None = Field(
        default=None,
        exclude_if=not_,
        description="vehicle -> what it has of V2X, where that differs: {vehicle_3: {sends: false, hears: none}}",
    )

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, value: Any) -> Any:
        right = f"must be a preset ({', '.join(CHANNELS)}), or a mapping such as {{preset: nominal, lost: 0.1}}"
        require(isinstance(value, str | dict | V2X), (), value, right)
        return {"preset": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _possible(self) -> V2X:
        channel = self.channel
        sent = channel.hears != "none" and channel.timing != "latency"
        right = "nobody sends messages one by one here; give a preset that generates them, such as nominal"
        self._require(channel.persistence == "first" or sent, "persistence", right)
        if channel.hears == "none":
            self._leave_out(
                ("link_latency_s", "lost", "vehicles", "tells", *_OF_MESSAGES), "hears none has no messages"
            )
        elif channel.timing == "fixed":
            later = _OF_LATER if channel.persistence == "periodic" else ()
            parts = tuple(name for name in _OF_MESSAGES if name not in later)
            self._leave_out(parts, "a fixed link_latency_s has no generated messages")
        elif channel.timing == "latency":
            self._leave_out((*_OF_MESSAGES, "vehicles"), f"preset {self.preset} has no generated messages")
        if channel.senses == "none":
            self._leave_out(("sensing_s",), "senses none has nobody in sight")
        low, high = channel.sensing_s
        self._require(low <= high, "sensing_s", "low must not be above high")
        silent = channel.timing == "messages" or channel.hears == "none" or channel.lost > 0.0
        blind = channel.senses == "none" and silent and channel.timing != "latency"
        right = (
            "without sight of the vehicle ahead, one that hears nothing would never react; use senses: both or front"
        )
        # name a key that the user gave: of the presets only paper has senses none
        self._require(not blind, "senses" if self.senses is not None else "lost", right)
        return self

    def _leave_out(self, names: tuple[str, ...], why: str) -> None:
        """Raise an error for the first of the keys ``names`` that is given, because it would have no effect.

        ``why`` says the reason in the message.
        """
        for name in names:
            self._require(getattr(self, name) is None, name, f"{why}; leave it out")

    def _require(self, holds: bool, name: str, right: str) -> None:
        value = getattr(self, name)
        require(holds, (name,), getattr(self.channel, name, value) if value is None else value, right)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Return the JSON schema: the name of a preset, or a mapping."""
        mapping = handler(core)
        return {"anyOf": [{"enum": list(CHANNELS), "type": "string"}, mapping]}

    @property
    def channel(self) -> Channel:
        """The preset's channel with the given settings replaced."""
        values = {name: getattr(self, name) for name in Channel._fields[1:] if getattr(self, name) is not None}
        base = CHANNELS[self.preset]
        return base._replace(timing="fixed" if self.link_latency_s is not None else base.timing, **values)

    @property
    def by_link(self) -> bool:
        """Whether the channel differs from the paper's rule: a vehicle knows everything after its own latency."""
        return self.channel != CHANNELS["paper"]

    @property
    def delays(self) -> bool:
        """Whether the channel differs from the paper's rule in more than what messages contain."""
        return self.channel._replace(tells=None) != CHANNELS["paper"]

    @property
    def drawn(self) -> bool:
        """Whether what is known, and when, is random: it differs from world to world."""
        channel = self.channel
        low, high = channel.sensing_s
        by_messages = channel.timing == "messages" and channel.hears != "none"
        lossy = channel.hears != "none" and 0.0 < channel.lost < 1.0
        lossy = lossy or (channel.persistence == "periodic" and channel.loss_begins > 0.0)
        return self.by_link and (by_messages or lossy or (channel.senses != "none" and low != high))

    def latest_reaction_s(self, own_latency_s: Floats, equipped: Equipped) -> Floats:
        """Return an upper bound of the time at which each vehicle can react, [N] s.

        Args:
            own_latency_s: upper bounds of the vehicles' own latencies, without the channel, [N] s.
            equipped: equipment that the vehicles have at least in every world, [1, N].

        """
        channel, latest = self.channel, own_latency_s.copy()
        if channel.timing == "latency":
            return latest
        sure = channel.hears != "none" and channel.lost == 0.0
        heard = float(link_delays(channel, _LATEST)[0]) if sure else np.inf
        for i in range(1, len(latest)):
            seen = latest[i - 1] + channel.sensing_s[1] if channel.senses != "none" else np.inf
            latest[i] = max(latest[i], min(seen, np.inf if equipped.unheard[0, i, 0] else heard))
        return latest

    @staticmethod
    def width(vehicles: int) -> int:
        """Return how many uniform numbers the links of a line of ``vehicles`` vehicles need per world."""
        return PER_LINK * vehicles * vehicles

    def with_news(self, vehicles: Vehicles, u: Floats, equipped: Equipped) -> Vehicles:
        """Return these vehicles with the latencies, and the times of first knowledge, that the channel gives them.

        The previous latencies, which must be without a channel, become ``own_latency_s``.

        Args:
            vehicles: parameters of n worlds.
            u: uniform numbers in [0, 1) for the links, [n, N * N * PER_LINK].
            equipped: V2X equipment, of each world or one for all.

        """
        (N, channel), (heard, seen) = (vehicles.latency_s.shape[1], self.channel), self.heard_and_seen(u, equipped)
        latency = vehicles.latency_s.copy()
        if channel.timing != "latency":
            for i in range(1, N):
                news = np.minimum(heard[:, i, 0], latency[:, i - 1] + seen[:, i, i - 1])
                latency[:, i] = np.maximum(latency[:, i], news)
        known = np.maximum(latency[:, :, np.newaxis], np.minimum(heard, seen))
        known[:, np.arange(N), np.arange(N)] = latency  # a vehicle knows itself from its latency on
        return replace(vehicles, latency_s=latency, known_from_s=known)

    def heard_and_seen(self, u: Floats, equipped: Equipped) -> tuple[Floats, Floats]:
        """Return when vehicle i can use the first message of vehicle j, and when i sees j, [n, N, N] s each.

        Infinite means never.

        Args:
            u: uniform numbers in [0, 1) for the links, [n, N * N * PER_LINK].
            equipped: V2X equipment, of each world or one for all.

        """
        N = equipped.sends.shape[1]
        channel, links = self.channel, u.reshape(len(u), N, N, PER_LINK)
        low, high = channel.sensing_s
        hop = low + (high - low) * links[..., 3]
        heard = link_delays(channel, links)
        receiver, sender = np.indices((N, N))
        unheard = {"all": sender < 0, "front": sender >= receiver, "none": sender >= 0}
        heard = np.where(unheard[channel.hears] | equipped.unheard, np.inf, heard)
        ahead = sender == receiver - 1
        in_sight = {"both": ahead | (sender == receiver + 1), "front": ahead, "none": sender < 0}
        return heard, np.where(in_sight[channel.senses], hop, np.inf)

    def with_channel(self, worlds: Worlds, u: Floats, key: Floats, time_step_s: float, equipped: Equipped) -> Worlds:
        """Return these worlds with what each vehicle knows when, and the columns of periodic messages.

        Args:
            worlds: worlds without a channel, at the alert (time 0).
            u: uniform numbers for the links, [n, N * N * PER_LINK] in [0, 1).
            key: seed of each world's later losses, [n] in [0, 1).
            time_step_s: time between two decisions, at which vehicles sample their states.
            equipped: V2X equipment, of each world or one for all.

        """
        channel, contents = self.channel, self.channel.contents(worlds.N)
        worlds = replace(worlds, vehicles=self.with_news(worlds.vehicles, u, equipped))
        if channel.persistence == "first" and contents is None:
            return worlds
        periodic = channel.persistence == "periodic"
        heard, seen = self.heard_and_seen(u, equipped)
        messages = Messages.silent(
            heard, seen, key * 2.0**53, channel.samples(time_step_s),
            period_s=channel.message_period_s if periodic else 0.0, delay_s=channel.delay_s if periodic else 0.0,
            loss_begins=channel.loss_begins, loss_ends=channel.loss_ends, contents=contents,
        )  # fmt: skip
        return replace(worlds, messages=messages.columns)

    def with_fixed_news(self, worlds: Worlds, time_step_s: float, where: str, equipped: Equipped | None) -> Worlds:
        """Return worlds from the user with this channel; raise ``InvalidInput`` if the channel is random.

        Args:
            worlds: worlds without a channel.
            time_step_s: time between two decisions, s.
            where: source of the worlds, for the message.
            equipped: V2X equipment of the vehicles, one row for all worlds; None: the scenario draws it.

        """
        if not self.by_link:
            return worlds
        if self.drawn or equipped is None:
            raise InvalidInput(
                f"{where}: the scenario draws what each vehicle knows when (v2x: {self.preset}); take one whose channel"
                " is fixed, for instance scenario.replace(v2x='paper')"
            )
        n, N = worlds.speeds_mps.shape
        return self.with_channel(worlds, np.zeros((n, self.width(N))), np.zeros(n), time_step_s, equipped)


def burst_periods(u: Floats, loss_begins: float, loss_ends: float) -> Ints:
    """Return the number k of message periods that a burst of losses lasts, in the shape of ``u``.

    ``k >= m`` exactly if ``u < (p / (p + r)) (1 - r)^(m - 1)``: the inverse distribution function of the stationary
    Gilbert-Elliott channel. It uses multiplication only, so every machine gets the same k.

    Args:
        u: uniform numbers in [0, 1).
        loss_begins: probability p per message that a good channel turns bad.
        loss_ends: probability r per message that a bad channel turns good again.

    """
    bound = loss_begins / (loss_begins + loss_ends)
    bounds = []
    while bound > 2.0**-53:
        bounds.append(bound)
        bound *= 1.0 - loss_ends
    rising = np.array(bounds[::-1])
    periods: Ints = len(rising) - np.searchsorted(rising, u, side="right")
    return periods


def link_delays(channel: Channel, u: Floats) -> Floats:
    """Return the delay tau (s) of each link, [...]; infinite: no message arrives.

    Minus infinity for timing ``latency``, where only the receiver's own latency counts.

    Args:
        channel: settings of the channel.
        u: uniform numbers in [0, 1) of each link, [..., PER_LINK].

    """
    delay = np.full(u.shape[:-1], -np.inf if channel.timing == "latency" else channel.link_latency_s)
    if channel.timing == "messages":
        periods = burst_periods(u[..., 1], channel.loss_begins, channel.loss_ends)
        delay = (u[..., 0] + periods) * channel.message_period_s + channel.delay_s
    delay[u[..., 2] < channel.lost] = np.inf
    return delay


_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


def register_preset(name: str, settings: Mapping[str, Any]) -> None:
    """Register a channel under a name, so that every scenario can use ``v2x: name``.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        settings: what ``v2x`` in a scenario would contain, for example ``{"preset": "nominal", "lost": 0.1}``.

    Registering the same channel again changes nothing. Raises ``AlreadyExists`` if the name belongs to another channel,
    ``InvalidInput`` for an invalid name or settings that are not a channel.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"preset {name!r:.80}: must be 1 to 64 of a-z, 0-9, - and _, not beginning with - or _")
    if not isinstance(settings, Mapping):
        raise InvalidInput(f"preset {name!r}: settings = {settings!r:.80}: must be a mapping such as {{'lost': 0.1}}")
    try:
        channel = V2X.model_validate(dict(settings)).channel
    except ValidationError as error:
        raise explain(Document(f"preset {name!r}", dict(settings), {}), error, Wording(V2X)) from None
    if CHANNELS.setdefault(name, channel) != channel:
        raise AlreadyExists(f"preset {name!r} is registered already; give another name")
