"""Checks of functions that users register (features, terms, objectives): name, docstring, results."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput, describe_error
from ethbrake_marl.motion.layout import Floats


def description_of(kind: str, name: object, function: object, pattern: str, form: str) -> str:
    """Docstring, on one line, of a ``function`` that a user registers as a ``kind``, such as ``term``.

    Raises ``InvalidInput`` if there is no docstring, or if ``name`` does not match the regular expression ``pattern``;
    the message describes the pattern by ``form``.
    """
    if not isinstance(name, str) or re.fullmatch(pattern, name) is None:
        raise InvalidInput(f"{kind} {name!r:.80}: the name must be 1 to 64 characters {form}")
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"{kind} {name!r}: must be a function with a docstring that describes the {kind}")
    return " ".join(str(function.__doc__).split())


def call_function(
    what: str, function: Callable[..., Any], arguments: tuple[Any, ...], *shapes: tuple[int, ...]
) -> Floats:
    """Result of ``function(*arguments)``, as an array of numbers.

    Raises ``InvalidInput``, with a message that begins with ``what``, if the function fails or if the shape of its
    result is not one of ``shapes``.
    """
    try:
        value = np.asarray(function(*arguments))
    except InvalidInput as error:
        raise InvalidInput(f"{what}: {error}") from error
    except Exception as error:
        raise InvalidInput(f"{what}: its function fails: {describe_error(error)}") from error
    if value.shape not in shapes or value.dtype.kind not in "fiub":
        right = " or ".join(f"{shape}, one per {'world' if len(shape) == 1 else 'vehicle'}" for shape in shapes)
        raise InvalidInput(
            f"{what}: its function returned {value.dtype} of shape {value.shape}; must return numbers of shape {right}"
        )
    return value


def check_finite_values(what: str, value: Floats, times_s: Floats) -> None:
    """Raise ``InvalidInput`` unless all numbers in ``value``, [n] or [n, N], are finite.

    The message names ``what``, the first world with a bad number, and the time in this world, from ``times_s`` [n].
    """
    for row, *vehicle in np.argwhere(~np.isfinite(value))[:1]:
        whose = "".join(f" for vehicle_{i + 1}" for i in vehicle)
        raise InvalidInput(
            f"{what}: its value is {value[(row, *vehicle)]}{whose} in row {row} at {times_s[row]:g} s; must be finite"
        )
