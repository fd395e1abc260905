"""Hostile and damaged files, each read by its command, and hostile command lines.

Every case must end within 10 s of processor time and 2 GiB of memory. The exit status must be 2, with one error line of
at most 2,000 characters without control characters; a case that may be valid can also succeed. In Python the error must
be an ``EthBrakeError``. Nothing may be executed, and nothing written except the command's output. The folder of the
attack is deleted at the end.
"""

import functools
import gc
import io
import itertools
import os
import random
import shutil
import socket
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
import typer.main

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.policies.bundle import load_policy
from tests.programmes import Cases, Given, Told
from tests.programmes.archives import COMMAND, good_bytes, table_cases
from tests.programmes.cage import (
    HERE,
    INSIDE,
    NASTY,
    OUTSIDE,
    PRECIOUS,
    REFUSED,
    Build,
    Case,
    Generator,
    judge,
    read_states,
    read_table,
    write,
)
from tests.programmes.files import (
    EVALUATE,
    MANIFEST,
    SPECS,
    WEIGHTS,
    bundle,
    bundle_cases,
    run_cases,
    stopped,
    text_cases,
    texts,
)

# ---------------------------------------------------------------- places: what may stand where a file is expected


class Target(NamedTuple):
    """A file that a command reads."""

    name: str
    right: bytes
    command: tuple[str, ...]  # command with the file's name
    reader: Callable[[str], object]
    beside: Build = lambda folder: None  # makes other files that the command needs


def targets() -> Iterator[Target]:
    for kind in ("scenario", "recipe", "CSV"):
        text = texts()[kind]
        yield Target(text.file, text.text.encode(), text.command, text.reader)
    yield Target(
        "mine.yaml", texts()["scenario"].text.encode(), ("scenario", "show", "mine.yaml"), texts()["scenario"].reader
    )
    yield Target("t.npz", good_bytes(), COMMAND, lambda path: BestHarmTable.load(Path(path)))
    with tempfile.TemporaryDirectory() as folder:
        bundle(Path(folder))
        right = {name: (Path(folder) / "policy" / name).read_bytes() for name in (MANIFEST, WEIGHTS)}
    for name in right:
        yield Target(f"policy/{name}", right[name], EVALUATE, lambda path: load_policy("policy"), bundle)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server, chdir(path.parent):  # the name of a socket has at most 107 bytes
        server.bind(path.name)


def _loop(path: Path) -> None:
    path.symlink_to(path.name + "2")
    (path.parent / (path.name + "2")).symlink_to(path.name)


def _outside(path: Path) -> None:
    path.symlink_to(next(above for above in path.parents if above.name == INSIDE).parent / OUTSIDE)


def _link(to: str, path: Path) -> None:
    path.symlink_to(to)


DEVICES = (
    "/dev/zero", "/dev/full", "/dev/tty", "/dev/stdin", "/dev/random", "/dev/null", "/proc/self/mem", "/proc/kmsg",
    "/proc/self/fd/0",
)  # fmt: skip
PLACES: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a socket": _socket,
    "a folder": Path.mkdir,
    "nothing": lambda path: None,
    "a link to nothing": partial(_link, "nowhere"),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "links in a loop": _loop,
    "a link to a folder": partial(_link, "."),
    "a link to a folder elsewhere": _outside,
    "ten gigabytes of nothing": lambda path: (path.touch(), os.truncate(path, 10 << 30)),
    "an empty file": Path.touch,
    **{f"a link to {device}": partial(_link, device) for device in DEVICES},
}


LONG = ("a" * 300, "a/" * 3000, "a" * 5000, f"../{INSIDE}/" * 300 + "x", HERE + "/" * 5000 + "x", "é" * 200)


def places(rng: random.Random) -> Iterator[Case]:
    """Yield cases with every kind of file replaced by pipes, links, folders and so on, and with hostile file names."""
    for target in targets():
        for place, put in PLACES.items():
            yield _at(target, place, put)
        if "policy/" in target.name:
            continue
        suffix = Path(target.name).suffix
        half = len(target.right) // 2
        wrong = target.right[:half] + b"\n\tq: [" + target.right[half:]
        for nasty in NASTY:
            name = f"{nasty.replace('/', '_')}{rng.randrange(10)}{suffix}"
            yield _named(target, "nasty name", name, partial(_write, name, wrong))
            yield _named(target, "nasty name of nothing", name)
        raw = os.fsdecode(b"\xff\xfe\x80") + suffix
        yield _named(target, "name that is no text", raw, partial(_write, raw, b"\x00"))
        for name in LONG:
            yield _named(target, "long name", name + suffix)
        yield _named(target, "name with NUL", f"a\0b{suffix}")
        yield _named(target, "name that is empty", "")
        yield _named(target, "below a file", f"f/x{suffix}", partial(_write, "f", b""))
        yield _named(target, "name like an option", f"--help-me{suffix}")


def _write(name: str, content: bytes, folder: Path) -> None:
    write(folder / name, content)


def _at(target: Target, category: str, put: Callable[[Path], object]) -> Case:
    """Return a case with something else in the place of the file."""

    def build(folder: Path) -> None:
        target.beside(folder)
        write(folder / "taken", b"")
        (folder / target.name).unlink(missing_ok=True)
        put(folder / target.name)

    return Case(category, target.command, build, reader=partial(target.reader, target.name))


def _named(target: Target, category: str, name: str, build: Build = lambda folder: None) -> Case:
    """Return a case in which the file has another name."""
    command = tuple(name if word == target.name else word for word in target.command)
    reader = None if name.startswith("--") or not name else lambda: target.reader(name.replace(HERE, f"{Path.cwd()}"))
    return Case(category, command, build, reader=reader)


# ---------------------------------------------------------------- command lines

FEW = ("--episodes", "3")
NUMBERS = (
    "", "-1", "0", "1.5", "1e3", "nan", "inf", "9" * 5000, "0x10", "1_000", "\u0663", "1;2", " 1 x", "None", "10000001",
)  # fmt: skip
WORDS = (
    "", "x" * 9000, f"{HERE}/", "..", "a/../../b", "a\0b", "%s%n", "{}", "[/]", "[bold]", ":smile:", "$(touch pwned)",
    "`touch pwned`", *NASTY,
)  # fmt: skip
VARIABLES = (
    {"PYTHONWARNINGS": "error"}, {"COLUMNS": "1"}, {"COLUMNS": "9" * 30}, {"COLUMNS": "-5"}, {"LINES": "x"},
    {"TERM": "\x1b[2J"}, {"LC_ALL": "\u202e"}, {"PYTHONIOENCODING": "ascii"}, {"NO_COLOR": ""}, {"FORCE_COLOR": "1"},
    {"TTY_COMPATIBLE": "1"}, {"TMPDIR": f"{HERE}/file/x"}, {"TMPDIR": f"{HERE}/file"}, {"HOME": f"{HERE}/file/x"},
    {"NUMBA_CACHE_DIR": f"{HERE}/file/x"}, {"MPLBACKEND": "nonsense"}, {"NUMBA_NUM_THREADS": "x"},
    {"OMP_NUM_THREADS": "-1"}, {"MPLCONFIGDIR": f"{HERE}/file"}, {"PWD": f"{HERE}/nowhere"}, {"TZ": "\x1b"},
    {"_ETHBRAKE_COMPLETE": "bash_source"}, {"_TYPER_STANDARD_TRACEBACK": "1"},
)  # fmt: skip
# Command lines in which ``@`` is replaced by a hostile word.
LINES = (
    "scenario show @", "scenario new @", "compare @ @", "train --resume @", "@",
    "evaluate --episodes 3 --set @", "evaluate --episodes 3 --set mass_t=@", "evaluate --episodes 3 --set harm_count=@",
    "evaluate --no@", "train --recipe @", "watch --agents coast --output @.png",
    "shield --episodes 3 --agents @", "agent export @ --onnx x.onnx", "study falsify --budget 10 --scenario @",
    "study ablate --levels @ --output o",
)  # fmt: skip
# Places in the case's folder where not even the superuser can write.
TARGETS = ("file", "file/x", "full", "link", "dangling", "loop", "pipe", "pipe/x", f"{HERE}/loop/x", "x" * 300, "\0b")
WRITERS: dict[str, tuple[str, ...]] = {
    "results": ("evaluate", "--agents", "coast", *FEW, "--output"),
    "worlds": ("study", "falsify", "--agent", "coast", "--against", "full_brake", "--budget", "9", "--output"),
    "run": ("train", "--steps", "1", "--output"),
    "new scenario": ("scenario", "new", "mine", "--output"),
    "film": ("watch", "--output"),
}
MAY_CHANGE = ("file", "full/results.json", "full/mine.yaml")


def _taken(folder: Path) -> None:
    write(folder / "file", "precious")
    write(folder / "full" / "thesis.txt", "years of work")
    (folder / "link").symlink_to(f"../../{OUTSIDE}/{PRECIOUS}")
    (folder / "dangling").symlink_to("nowhere")
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe")


def commands(rng: random.Random) -> Iterator[Case]:
    """Yield hostile command lines, output paths and environment variables."""
    line = partial(Case, build=lambda folder: None, may_change=MAY_CHANGE)
    for spec in (*SPECS, *(f"ppo@{word}" for word in WORDS), *(f"{word}:1" for word in WORDS if word)):
        good = spec in ("ppo", "ladder", "constant:-7")
        yield line("agent", ("evaluate", *FEW, "--agents", spec), certain=not good)
    for number in NUMBERS:
        certain = number not in ("0", "0x10", "\u0663", "10000001", "1e3", "1_000")
        for option in ("--seed", *(["--episodes"] if number != "10000001" else [])):  # so many worlds take long
            yield line("number", ("evaluate", "--agents", "coast", option, number), certain=certain)
        if number != "10000001":  # a large budget is allowed to take long
            wrong = number in ("", "-1", "0", "1.5", "nan")
            yield line(
                "number",
                ("study", "falsify", "--agent", "coast", "--measure", "harm", "--budget", number),
                certain=wrong,
            )
    for word, text in itertools.product(WORDS, LINES):
        yield line("word", tuple(each.replace("@", word) for each in text.split(" ")))
    for (what, command), target in itertools.product(WRITERS.items(), TARGETS):
        taken = partial(Case, f"output taken: {what}", build=_taken, may_change=MAY_CHANGE)
        yield taken((*command, target), certain=what not in ("new scenario", "results") or target != "full")
        if what not in ("run", "new scenario"):
            yield taken((*command, target, "--force"), certain=target != ("full" if what == "results" else "file"))
    for variables in VARIABLES:
        around = partial(Case, build=partial(_write, "file", b"precious"), environment=variables)
        yield around("environment", ("evaluate", "--agents", "coast,full_brake", *FEW), certain=False)
        yield around("environment, error", ("evaluate", "--agents", "ppo@\x1b[2J"))


KINDS: dict[str, Generator] = {
    **{kind: partial(text_cases, kind) for kind in ("scenario", "recipe", "worlds", "CSV")},
    "table": table_cases,
    "place": places,
    "bundle": bundle_cases,
    "run": partial(run_cases, "run"),
    "checkpoint": partial(run_cases, "checkpoint"),
    "command": commands,
}


# ---------------------------------------------------------------- the attack


OPTIONS = {"--sample": {"type": int, "help": "number of cases per category"}, "--seed": {"type": int, "default": 0}}


def by_category(kind: str, seed: int) -> dict[str, list[Case]]:
    """Return the cases of a kind by category, each category shuffled."""
    grouped: dict[str, list[Case]] = defaultdict(list)
    for case in KINDS[kind](random.Random(f"{seed} {kind}")):
        grouped[case.category].append(case)
    for group in grouped.values():
        random.Random(f"{seed} {kind} sample").shuffle(group)
    return grouped


def cases(given: Given) -> Cases:
    with tempfile.TemporaryDirectory(prefix="hostile-", ignore_cleanup_errors=True) as folder:
        own = Path(folder).resolve()
        tempfile.tempdir = os.fspath(own)
        os.chdir(own)
        if not given.list:
            warm_up(own)
        for kind in KINDS:
            for number, (category, group) in enumerate(by_category(kind, given.seed).items()):
                tried = group[: given.sample]
                yield f"{kind}: {category}, {len(tried)}", partial(attack, tried, own / f"{kind}-{number}")


def attack(tried: list[Case], folder: Path) -> Told:
    """Judge the cases of a category."""
    verdicts = []
    for case in tried:
        verdicts.append(judge(case, folder))
        if faults := verdicts[-1].faults:
            print(f"BROKEN {' '.join(case.command)!a:.120}:", *(f"    {each!a:.400}" for each in faults), sep="\n")
    refused = sum(verdict.status == REFUSED for verdict in verdicts)
    broken = sum(bool(verdict.faults) for verdict in verdicts)
    slowest, longest = max(verdict.cpu_s for verdict in verdicts), max(verdict.longest for verdict in verdicts)
    return Told(
        not broken,
        f"{refused} refused, {len(tried) - refused - broken} valid, {broken} broke a rule; at most {slowest:.2f} s"
        f" of processor time and {longest} characters per line",
    )


WARM = (
    *(f"{command} {place}{file}{rest}"
      for place in ("", "bad/")
      for command, file, rest in (
          ("scenario validate", "scenario.yaml", ""),
          ("train --recipe", "recipe.yaml", " --output file"),
          ("study falsify --again", "worlds.yaml", ""),
      )),
    "train --resume ppo", "train --resume sac", "nonsense", "shield --agents x",
    "study ablate --levels x --output x", "agent export x --onnx x", "watch --output file",
    "evaluate --agents coast,full_brake --episodes 3 --output out --per-world csv",
)  # fmt: skip


def warm_up(folder: Path) -> None:
    """Import late modules and compile the kernels, so that a case is charged only for its own work."""
    torch.set_num_threads(1)
    typer.main.get_command = functools.cache(typer.main.get_command)  # else built per command line
    write(folder / "file", "")
    for place in (folder, folder / "bad"):
        for kind, text in texts().items():
            write(place / f"{kind}{Path(text.file).suffix}", text.text if place == folder else "bad: [")
        write(place / "t.npz", good_bytes() if place == folder else b"")
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        for algorithm in ("ppo", "sac"):
            shutil.copytree(stopped(algorithm), folder / algorithm)
        for line in WARM:
            run_command(line.split(" "))
        for place, read in itertools.product((folder, folder / "bad"), (read_states, read_table)):
            with suppress(EthBrakeError):
                read(place / ("CSV.csv" if read is read_states else "t.npz"))
    sys.stdout.flush()
    gc.collect()
    gc.freeze()  # so that children share these pages
