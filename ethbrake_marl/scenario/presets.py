"""Presets of the V2X channel that somebody registers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.messages import explain
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.scenario.v2x import CHANNELS, V2X
from ethbrake_marl.scenario.wording import ScenarioWording

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
        raise explain(
            error, Document(f"preset {name!r}", dict(settings), {}), ScenarioWording(V2X.model_fields)
        ) from None
    if CHANNELS.setdefault(name, channel) != channel:
        raise AlreadyExists(f"preset {name!r} is registered already; give another name")
