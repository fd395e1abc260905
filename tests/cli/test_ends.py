"""How a command ends: its exit status, where its output goes or cannot go, and Ctrl-C."""

import builtins
import errno
import io
import os
import shlex
import signal
import subprocess
import sys
import time
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


AGENT = """
import sys, time
import ethbrake_marl as eb

def make():
    exec('''{code}''')
    return eb.make_agent("coast")
"""


def interrupted(
    begun: str, seconds: float, words: Sequence[str], cache: Path | None = None, **environment: str
) -> tuple[int, list[str]]:
    """Start a program in its own group, and send Ctrl-C to the group; return status and stderr without progress.

    Ctrl-C is sent ``seconds`` after the program has written ``begun`` on stderr, if anything, and has stored a file in
    ``cache``, if it is given.
    """
    process = subprocess.Popen(
        words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, **environment},
    )  # fmt: skip
    assert process.stderr is not None
    while begun and begun not in process.stderr.readline():
        assert process.poll() is None
    time.sleep(seconds)
    while cache is not None and not [*cache.rglob("*.*")]:
        assert process.poll() is None
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    lines = process.communicate(timeout=120)[1].splitlines()
    return process.returncode, [each for each in lines if " of " not in each and not each.startswith("compiling")]


def test_ctrl_c__is_one_line_and_status_130_even_inside_exec(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(AGENT.format(code='print("begun", flush=True); time.sleep(60)'))
    line = [*RUN, "evaluate", "--agents", f"{tmp_path}/slow.py:make"]
    assert interrupted("begun", 0.0, line) == (130, ["interrupted; nothing was written"])


IN_LLVM = """
import signal, sys
import numba

def interrupt(frame, happened, argument):
    if frame.f_code.co_name == "_raw_object_cache_notify" and happened == "call":
        sys.setprofile(None)
        print("begun", flush=True)
        signal.raise_signal(signal.SIGINT)

def make():
    sys.setprofile(interrupt)
    numba.njit(lambda x: x / 3.0)(6.0)
    while True:
        pass
"""


def test_ctrl_c_in_a_function_that_llvm_calls__is_not_lost(tmp_path: Path) -> None:
    """Python ignores exceptions of such a function."""
    (tmp_path / "slow.py").write_text(IN_LLVM)
    line = [*RUN, "evaluate", "--agents", f"{tmp_path}/slow.py:make"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)
    lines = [each for each in done.stderr.splitlines() if " of " not in each and each != "begun"]
    assert (done.returncode, lines) == (130, ["interrupted; nothing was written"])


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "kept"), [(0.0, False), (1.0, False), (3.0, False), (0.0, True)])
def test_ctrl_c_while_kernels_compile__is_one_line_and_keeps_those_that_are_finished(
    seconds: float, kept: bool, tmp_path: Path
) -> None:
    line, cache = [*RUN, "study", "front", "--output", str(tmp_path / "front"), "--episodes", "20"], tmp_path / "cache"
    told = interrupted("compiling", seconds, line, cache if kept else None, NUMBA_CACHE_DIR=str(cache))
    assert told == (130, ["interrupted; nothing was written"])
    assert not kept or [*cache.rglob("*.*")]


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [1.5, 2.0, 2.5, 3.0, 4.0])
def test_ctrl_c_while_processes_start_and_work__is_one_line(seconds: float) -> None:
    line = [*RUN, "evaluate", "--agents", "e_v2x_bm,ppo+step", "--episodes", "10000", "--jobs", "2"]
    status, told = interrupted("", seconds, line)
    assert status == 130 and len(told) == 1 and told[0].startswith("interrupted; "), told
