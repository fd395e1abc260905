"""The V2X channel: when each vehicle first knows of each other vehicle, by a message or because it sees a neighbour.

A link is the way from a sender j to a receiver i. The first message of j can be used from (s after the alert)

    tau_ij = U(0, T) + k T + L_radio + t_proc + t_act

with the message period T, the random wait ``U(0, T)`` for the next message, the number k of periods in which a burst of
losses destroys every message, the time of transmission L_radio, of processing t_proc, and until the brakes respond
t_act. In each period a burst begins with probability p, and an ongoing burst ends with probability r; in the stationary
state of this Gilbert-Elliott channel ``P(k >= m) = (p / (p + r)) (1 - r)^(m - 1)`` for m = 1, 2, ... With probability
``lost`` no message ever arrives on a link. A direct neighbour in sight is seen after a *hop*, drawn from ``sensing_s``.

Vehicle i can react from ``latency_i = max(own latency_i, min(tau_i1, latency_(i-1) + hop_(i, i-1)))`` on: its own
latency is over, and it has the message of Vehicle 1 or has seen the vehicle ahead brake. It acts on news of j from
``max(latency_i, min(tau_ij, hop_ij))`` on. With the preset ``paper`` it knows everything once its own latency is over.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Protocol, Self

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.model import NAME_PATTERN, UNSHOWN, Wording, read_model, require, suggestion
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.registry import Registry
from ethbrake_marl.worlds.counters import Numbers
from ethbrake_marl.worlds.quantity import Part, ordered

if TYPE_CHECKING:
    from ethbrake_marl.episode.game import Game
    from ethbrake_marl.worlds.scenario import Scenario

PER_LINK = 4  # uniform numbers of a link: wait, burst, loss, hop

Hears = Literal["all", "front", "none"]
HEARS: tuple[Hears, ...] = ("all", "front", "none")
Seconds = Annotated[float, Field(ge=0.0, le=60.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Equipage(Part):
    """V2X equipment of the vehicles of one type."""

    sends: bool = Field(default=True, description="whether the vehicle sends messages")
    hears: Hears = Field(
        default="all",
        description="senders whose messages the vehicle receives, if the channel delivers them: all, front (vehicles"
        " ahead) or none",
    )


class Channel(NamedTuple):
    """All settings of a channel."""

    timing: Literal["latency", "fixed", "messages"]  # tau is the receiver's latency, link_latency_s, or drawn
    hears: Hears = "all"
    senses: Literal["both", "front", "none"] = "both"
    link_latency_s: float = 0.0
    loss_begins: float = 0.0
    loss_ends: float = 1.0
    lost: float = 0.0
    message_period_s: float = 0.1
    radio_s: float = 0.02
    processing_s: float = 0.1
    actuation_s: float = 0.2
    sensing_s: tuple[float, float] = (0.8, 1.1)

    def first_message_s(self, u: Floats) -> Floats:
        """Return tau of links (s) for uniform numbers ``u`` [..., PER_LINK]; infinite: no message arrives."""
        delay = np.full(u.shape[:-1], -np.inf if self.timing == "latency" else self.link_latency_s)
        if self.timing == "messages":
            periods = burst_periods(u[..., 1], self.loss_begins, self.loss_ends)
            on_the_way = self.radio_s + self.processing_s + self.actuation_s
            delay = (u[..., 0] + periods) * self.message_period_s + on_the_way
        delay[u[..., 2] < self.lost] = np.inf
        return delay

    def heard_and_seen(self, u: Floats, unheard: Bools) -> tuple[Floats, Floats]:
        """Return when i can use the first message of j, and the delay until i sees j, [n, N, N] s each.

        ``u`` [n, PER_LINK N^2] are the uniform numbers of the links, ``unheard`` [n or 1, N, N] says whose equipment
        lets no message through (``unheard_by``). Infinite: never. Minus infinite: at once.
        """
        N = unheard.shape[1]
        links, (receiver, sender) = u.reshape(len(u), N, N, PER_LINK), np.indices((N, N))
        deaf = {"all": sender < 0, "front": sender >= receiver, "none": sender >= 0}[self.hears]
        heard = np.where(deaf | unheard, np.inf, self.first_message_s(links))
        ahead = sender == receiver - 1
        in_sight = {"both": ahead | (sender == receiver + 1), "front": ahead, "none": sender < 0}[self.senses]
        low, high = self.sensing_s
        return heard, np.where(in_sight, low + (high - low) * links[..., 3], np.inf)

    def news(self, own_latency: Floats, u: Floats, unheard: Bools) -> tuple[Floats, Floats]:
        """Return when each vehicle can react, [n, N] s, and from when it acts on news of each other, [n, N, N] s."""
        N, (heard, seen) = own_latency.shape[1], self.heard_and_seen(u, unheard)
        latency = own_latency.copy()
        for i in range(1, N if self.timing != "latency" else 0):
            first = np.minimum(heard[:, i, 0], latency[:, i - 1] + seen[:, i, i - 1])
            latency[:, i] = np.maximum(latency[:, i], first)
        known = np.maximum(latency[:, :, np.newaxis], np.minimum(heard, seen))
        known[:, np.arange(N), np.arange(N)] = latency
        return latency, known

    def latest_reaction_s(self, own_latency: Floats, unheard: Bools) -> Floats:
        """Return upper bounds of the times from which vehicles can react, [n, N] s, from their own latencies."""
        slowest = np.tile([1.0, 0.0, 0.0, 1.0], (len(own_latency), own_latency.shape[1] ** 2))  # numbers of links
        return self.news(own_latency, slowest, unheard)[0]


def unheard_by(sends: Bools, hears: Ints) -> Bools:
    """Return whether vehicle i never receives a message of j, [n, N, N]; ``hears`` [n, N] are indices of ``HEARS``."""
    receiver, sender = np.indices((sends.shape[1],) * 2)
    hears = hears[:, :, np.newaxis]
    unheard: Bools = ~sends[:, np.newaxis] | (hears == 2) | ((hears == 1) & (sender >= receiver))
    return unheard


def burst_periods(u: Floats, loss_begins: float, loss_ends: float) -> Ints:
    """Return the number k of periods that a burst of losses lasts, for uniform numbers ``u``.

    k is at least m exactly if ``u < (p / (p + r)) (1 - r)^(m - 1)``. No logarithm: every machine gets the same k.
    """
    bound, bounds = loss_begins / (loss_begins + loss_ends), []
    while bound > 2.0**-53:
        bounds.append(bound)
        bound *= 1.0 - loss_ends
    periods: Ints = len(bounds) - np.searchsorted(np.array(bounds[::-1]), u, side="right")
    return periods


class Extension(Protocol):
    """What a package adds to the knowledge of vehicles, declared by keys of ``v2x``."""

    name: str  # of its memory in `State.memories`
    schemas: Mapping[str, JsonSchemaValue]  # JSON schema of each key, with a description

    def read(self, key: str, value: Any) -> Any:
        """Return the value of a key as plain data. Refuses (``files.model.refuse``) a bad value."""

    def uses(self, v2x: V2X) -> tuple[str, ...]:
        """Return the keys of messages that have an effect because of this extension. Refuses keys without effect."""

    def is_random(self, v2x: V2X) -> bool:
        """Return whether random numbers determine what vehicles know, beside those of the channel."""

    def check(self, scenario: Scenario) -> None:
        """Refuse a scenario in which these keys cannot be used."""

    def at_alert(self, scenario: Scenario, numbers: Numbers, unheard: Bools, n: int) -> Any:
        """Return the memory of n worlds at the alert."""

    def game(self, game: Game) -> Game:
        """Return the game with this extension."""


def register_v2x_extension(key: str, extension: Extension) -> None:
    """Register what the key ``key`` of ``v2x`` declares. Entry points: ``ethbrake_marl.v2x_extensions``."""
    EXTENSIONS.add(key, extension, lambda other: other is extension)


EXTENSIONS: Registry[Extension] = Registry("key of v2x", "v2x_extensions", register_v2x_extension)

CHANNELS = {
    "paper": Channel("latency", senses="none"),
    "clear": Channel("messages", loss_begins=0.01, loss_ends=0.5),
    "nominal": Channel("messages", loss_begins=0.05, loss_ends=0.5),
    "congested": Channel("messages", loss_begins=0.10, loss_ends=0.30, lost=0.05),
    "blocked": Channel("messages", loss_begins=0.20, loss_ends=0.20, lost=0.20),
    "sensors-only": Channel("messages", hears="none"),
}

OF_MESSAGES = ("message_period_s", "loss_begins", "loss_ends", "radio_s", "processing_s", "actuation_s")


class V2X(Part):
    """The key ``v2x`` of a scenario: the name of a preset, or a mapping with settings that differ from a preset.

    Other packages may add keys (``EXTENSIONS``).
    """

    model_config = ConfigDict(extra="allow")

    preset: str = Field(default="paper", description="preset whose values are used for keys that are left out")
    hears: Hears | None = Field(
        default=None, description="senders whose messages a vehicle receives: all, front (vehicles ahead) or none"
    )
    senses: Literal["both", "front", "none"] | None = Field(
        default=None, description="direct neighbours in sight: both, front or none"
    )
    link_latency_s: Seconds | None = Field(
        default=None, description="fixed delay from every sender to every receiver, instead of a random one"
    )
    lost: Share | None = Field(default=None, description="share of links (not of vehicles) on which no message arrives")
    message_period_s: Annotated[Seconds, Field(ge=1e-3)] | None = Field(
        default=None, description="T, time between two messages of a sender"
    )
    loss_begins: Share | None = Field(
        default=None, description="p, probability per message period that a burst of losses begins"
    )
    loss_ends: Annotated[Share, Field(ge=0.01)] | None = Field(
        default=None, description="r, probability per message period that a burst of losses ends"
    )
    radio_s: Seconds | None = Field(default=None, description="L_radio, time to transmit a message")
    processing_s: Seconds | None = Field(
        default=None, description="t_proc, time until the receiver has processed a message"
    )
    actuation_s: Seconds | None = Field(default=None, description="t_act, time until the receiver's brakes respond")
    sensing_s: Annotated[tuple[Seconds, Seconds], Field(strict=False), AfterValidator(ordered)] | None = Field(
        default=None, description="[low, high]: range of the uniform delay after which a neighbour is seen"
    )

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, value: Any) -> Any:
        if isinstance(value, V2X):
            return value
        name = value.get("preset", "paper") if isinstance(value, dict) else value
        right = f"must be a preset ({', '.join(CHANNELS)}), or a mapping such as {{preset: nominal, lost: 0.1}}"
        place = ("preset",) if isinstance(value, dict) else ()
        require(isinstance(name, str) and name in CHANNELS, place, name, right)
        written = value if isinstance(value, dict) else {"preset": value}
        known = (*cls.model_fields, *EXTENSIONS)
        for key in written:
            close = suggestion(str(key), known) or f"known: {', '.join(known)}"
            require(key in known, (key,), UNSHOWN, f"unknown key; {close}")
        return {key: EXTENSIONS[key].read(key, each) if key in EXTENSIONS else each for key, each in written.items()}

    @model_validator(mode="after")
    def _possible(self) -> Self:
        channel, timing = self.channel, self.channel.timing
        used = [key for extension in self.extensions for key in extension.uses(self)]
        unused = [key for key in OF_MESSAGES if key not in used]
        unheard = ("link_latency_s", "lost", *OF_MESSAGES)
        for useless, keys, why in (
            (channel.senses == "none", ["sensing_s"], "senses: none means that no vehicle is in sight"),
            (channel.hears == "none", unheard, "hears: none means that no vehicle gets messages"),
            (timing == "latency", OF_MESSAGES, f"preset {self.preset} generates no messages"),
            (timing == "fixed", unused, "link_latency_s fixes the delay of messages"),
        ):
            for key in keys if useless else ():
                value = getattr(self, key)
                require(value is None, (key,), value, f"has no effect, because {why}; leave it out")
        silent = timing == "messages" or channel.hears == "none" or channel.lost > 0.0
        blind = channel.senses == "none" and silent and timing != "latency"
        right = "a vehicle that may never get a message must see the vehicle ahead; use senses: both or front"
        require(not blind, (), self, right)
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        mapping = handler(core)
        added = {key: extension.schemas[key] for key, extension in EXTENSIONS.usable().items()}
        mapping = {**mapping, "properties": {**mapping["properties"], **added}, "additionalProperties": False}
        return {"anyOf": [{"enum": list(CHANNELS), "type": "string"}, mapping]}

    @property
    def extensions(self) -> tuple[Extension, ...]:
        """The extensions whose keys are written here."""
        return tuple(dict.fromkeys(EXTENSIONS[key] for key in self.model_extra or ()))

    @property
    def channel(self) -> Channel:
        """The preset's settings, except those that are written here."""
        own = {key: getattr(self, key) for key in Channel._fields[1:] if getattr(self, key) is not None}
        base = CHANNELS[self.preset]
        return base._replace(timing="fixed" if self.link_latency_s is not None else base.timing, **own)

    @property
    def by_link(self) -> bool:
        """Whether the channel differs from that of the paper: each vehicle knows everything after its own latency."""
        return self.channel != CHANNELS["paper"]

    @property
    def drawn(self) -> bool:
        """Whether random numbers determine what vehicles know, or when."""
        channel = self.channel
        heard = channel.hears != "none" and (channel.timing == "messages" or 0.0 < channel.lost < 1.0)
        seen = channel.senses != "none" and channel.sensing_s[0] != channel.sensing_s[1]
        own = any(extension.is_random(self) for extension in self.extensions)
        return self.by_link and (heard or seen or own)


def register_preset(name: str, settings: Mapping[str, Any]) -> None:
    """Register a channel as a preset, which every scenario can then use: ``v2x: name``.

    ``settings`` is the content of ``v2x`` in a scenario, such as ``{"preset": "nominal", "lost": 0.1}``. Raises
    ``AlreadyExists`` if the name belongs to another channel, ``InvalidInput`` for a bad name or bad settings.
    """
    if not isinstance(name, str) or re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"preset {name!r:.80}: the name must be 1 to 64 characters a-z, 0-9, - and _, beginning with a letter or"
            " digit"
        )
    document = Document(f"preset {name!r}", settings, {})
    channel = read_model(document, V2X, Wording(V2X), "such as {'lost': 0.1}").channel
    if CHANNELS.setdefault(name, channel) != channel:
        raise AlreadyExists(f"preset {name!r}: another channel is already registered under this name; choose another")
