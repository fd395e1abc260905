"""JSON as it should be: one value, no key twice, only finite numbers, UTF-8."""

from __future__ import annotations

import json
import math
from typing import Any, NoReturn


def parse_strict_json(data: bytes) -> Any:
    """Parse ``data``; raises ``ValueError`` with a one-line reason on anything ambiguous or not in the standard."""
    try:
        return json.loads(
            data.decode("utf-8"), object_pairs_hook=_object, parse_constant=_not_a_number, parse_float=_finite
        )
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    parsed: dict[str, Any] = {}
    for key, value in pairs:
        if key in parsed:
            raise ValueError(f"key {key!r} stands twice")
        parsed[key] = value
    return parsed


def _not_a_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a JSON number")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is too large for a number")
    return number
