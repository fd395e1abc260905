"""Options, agents and environment variables that bite, and results that are to go where they cannot."""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from pathlib import Path

from tests.hostile.case import HERE, NASTY, OUTSIDE, PRECIOUS, Build, Case, write
from tests.hostile.yaml_parts import SPECS

FEW = ("--episodes", "3")
NUMBERS = (
    "",
    "-1",
    "0",
    "1.5",
    "1e3",
    "nan",
    "inf",
    "9" * 5000,
    "0x10",
    "1_000",
    "\u0663",
    "1;2",
    " 1 x",
    "None",
    "10000001",
)
WORDS = (
    "",
    "x" * 9000,
    f"{HERE}/",
    "..",
    "a/../../b",
    "a\0b",
    "%s%n",
    "{}",
    "[/]",
    "[bold]",
    ":smile:",
    "$(touch pwned)",
    "`touch pwned`",
    *NASTY,
)
VARIABLES = (
    {"PYTHONWARNINGS": "error"},
    {"COLUMNS": "1"},
    {"COLUMNS": "9" * 30},
    {"COLUMNS": "-5"},
    {"LINES": "x"},
    {"TERM": "\x1b[2J"},
    {"LC_ALL": "\u202e"},
    {"PYTHONIOENCODING": "ascii"},
    {"NO_COLOR": ""},
    {"FORCE_COLOR": "1"},
    {"TTY_COMPATIBLE": "1"},
    {"TMPDIR": f"{HERE}/file/x"},
    {"TMPDIR": f"{HERE}/file"},
    {"HOME": f"{HERE}/file/x"},
    {"NUMBA_CACHE_DIR": f"{HERE}/file/x"},
    {"MPLBACKEND": "nonsense"},
    {"NUMBA_NUM_THREADS": "x"},
    {"OMP_NUM_THREADS": "-1"},
    {"MPLCONFIGDIR": f"{HERE}/file"},
    {"PWD": f"{HERE}/nowhere"},
    {"TZ": "\x1b"},
    {"_ETHBRAKE_COMPLETE": "bash_source"},
    {"_TYPER_STANDARD_TRACEBACK": "1"},
)


def _taken(folder: Path) -> None:
    write(folder / "file", "precious")
    write(folder / "full" / "thesis.txt", "years of work")
    (folder / "link").symlink_to(f"../../{OUTSIDE}/{PRECIOUS}")
    (folder / "dangling").symlink_to("nowhere")
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe")


# Places below the case's own folder where nothing can be written, not even by the superuser.
TARGETS = ("file", "file/x", "full", "link", "dangling", "loop", "pipe", "pipe/x", f"{HERE}/loop/x", "x" * 300, "\0b")
WRITERS: dict[str, tuple[str, ...]] = {
    "per world": ("evaluate", "--agents", "coast", *FEW, "--per-world"),
    "table": ("search", "best-harm", *FEW, "--budget", "1", "--output"),
    "run": ("train", "--steps", "1", "--output"),
    "new scenario": ("scenario", "new", "mine", "--output"),
    "picture": ("watch", "picture", "criticality", "--output"),
}


def commands(rng: random.Random) -> Iterator[Case]:
    """Command lines, the places where their results are to go, and the variables around them."""
    yield from _values()
    yield from _words()
    yield from _outputs()
    yield from _variables()


def _values() -> Iterator[Case]:
    for spec in (*SPECS, *(f"ppo@{word}" for word in WORDS), *(f"{word}:1" for word in WORDS if word)):
        yield _case(
            "agent", ("evaluate", *FEW, "--agents", spec), certain=spec not in ("ppo@shipped", "ladder", "constant:-7")
        )
    for number in NUMBERS:
        for option in ("--episodes", "--seed"):
            yield _case(
                "number",
                ("evaluate", "--agents", "coast", option, number),
                certain=number not in ("0", "0x10", "\u0663", "10000001", "1e3", "1_000"),
            )
        if number != "10000001":  # a budget that takes its time is the user's own wish
            wrong = number in ("", "-1", "0", "1.5", "nan")
            yield _case("number", ("search", "best-harm", *FEW, "--budget", number), certain=wrong)


def _words() -> Iterator[Case]:
    for word in WORDS:
        for command in (
            ("scenario", "show", word),
            ("scenario", "new", word),
            ("recipe", "show", word),
            ("recipe", "new", word),
            ("compare", word, word),
            ("evaluate", *FEW, "--set", word),
            ("evaluate", *FEW, "--set", f"mass_t={word}"),
            ("evaluate", *FEW, "--vehicle", word),
            ("train", "resume", word),
            (word,),
            ("evaluate", f"--no{word}"),
            ("train", "--name", word),
            ("train", "--recipe", word),
            ("evaluate", *FEW, "--objective", word),
            ("shield", *FEW, "--agents", word),
            ("agent", "export", word, "--onnx", "x.onnx"),
            ("train", "curves", "--output", "o", "--scenario", word),
            ("study", "ablate", "--levels", word, "--output", "o"),
            ("study", "generalise", "--runs", word, "--vehicles", "3"),
            ("study", "generalise", "--runs", "x", "--vehicles", word),
        ):
            yield _case("word", command)


def _outputs() -> Iterator[Case]:
    for what, command in WRITERS.items():
        for target in TARGETS:
            good = what == "new scenario" and target == "full"
            yield _case(f"output taken: {what}", (*command, target), _taken, certain=not good)
            if what not in ("run", "new scenario"):
                yield _case(f"output taken: {what}", (*command, target, "--force"), _taken, certain=target != "file")


def _variables() -> Iterator[Case]:
    for variables in VARIABLES:
        yield Case(
            "command",
            "environment",
            ("evaluate", "--agents", "coast,full_brake", *FEW),
            lambda folder: write(folder / "file", "precious"),
            certain=False,
            environment=variables,
        )
        yield Case(
            "command",
            "environment, error",
            ("evaluate", "--agents", "ppo@\x1b[2J"),
            lambda folder: write(folder / "file", "precious"),
            environment=variables,
        )


def _case(category: str, command: tuple[str, ...], build: Build = lambda folder: None, *, certain: bool = True) -> Case:
    return Case(
        "command", category, command, build, certain=certain, may_change=("file", "file.json", "full/mine.yaml")
    )
