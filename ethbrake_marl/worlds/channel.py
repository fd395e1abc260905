"""The V2X channel: when each vehicle first knows of each other vehicle, by a message or by seeing a neighbour.

A link leads from a sender j to a receiver i. The first message of j can be used after (s since the alert)

    tau_ij = U(0, T) + k T + L_radio + t_proc + t_act

with the message period T, the random wait ``U(0, T)`` for the next message, the number k of periods in which a burst of
losses destroys every message, and the times for transmission L_radio, for processing t_proc, and until the brakes
respond t_act. In each period a burst begins with probability p, and an ongoing burst ends with probability r; in the
stationary state of this Gilbert-Elliott channel ``P(k >= m) = (p / (p + r)) (1 - r)^(m - 1)`` for m = 1, 2, ..., so a
share p / (p + r) of all messages is lost; with r = 1 - p each on its own. With probability ``silent_links`` a link
never delivers a message. A direct neighbour in sight is seen after a delay, the *hop*, drawn from ``sensing_s``.

Vehicle i can react from ``latency_i = max(own latency_i, min(tau_i1, latency_(i-1) + hop_(i, i-1)))`` on: its own
latency is over, and it has the message of Vehicle 1 or has seen the vehicle ahead brake. It reacts to vehicle j from
``max(latency_i, min(tau_ij, hop_ij))`` on. With the preset ``paper`` a vehicle knows everything once its own latency is
over.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    ModelWrapValidatorHandler,
    PrivateAttr,
    SerializationInfo,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.episode.departures import MARKS
from ethbrake_marl.episode.layer import Layer
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.model import NAME_PATTERN, UNSHOWN, Wording, read_model, require, suggestion
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.registry import Registry
from ethbrake_marl.worlds.counters import Numbers
from ethbrake_marl.worlds.quantity import ScenarioPart, check_order

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

PER_LINK = 4  # uniform numbers of a link: wait, burst, loss, hop

Hears = Literal["all", "front", "none"]
Seconds = Annotated[float, Field(ge=0.0, le=60.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Equipage(ScenarioPart):
    """V2X equipment of the vehicles of one type."""

    sends: bool = Field(default=True, description="whether the vehicle sends messages")
    hears: Hears = Field(
        default="all",
        description="senders whose messages the vehicle receives, if the channel delivers them: all, front (vehicles"
        " ahead) or none",
    )


def burst_periods(u: Floats, loss_begins: float, loss_ends: float) -> Ints:
    """Number k of message periods that a burst of losses lasts, for each of the uniform numbers ``u`` in [0, 1).

    With p = ``loss_begins`` and r = ``loss_ends``, k is at least m exactly if ``u < (p / (p + r)) (1 - r)^(m - 1)``.
    """
    bound, bounds = loss_begins / (loss_begins + loss_ends), []
    while bound > 2.0**-53:
        bounds.append(bound)
        bound *= 1.0 - loss_ends
    periods: Ints = len(bounds) - np.searchsorted(np.array(bounds[::-1]), u, side="right")
    return periods


class ChannelKey:
    """Base class of what a key of ``v2x`` adds to the channel, or several keys together. Override what differs.

    >>> import ethbrake_marl as eb
    >>> from ethbrake_marl.worlds.quantity import ScenarioPart
    >>> class FogKeys(ScenarioPart):
    ...     fog_m: float | None = None
    >>> class Fog(eb.ChannelKey):
    ...     name, keys = "fog", FogKeys
    ...     def layer(self, v2x):
    ...         return eb.Layer()  # here one that limits the gaps to v2x.fog_m
    """

    name: str  # of its memory in `State.memories`
    keys: type[ScenarioPart]  # its keys of ``v2x``, with types and descriptions; none is required

    def uses(self, v2x: V2X) -> tuple[str, ...]:
        """Keys of ``OF_MESSAGES`` needed even if ``link_latency_s`` fixes all delays."""
        return ()

    def is_random(self, v2x: V2X) -> bool:
        """Whether the key draws random numbers of its own."""
        return False

    def check(self, scenario: Scenario) -> None:
        """Refuse a scenario in which ``keys`` make no sense."""

    def at_alert(self, scenario: Scenario, numbers: Numbers, unheard: Bools, n: int) -> Any:
        """Memory of this key for n worlds at the alert: None, an array with n rows, or a tuple of such arrays.

        ``numbers``: source of random numbers (``counters.uniform_numbers``). ``unheard`` [n or 1, N, N]: whether the
        vehicles' equipment excludes messages of vehicle j (last axis) to vehicle i.
        """

    def layer(self, v2x: V2X) -> Layer:
        """Layer that changes what vehicles know of the state (``episode.layer``)."""
        raise NotImplementedError


def register_v2x_key(key: str, channel_key: ChannelKey) -> None:
    """Register what a key of ``v2x`` adds to the channel. Entry points: ``ethbrake_marl.v2x_keys``.

    Raises ``InvalidInput`` for a bad key or name; ``AlreadyExists`` for a key of ``v2x`` itself.
    """
    keys, name = getattr(channel_key, "keys", None), getattr(channel_key, "name", None)
    if name in (MARKS, "shaping", "shield"):  # memories that a game has itself
        raise InvalidInput(f"key {key!r} of v2x: the name of its memory, {name!r}, is in use; choose another")
    is_named = isinstance(channel_key, ChannelKey) and isinstance(name, str)
    if not is_named or key not in getattr(keys, "model_fields", ()):
        raise InvalidInput(
            f"key {key!r} of v2x: {channel_key!r:.60}: must be a ChannelKey with a name, whose keys are a ScenarioPart"
            f" with a field {key}"
        )
    if key in V2X.model_fields:
        raise AlreadyExists(f"key {key!r} of v2x: this name is already in use; give another name")
    CHANNEL_KEYS.add(key, channel_key, lambda registered: registered is channel_key)


CHANNEL_KEYS: Registry[ChannelKey] = Registry("key of v2x", "v2x_keys", register_v2x_key)

PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"senses": "none"},
    "clear": {"loss_begins": 0.01, "loss_ends": 0.5},
    "nominal": {"loss_begins": 0.05, "loss_ends": 0.5},
    "congested": {"loss_begins": 0.10, "loss_ends": 0.30, "silent_links": 0.05},
    "blocked": {"loss_begins": 0.20, "loss_ends": 0.20, "silent_links": 0.20},
    "sensors-only": {"hears": "none"},
}  # the key `preset` of a preset of the user names the one of these on which it is based

OLD_KEYS = {
    "lost": "write silent_links for the share of links on which no message ever arrives; for 30 % of all"
    " messages write loss_begins: 0.3, loss_ends: 0.7"
}  # key of an earlier version -> what to write instead

OF_MESSAGES = ("message_period_s", "loss_begins", "loss_ends", "radio_s", "processing_s", "actuation_s")
UNHEARD = ("link_latency_s", "silent_links", *OF_MESSAGES)  # without effect if no vehicle hears another


class V2X(ScenarioPart):
    """The key ``v2x`` of a scenario: the name of a preset, or a mapping with settings that differ from a preset.

    Other packages may add keys (``CHANNEL_KEYS``).
    """

    model_config = ConfigDict(extra="allow")

    preset: str = Field(default="paper", description="preset whose values are used for keys that are left out")
    hears: Hears = Field(
        default="all", description="senders whose messages a vehicle receives: all, front (vehicles ahead) or none"
    )
    senses: Literal["both", "front", "none"] = Field(
        default="both", description="direct neighbours in sight: both, front or none"
    )
    link_latency_s: Seconds | None = Field(
        default=None, description="fixed delay from every sender to every receiver, instead of a random one"
    )
    silent_links: Share = Field(
        default=0.0, description="share of links (from one sender to one receiver) on which no message ever arrives"
    )
    message_period_s: Annotated[Seconds, Field(ge=1e-3)] = Field(
        default=0.1, description="T, time between two messages of a sender"
    )
    loss_begins: Share = Field(
        default=0.0, description="p, probability per message period that a burst of losses begins"
    )
    loss_ends: Annotated[Share, Field(ge=0.01)] = Field(
        default=1.0, description="r, probability per message period that a burst of losses ends"
    )
    radio_s: Seconds = Field(default=0.02, description="L_radio, time to transmit a message")
    processing_s: Seconds = Field(default=0.1, description="t_proc, time until the receiver has processed a message")
    actuation_s: Seconds = Field(default=0.2, description="t_act, time until the receiver's brakes respond")
    sensing_s: Annotated[tuple[Seconds, Seconds], Field(strict=False), AfterValidator(check_order)] = Field(
        default=(0.8, 1.1), description="[low, high]: range of the uniform delay after which a neighbour is seen"
    )

    _keys: frozenset[str] = PrivateAttr(default=frozenset())  # `preset`, and what the file says beside it

    @model_validator(mode="wrap")
    @classmethod
    def _with_preset(cls, value: Any, build: ModelWrapValidatorHandler[Self]) -> Self:
        if isinstance(value, V2X):
            return build(value)
        name = value.get("preset", "paper") if isinstance(value, dict) else value
        right = f"must be a preset ({', '.join(PRESETS)}), or a mapping such as {{preset: nominal, loss_begins: 0.1}}"
        place = ("preset",) if isinstance(value, dict) else ()
        require(isinstance(name, str) and name in PRESETS, place, name, right)
        written = value if isinstance(value, dict) else {"preset": value}
        known = (*cls.model_fields, *CHANNEL_KEYS)
        settings = dict(written)
        for key in written:
            close = OLD_KEYS.get(str(key)) or suggestion(str(key), known) or f"known: {', '.join(known)}"
            require(key in known, (key,), UNSHOWN, f"unknown key; {close}")
            if key in CHANNEL_KEYS:
                part = CHANNEL_KEYS[key].keys.model_validate({key: written[key]})
                settings |= part.model_dump(exclude_unset=True)
        v2x = build({**PRESETS[name], **settings, "preset": name})
        v2x._keys = frozenset({"preset", *written})
        v2x._check()
        return v2x

    @classmethod
    def key_fields(cls) -> Mapping[str, FieldInfo]:
        registered = CHANNEL_KEYS.usable()
        return {**cls.model_fields, **{key: registered[key].keys.model_fields[key] for key in registered}}

    @model_serializer(mode="wrap")
    def _as_written(self, dump: SerializerFunctionWrapHandler, info: SerializationInfo) -> dict[str, Any]:
        """Settings that the scenario file contains."""
        with_defaults = not (info.exclude_unset or info.exclude_none)
        return {
            key: setting if key in self._keys else None
            for key, setting in dump(self).items()
            if with_defaults or key in self._keys
        }

    def _check(self) -> None:
        extended = {CHANNEL_KEYS[key]: key for key in self.model_extra or ()}
        right = "belong to different channel keys, whose memories have the same name; leave one out"
        names = {channel_key.name for channel_key in extended}
        require(len(names) == len(extended), (), UNSHOWN, f"{' and '.join(extended.values())} {right}")
        for key, why in self.without_effect().items():
            require(key not in self._keys, (key,), getattr(self, key), f"has no effect, because {why}; leave it out")
        silent = self.timing == "messages" or self.hears == "none" or self.silent_links > 0.0
        blind = self.senses == "none" and silent and self.timing != "latency"
        right = "a vehicle that may never get a message must see the vehicle ahead; use senses: both or front"
        require(not blind, (), self, right)

    def without_effect(self) -> dict[str, str]:
        used_keys = [key for channel_key in self.channel_keys for key in channel_key.uses(self)]
        unused_keys = [key for key in OF_MESSAGES if key not in used_keys]
        reasons: dict[str, str] = {}
        for useless, keys, why in (
            (self.senses == "none", ("sensing_s",), "senses: none means that no vehicle is in sight"),
            (self.hears == "none", UNHEARD, "hears: none means that no vehicle gets messages"),
            (self.timing == "latency", OF_MESSAGES, f"preset {self.preset} generates no messages"),
            (self.timing == "fixed", unused_keys, "link_latency_s fixes the delay of messages"),
        ):
            for key in keys if useless else ():
                reasons.setdefault(key, why)
        return reasons

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        mapping = handler(core)
        properties = dict(mapping["properties"])
        for channel_key in CHANNEL_KEYS.usable().values():
            properties |= handler.resolve_ref_schema(handler(channel_key.keys.__pydantic_core_schema__))["properties"]
        properties = {key: {k: v for k, v in schema.items() if k != "default"} for key, schema in properties.items()}
        mapping = {**mapping, "properties": properties, "additionalProperties": False}
        return {"anyOf": [{"enum": list(PRESETS), "type": "string"}, mapping]}

    @property
    def channel_keys(self) -> tuple[ChannelKey, ...]:
        """Sorted by name, so the order of the keys has no effect."""
        channel_keys = {CHANNEL_KEYS[key] for key in self.model_extra or ()}
        return tuple(sorted(channel_keys, key=lambda channel_key: channel_key.name))

    @property
    def timing(self) -> Literal["latency", "fixed", "messages"]:
        if self.link_latency_s is not None:
            return "fixed"
        return "latency" if PRESETS[self.preset].get("preset", self.preset) == "paper" else "messages"

    @property
    def by_link(self) -> bool:
        """Whether single links (from one sender to one receiver) matter."""
        return self.timing != "latency" or (self.hears, self.senses, self.silent_links) != ("all", "none", 0.0)

    @property
    def drawn(self) -> bool:
        random_messages = self.hears != "none" and (self.timing == "messages" or 0.0 < self.silent_links < 1.0)
        random_sensing = self.senses != "none" and self.sensing_s[0] != self.sensing_s[1]
        random_keys = any(channel_key.is_random(self) for channel_key in self.channel_keys)
        return random_keys or (self.by_link and (random_messages or random_sensing))

    def first_message_s(self, u: Floats) -> Floats:
        """Delay tau of the first message on each link (s since the alert), for uniform numbers ``u`` [..., PER_LINK].

        Infinite: the link never delivers. Minus infinite: only the receiver's latency matters.
        """
        delay = np.full(u.shape[:-1], -np.inf if self.link_latency_s is None else self.link_latency_s)
        if self.timing == "messages":
            periods = burst_periods(u[..., 1], self.loss_begins, self.loss_ends)
            on_the_way = self.radio_s + self.processing_s + self.actuation_s
            delay = (u[..., 0] + periods) * self.message_period_s + on_the_way
        delay[u[..., 2] < self.silent_links] = np.inf
        return delay

    def heard_and_seen(self, u: Floats, unheard: Bools) -> tuple[Floats, Floats]:
        """Time of the first message from vehicle j to i, and delay until i sees j, [n, N (i), N (j)] s each.

        ``u`` [n, PER_LINK N^2]: uniform numbers, PER_LINK for each link. ``unheard`` [n or 1, N, N]: whether the
        vehicles' equipment excludes the link (``Scenario.unheard``). Infinite: never. Minus infinite: at once.
        """
        N = unheard.shape[1]
        links, (receiver, sender) = u.reshape(len(u), N, N, PER_LINK), np.indices((N, N))
        deaf = {"all": sender < 0, "front": sender >= receiver, "none": sender >= 0}[self.hears]
        message_time = np.where(deaf | unheard, np.inf, self.first_message_s(links))
        ahead = sender == receiver - 1
        in_sight = {"both": ahead | (sender == receiver + 1), "front": ahead, "none": sender < 0}[self.senses]
        low, high = self.sensing_s
        return message_time, np.where(in_sight, low + (high - low) * links[..., 3], np.inf)

    def news(self, own_latency: Floats, u: Floats, unheard: Bools) -> tuple[Floats, Floats]:
        """Times from which each vehicle can react, [n, N] s, and from which vehicle i reacts to vehicle j, [n, N, N] s.

        ``own_latency`` [n, N] (s): latencies without the wait for messages.
        """
        N, (message_time, sensing_delay) = own_latency.shape[1], self.heard_and_seen(u, unheard)
        latency = own_latency.copy()
        for i in range(1, N if self.timing != "latency" else 0):
            first = np.minimum(message_time[:, i, 0], latency[:, i - 1] + sensing_delay[:, i, i - 1])
            latency[:, i] = np.maximum(latency[:, i], first)
        reaction_time = np.maximum(latency[:, :, np.newaxis], np.minimum(message_time, sensing_delay))
        reaction_time[:, np.arange(N), np.arange(N)] = latency
        return latency, reaction_time

    def latest_reaction_s(self, own_latency: Floats, unheard: Bools) -> Floats:
        """Latest time from which each vehicle can react, whatever is drawn, [n, N] s."""
        n, N = own_latency.shape
        slowest = np.tile([1.0, 0.0, 0.0, 1.0], (n, N * N))  # numbers of links
        return self.news(own_latency, slowest, unheard)[0]


def register_preset(name: str, settings: Mapping[str, Any]) -> None:
    """Register a V2X channel as the preset ``name``, for ``v2x: name`` in scenarios.

    ``settings``: content of the key ``v2x``, such as ``{"preset": "nominal", "loss_begins": 0.1}``. Raises
    ``AlreadyExists``, ``InvalidInput``.
    """
    if not isinstance(name, str) or re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"preset {name!r:.80}: the name must be 1 to 64 characters a-z, 0-9, - and _, beginning with a letter or"
            " digit"
        )
    document = Document(f"preset {name!r}", settings, {})
    v2x = read_model(document, V2X, Wording(V2X), "such as {'loss_begins': 0.1}")
    written = {key: getattr(v2x, key) for key in v2x._keys if key != "preset"}
    preset = {"preset": v2x.preset, **PRESETS[v2x.preset], **written}
    if PRESETS.setdefault(name, preset) != preset:
        raise AlreadyExists(f"preset {name!r}: another channel is already registered under this name; choose another")
