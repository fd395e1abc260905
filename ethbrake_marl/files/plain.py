"""Safe reading of untrusted files: plain files only (no folders, pipes or devices), of limited size; strict JSON."""

from __future__ import annotations

import json
import math
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any, NoReturn

from ethbrake_marl.errors import EthBrakeError, InvalidInput

LARGEST_OBJECT_BYTES = 16 << 20  # largest accepted size of a JSON file of a training run


def read_plain(
    path: str | os.PathLike[str],
    limit_bytes: int,
    *,
    refusal: type[EthBrakeError] = InvalidInput,
    follow_links: bool = True,
) -> bytes:
    """As ``open_plain``."""
    with open_plain(path, limit_bytes, refusal=refusal, follow_links=follow_links) as stream:
        data = stream.read(limit_bytes + 1)  # files of /proc say that they are empty, and a file may grow
    if len(data) > limit_bytes:
        raise _too_large(Path(path), limit_bytes, refusal)
    return data


@contextmanager
def open_plain(
    path: str | os.PathLike[str],
    limit_bytes: int,
    *,
    refusal: type[EthBrakeError] = InvalidInput,
    follow_links: bool = True,
) -> Iterator[BufferedReader]:
    """Kind and size are checked first, so pipes and devices are never opened. Raises ``refusal`` with path and reason
    if the file does not exist, is not plain, is a symbolic link (unless ``follow_links``), is too large or cannot be
    opened.
    """
    file = Path(path)
    try:
        status = file.stat(follow_symlinks=follow_links)
        reader = file.open("rb") if stat.S_ISREG(status.st_mode) else None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        raise refusal(
            f"{file}: {'the file does not exist' if isinstance(error, FileNotFoundError) else reason}"
        ) from None
    if reader is None:
        if stat.S_ISLNK(status.st_mode):
            raise refusal(f"{file}: is a symbolic link; give the path of the file to which it points")
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a device, a pipe or a socket"
        raise refusal(f"{file}: is {kind}; must be a plain file")
    with reader as stream:
        if status.st_size > limit_bytes:
            raise _too_large(file, limit_bytes, refusal)
        yield stream


def _too_large(file: Path, limit_bytes: int, refusal: type[EthBrakeError]) -> EthBrakeError:
    size = f"{limit_bytes >> 20} MiB" if limit_bytes >= 1 << 20 else f"{limit_bytes >> 10} KiB"
    return refusal(f"{file}: is larger than {size}, the limit for this kind of file")


def parse_strict_json(data: bytes) -> Any:
    """Content of UTF-8 JSON. Raises ``ValueError`` with a reason for repeated keys, NaN, infinity and bad text."""
    try:
        return json.loads(
            data.decode("utf-8"), object_pairs_hook=_object, parse_constant=_not_a_number, parse_float=_finite
        )
    except RecursionError:
        raise ValueError("nested too deeply") from None


def read_object(file: Path) -> dict[str, Any]:
    """Raises ``InvalidInput`` if the file is missing or damaged."""
    data = read_plain(file, LARGEST_OBJECT_BYTES)
    try:
        content = parse_strict_json(data)
    except ValueError as error:
        raise InvalidInput(f"{file}: is damaged: {error}") from None
    if not isinstance(content, dict):
        raise InvalidInput(f"{file}: is damaged: the content is not a JSON object")
    return content


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    parsed: dict[str, Any] = {}
    for key, value in pairs:
        if key in parsed:
            raise ValueError(f"a JSON object contains the key {key!r} twice")
        parsed[key] = value
    return parsed


def _not_a_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a JSON number")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is too large for a floating-point number")
    return number
