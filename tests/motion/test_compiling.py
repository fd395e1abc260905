"""Where machine code is kept, and what happens where it cannot be. Each case compiles one small kernel in a process."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

KERNELS = """\
from ethbrake_marl.motion.compiling import folder_of, kernel, large

@kernel
def twice(x):
    return {factor} * x

@large
def answer(x):
    return twice(x) + 2.0
"""
ASK = "import kernels; print(kernels.answer(20.0), kernels.folder_of(kernels.__file__), {state})"
HITS = "sum(kernels.answer.stats.cache_hits.values())"
ROOT = Path(__file__).parents[2]


class Place:
    """A folder with a module of kernels, and the environment of the processes that use it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.cache = folder, folder / "cache"
        self.cache.mkdir()
        self.environment = {
            **{name: value for name, value in os.environ.items() if name not in ("HOME", "XDG_CACHE_HOME")},
            "NUMBA_CACHE_DIR": str(self.cache), "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "HOME": str(folder),
            "TMPDIR": str(folder),
        }  # fmt: skip
        self.write(2.0)

    def write(self, factor: float) -> None:
        (self.folder / "kernels.py").write_text(KERNELS.format(factor=factor))

    def begin(self, first: str = "", **changes: str | None) -> subprocess.Popen[str]:
        environment = {name: value for name, value in {**self.environment, **changes}.items() if value is not None}
        return subprocess.Popen(
            [sys.executable, "-c", first + ASK.format(state=HITS)],
            env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    def ask(self, first: str = "", **changes: str | None) -> tuple[float, Path, bool, str]:
        """Return the kernel's answer, the folder of its machine code, whether it was loaded, and what was warned."""
        return told(self.begin(first, **changes))


def told(process: subprocess.Popen[str]) -> tuple[float, Path, bool, str]:
    out, error = process.communicate(timeout=300)
    assert process.returncode == 0, error
    answer, folder, hits = out.split()
    return float(answer), Path(folder), hits != "0", error


@pytest.fixture
def place(tmp_path: Path) -> Place:
    return Place(tmp_path)


def test_machine_code__is_loaded_until_a_source_changes(place: Place) -> None:
    answer, folder, loaded, warned = place.ask()
    assert (answer, loaded, warned) == (42.0, False, "")
    assert folder.is_relative_to(place.cache)
    assert place.ask() == (42.0, folder, True, "")
    place.write(3.0)  # also what another kernel contains
    answer, other, loaded, warned = place.ask()
    assert (answer, loaded, warned) == (62.0, False, "")
    assert other != folder
    (place.folder / "beside.py").write_text(KERNELS.format(factor=5.0))  # a kernel that it may call
    assert place.ask()[1] != other


def test_two_processes__may_compile_at_once(place: Place) -> None:
    together = [place.begin() for _ in range(3)]
    assert {told(each)[0] for each in together} == {42.0}
    assert place.ask()[::2] == (42.0, True)


@pytest.mark.parametrize("of_home", [{"HOME": None}, {"HOME": "/nowhere"}])
def test_user_without_a_home__compiles(place: Place, of_home: dict[str, str | None]) -> None:
    answer, _, loaded, _ = place.ask(NUMBA_CACHE_DIR=None, **of_home)
    assert (answer, loaded) == (42.0, False)


READ_ONLY = "import ethbrake_marl.motion.compiling as c; c._has_room = lambda folder: False; "  # as for a plain user


def test_machine_code_that_may_only_be_read__is_used_without_a_word(place: Place) -> None:
    folder = place.ask()[1]
    answer, copied, loaded, warned = place.ask(READ_ONLY)
    assert (answer, loaded, warned) == (42.0, True, "")
    assert copied.name == folder.name
    assert not copied.is_relative_to(place.cache)
    assert not copied.exists()  # deleted with the process


def test_cache_that_cannot_be_written__warns_once(place: Place) -> None:
    answer, _, loaded, warned = place.ask(READ_ONLY)
    assert (answer, loaded) == (42.0, False)
    assert warned.count("cannot be written") == 1
    assert "NUMBA_CACHE_DIR" in warned


def test_full_disk__warns_once(place: Place) -> None:
    full = "import shutil, types; shutil.disk_usage = lambda folder: types.SimpleNamespace(free=0); "
    answer, _, _, warned = place.ask(full)
    assert answer == 42.0
    assert warned.count("its disk is full") == 1


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can give files away")
def test_machine_code_of_somebody_else__is_not_run(place: Place) -> None:
    folder = place.ask()[1]
    os.chown(folder, 12345, -1)
    answer, other, loaded, warned = place.ask()
    assert (answer, loaded) == (42.0, False)
    assert other != folder
    assert warned.count("cannot be written") == 1
    shutil.rmtree(folder)
