"""What lies around the attack: which places a case names, and whether anything has come to stand outside its folder."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from tests.hostile.case import Case

# What is outside and may be named: to be read, in the place of a file. Nobody makes a file of them.
READ_ONLY = (
    "/dev/zero",
    "/dev/full",
    "/dev/tty",
    "/dev/stdin",
    "/dev/random",
    "/dev/null",
    "/proc/self/mem",
    "/proc/kmsg",
    "/proc/self/fd/0",
)
WRITTEN_TO = ("--output", "--per-world", "--onnx")  # options whose value is a place to write to
_BETWEEN = re.compile("[@:=,]")  # agents and options hold names between these

Listing = Mapping[Path, frozenset[str]]


def strays(case: Case, inside: Path, own: Path) -> list[str]:
    """The places outside ``own`` that a case names in its command, its environment or a link that it built.

    ``inside`` is where the command runs. Devices that are only read are no strays, but as a place to write to.
    """
    found = []
    for before, word in zip(("", *case.command), case.command, strict=False):
        allowed = () if before in WRITTEN_TO else READ_ONLY
        found += [part for part in _parts(word) if _is_outside(part, inside, own, allowed)]
    found += [value for value in case.environment.values() if _is_outside(value, inside, own, ())]
    for link in inside.rglob("*"):
        if link.is_symlink() and _is_outside(os.readlink(link), link.parent, own, READ_ONLY):
            found.append(f"{link.name} -> {os.readlink(link)}")
    return found


def _parts(word: str) -> list[str]:
    return [word, *_BETWEEN.split(word)]


def _is_outside(name: str, base: Path, own: Path, allowed: Iterable[str]) -> bool:
    place = os.path.normpath(os.path.join(base, name.replace("\0", "")))
    return name not in allowed and place != os.fspath(own) and not place.startswith(f"{own}{os.sep}")


def names_of(case: Case, inside: Path) -> Iterator[str]:
    """The names that a file could get by this case: of its command and of what it built."""
    for word in case.command:
        yield from re.split("[/@:=,]", word)
    yield from os.listdir(inside)


def listing(own: Path) -> Listing:
    """What stands in the folders around: above the programme's own, the current one, home, and those of the system."""
    around = (
        own.parent,
        Path.cwd(),
        Path.home(),
        Path(tempfile.gettempdir()),
        *map(Path, ("/", "/tmp", "/etc", "/dev")),
    )
    return {folder: frozenset(os.listdir(folder)) for folder in around if folder.is_dir()}


def gained(before: Listing, names: Iterable[str]) -> list[str]:
    """Files that were not there before and have a name that a case uses."""
    used = frozenset(names)
    return [
        os.fspath(folder / name)
        for folder, there in before.items()
        for name in sorted((frozenset(os.listdir(folder)) - there) & used)
    ]
