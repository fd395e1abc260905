"""Plain values written as one line of YAML, so that a message or a template shows what a file would say."""

from __future__ import annotations

import json
import re
from typing import Any

_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_@./-]*(:[A-Za-z0-9_@./+-]+)*")
_RESERVED = {"null", "true", "false"}


def flow_text(value: Any, longest: int | None = None) -> str:
    """Write ``value`` in YAML's flow style; reading it back with ``yaml_loading`` gives an equal value
    (of printable text, lists, mappings with text keys, finite or infinite numbers, true, false, null).

    A text longer than ``longest`` characters is cut (for messages only).
    """
    text = _flow(value)
    return text if longest is None or len(text) <= longest else f"{text[: longest - 3]}..."


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_flow(key)}: {_flow(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_flow(entry) for entry in value) + "]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    if isinstance(value, str):
        plain = _PLAIN.fullmatch(value) and value.lower() not in _RESERVED
        return value if plain else json.dumps(value, ensure_ascii=False)
    return _number(value) if isinstance(value, int | float) else repr(value)


def _number(value: int | float) -> str:
    if value != value:
        return ".nan"
    if value in (float("inf"), float("-inf")):
        return ".inf" if value > 0 else "-.inf"
    if isinstance(value, int):
        return str(int(value)) if abs(value) < 2**63 else f"{str(value)[:24]}..."
    return str(int(value)) if abs(value) < 1e15 and value == int(value) else repr(float(value))
