"""How a command ends: its exit status, where its output goes or cannot go, and Ctrl-C."""

import builtins
import errno
import io
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import NoReturn
from unittest.mock import Mock

import pytest
import typer

from ethbrake_marl.cli.app import COMMANDS, _build_commands, add_command, run_command
from tests.fixtures.commands import Command

COAST = "evaluate --agents coast --episodes 3"
LINES = ("scenario list --json", "agent list", "doctor", COAST)
RUN = [sys.executable, "-W", "error", "-m", "ethbrake_marl"]


@pytest.mark.parametrize("line", ["--version", "scenario --help", "--show-completion bash", "--install-completion zsh"])
def test_exit_of_typer__is_a_success(line: str, ethbrake: Command, tmp_path: Path, monkeypatch, request) -> None:
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")  # the option then takes a shell
    _build_commands.cache_clear()
    request.addfinalizer(_build_commands.cache_clear)
    monkeypatch.setenv("HOME", str(tmp_path))
    answer = ethbrake(*line.split())
    assert (answer.status, answer.err) == (0, "") and answer.out


@pytest.mark.parametrize(
    ("end", "status", "line"),
    [
        (typer.Exit(3), 3, ""),
        (SystemExit(4), 4, ""),
        (SystemExit("no such car"), 1, "no such car\n"),
        (typer.Abort(), 1, "Aborted!\n"),
        (KeyboardInterrupt(), 130, "interrupted; repeat the command\n"),
        (GeneratorExit("gone"), 2, "ethbrake: error: your own code ended the process: GeneratorExit: gone"),
    ],
    ids=repr,
)
def test_command_of_another_package__ends_with_its_own_status(end, status, line, ethbrake: Command) -> None:
    def finish() -> NoReturn:
        raise end

    add_command("finish", finish)
    try:
        answer = ethbrake("finish")
    finally:
        del COMMANDS.loaded["finish"]
    assert (answer.status, answer.out) == (status, "") and answer.err.startswith(line)
    assert answer.err.count("\n") == bool(line)


@pytest.mark.parametrize("line", ["scenario list", COAST])
def test_output__goes_to_sys_stdout_in_a_notebook(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shell = type("ZMQInteractiveShell", (), {})  # by this name rich knows Jupyter
    monkeypatch.setattr(builtins, "get_ipython", shell, raising=False)
    with redirect_stdout(io.StringIO()) as written:
        assert run_command(line.split()) == 0
    assert len(written.getvalue()) > 300


def ended(line: str, streams: str) -> tuple[int, str, list[str]]:
    """Run a command with warnings as errors and the shell's ``streams``; return its status, stdout, stderr's lines."""
    done = subprocess.run(["sh", "-c", f'exec "$@" {streams}', "sh", *RUN, *shlex.split(line)], capture_output=True)
    return (
        done.returncode,
        done.stdout.decode(),
        [each for each in done.stderr.decode().splitlines() if " of " not in each and not each.startswith("compiling")],
    )


@pytest.mark.parametrize("line", ["--help", *(pytest.param(each, marks=pytest.mark.slow) for each in LINES)])
def test_result_that_cannot_be_written__is_an_error_of_one_line(line: str) -> None:
    assert ended(line, ">&-") == (3, "", ["ethbrake: error: output: not writable"])
    assert ended(line, ">/dev/full") == (3, "", ["ethbrake: error: output: No space left on device"])


@pytest.mark.parametrize("line", ["scenario list", pytest.param(COAST, marks=pytest.mark.slow)])
def test_message_that_cannot_be_written__loses_no_result(line: str) -> None:
    for streams in ("<&- 2>&-", "2>/dev/full"):
        status, out, told = ended(line, streams)
        assert (status, told) == (0, []) and len(out) > 100


@pytest.mark.parametrize("more", [["--json"], ["--per-world", "csv"], ["--report"]])
def test_result__is_printed_although_its_files_cannot_be_written(
    more: list[str], ethbrake: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
    answer = ethbrake(*COAST.split(), *more, "--output", str(tmp_path / "new"))
    assert answer.status == 3 and "coast" in answer.out and [*(tmp_path / "new").iterdir()] == []
    last = answer.err.splitlines()[-1]
    assert last.startswith(f"ethbrake: error: {tmp_path}/new/") and last.endswith(": No space left on device")


def test_result_in_a_file__may_have_no_stdout(tmp_path: Path) -> None:
    status, out, (told,) = ended(f"{COAST} --output {tmp_path}/new", "<&- >&-")
    assert (status, out, told) == (0, "", f"results: {tmp_path}/new/results.json")


@pytest.mark.parametrize("line", ["--help", *(pytest.param(each, marks=pytest.mark.slow) for each in LINES)])
def test_reader_that_goes__is_status_1_without_a_word(line: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([*RUN, *line.split()], stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert done.returncode == 1 and b"rror" not in done.stderr


IMPORTS = """
import runpy, signal, sys

class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == {module!r}:
            print("begun", file=sys.stderr, flush=True)
            {interrupt}

class Lost:
    def __del__(self):  # Python ignores what is raised here
        signal.raise_signal(signal.SIGINT)

signal.signal(signal.SIGINT, signal.{handler})
sys.meta_path.insert(0, Interrupting())
sys.argv, sys.orig_argv = [{program!r}, "--version"], ["python", "-m", "ethbrake_marl", "--version"]
import ethbrake_marl
runpy.run_module("ethbrake_marl.__main__", run_name="__main__")
"""
RAISED, LOST = "signal.raise_signal(signal.SIGINT)", "Lost()"


@pytest.mark.parametrize("program", ["/bin/ethbrake", "-m"])
@pytest.mark.parametrize(
    ("module", "interrupt"), [("difflib", RAISED), ("difflib", LOST), ("rich.console", RAISED), ("rich.console", LOST)]
)
def test_ctrl_c_during_imports__is_one_line_and_status_130(program: str, module: str, interrupt: str) -> None:
    source = IMPORTS.format(program=program, module=module, interrupt=interrupt, handler="default_int_handler")
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "begun\ninterrupted; repeat the command\n")


def test_ctrl_c_during_imports__that_a_background_job_ignores_is_ignored() -> None:
    source = IMPORTS.format(program="ethbrake", module="rich.console", interrupt=RAISED, handler="SIG_IGN")
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "begun\n") and done.stdout.startswith("ethbrake ")


def test_ctrl_c_during_the_import_of_the_package_by_another_program__is_an_exception() -> None:
    source = IMPORTS.format(program="mine.py", module="difflib", interrupt=RAISED, handler="default_int_handler")
    source = source.replace(
        "import ethbrake_marl\n", "try: import ethbrake_marl\nexcept KeyboardInterrupt: sys.exit(7)\n"
    )
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (7, "begun\n")


WAITING = """
import os, sys, time

class Waiting:
    name, knows = "waiting", "own sensors"

    def begin(self, alert, body):
        return None

    def act(self, state, memory, body):
        print("begun", file=sys.stderr, flush=True)
        time.sleep(60)

def make():
    return Waiting()
"""


@pytest.mark.parametrize("jobs", [(), ("--jobs", "2")], ids=["one process", "processes"])
def test_ctrl_c__is_one_line_and_status_130(jobs: Sequence[str], tmp_path: Path) -> None:
    """The terminal sends it to all processes."""
    (tmp_path / "slow.py").write_text(WAITING)
    process = subprocess.Popen(
        [*RUN, "evaluate", "--agents", f"{tmp_path}/slow.py:make", *jobs],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    assert process.stderr is not None
    while "begun" not in process.stderr.readline():
        assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)
    lines = [line for line in process.communicate(timeout=60)[1].splitlines() if "begun" not in line]
    assert (process.returncode, lines) == (130, ["interrupted; nothing was written"])
