"""Blocks of code in the pages, run as a reader runs them: from top to bottom, in one folder for each page.

Python blocks of a page share their names. Commands run in this process, in a short form (``SHORT``) unless the page
shows what they print; targets of make and installations are only checked. A block without a language shows what the
block above prints, as do the lines below a command in a ``console`` block and the comment behind ``print(...)``;
``...`` stands for any text. A block of YAML is a scenario, a recipe, or keys of the scenario ``paper-random``.
Without ``--all`` only the first block of code that can run is run, and of several commands the first; the others are
parsed.

A comment before a block, ``<!-- block: MARK; MARK -->``, says what is different with it:

- ``slow``: never the first block, because it takes more than a few seconds.
- ``not run: REASON``: only parsed: the options of its commands exist.
- ``needs PACKAGE``: run where this package is installed, and parsed elsewhere.
- ``short A=B C=D``: run with B in place of A; its commands in their short form although the page shows what they print.
- ``except A, B``: lines that begin with these words have figures that depend on the machine; they are not compared.
- ``write FILE``: content of a file that the reader writes. ``show FILE``: of a file that the blocks above wrote.
- ``change FILE``: new values of keys of a YAML file. ``without A, B``: keys of ``paper-random`` that must be left out.
"""

import argparse
import contextlib
import csv
import difflib
import doctest
import io
import os
import pkgutil
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import yaml
from markdown_it import MarkdownIt

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command, whole_command
from tests.cli.test_printed import PROGRESS
from tests.fixtures.registered import registries
from tests.programmes.__main__ import main as run_programme

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
GROUPS = {f"ethbrake_marl.{each.group}" for each in registries()}
COMMENT = re.compile(r"<!-- block: (.*) -->\s*", re.DOTALL)
MARK = re.compile(r"(slow$|not run: |needs |short(?: |$)|except |write |show |change |without )(.*)")
NO_CODE = ("text", "bibtex")
TINY = "--steps 1 --set evaluation.worlds=10 --set n_envs=16 --set tried=16"
SHORT = {  # what is added to a command, the first that fits: the last value of an option counts
    "ethbrake train --recipe three-tests": TINY,
    "ethbrake train": "--steps 1 --set evaluation.worlds=10",
    "ethbrake run": "--steps 1 --set evaluation.worlds=10 --episodes 20",
    "ethbrake evaluate": "--episodes 20",
    "ethbrake reproduce": "--list",
    "ethbrake study ablate": "--steps 1 --episodes 4 --search-episodes 2 --seeds 1",
    "python train/ippo.py": "--steps 200 --copies 2 --rollout 60",
    "python train/benchmark/run.py": "--seeds 1 --jobs 1 --decisions 100 --episodes 5",
    "python train/tune.py": "--trials 1 --jobs 1 --set total_steps=1 evaluation.worlds=10",
    "python docs/studies/best_harm.py": "--episodes 2 --budget 20",
    "python docs/studies/whose_harm.py": "--worlds 2 --budget 20",
    "python docs/studies/offline_data.py": "--episodes 20",
}


@dataclass(frozen=True)
class Block:
    """A block of a page. ``is_shown``: the next block shows what it prints."""

    place: str  # page:line
    language: str  # empty: shows output
    text: str
    marks: dict[str, str]
    is_shown: bool = False

    @property
    def code(self) -> str:
        """The text with the replacements of ``short``."""
        text = self.text
        for old, _, new in (each.partition("=") for each in shlex.split(self.marks.get("short", ""))):
            assert old in text, f"{self.place}: {old} is not in the block"
            text = text.replace(old, new)
        return text


def blocks(page: Path) -> list[Block]:
    """Blocks of a page. Raises ``AssertionError`` for an unknown mark, or a mark without a block."""
    found: list[Block] = []
    marks: dict[str, str] = {}
    for token in MarkdownIt().parse(page.read_text("utf-8")):
        place = f"{page.name}:{token.map[0] + 1 if token.map else '?'}"
        if token.type in ("fence", "code_block"):
            language = token.info.strip() if token.type == "fence" else "(indented)"
            if not language and found and not {"write", "show"} & marks.keys():
                found[-1] = replace(found[-1], is_shown=True)
            found.append(Block(place, language, token.content, marks))
            marks = {}
            continue
        assert not marks, f"{place}: a mark without a block"
        if token.type == "html_block" and "block:" in token.content:
            marks = _marks(place, token.content)
    assert not marks, f"{page.name}: a mark without a block"
    return found


def _marks(place: str, comment: str) -> dict[str, str]:
    match = COMMENT.fullmatch(comment)
    assert match, f"{place}: must be <!-- block: MARKS -->"
    marks = {}
    for mark in " ".join(match[1].split()).split("; "):
        parts = MARK.fullmatch(mark)
        assert parts, f"{place}: unknown mark {mark!r}"
        marks[parts[1].strip(" :")] = parts[2]
    return marks


class Reader:
    """Follows a page in the current folder. ``reads_all``: runs every block; otherwise the first that is not slow."""

    def __init__(self, reads_all: bool) -> None:
        self.reads_all = reads_all
        self.has_run = False
        self.names: dict[str, Any] = {"__name__": "my_file"}
        self.printed: str | None = None  # by the last block of code; None if it was not run
        shutil.copytree(ROOT / "train", "train")

    def read(self, block: Block) -> None:
        """Run a block. Raises ``AssertionError`` or the code's own exception if the page is wrong."""
        marks = block.marks
        if "write" in marks:
            Path(marks["write"]).write_text(block.text)
        elif {"show", "change"} & marks.keys():
            if self.reads_all:
                check_file(block)
        elif not block.language:
            has_output = self.runs(block) if self.reads_all else self.printed is not None
            assert has_output == (self.printed is not None), f"{block.place}: shows output of no block"
            if self.printed is not None:
                check_output(block.place, block.text, self.printed, marks.get("except", ""))
        elif block.language == "python":
            self.run_python(block)
        elif block.language in ("sh", "console"):
            self.run_commands(block)
        elif block.language == "yaml":
            read_yaml(block)
        elif block.language == "toml":
            groups = tomllib.loads(block.text)["project"]["entry-points"]
            assert groups.keys() <= GROUPS, f"{block.place}: unknown entry points"
        elif block.language == "{eval-rst}":
            for name in re.findall(r"(?m)^   ([a-zA-Z_.]+)$|autopydantic_model:: ethbrake_marl\.(.*)$", block.text):
                pkgutil.resolve_name(f"ethbrake_marl.{''.join(name)}")
        else:
            assert block.language in NO_CODE, f"{block.place}: nothing runs a block of {block.language!r}"

    def runs(self, block: Block) -> bool:
        skipped = "not run" in block.marks or (not self.reads_all and (self.has_run or "slow" in block.marks))
        return not skipped and ("needs" not in block.marks or find_spec(block.marks["needs"]) is not None)

    def run_python(self, block: Block) -> None:
        code, output = compile(block.code, block.place, "exec"), io.StringIO()
        self.printed = None
        if self.runs(block):
            with contextlib.redirect_stdout(output):
                exec(code, self.names)
            self.printed, self.has_run = output.getvalue(), True
            if comments := re.findall(r"(?m)^ *print\(.*\)  # (.*)$", block.text):
                check_output(block.place, f"...{'...'.join(comments)}...", self.printed)

    def run_commands(self, block: Block) -> None:
        self.printed = "" if self.runs(block) else None
        for line, shown in commands(block.code, has_prompt=block.language == "console"):
            words, whole = shlex.split(line, comments=True), "short" not in block.marks and (shown or block.is_shown)
            follows = not self.reads_all and self.has_run and not (shown or block.is_shown)
            if self.printed is None or follows or not is_run(words, bool(whole)):
                parse(words)
                continue
            printed = run(words if whole else words + short_form(words), fails=shown.startswith("ethbrake: error: "))
            self.printed += printed
            self.has_run = True
            if shown:
                check_output(block.place, shown, printed, block.marks.get("except", ""))


def commands(text: str, has_prompt: bool) -> Iterator[tuple[str, str]]:
    """Yield each command of a block and what the page shows below it. A prompt is ``$``."""
    text = text.replace("\\\n", " ")
    if not has_prompt:
        yield from ((line, "") for line in text.splitlines() if line.partition("#")[0].strip())
        return
    before, *parts = re.split(r"(?m)^\$ ", text)
    assert not before, f"no command: {before}"
    for part in parts:
        line, _, shown = part.partition("\n")
        yield line, shown


def check_output(place: str, shown: str, printed: str, left_out: str = "") -> None:
    """Compare what a page shows with what was printed, except for lines that begin with one of these words."""
    words = tuple(left_out.split(", ")) if left_out else ()
    want, got = (
        "\n".join(each for each in text.splitlines() if not each.startswith(words)) for text in (shown, printed)
    )
    alike = doctest.OutputChecker().check_output(want, got, doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    assert alike, f"{place}\n" + "\n".join(difflib.unified_diff(want.splitlines(), got.splitlines(), "page", "printed"))


def check_file(block: Block) -> None:
    """Compare a file with a block that shows it, or change it as the block says."""
    if "show" in block.marks:
        check_output(block.place, block.text, columns_of(Path(block.marks["show"]), block.text))
    else:
        change(Path(block.marks["change"]), block)


def columns_of(file: Path, shown: str) -> str:
    """Text of a file; of a CSV file only the columns that the page shows."""
    if file.suffix != ".csv":
        return file.read_text()
    header = shown.partition("\n")[0].split(",")
    with file.open(newline="") as table:
        rows = [[row[name] for name in header] for row in csv.DictReader(table)]
    return "\n".join(",".join(row) for row in (header, *rows))


def change(file: Path, block: Block) -> None:
    """Replace lines of a YAML file by the lines of a block with the same keys."""
    text = file.read_text()
    for line in block.text.splitlines():
        text, count = re.subn(rf"(?m)^(?:# )?{line.partition(':')[0]}: .*$", line, text)
        assert count == 1, f"{block.place}: {file} has no line {line.partition(':')[0]}"
    file.write_text(text)


def read_yaml(block: Block) -> None:
    """Read a scenario or a recipe strictly, from a file with its name that stays for the blocks below."""
    content, base = yaml.safe_load(block.text), ""
    if "name" not in content:
        shipped = yaml.safe_load((ROOT / "scenarios" / "paper" / "paper-random.yaml").read_text("utf-8"))
        replaced = {*content, *block.marks.get("without", "").split(", ")}
        base = yaml.safe_dump({key: value for key, value in shipped.items() if key not in replaced})
    file = Path(f"{content.get('name', 'paper-random')}.yaml")
    file.write_text(base + block.text)
    if "algorithm" in content:
        eb.load_recipe(file)
    else:
        eb.load_scenario(file).sample(10, seed=7)


# ---------------------------------------------------------------- commands


def short_form(words: list[str]) -> list[str]:
    line = f"{' '.join(words)} "
    return next((more.split() for begin, more in SHORT.items() if line.startswith(f"{begin} ")), [])


def is_run(words: list[str], whole: bool) -> bool:
    """Whether a command is run. Installations and targets of make are not, except ``make run``."""
    program, *rest = words
    if program == "make":
        return whole and rest == ["run"]
    return program in ("ethbrake", "cp") or (is_python(program) and rest[:2] not in (["-m", "pip"], ["-m", "venv"]))


def is_python(program: str) -> bool:
    return program in ("python", ".venv/bin/python")


def run(words: list[str], fails: bool = False) -> str:
    """Run a command in this process. Return what it prints, without progress."""
    output, (program, *rest) = io.StringIO(), words
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        if program in ("ethbrake", "make"):  # make run
            status = run_command(rest)
        elif is_python(program):
            status = run_script(rest)
        else:
            status = subprocess.run(words, check=False).returncode
    text = PROGRESS.sub("", output.getvalue())
    assert bool(status) == fails, f"{shlex.join(words)}: status {status}: {text[-2000:]}"
    return text


def run_script(words: list[str]) -> int:
    """Run ``python WORDS``; return the exit status."""
    before, sys.argv = sys.argv, words[words[0] == "-m" :]
    handler = signal.getsignal(signal.SIGINT)
    try:
        if words[0] == "-m":
            runpy.run_module(words[1], run_name="__main__", alter_sys=True)
        else:
            runpy.run_path(words[0] if Path(words[0]).is_file() else str(ROOT / words[0]), run_name="__main__")
    except SystemExit as stop:
        return int(stop.code or 0)
    finally:
        sys.argv = before
        signal.signal(signal.SIGINT, handler)
    return 0


def parse(words: list[str]) -> None:
    """Check a command that is not run: its program, target, options and extras."""
    program, *rest = words
    if program == "ethbrake":
        context = whole_command().make_context("ethbrake", list(rest))
        while hasattr(context.command, "commands"):
            name, command, left = context.command.resolve_command(context, [*context._protected_args, *context.args])
            context = command.make_context(name, left, parent=context)
    elif program == "make":
        check_target(rest)
    elif is_python(program) and rest[0].endswith(".py"):
        parse_script(rest)
    elif program == "cp":
        assert len(rest) == 2, f"{shlex.join(words)}: a file and a file"
    elif program == "pip" or rest[:2] == ["-m", "pip"]:
        extras = {extra for word in rest for listed in re.findall(r"\[(.*?)\]", word) for extra in listed.split(",")}
        assert extras <= PROJECT["optional-dependencies"].keys(), f"{shlex.join(words)}: unknown extra"
    else:
        installs = (["source", ".venv/bin/activate"], ["python", "-m", "venv", ".venv"])
        assert words in installs or rest[:1] == ["-m"], f"nothing runs {shlex.join(words)}"


def parse_script(words: list[str]) -> None:
    """Let a script parse its arguments, and stop there."""
    if "parse_args(" not in (ROOT / words[0]).read_text("utf-8"):
        assert len(words) == 1, f"{words[0]} takes no arguments"
        return
    whole = argparse.ArgumentParser.parse_args

    def parse_and_stop(parser: argparse.ArgumentParser, *given: Any) -> Any:
        whole(parser, *given)
        raise SystemExit(0)

    argparse.ArgumentParser.parse_args = parse_and_stop
    try:
        with contextlib.redirect_stderr(io.StringIO()) as told:
            status = run_script(words)
        assert not status, told.getvalue()
    finally:
        argparse.ArgumentParser.parse_args = whole


def check_target(words: list[str]) -> None:
    """Check targets of the Makefile, and a programme: its options, and that it has cases."""
    targets = re.findall(r"(?m)^([a-z]+):", (ROOT / "Makefile").read_text("utf-8"))
    unknown = [word for word in words if "=" not in word and word not in targets]
    assert not unknown, f"make {shlex.join(words)}: no target {', '.join(unknown)}"
    asked = ["make", "-n", "--no-print-directory", *words]
    outer = ("MAKEFLAGS", "MAKEOVERRIDES", "MFLAGS", "ARGS", "NAME", "WORKERS")  # set by `make test ARGS=--all`
    own = {name: value for name, value in os.environ.items() if name not in outer}
    told = subprocess.run(asked, cwd=ROOT, env=own, capture_output=True, text=True, check=True)
    if words[0] == "programme":
        listed = io.StringIO()
        with contextlib.redirect_stdout(listed):
            status = run_programme([*shlex.split(told.stdout.partition("-m tests.programmes ")[2]), "--list"])
        assert listed.getvalue() and not status, f"make {shlex.join(words)}: has no cases"
