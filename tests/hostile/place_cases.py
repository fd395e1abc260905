"""What may stand where a file is expected: pipes, devices, folders, links, giants, files that change, bad names."""

from __future__ import annotations

import os
import random
import shutil
import socket
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.limits.limits import BestHarmTable
from ethbrake_marl.policies import load_policy, shipped_policies
from ethbrake_marl.scenario import load_scenario
from tests.hostile.archives import good_bytes
from tests.hostile.case import HERE, INSIDE, NASTY, OUTSIDE, Build, Case, write
from tests.hostile.csv_cases import TABLE
from tests.hostile.table_cases import COMMAND
from tests.hostile.yaml_parts import RECIPE, SCENARIO


@dataclass(frozen=True)
class Target:
    """A file that a command reads: its name, what is right in it, and who reads it."""

    name: str
    right: bytes
    command: Callable[[str], tuple[str, ...]]
    reader: Callable[[str], object]
    beside: Build = lambda folder: None  # what must be there too


def _rest_of_bundle(folder: Path) -> None:
    """A policy bundle, of which one file is going to be replaced."""
    shutil.copytree(shipped_policies()["ppo"] / "policy", folder / "policy")
    (folder / "policy").chmod(0o755)
    for file in (folder / "policy").iterdir():
        file.chmod(0o644)


def _bundle_file(name: str) -> Target:
    return Target(
        f"policy/{name}",
        (shipped_policies()["ppo"] / "policy" / name).read_bytes(),
        lambda path: ("evaluate", "--episodes", "2", "--agents", "ppo@policy"),
        lambda path: load_policy("policy"),
        _rest_of_bundle,
    )


def targets() -> dict[str, Target]:
    """The files by what they are."""
    return {
        "scenario": Target("mine.yaml", SCENARIO.encode(), lambda p: ("scenario", "validate", p), load_scenario),
        "shown scenario": Target("mine.yaml", SCENARIO.encode(), lambda p: ("scenario", "show", p), load_scenario),
        "recipe": Target(
            "mine.yaml", RECIPE.encode(), lambda p: ("train", "--recipe", p, "--output", "taken"), load_recipe
        ),
        "CSV": Target(
            "w.csv",
            TABLE.encode(),
            lambda p: ("evaluate", "--agents", "coast", "--initial-states", p),
            lambda p: load_scenario("paper-random").read_worlds(p),
        ),
        "table": Target(
            "t.npz", good_bytes(), lambda p: (*COMMAND[:-2], p, "--json"), lambda p: BestHarmTable.load(Path(p))
        ),
        "manifest": _bundle_file("manifest.json"),
        "weights": _bundle_file("weights.safetensors"),
    }


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        here = Path.cwd()
        os.chdir(path.parent)  # the name of a socket has at most 107 bytes
        try:
            server.bind(path.name)
        finally:
            os.chdir(here)


def _giant(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(10 << 30)


def _link(to: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(to)


def _link_out(path: Path) -> None:
    path.symlink_to(next(above for above in path.parents if above.name == INSIDE).parent / OUTSIDE)


def _loop(path: Path) -> None:
    path.symlink_to(path.name + "2")
    (path.parent / (path.name + "2")).symlink_to(path.name)


PLACES: dict[str, Callable[[Path], object]] = {
    "a pipe": lambda path: os.mkfifo(path),
    "a socket": _socket,
    "a folder": lambda path: path.mkdir(),
    "nothing": lambda path: None,
    "a link to nothing": _link("nowhere"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "links in a loop": _loop,
    "a link to a folder": _link("."),
    "a link to /dev/zero": _link("/dev/zero"),
    "a link to /dev/full": _link("/dev/full"),
    "a link to /dev/tty": _link("/dev/tty"),
    "a link to /dev/stdin": _link("/dev/stdin"),
    "a link to /dev/random": _link("/dev/random"),
    "a link to /proc/self/mem": _link("/proc/self/mem"),
    "a link to /proc/kmsg": _link("/proc/kmsg"),
    "a link to /proc/self/fd/0": _link("/proc/self/fd/0"),
    "a link to a folder elsewhere": _link_out,
    "ten gigabytes of nothing": _giant,
    "an empty file": lambda path: path.touch(),
    "/dev/null": _link("/dev/null"),
}


def _vanishing(path: Path, right: bytes) -> Build:
    """Takes the file away and puts it back."""

    def once(folder: Path) -> None:
        with suppress(OSError):
            (folder / path).unlink()
        with suppress(OSError):
            (folder / path).write_bytes(right)

    return once


def _growing(path: Path, right: bytes) -> Build:
    def once(folder: Path) -> None:
        with suppress(OSError), (folder / path).open("ab") as file:
            file.write(b"\n" * 4096)
            if file.tell() > 1 << 20:
                file.truncate(len(right))

    return once


def _turning(path: Path, right: bytes) -> Build:
    """Puts a pipe in the file's place and the file back."""

    def once(folder: Path) -> None:
        with suppress(OSError):
            os.mkfifo(folder / "pipe")
            os.replace(folder / "pipe", folder / path)
            (folder / "plain").write_bytes(right)
            os.replace(folder / "plain", folder / path)

    return once


CHANGING = {"vanishes and comes back": _vanishing, "grows": _growing, "turns into a pipe": _turning}

LONG = ("a" * 300, "a/" * 3000, "a" * 5000, f"../{INSIDE}/" * 300 + "x", HERE + "/" * 5000 + "x", "é" * 200)


def places(rng: random.Random) -> Iterator[Case]:
    """Every kind of file replaced by everything, changed while it is read, and called by names that bite."""
    for kind, target in targets().items():
        for place, put in PLACES.items():
            yield _case(f"{place}", target, _built(target, put), target.name)
        for what, change in CHANGING.items():
            for _ in range(4):
                yield _case(
                    what,
                    target,
                    _built(target, lambda path, right=target.right: path.write_bytes(right)),
                    target.name,
                    certain=False,
                    meanwhile=change(Path(target.name), target.right),
                )
        if "policy/" in target.name:
            continue
        suffix = Path(target.name).suffix
        for nasty in NASTY:
            name = f"{nasty.replace('/', '_')}{rng.randrange(10)}{suffix}"
            wrong = target.right[: len(target.right) // 2] + b"\n\tq: [" + target.right[len(target.right) // 2 :]
            yield _case("nasty name", target, lambda folder, name=name, wrong=wrong: write(folder / name, wrong), name)
            yield _case("nasty name of nothing", target, lambda folder: None, name)
        raw = os.fsdecode(b"\xff\xfe\x80" + kind.encode().replace(b" ", b"_")) + suffix
        yield _case("name that is no text", target, lambda folder, raw=raw: write(folder / raw, b"\x00"), raw)
        for name in LONG:
            yield _case("long name", target, lambda folder: None, name + suffix)
        yield _case("name with NUL", target, lambda folder: None, f"a\0b{suffix}")
        yield _case("name that is empty", target, lambda folder: None, "")
        yield _case("below a file", target, lambda folder: write(folder / "f", b""), f"f/x{suffix}")
        yield _case("name like an option", target, lambda folder: None, f"--help-me{suffix}")


def _built(target: Target, put: Callable[[Path], object]) -> Build:
    def build(folder: Path) -> None:
        target.beside(folder)
        write(folder / "taken", b"")
        path = folder / target.name
        if path.exists():
            path.unlink()
        put(path)

    return build


def _case(
    category: str, target: Target, build: Build, name: str, *, certain: bool = True, meanwhile: Build | None = None
) -> Case:
    command = target.command(name)
    reader = None if name.startswith("--") or not name else lambda: target.reader(name.replace(HERE, f"{Path.cwd()}"))
    return Case("place", category, command, build, certain=certain, reader=reader, meanwhile=meanwhile)
