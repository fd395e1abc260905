"""The frame of all commands: names, help, completion, streams, signals, exit statuses; and agents from a file."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest
import typer

from ethbrake_marl import __version__, kernel_cache
from ethbrake_marl.cli import app as frame
from ethbrake_marl.cli.app import run_command, whole_command
from ethbrake_marl.cli.command import Out
from tests.fixtures.commands import Command, check_refused, told_json

COMMANDS = [""]  # every one, groups too
for name, found in whole_command().commands.items():
    COMMANDS += [name, *(f"{name} {each}" for each in getattr(found, "commands", ()))]


@pytest.mark.parametrize("words", COMMANDS)
def test_help__has_examples_that_parse_and_a_short_name(
    ethbrake: Command, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    answer = ethbrake(*words.split(), "--help")
    assert (answer.status, answer.err) == (0, "") and "-h, --help" in answer.out
    assert not re.search(r"^  [a-z][a-z-]* .*\.\.\.$", answer.out, re.MULTILINE)  # no command's sentence is cut
    assert ethbrake(*words.split(), "-h").out == answer.out
    examples = [" ".join(each.split()) for each in re.findall(r"Example: ethbrake ((?:.|\n(?!\n))+)", answer.out)]
    assert len(examples) == (2 if "\nCommands:" in answer.out else 1)
    for example in examples:
        arguments = shlex.split(example.partition(" >")[0])
        assert " ".join(arguments).startswith(words)
        assert ethbrake(*arguments, "--help").status == 0


FISH = {"_ETHBRAKE_COMPLETE": "complete_fish", "_TYPER_COMPLETE_ARGS": "ethbrake doctor --js"}


@pytest.mark.parametrize(
    ("asked", "answered"),
    [
        (
            {"_ETHBRAKE_COMPLETE": "complete_bash", "COMP_WORDS": "ethbrake scenario val", "COMP_CWORD": "2"},
            "validate\n",
        ),
        ({**FISH, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}, "--json"),
        ({**FISH, "_TYPER_COMPLETE_FISH_ACTION": "is-args"}, ""),
        ({"_ETHBRAKE_COMPLETE": "1"}, None),
    ],
)
def test_completion__a_shell_that_asks_gets_what_can_follow(monkeypatch, capsys, asked, answered) -> None:
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    assert run_command(["--version"] if answered is None else []) == 0
    assert (f"ethbrake {__version__}\n" if answered is None else answered) in capsys.readouterr().out


def test_results__stand_alone_on_stdout_whatever_a_file_of_the_users_prints(ethbrake: Command, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "import numpy as np, ethbrake_marl as eb\n"
        'print("noise of a file")\n'
        "def act(seen):\n"
        '    print("noise of a policy")\n'
        "    return np.full((len(seen), 1), -1.0)\n"
        "def make(): return eb.policy_agent(act)\n"
    )
    files = ["--agents", f"full_brake,{tmp_path}/mine.py:make"]
    told = ethbrake("evaluate", *files, "--episodes", "3", "--json")
    assert len(told_json(told)) == 2
    assert "noise of a file" in told.err and "noise of a policy" in told.err
    assert "noise" not in ethbrake("evaluate", *files, "--episodes", "3").out


def test_defect_of_the_program__keeps_its_traceback_and_missing_memory_is_one_line(ethbrake, monkeypatch) -> None:
    monkeypatch.setattr("ethbrake_marl.worlds.catalogue.list_scenarios", Mock(side_effect=RuntimeError("a defect")))
    with pytest.raises(RuntimeError, match="a defect"):
        ethbrake("scenario", "list")
    short = Mock(side_effect=MemoryError("Unable to allocate 9 TiB"))
    monkeypatch.setattr("ethbrake_marl.evaluation.comparison.evaluate", short)
    check_refused(ethbrake("evaluate"), "not enough memory (Unable to allocate 9 TiB)", "fewer worlds")


def program(source: str, **environment: str) -> tuple[int, str, str]:
    process = subprocess.run(
        [sys.executable, "-c", source],
        env={**os.environ, **environment},
        capture_output=True,
        encoding=environment.get("PYTHONIOENCODING", "utf-8"),
        check=False,
    )
    return process.returncode, process.stdout, process.stderr


def test_a_command__uses_one_core_unless_it_is_told_otherwise() -> None:
    source = (
        "import os, sys; os.environ.pop('OMP_NUM_THREADS', None); sys.argv = ['ethbrake', '--version']\n"
        "from ethbrake_marl.cli.app import main\n"
        "print('numpy' in sys.modules)\n"  # which reads the variable when it is imported
        "try: main()\n"
        "finally: print(os.environ['OMP_NUM_THREADS'])"
    )
    assert program(source)[1].split() == ["False", "ethbrake", __version__, "1"]


def test_program__exit_status_and_streams_and_a_full_disk_behind_stdout() -> None:
    calling = (
        "import os, runpy, sys; sys.argv = ['ethbrake', {!r}];{} runpy.run_module('ethbrake_marl', run_name='__main__')"
    )
    assert program(calling.format("--version", "")) == (0, f"ethbrake {__version__}\n", "")
    status, out, err = program(calling.format("evalute", ""))
    assert (status, out, err.count("\n")) == (2, "", 1)
    full = program(calling.format("--version", " os.dup2(os.open('/dev/full', os.O_WRONLY), 1);"))
    assert full == (3, "", "ethbrake: error: output: No space left on device\n")


def test_command__ctrl_c_is_one_line_and_the_status_of_an_interruption(capsys) -> None:
    with pytest.raises(typer.Exit) as raised, Out(remains="what was found is kept"):
        raise KeyboardInterrupt
    assert raised.value.exit_code == 130
    assert capsys.readouterr().err == "interrupted; what was found is kept\n"


# ---------------------------------------------------------------- files and commands of the user's own


def test_stdout__has_results_alone_whatever_writes_past_python(capfd, monkeypatch) -> None:
    for owner, name in ((sys, "stdout"), (frame.warnings, "showwarning")):
        monkeypatch.setattr(owner, name, getattr(owner, name))
    before = os.dup(1)
    sys.stdout = sys.__stdout__
    try:
        frame.prepare_streams()
        os.write(1, b"raw")
        with sys.stdout:
            print("result")
    finally:
        os.dup2(before, 1)
        os.close(before)
    assert capfd.readouterr() == ("result\n", "raw")


@pytest.mark.parametrize(
    "name, what",
    [
        ("", "the physics for the first time, which takes a minute or more"),
        ("a", "parts of the physics that no earlier command needed, first of motion.impact"),
    ],
)
def test_compilation__is_announced_once(name: str, what: str, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(kernel_cache, "_announced", [])
    if name:
        kernel_cache.save_data(name, b"")
    for module in ("motion.impact", "motion.step"):
        kernel_cache.announce_compilation(module)
    [line] = capsys.readouterr().err.splitlines()
    assert line == f"compiling {what}"
