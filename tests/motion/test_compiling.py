"""Where machine code is kept, and what happens where it cannot be."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType, SimpleNamespace
from unittest.mock import Mock

import numba
import pytest
from numba.core import event

from ethbrake_marl import kernel_store
from ethbrake_marl.motion import compiling
from ethbrake_marl.stopping import stop_on_signal

KERNELS = """\
from ethbrake_marl.motion.compiling import folder_of, kernel, large

@kernel
def twice(x):
    return {factor} * x

@large
def answer(x):
    return twice(x) + 2.0
"""
ASK = """\
import sys, ethbrake_marl.kernel_store as store
store.on_first_compilation(lambda folder, is_empty: print("compiles", is_empty))
import kernels
print(kernels.answer(20.0), kernels.folder_of(kernels.__file__))
"""


def test_machine_code__is_loaded_until_a_source_changes(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": f"{tmp_path}{os.pathsep}{os.getcwd()}"}

    def ask(factor: float) -> list[str]:
        (tmp_path / "kernels.py").write_text(KERNELS.format(factor=factor))
        command = [sys.executable, "-B", "-c", ASK]  # byte code is not made again for a change within a second
        done = subprocess.run(command, env=environment, text=True, capture_output=True, check=True)
        assert done.stderr == ""
        return done.stdout.split()

    *said, answer, folder = ask(2.0)
    assert (said, answer) == (["compiles", "True"], "42.0") and Path(folder).is_relative_to(cache)
    assert ask(2.0) == ["42.0", folder]
    *said, answer, other = ask(3.0)  # what another kernel contains
    assert (said, answer) == (["compiles", "False"], "62.0") and other != folder


def test_folder__depends_on_the_kernels_beside(tmp_path: Path) -> None:
    file, folder_of = tmp_path / "kernels.py", compiling.folder_of.__wrapped__
    file.write_text(KERNELS.format(factor=2.0))
    folder = folder_of(str(file))
    (tmp_path / "beside.py").write_text("no kernels")
    assert folder_of(str(file)) == folder
    (tmp_path / "beside.py").write_text(KERNELS.format(factor=5.0))
    assert folder_of(str(file)) != folder


@pytest.fixture
def asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], tuple[Path, list[str]]]:
    """Ask for the folder of a file's machine code, as in a new process; also return what was warned."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(compiling, "_warn_once", compiling._warn_once.__wrapped__)

    def ask() -> tuple[Path, list[str]]:
        folder = kernel_store.cache_folder.__wrapped__()
        monkeypatch.setattr(compiling, "cache_folder", lambda: folder)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            return compiling.folder_of.__wrapped__(__file__), [str(each.message) for each in warned]

    return ask


def cannot_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", Mock(side_effect=PermissionError))


def is_full(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=10_000_000))


def is_of_somebody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    os.chown(os.environ["NUMBA_CACHE_DIR"] + "/ethbrake_marl", 54321, -1)


def has_no_home(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", Mock(side_effect=RuntimeError))


@pytest.mark.parametrize("kept", [False, True])
@pytest.mark.parametrize("what", [cannot_be_written, is_full, is_of_somebody_else, has_no_home])
def test_cache__that_cannot_be_used(what: Callable, kept: bool, asked: Callable, tmp_path: Path, monkeypatch) -> None:
    """Machine code that may be read is used without a word. Otherwise one warning says what to do."""
    folder, warned = asked()
    assert folder.is_relative_to(tmp_path / "cache") and warned == []
    if kept:
        folder.mkdir()
        (folder / "kernel.nbi").touch()
    if what is is_of_somebody_else and os.getuid() != 0:
        pytest.skip("only root can give files away")
    what(monkeypatch)
    temporary, warned = asked()
    assert temporary.name == folder.name and kernel_store.is_temporary(temporary.parent)
    is_used = kept and what in (cannot_be_written, is_full)
    assert (temporary / "kernel.nbi").exists() == is_used
    assert len(warned) == (not is_used) and all("set NUMBA_CACHE_DIR to a folder" in text for text in warned)
    shutil.rmtree(temporary.parent)


def test_ctrl_c_while_llvm_calls_python__is_no_lost_exception() -> None:
    """LLVM hands a finished function over by a call of Python, whose exceptions vanish."""
    thirds = numba.njit(lambda x: x / 3.0)
    calls = []

    def interrupt(frame: FrameType, happened: str, argument: object) -> None:
        if frame.f_code.co_name == "_raw_object_cache_notify" and happened == "call" and not calls:
            calls.append(frame)
            signal.raise_signal(signal.SIGINT)

    sys.setprofile(interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            thirds(6.0)
    finally:
        sys.setprofile(None)
    assert calls and thirds(6.0) == 2.0
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_while_llvm_calls_python__reaches_a_handler_that_does_not_raise() -> None:
    with stop_on_signal() as stop:
        event.start_event("numba:compiler_lock")
        signal.raise_signal(signal.SIGINT)
        assert not stop()
        event.end_event("numba:compiler_lock")
        assert stop()
