"""Every refusal: what is done, and the whole message that answers it, as listed in ``tests/refusals/*.txt``.

A list begins with Python that each of its cases sees. Then come the cases, parted by empty lines: lines ``>>> `` (and
``... ``) of Python and ``$ ethbrake ...`` of the command line, of which the last must be refused, and below them the
answer: ``Class: message`` of what is raised, or what the command writes to stderr with exit status 2 and nothing else.
A case runs in an empty folder, which stands as ``HERE`` in answers; what it wrote before the refusal, it must find
unchanged. ``python -m tests.test_refusals`` writes the answers of today into the lists: read the difference.
"""

import contextlib
import io
import os
import shlex
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ethbrake_marl import errors
from ethbrake_marl.cli.app import run_command

WRITES = "REFUSALS_ARE_WRITTEN"
LISTS = sorted((Path(__file__).parent / "refusals").glob("*.txt"))


class Case(NamedTuple):
    """A block of a list."""

    list: Path
    done: tuple[str, ...]  # pieces of Python, and command lines with their ``$ ``
    answer: str


@cache
def setup(file: Path) -> dict[str, Any]:
    """The names that the first block of a list makes."""
    names: dict[str, Any] = {"Path": Path}
    exec(compile(file.read_text("utf-8").split("\n>>> ")[0].split("\n$ ")[0], str(file), "exec"), names)
    return names


def cases(file: Path) -> Iterator[Case]:
    """The cases of a list."""
    for block in file.read_text("utf-8").strip().split("\n\n"):
        done: list[str] = []
        lines = block.split("\n")
        while lines and lines[0].startswith((">>> ", "... ", "$ ")):
            line = lines.pop(0)
            if line.startswith("... "):
                done[-1] += "\n" + line[4:]
            else:
                done.append(line.removeprefix(">>> "))
        if done:
            yield Case(file, tuple(done), "\n".join(lines))


def carry_out(code: str, names: dict[str, Any]) -> str:
    """The answer to one piece; empty where it is not refused."""
    if not code.startswith("$ "):
        try:
            exec(code, names)
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        return ""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = run_command(shlex.split(code)[2:])
    if (status, out.getvalue()) == (2, ""):
        return err.getvalue().rstrip("\n")
    assert status == 0, f"{code}: status {status}, {out.getvalue()}{err.getvalue()}"
    return ""


def answer(case: Case) -> str:
    """What the last piece of a case is answered with, in the folder where this runs."""
    names = dict(setup(case.list))
    for code in case.done[:-1]:
        told = carry_out(code, names)
        assert not told, f"{code}: {told}"
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    told = carry_out(case.done[-1], names)
    assert told.startswith("ethbrake: ") or hasattr(errors, told.partition(":")[0]), told  # no defect is a refusal
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before
    return told.replace(str(Path().resolve()), "HERE")


ALL = [case for file in LISTS for case in cases(file)]


@pytest.mark.parametrize("case", ALL, ids=lambda case: f"{case.list.stem}: {case.done[-1]}"[:100])
def test_refusal__is_the_whole_message(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    told = answer(case)
    if WRITES in os.environ and told:
        write(case, told)
    assert told and (told == case.answer or WRITES in os.environ)


def write(case: Case, told: str) -> None:
    """Put the answer of a case into its list."""
    shown = "\n".join(code if code.startswith("$ ") else ">>> " + code.replace("\n", "\n... ") for code in case.done)
    text, old = case.list.read_text("utf-8"), f"{shown}\n{case.answer}" if case.answer else shown
    case.list.write_text(text.replace(f"\n\n{old}\n", f"\n\n{shown}\n{told}\n", 1), "utf-8")


if __name__ == "__main__":
    os.environ[WRITES] = "1"
    sys.exit(pytest.main([__file__, "-q", "-n", "0"]))
