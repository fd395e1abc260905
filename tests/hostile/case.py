"""What a hostile case is: files that a stranger wrote or a disk damaged, and the command that meets them."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

Build = Callable[[Path], object]

INSIDE = "inside"  # of a case's folder: where the command runs
OUTSIDE = "outside"  # beside it: what no case may touch
PRECIOUS = "precious.txt"
HERE = "/@here"  # in a command or a variable: the absolute path of the folder where the command runs


@dataclass(frozen=True)
class Case:
    """One attempt. ``build`` fills the folder that becomes the current one of ``command``."""

    kind: str
    category: str
    command: tuple[str, ...]
    build: Build
    certain: bool = True  # it must be refused; otherwise it may also be found to be in order
    reader: Callable[[], object] | None = None  # the same through Python: must raise an error of the project's family
    meanwhile: Build | None = None  # goes on in another process while the command runs
    environment: Mapping[str, str] = field(default_factory=dict)
    content: bytes | str = b""  # of the one file that is tried, where there is one
    may_change: tuple[str, ...] = ()  # what a command that is not refused may write, inside the folder


Generator = Callable[[random.Random], Iterator[Case]]

# Text of somebody who wants to move the cursor, hide or turn around what follows, or break a line.
NASTY = (
    "\x1b[2J\x1b[1;1H",
    "\x1b]0;owned\x07",
    "\x1b[31mred",
    "\r\nethbrake: OK",
    "\u202egnp.exe",
    "\u2066\u2069",
    "\u200b\u200d",
    "\u2028line",
    "\u2029",
    "\x85",
    "\x9b31m",
    "\x08\x08\x08",
    "\x7f",
    "\ufeff",
    "\U000e0001\U000e0041",
    "\xa0",
    "a\tb",
    "\u061c",
)


def placed(case: Case, inside: Path) -> Case:
    """The case with the folder where its command runs in the place of ``HERE``."""
    variables = {name: value.replace(HERE, f"{inside}") for name, value in case.environment.items()}
    return replace(case, command=tuple(word.replace(HERE, f"{inside}") for word in case.command), environment=variables)


def write(path: Path, content: bytes | str) -> None:
    """Write a file and the folders above it; text in UTF-8, lone surrogates included."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))


def damaged(rng: random.Random, data: bytes) -> bytes:
    """Data as a disk or a bad connection leaves it: bits, bytes or blocks changed, lost, doubled or blank."""
    spoiled = bytearray(data)
    at = rng.randrange(len(spoiled))
    length = rng.choice((1, 2, 16, 512))
    match rng.randrange(6):
        case 0:
            spoiled[at] ^= 1 << rng.randrange(8)
        case 1:
            del spoiled[at:]
        case 2:
            del spoiled[at : at + length]
        case 3:
            spoiled[at : at + length] = bytes(len(spoiled[at : at + length]))
        case 4:
            spoiled[at:at] = rng.randbytes(length)
        case _:
            spoiled[at:at] = spoiled[: min(at, length)] or b"\x00"
    return bytes(spoiled)
