"""Compiled kernels are kept by content: found wherever the package lies, and never stale, damaged or another's."""

import importlib
import json
import os
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from pathlib import Path

import numba
import pytest

import ethbrake_marl
from ethbrake_marl import kernel_store
from ethbrake_marl.first_edition.physics import jit
from ethbrake_marl.first_edition.physics.jit import digest_of_sources, keep_kernel, kernel_sources, load_kernel
from ethbrake_marl.kernel_store import cache_folder

needs_compiler = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="compilation is switched off")
PACKAGE = Path(ethbrake_marl.__file__).parent


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    forget()
    yield
    forget()


def forget() -> None:
    for remembered in (cache_folder, digest_of_sources, jit._imports):
        remembered.cache_clear()


# ---------------------------------------------------------------- the folder


@pytest.mark.parametrize(
    ("numba", "xdg", "place"), [("numba", "xdg", "numba"), (None, "xdg", "xdg"), (None, None, ".cache")]
)
def test_cache_folder__is_in_the_named_place(monkeypatch, tmp_path, numba, xdg, place):
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    for name, folder in (("NUMBA_CACHE_DIR", numba), ("XDG_CACHE_HOME", xdg)):
        if folder:
            monkeypatch.setenv(name, str(tmp_path / folder))
    assert cache_folder() == tmp_path / place / "ethbrake_marl" and cache_folder().is_dir()


def test_cache_folder__that_cannot_be_written_is_a_temporary_one_that_goes_at_the_end_of_the_process(
    monkeypatch, tmp_path
):
    (tmp_path / "file").write_text("not a folder", "utf-8")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    at_the_end = []
    monkeypatch.setattr(kernel_store.atexit, "register", lambda *call, **options: at_the_end.append((call, options)))
    folder = cache_folder()
    assert folder.is_dir() and folder.name.startswith("ethbrake_marl-") and tmp_path not in folder.parents
    (folder / "kernel").write_text("machine code", "utf-8")
    [((act, *given), options)] = at_the_end
    act(*given, **options)
    assert not folder.exists()
    act(*given, **options)  # also when somebody else has removed it


# ---------------------------------------------------------------- one file


def test_keep_kernel__is_loaded_again():
    assert load_kernel("one-1") is None
    for content in (b"machine code", b"other code"):
        keep_kernel("one-1", content)
        assert load_kernel("one-1") == content
    assert [file.name for file in cache_folder().iterdir()] == ["one-1"]


@pytest.mark.parametrize("damage", [lambda good: good[:-1] + b"!", lambda good: good[:-1], lambda good: b""])
def test_load_kernel__of_a_damaged_file_or_under_another_name_is_nothing(damage):
    keep_kernel("one-1", b"machine code")
    good = (cache_folder() / "one-1").read_bytes()
    (cache_folder() / "two-2").write_bytes(good)
    (cache_folder() / "one-1").write_bytes(damage(good))
    assert load_kernel("one-1") is load_kernel("two-2") is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="files have no owner here")
@pytest.mark.parametrize(("user", "loaded"), [(0, True), (1000, False)])
def test_load_kernel__of_another_users_file_is_nothing(monkeypatch, user, loaded):
    keep_kernel("one-1", b"machine code")
    stat = os.fstat

    def owned(handle):
        found = list(stat(handle))
        found[4] = user
        return os.stat_result(found)

    monkeypatch.setattr(jit.os, "fstat", owned)
    monkeypatch.setattr(jit.os, "getuid", lambda: 1001)
    assert (load_kernel("one-1") is not None) == loaded


# ---------------------------------------------------------------- what a kernel is made of


@pytest.fixture
def copied(monkeypatch, tmp_path) -> Path:
    package = tmp_path / "copied" / "ethbrake_marl"
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(jit, "_PACKAGE", package)
    return package


def digest_in(package: Path, name: str) -> str:
    forget()
    return digest_of_sources(package / name)


@pytest.mark.parametrize(
    ("kernel", "edited", "moves"),
    [
        ("first_edition/physics/advance.py", "first_edition/physics/advance.py", True),  # its own file
        ("first_edition/physics/advance.py", "first_edition/physics/impact.py", True),  # what it calls
        ("first_edition/shields/members.py", "first_edition/physics/impact.py", True),  # through several files
        ("first_edition/shields/options.py", "errors.py", False),  # a file without kernels or constants
        (
            "first_edition/physics/advance.py",
            "first_edition/shields/options.py",
            False,
        ),  # kernels that it does not call
        ("first_edition/physics/impact.py", "first_edition/physics/advance.py", False),  # its callers
        ("first_edition/physics/advance.py", "first_edition/physics/state.py", False),  # types
    ],
)
def test_digest_of_sources__changes_with_what_its_kernels_are_made_of(copied, monkeypatch, kernel, edited, moves):
    monkeypatch.setattr(jit, "_IMPORTED_S", float("inf"))
    before = digest_in(copied, kernel)
    assert digest_in(copied, kernel) == before and len(before) == 64
    source = copied / edited
    source.write_text(source.read_text("utf-8") + "\n# a change\n", "utf-8")
    assert (digest_in(copied, kernel) != before) == moves


def test_digest_of_sources__is_not_known_of_code_in_no_file_edited_since_or_from_the_future_which_is_told(copied):
    assert digest_of_sources(Path("<stdin>")) == ""
    assert digest_in(copied, "first_edition/physics/advance.py")
    now = time.time()
    for date in ((jit._IMPORTED_S + now) / 2, now + 3600.0):
        os.utime(copied / "first_edition" / "physics" / "impact.py", (date, date))
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            assert digest_in(copied, "first_edition/physics/advance.py") == ""
        expected = [f"{copied}: a file in this folder has a date in the future"] * (date > now)
        assert [str(each.message)[: len(expected[0])] for each in told] == expected


def kernel_files(package: Path) -> list[Path]:
    found = [source for source in sorted(package.rglob("*.py")) if "@compiled" in source.read_text("utf-8")]
    return [source for source in found if source.name != "jit.py"]


@needs_compiler
def test_kernel_sources__hold_every_kernel_that_a_kernel_names():
    checked = 0
    for source in kernel_files(PACKAGE):
        place = source.relative_to(PACKAGE.parent).with_suffix("")
        sources = kernel_sources(source)
        for kernel in vars(importlib.import_module(".".join(place.parts))).values():
            if hasattr(kernel, "py_func") and kernel.py_func.__code__.co_filename == str(source):
                named = [kernel.py_func.__globals__.get(name) for name in kernel.py_func.__code__.co_names]
                called = [each.py_func.__code__.co_filename for each in named if hasattr(each, "py_func")]
                assert {Path(file) for file in called} <= set(sources), f"{source.name}: {kernel}"
                checked += len(called)
    assert checked > 300


# ---------------------------------------------------------------- processes

PROGRAM = """
import os, time
import numpy as np
from pathlib import Path
from numba.core import event
from ethbrake_marl.first_edition.physics.impact import pool
from ethbrake_marl.first_edition.physics.rows import ROW

class Count(event.Listener):
    names = []
    def on_start(self, happened):
        self.names.append(happened.data["dispatcher"].__name__)
    def on_end(self, happened):
        pass

Path(f"ready-{os.getpid()}").touch()
while len(list(Path().glob("ready-*"))) < int(os.environ["AT_ONCE"]):
    time.sleep(0.001)
event.register("numba:compile", Count())
table = np.zeros((ROW.OF_IMPACT, 2))
table[ROW.MASS] = 1.0
table[ROW.SPEED] = 2.0, 4.0
print(pool(table, ROW.SPEED, ROW.SPEED, 0, 1, ROW.GAP), *table[ROW.GAP], *sorted(set(Count.names)))
"""
SAME = "1 3.0 3.0\n"  # two of one mass, the one behind faster: one block, at the mean of both speeds
COMPILED = "1 3.0 3.0 pool\n"

# Each program runs in a process of its own, forked from one that has imported numba, and not this package. A warm one
# has compiled something, too, which takes most of the time. What a program prints goes to a file named by its number.
SERVER = """
import json, os, runpy, sys, tempfile
import numba
if "warm" in sys.argv:
    numba.njit(lambda x: x + 1.0)(1.0)
for line in sys.stdin:
    package, folder, environment = json.loads(line)
    children = []
    for number in range(int(environment["AT_ONCE"])):
        children.append(os.fork())
        if not children[-1]:
            os.chdir(folder)
            os.environ.update(environment)
            numba.config.reload_config()
            sys.path[0], tempfile.tempdir = package, folder
            for stream in (1, 2):
                os.dup2(os.open(f"out-{number}", os.O_CREAT | os.O_WRONLY | os.O_APPEND), stream)
            runpy.run_path("program.py", run_name="__main__")
            sys.exit()
    for child in children:
        os.waitpid(child, 0)
    print(flush=True)
"""


@pytest.fixture(scope="module")
def server() -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    if not hasattr(os, "fork"):
        pytest.skip("processes cannot be forked here")
    options = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    options["env"] = {**os.environ, "NUMBA_DISABLE_JIT": "0"}
    with ExitStack() as running:
        yield cache(lambda way: running.enter_context(subprocess.Popen([sys.executable, "-c", SERVER, way], **options)))


@pytest.fixture
def run(server, tmp_path: Path) -> Callable[..., str]:
    def run(package: Path = PACKAGE, program: str = PROGRAM, *, at_once: int = 1, way: str = "warm") -> str:
        """What a program prints in processes of its own, with its errors, in alphabetical order."""
        for file in (*tmp_path.glob("out-*"), *tmp_path.glob("ready-*")):
            file.unlink()
        (tmp_path / "program.py").write_text(program, "utf-8")
        environment = {name: value for name, value in os.environ.items() if name.startswith("NUMBA_C")}
        request = [str(package.parent), str(tmp_path), environment | {"AT_ONCE": str(at_once)}]
        server(way).stdin.write(json.dumps(request) + "\n")
        server(way).stdin.flush()
        assert server(way).stdout.readline() == "\n"
        return "".join(sorted((tmp_path / f"out-{number}").read_text("utf-8") for number in range(at_once)))

    return run


def test_kernels__of_a_moved_package_are_at_hand_and_one_damaged_or_an_edited_callee_compiles_anew(run, copied):
    assert run(PACKAGE) == COMPILED
    assert run(copied) == SAME
    for file in cache_folder().iterdir():
        file.write_bytes(file.read_bytes()[:-1])
    assert run(copied) == COMPILED
    with (copied / "first_edition" / "physics" / "impact.py").open("a") as file:
        file.write("# a change\n")
    assert run(copied) == COMPILED
    assert run(PACKAGE) == SAME


def test_kernels__that_two_processes_need_at_once_are_compiled_by_one(run):
    assert run(at_once=2) == SAME + COMPILED
    assert not list(cache_folder().glob("*.lock"))
