"""The channel between vehicles: V2X messages on each link, losses of messages, and sensors that see the neighbours.

A link is the direction from a sending vehicle j to a receiving vehicle i. A message contains the sender's place, speed,
acceleration, braking capacity, latency and mass, or the items listed in ``tells``. Vehicle i can use the first message
of vehicle j from the time ``tau_ij`` (in s after the alert) on:

    tau_ij = U(0, T) + k T + L_radio + t_proc + t_act

T is the message period, and ``U(0, T)`` the random wait for the next message. L_radio is the time of transmission,
t_proc the time until the message is processed, and t_act the time until the brakes respond. ``k`` is the number of
message periods during which a burst of losses destroys every message. In each period, a burst begins with probability
p, and an ongoing burst ends with probability r. In the stationary state of this Gilbert-Elliott channel,
``P(k >= m) = (p / (p + r)) (1 - r)^(m - 1)`` for m = 1, 2, ... With probability ``lost`` no message ever arrives on a
link. A vehicle's sensors see its direct neighbours after a delay, called a *hop*, which is drawn from the range
``sensing_s``. Vehicle i can react to the emergency from the time ``latency_i`` (in s after the alert) on:

    latency_i = max(own latency_i, min(tau_i1, latency_(i-1) + hop_(i, i-1)))

At this time, vehicle i's own latency has elapsed, and vehicle i has either received the message of Vehicle 1 or seen
the vehicle ahead brake. Vehicle i knows the state of vehicle j from ``max(latency_i, tau_ij)`` on, or from
``max(latency_i, min(tau_ij, hop_ij))`` on if it also sees vehicle j. If a vehicle observes another vehicle's latency,
it observes the *own* latency of that vehicle, which does not include delays of the channel. Under the preset ``paper``
a vehicle knows the state of every vehicle as soon as its own latency has elapsed.

With ``persistence: first``, vehicle i knows the present state of vehicle j after the first message. With
``persistence: periodic``, vehicle j sends a message in every period T, and each message may be lost in a burst. Vehicle
i then knows the state that is contained in the newest message that has arrived (``physics.messages``).

Arguments that several methods share: ``u`` has the uniform numbers in [0, 1) that draw the random values of all links,
[n, N * N * PER_LINK]. ``equipped`` is the V2X equipment, one row per world or one row for all worlds. ``time_step_s``
is the time between two decisions, s.
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
from ethbrake_marl.first_edition.physics.messages import PIECES, USUAL_PIECES, Messages, Piece
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Vehicles, Worlds

PER_LINK = 4  # uniform numbers per link: wait, burst, loss, hop; the output of one Philox counter

Hears = Literal["all", "front", "none"]

Senses = Literal["both", "front", "none"]

Persistence = Literal["first", "periodic"]

Tells = tuple[Piece, ...] | Mapping[str, tuple[Piece, ...]]  # contents of messages: for all vehicles, or by name

Seconds = Annotated[float, Field(ge=0.0, le=60.0, allow_inf_nan=False)]

Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Equipage(FileModel):
    """V2X equipment of one vehicle, or of all vehicles of one type."""

    sends: bool = Field(default=True, description="whether the vehicle sends messages")
    hears: Hears = Field(
        default="all",
        description="senders whose messages the vehicle receives, if the channel delivers them: all, front (vehicles"
        " ahead) or none",
    )


class Equipped(NamedTuple):
    """V2X equipment of the vehicles in n worlds.

    The arrays have a single row (n = 1) if all worlds have the same equipment, or if the row contains the least
    equipment that each vehicle has in any world.
    """

    sends: Bools  # [n, N] whether vehicle i sends messages
    hears: Ints  # [n, N] senders whose messages vehicle i receives: 0 all vehicles, 1 vehicles ahead, 2 none

    @classmethod
    def of(cls, equipage: Sequence[Equipage]) -> Equipped:
        """Return the equipment of one world in which vehicle i has the equipment ``equipage[i]``, [1, N]."""
        hears = [get_args(Hears).index(each.hears) for each in equipage]
        return cls(np.array([[each.sends for each in equipage]]), np.array([hears]))

    @property
    def unheard(self) -> Bools:
        """Mask [n, N, N]: True where vehicle i (second axis) never receives a message from vehicle j (third axis)."""
        receiver, sender = np.indices((self.sends.shape[1],) * 2)
        hears = self.hears[:, :, np.newaxis]
        unheard: Bools = ~self.sends[:, np.newaxis] | (hears == 2) | ((hears == 1) & (sender >= receiver))
        return unheard


class Channel(NamedTuple):
    """All settings that determine what each vehicle knows, and when."""

    # how the delay tau of a link arises: "latency": tau is the receiver's own latency; "fixed": tau is link_latency_s;
    # "messages": tau is drawn with the settings of messages and losses below
    timing: Literal["latency", "fixed", "messages"]
    hears: Hears = "all"  # senders whose messages a vehicle receives: all, front (vehicles ahead) or none
    senses: Senses = "both"  # which direct neighbours are in sight
    link_latency_s: float = 0.0  # delay tau of every link for timing "fixed" (s)
    loss_begins: float = 0.0  # p, probability per message period that a burst of losses begins
    loss_ends: float = 1.0  # r, probability per message period that a burst ends; its mean length is 1 / r periods
    lost: float = 0.0  # probability that no message ever arrives on a link
    message_period_s: float = 0.1  # T, time between two messages (s)
    radio_s: float = 0.02  # L_radio, time of transmission (s)
    processing_s: float = 0.1  # t_proc, time until the receiver has processed a message (s)
    actuation_s: float = 0.2  # t_act, time until the receiver's brakes respond (s)
    sensing_s: tuple[float, float] = (0.8, 1.1)  # range of the uniform distribution of a hop (s)
    persistence: Persistence = "first"  # known after the first message: the present state, or the newest message
    tells: Tells | None = None  # items of PIECES that a message contains; None: USUAL_PIECES

    def contents(self, vehicles: int) -> Bools | None:
        """Return a mask [N, len(PIECES)]: True where a vehicle's messages contain an item; None if ``tells`` is not
        given.

        Without ``tells``, messages contain the items in ``USUAL_PIECES``.
        """
        if self.tells is None:
            return None
        each: list[tuple[Piece, ...]] = [USUAL_PIECES] * vehicles
        for i in range(vehicles):
            each[i] = self.tells.get(f"vehicle_{i + 1}", each[i]) if isinstance(self.tells, Mapping) else self.tells
        return np.array([[piece in pieces for piece in PIECES] for pieces in each])

    @property
    def delay_s(self) -> float:
        """Time from sending a message until the receiver can use it (s); infinite if no messages are sent."""
        if self.timing == "messages":
            return self.radio_s + self.processing_s + self.actuation_s
        return self.link_latency_s if self.timing == "fixed" else math.inf

    def samples(self, time_step_s: float) -> int:
        """Return how many samples of its own state a vehicle stores for its messages, one sample per decision.

        The result is 0 without periodic messages.
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

_LATEST = np.array(
    [[1.0, 0.0, 1.0, 1.0]]
)  # uniform numbers of a link with the largest delay at which a message arrives

_OF_LATER = ("message_period_s", "loss_begins", "loss_ends")  # settings of the messages after the first one

_OF_MESSAGES = ("message_period_s", "loss_begins", "loss_ends", "radio_s", "processing_s", "actuation_s")


def _known_preset(name: str) -> str:
    *names, last = CHANNELS
    require(name in CHANNELS, (), name, f"must be a preset: {', '.join(names)} or {last}")
    return name


class _PresetSchema:
    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"enum": list(CHANNELS), "type": "string"}


Preset = Annotated[str, AfterValidator(_known_preset), _PresetSchema]


def _pieces(value: Any) -> Tells | None:
    """Check the value of the key ``tells``; return its items in the order of ``PIECES``."""
    if value is None:
        return None
    by_name = isinstance(value, Mapping)
    right = f"must be a list of items from {', '.join(PIECES)}, or a mapping from vehicle names to such lists"
    require(isinstance(value, list | tuple) or (by_name and len(value) > 0), (), value, right)
    pieces: dict[str, tuple[Piece, ...]] = {}
    for name, listed in value.items() if by_name else [("", value)]:
        at = (name,) if by_name else ()
        require(isinstance(name, str) and isinstance(listed, list | tuple), at, listed, right)
        for k, piece in enumerate(listed):
            hint = suggestion(piece, PIECES) if isinstance(piece, str) else ""
            require(piece in PIECES, (*at, k), piece, f"{hint}; known: {', '.join(PIECES)}".removeprefix("; "))
        require(len(set(listed)) == len(listed), at, listed, "must not list an item twice")
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

    In YAML, ``v2x`` is the name of a preset or a mapping.
    """

    preset: Preset = Field(default="paper", description="preset whose values are used for keys that are left out")
    hears: Hears | None = Field(
        default=None, description="senders whose messages a vehicle receives: all, front (vehicles ahead) or none"
    )
    senses: Senses | None = Field(default=None, description="direct neighbours in sight: both, front or none")
    link_latency_s: Seconds | None = Field(
        default=None, description="fixed delay from every sender to every receiver, instead of a random one"
    )
    lost: Share | None = Field(default=None, description="share of links (not of vehicles) on which no message arrives")
    message_period_s: Annotated[float, Field(gt=0.0, le=60.0, allow_inf_nan=False)] | None = Field(
        default=None, description="T, time between two messages of a sender"
    )
    loss_begins: Share | None = Field(
        default=None, description="p, probability per message period that a burst of losses begins"
    )
    loss_ends: Annotated[float, Field(ge=0.01, le=1.0, allow_inf_nan=False)] | None = Field(
        default=None, description="r, probability per message period that a burst of losses ends"
    )
    radio_s: Seconds | None = Field(default=None, description="L_radio, time to transmit a message")
    processing_s: Seconds | None = Field(
        default=None, description="t_proc, time until the receiver has processed a message"
    )
    actuation_s: Seconds | None = Field(default=None, description="t_act, time until the receiver's brakes respond")
    sensing_s: Annotated[tuple[Seconds, Seconds], Field(strict=False)] | None = Field(
        default=None, description="[low, high]: range of the uniform delay after which a neighbour is seen"
    )
    persistence: Persistence | None = Field(
        default=None,
        exclude_if=not_,
        description="what a receiver knows after the first message: first: always the present state of the sender;"
        " periodic: the state in the newest message that arrived",
    )
    tells: Annotated[Any, BeforeValidator(_pieces), _TellsSchema] = Field(
        default=None,
        exclude_if=lambda tells: tells is None,
        description="contents of messages, for all vehicles or by vehicle name: place, speed, acceleration,"
        " braking_capacity, latency, mass, intent; by default all but intent",
    )
    vehicles: dict[str, Equipage] | None = Field(
        default=None,
        exclude_if=not_,
        description="vehicles with other V2X equipment than the rest, such as {vehicle_3: {sends: false, hears: none}}",
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
        right = "needs a channel with separate messages; use a preset that generates messages, such as nominal"
        self._require(channel.persistence == "first" or sent, "persistence", right)
        if channel.hears == "none":
            self._leave_out(
                ("link_latency_s", "lost", "vehicles", "tells", *_OF_MESSAGES),
                "hears: none means that no vehicle gets messages",
            )
        elif channel.timing == "fixed":
            later = _OF_LATER if channel.persistence == "periodic" else ()
            parts = tuple(name for name in _OF_MESSAGES if name not in later)
            self._leave_out(parts, "link_latency_s fixes the delay of messages")
        elif channel.timing == "latency":
            self._leave_out((*_OF_MESSAGES, "vehicles"), f"preset {self.preset} generates no messages")
        if channel.senses == "none":
            self._leave_out(("sensing_s",), "senses: none means that no vehicle is in sight")
        low, high = channel.sensing_s
        self._require(low <= high, "sensing_s", "low must not be above high")
        silent = channel.timing == "messages" or channel.hears == "none" or channel.lost > 0.0
        blind = channel.senses == "none" and silent and channel.timing != "latency"
        right = "a vehicle that may never get a message must see the vehicle ahead; use senses: both or front"
        # name a key that the user gave: of the presets only paper has senses none
        self._require(not blind, "senses" if self.senses is not None else "lost", right)
        return self

    def _leave_out(self, names: tuple[str, ...], why: str) -> None:
        """Raise an error, with the reason ``why``, if one of the keys ``names`` is set although it has no effect."""
        for name in names:
            self._require(getattr(self, name) is None, name, f"has no effect, because {why}; leave it out")

    def _require(self, holds: bool, name: str, right: str) -> None:
        value = getattr(self, name)
        require(holds, (name,), getattr(self.channel, name, value) if value is None else value, right)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """JSON schema: the name of a preset, or a mapping."""
        mapping = handler(core)
        return {"anyOf": [{"enum": list(CHANNELS), "type": "string"}, mapping]}

    @property
    def channel(self) -> Channel:
        """The values of the preset, except where ``v2x`` gives another value."""
        values = {name: getattr(self, name) for name in Channel._fields[1:] if getattr(self, name) is not None}
        base = CHANNELS[self.preset]
        return base._replace(timing="fixed" if self.link_latency_s is not None else base.timing, **values)

    @property
    def by_link(self) -> bool:
        """Whether the channel differs from the paper's rule (a vehicle knows everything after its own latency)."""
        return self.channel != CHANNELS["paper"]

    @property
    def delays(self) -> bool:
        """Whether the channel differs from the paper's rule in anything other than the contents of messages."""
        return self.channel._replace(tells=None) != CHANNELS["paper"]

    @property
    def drawn(self) -> bool:
        """Whether random numbers determine what vehicles know, or when they know it."""
        channel = self.channel
        low, high = channel.sensing_s
        by_messages = channel.timing == "messages" and channel.hears != "none"
        lossy = channel.hears != "none" and 0.0 < channel.lost < 1.0
        lossy = lossy or (channel.persistence == "periodic" and channel.loss_begins > 0.0)
        return self.by_link and (by_messages or lossy or (channel.senses != "none" and low != high))

    def latest_reaction_s(self, own_latency_s: Floats, equipped: Equipped) -> Floats:
        """Return, for each vehicle, an upper bound of the time from which the vehicle can react, [N] s.

        ``own_latency_s`` has upper bounds of the own latencies, [N] s. ``equipped`` has one row: the least equipment
        that each vehicle has in any world.
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
        """Return how many uniform numbers one world needs for all links in a line of ``vehicles`` vehicles."""
        return PER_LINK * vehicles * vehicles

    def with_news(self, vehicles: Vehicles, u: Floats, equipped: Equipped) -> Vehicles:
        """Return ``vehicles`` with the channel's delays, in the latencies and in ``known_from_s``.

        The latencies in the argument ``vehicles`` must not include delays of a channel; they become ``own_latency_s``
        of the result.
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
        """Return (heard, seen): time from which vehicle i can use the first message of j, and delay until i sees j.

        Both arrays have the shape [n, N, N] (world, i, j) and the unit s. Infinite means never, minus infinite at once.
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
        """Return ``worlds`` with the times from which each vehicle knows every other, and with the periodic messages.

        ``worlds`` are at the alert and do not yet contain delays or messages of a channel. The random losses of all
        messages after the first one are computed from ``key``, which has a number in [0, 1) for each world, [n].
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
        """Return the user's ``worlds`` with this channel's data added.

        Under the preset ``paper`` there is nothing to add. Under any other channel, ``InvalidInput`` is raised if the
        channel is random, or if the equipment is (``equipped`` is None). ``worlds`` do not yet contain delays or
        messages of a channel. The error message begins with ``where``, which says where the user gave the worlds.
        """
        if not self.by_link:
            return worlds
        if self.drawn or equipped is None:
            raise InvalidInput(
                f"{where}: with v2x: {self.preset}, it is random what the vehicles learn about each other, and when;"
                " worlds of your own need a channel in which this is not random, for instance"
                " scenario.replace(v2x='paper')"
            )
        n, N = worlds.speeds_mps.shape
        return self.with_channel(worlds, np.zeros((n, self.width(N))), np.zeros(n), time_step_s, equipped)


def burst_periods(u: Floats, loss_begins: float, loss_ends: float) -> Ints:
    """Return the number k of message periods that a burst of losses lasts, in the shape of ``u`` (uniform numbers).

    For m = 1, 2, ..., the result k is at least m exactly if ``u < (p / (p + r)) (1 - r)^(m - 1)``, where p is
    ``loss_begins`` and r is ``loss_ends``. This rule is the inverse of the distribution function of k in the stationary
    Gilbert-Elliott channel. The number k is computed without logarithms, so every machine gets the same k.
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
    """Return the delay tau of the first message on each link in s, [...], for uniform numbers ``u``, [..., PER_LINK].

    The delay is infinite if no message arrives. With the timing ``latency`` the delay is minus infinity: a vehicle
    knows everything after its own latency.
    """
    delay = np.full(u.shape[:-1], -np.inf if channel.timing == "latency" else channel.link_latency_s)
    if channel.timing == "messages":
        periods = burst_periods(u[..., 1], channel.loss_begins, channel.loss_ends)
        delay = (u[..., 0] + periods) * channel.message_period_s + channel.delay_s
    delay[u[..., 2] < channel.lost] = np.inf
    return delay


_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


def register_preset(name: str, settings: Mapping[str, Any]) -> None:
    """Register a channel as a preset, so that every scenario can use it as ``v2x: name``.

    Registering the same channel again changes nothing. Raises ``AlreadyExists`` if the name belongs to another channel,
    and ``InvalidInput`` for an invalid name or invalid settings.

    Args:
        name: name of the preset, 1 to 64 characters ``a-z``, ``0-9``, ``-``, ``_``; the first is a letter or digit.
        settings: content of ``v2x`` in a scenario, for example ``{"preset": "nominal", "lost": 0.1}``.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"preset {name!r:.80}: the name must be 1 to 64 characters a-z, 0-9, - and _, beginning with a letter or"
            " digit"
        )
    if not isinstance(settings, Mapping):
        raise InvalidInput(f"preset {name!r}: settings = {settings!r:.80}: must be a mapping such as {{'lost': 0.1}}")
    try:
        channel = V2X.model_validate(dict(settings)).channel
    except ValidationError as error:
        raise explain(Document(f"preset {name!r}", dict(settings), {}), error, Wording(V2X)) from None
    if CHANNELS.setdefault(name, channel) != channel:
        raise AlreadyExists(f"preset {name!r}: another channel is already registered under this name; choose another")
