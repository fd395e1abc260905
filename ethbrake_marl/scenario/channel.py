"""The channel between vehicles: V2X messages per link, lost information, on-board sensing as the fall-back.

A message carries its sender's state, capacities and latency. On the link from vehicle j to vehicle i it is of use from

    tau_ij = U(0, T) + k T + L_radio + t_proc + t_act        (T the message period)

on, where ``U(0, T)`` is the wait for the next message, ``k`` the periods lost to a burst (Gilbert-Elliott channel:
``P(k >= m) = p / (p + r) (1 - r)^(m - 1)``), and with the share ``lost`` of links no message ever arrives. Sensors see
the direct neighbours: they add a hop of ``sensing_s``. Vehicle i reacts from

    latency_i = max(own latency_i, min(tau_i1, latency_(i-1) + hop_(i, i-1)))

on (nobody reacts to an emergency before its news: Vehicle 1's own message, or the sight of the vehicle ahead that
brakes), and knows of vehicle j from ``max(latency_i, tau_ij)``, or ``max(latency_i, hop_ij)`` for a direct neighbour
in sight if that is sooner. Of latencies themselves only the own parts are observed: what a channel has drawn shows when
it happens. The rule of the paper, preset ``paper``: everything, from the own latency on.

With ``persistence: first`` that is all: from its first message on j is known as it is. With ``periodic`` each message
is one of many, T apart, and lost or not by the same Gilbert-Elliott channel; what i knows is as old as the newest that
arrived (``physics.messages``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import not_
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from pydantic import AfterValidator, Field, GetJsonSchemaHandler, ValidationError, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.model import FileModel, Wording, explain, require
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.physics.messages import Messages
from ethbrake_marl.physics.state import Bools, Floats, Ints, Vehicles, Worlds

PER_LINK = 4  # uniform numbers of one link: wait, burst, loss, hop; one Philox counter

Hears = Literal["all", "front", "none"]

Senses = Literal["both", "front", "none"]

Persistence = Literal["first", "periodic"]

Seconds = Annotated[float, Field(ge=0.0, le=60.0, allow_inf_nan=False)]

Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Equipage(FileModel):
    """What one vehicle, or a type of vehicles, has of V2X."""

    sends: bool = Field(default=True, description="whether others can hear of it")
    hears: Hears = Field(default="all", description="whose messages it gets, of those that the channel brings")


class Equipped(NamedTuple):
    """Who has what of V2X in n worlds; of one world also what every possible world has."""

    sends: Bools  # [n, N]
    hears: Ints  # [n, N] index of a word of ``Hears``

    @classmethod
    def of(cls, equipage: Sequence[Equipage]) -> Equipped:
        """One world of these vehicles, [1, N]."""
        hears = [get_args(Hears).index(each.hears) for each in equipage]
        return cls(np.array([[each.sends for each in equipage]]), np.array([hears]))

    @property
    def unheard(self) -> Bools:
        """Whether vehicle i never gets a message of vehicle j, [n, N, N]."""
        receiver, sender = np.indices((self.sends.shape[1],) * 2)
        hears = self.hears[:, :, np.newaxis]
        unheard: Bools = ~self.sends[:, np.newaxis] | (hears == 2) | ((hears == 1) & (sender >= receiver))
        return unheard


class Channel(NamedTuple):
    """Everything that decides who knows what, and when."""

    timing: Literal["latency", "fixed", "messages"]  # tau: the receiver's own latency, a number, or generated
    hears: Hears = "all"  # whose messages a vehicle gets: all vehicles', only those from ahead, nobody's
    senses: Senses = "both"  # direct neighbours in sight
    link_latency_s: float = 0.0  # tau of timing "fixed"
    loss_begins: float = 0.0  # p, per message period
    loss_ends: float = 1.0  # r, per message period; mean burst 1 / r
    lost: float = 0.0  # share of links on which nothing ever arrives
    message_period_s: float = 0.1  # T
    radio_s: float = 0.02  # L_radio
    processing_s: float = 0.1  # t_proc
    actuation_s: float = 0.2  # t_act
    sensing_s: tuple[float, float] = (0.8, 1.1)  # a hop is drawn evenly from it
    persistence: Persistence = "first"  # whether what was once heard stays present, or each message grows old

    @property
    def delay_s(self) -> float:
        """Time from sending a message until it is of use (s); infinite where nobody sends any."""
        if self.timing == "messages":
            return self.radio_s + self.processing_s + self.actuation_s
        return self.link_latency_s if self.timing == "fixed" else math.inf

    def samples(self, time_step_s: float) -> int:
        """Samples of its state that a vehicle keeps for messages on their way; 0 without periodic messages."""
        return Messages.ring_length(self.delay_s, time_step_s) if self.persistence == "periodic" else 0


CHANNELS = {
    "paper": Channel("latency", senses="none"),
    "clear": Channel("messages", loss_begins=0.01, loss_ends=0.5),
    "nominal": Channel("messages", loss_begins=0.05, loss_ends=0.5),
    "congested": Channel("messages", loss_begins=0.10, loss_ends=0.30, lost=0.05),
    "blocked": Channel("messages", loss_begins=0.20, loss_ends=0.20, lost=0.20),
    "sensors-only": Channel("messages", hears="none"),
}

PRESETS = tuple(CHANNELS)  # those that are built in; ``register_preset`` adds to the channels

_LATEST = np.array([[1.0, 0.0, 1.0, 1.0]])  # uniform numbers of one link: a whole period, the longest burst, not lost

_OF_LATER = ("message_period_s", "loss_begins", "loss_ends")  # of every message after the first one

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


class V2X(FileModel):
    """A preset, and what differs from it; see ``docs/v2x.md``. Written as its name alone, or as a mapping."""

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
            self._leave_out(("link_latency_s", "lost", "vehicles", *_OF_MESSAGES), "hears none has no messages")
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
        # one that is given: only preset paper itself sees nobody
        self._require(not blind, "senses" if self.senses is not None else "lost", right)
        return self

    def _leave_out(self, names: tuple[str, ...], why: str) -> None:
        """Refuse the first of these keys that is given: it would do nothing."""
        for name in names:
            self._require(getattr(self, name) is None, name, f"{why}; leave it out")

    def _require(self, holds: bool, name: str, right: str) -> None:
        value = getattr(self, name)
        require(holds, (name,), getattr(self.channel, name, value) if value is None else value, right)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """A preset's name, or a mapping."""
        mapping = handler(core)
        return {"anyOf": [{"enum": list(CHANNELS), "type": "string"}, mapping]}

    @property
    def channel(self) -> Channel:
        """The preset with everything that was given in its place."""
        given = {name: getattr(self, name) for name in Channel._fields[1:] if getattr(self, name) is not None}
        base = CHANNELS[self.preset]
        return base._replace(timing="fixed" if self.link_latency_s is not None else base.timing, **given)

    @property
    def by_link(self) -> bool:
        """Whether anything differs from the paper's rule: all news, from the own latency on."""
        return self.channel != CHANNELS["paper"]

    @property
    def drawn(self) -> bool:
        """Whether chance decides: what is known when differs from world to world."""
        channel = self.channel
        low, high = channel.sensing_s
        by_messages = channel.timing == "messages" and channel.hears != "none"
        lossy = channel.hears != "none" and 0.0 < channel.lost < 1.0
        lossy = lossy or (channel.persistence == "periodic" and channel.loss_begins > 0.0)
        return self.by_link and (by_messages or lossy or (channel.senses != "none" and low != high))

    def latest_reaction_s(self, own_latency_s: Floats, equipped: Equipped) -> Floats:
        """Upper bound of each vehicle's latency, [N], from that of its own part [N], and what all surely have."""
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
        """How many uniform numbers the news of a line takes."""
        return PER_LINK * vehicles * vehicles

    def with_news(self, vehicles: Vehicles, u: Floats, equipped: Equipped) -> Vehicles:
        """These vehicles with the latencies and the news of the channel drawn by ``u`` [n, N * N * PER_LINK] in [0, 1).

        Their latencies, so far all own, stay as ``own_latency_s``.
        """
        (N, channel), (heard, seen) = (vehicles.latency_s.shape[1], self.channel), self.heard_and_seen(u, equipped)
        latency = vehicles.latency_s.copy()
        if channel.timing != "latency":
            for i in range(1, N):
                told = np.minimum(heard[:, i, 0], latency[:, i - 1] + seen[:, i, i - 1])
                latency[:, i] = np.maximum(latency[:, i], told)
        known = np.maximum(latency[:, :, np.newaxis], np.minimum(heard, seen))
        known[:, np.arange(N), np.arange(N)] = latency  # no vehicle waits for a message from itself
        return replace(vehicles, latency_s=latency, known_from_s=known)

    def heard_and_seen(self, u: Floats, equipped: Equipped) -> tuple[Floats, Floats]:
        """When a first message of vehicle j reaches vehicle i, and when i sees j, [n, N, N] s each; infinite: never."""
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
        """These worlds at the alert with their news and, where messages are periodic, their columns, none sent yet.

        Args:
            worlds: whose latencies are all own.
            u: what the news is drawn by, [n, N * N * PER_LINK] in [0, 1).
            key: [n] in [0, 1), one for all later losses of a world.
            time_step_s: between two decisions, at which vehicles sample their states.
            equipped: who has what of it, in each world or in all.

        """
        channel = self.channel
        worlds = replace(worlds, vehicles=self.with_news(worlds.vehicles, u, equipped))
        if channel.persistence == "first":
            return worlds
        heard, seen = self.heard_and_seen(u, equipped)
        messages = Messages.silent(
            heard, seen, key * 2.0**53, channel.samples(time_step_s), period_s=channel.message_period_s,
            delay_s=channel.delay_s, loss_begins=channel.loss_begins, loss_ends=channel.loss_ends,
        )  # fmt: skip
        return replace(worlds, messages=messages.columns)

    def with_fixed_news(self, worlds: Worlds, time_step_s: float, where: str, equipped: Equipped | None) -> Worlds:
        """Worlds that somebody gives with this channel; ``InvalidInput`` where it leaves something to chance.

        ``equipped``: who has what of it; None: that is drawn, too.
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
    """Message periods k lost to a burst, in the shape of the uniform numbers ``u`` in [0, 1).

    ``k >= m`` exactly where ``u < p / (p + r) (1 - r)^(m - 1)``: the inverse distribution function of the
    Gilbert-Elliott channel in its long-run state, by multiplication alone, so every machine gets the same k.
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
    """The delay tau (s) of each link from its uniform numbers ``u`` [..., PER_LINK]; infinite where nothing arrives.

    Where the receiver's own latency is all that counts, minus infinity.
    """
    delay = np.full(u.shape[:-1], -np.inf if channel.timing == "latency" else channel.link_latency_s)
    if channel.timing == "messages":
        periods = burst_periods(u[..., 1], channel.loss_begins, channel.loss_ends)
        delay = (u[..., 0] + periods) * channel.message_period_s + channel.delay_s
    delay[u[..., 2] < channel.lost] = np.inf
    return delay


_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


def register_preset(name: str, settings: Mapping[str, Any]) -> None:
    """Make ``v2x: name`` known to every scenario.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        settings: what a scenario would say, a preset and what differs from it: ``{"preset": "nominal", "lost": 0.1}``.

    Registering the same again changes nothing. Raises ``AlreadyExists`` for another channel under a name that is taken,
    ``InvalidInput`` for a name that is none and for settings that are no channel.

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
