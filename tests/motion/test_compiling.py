"""Where machine code is stored, and that no state of its folder stops a program or makes it run other code."""

import errno
import importlib.util
import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import partialmethod
from importlib.machinery import SourceFileLoader as Loader
from pathlib import Path
from types import FrameType
from typing import NamedTuple
from unittest.mock import Mock

import numba
import pytest

from ethbrake_marl import kernel_cache
from ethbrake_marl.errors import CacheFault
from ethbrake_marl.motion import compiling
from tests.fixtures.kernels import OWN, give_own_cache, pytest_collection

KERNELS = """\
from ethbrake_marl.motion.compiling import kernel, large

@kernel
def twice(x):
    "A text that -OO leaves out, before a constant."
    return {factor} * x if x is not None else None

@large
def answer(x):
    return twice(x) + 2.0
"""
ASK = """\
import kernels
print(kernels.answer(20.0))
"""


def begin(folder: Path, cache: Path, *options: str, before: str = "") -> subprocess.Popen[str]:
    path = f"{folder}{os.pathsep}{os.getcwd()}"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": path}
    command = [sys.executable, "-B", *options, "-c", before + ASK]  # -B: a change within a second would not be noticed
    return subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_machine_code__is_loaded_without_docstrings(ask: Callable, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    ask()
    monkeypatch.setattr(Loader, "source_to_code", partialmethod(Loader.source_to_code, _optimize=2))
    assert ask() == (42.0, 0, [])


@pytest.mark.slow
def test_python_oo__uses_the_same_machine_code(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS.format(factor=2.0))
    assert begin(tmp_path, tmp_path / "cache").communicate()[0] == "42.0\n"
    assert begin(tmp_path, tmp_path / "cache", "-OO").communicate() == ("42.0\n", "")


@pytest.mark.slow
def test_processes__begin_at_once_with_an_empty_cache(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS.format(factor=2.0))
    begun = [begin(tmp_path, tmp_path / "cache") for _ in range(8)]
    ended = [process.communicate() for process in begun]
    assert [said for said, _ in ended] == ["42.0\n"] * 8
    assert {notice.partition(" ")[0] for _, notice in ended if notice} == {"compiling"}  # all, or what others left
    assert begin(tmp_path, tmp_path / "cache").communicate() == ("42.0\n", "")
    assert {path.suffix for path in (tmp_path / "cache/ethbrake_marl").iterdir()} == {kernel_cache.SUFFIX}


def test_stamp__depends_on_the_kernels_beside_and_on_no_path(tmp_path: Path) -> None:
    def stamp(folder: str = "one") -> str:
        for known in (compiling.stamp_of, compiling._source):
            known.cache_clear()
        return compiling.stamp_of(str(tmp_path / folder / "kernels.py"))

    one, other = tmp_path / "one", tmp_path / "a" / "later" / "other"
    one.mkdir()
    (one / "kernels.py").write_text(KERNELS.format(factor=2.0))
    alone = stamp()
    (one / "beside.py").write_text("no kernels")
    (one / ".#kernels.py").symlink_to("an editor's mark of a file that is open")
    assert stamp() == alone
    (one / "beside.py").write_text(KERNELS.format(factor=5.0))
    assert stamp() != alone
    shutil.copytree(one, other, symlinks=True, copy_function=shutil.copy)  # with other times
    assert stamp("a/later/other") == stamp()
    (other / "beside.py").rename(other / "aside.py")
    assert stamp("a/later/other") != stamp()


class Told(NamedTuple):
    answer: float
    compiled: int  # number of compilations
    warned: list[str]


@pytest.fixture
def ask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Told]:
    """Call a kernel as in a new process."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "kernels.py").write_text(KERNELS.format(factor=2.0))
    place = importlib.util.spec_from_file_location("kernels", tmp_path / "kernels.py")

    def ask() -> Told:
        monkeypatch.setattr(kernel_cache, "_warned", [])
        module = importlib.util.module_from_spec(place)
        place.loader.exec_module(module)
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            answer = module.answer(20.0)
        assert all(each.category is CacheFault for each in warned)
        missed = [sum(each.stats.cache_misses.values()) for each in (module.answer, module.twice)]
        return Told(answer, sum(missed), [str(each.message) for each in warned])

    return ask


def folder_of(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "ethbrake_marl"


def flip(file: Path, place: int) -> None:
    content = bytearray(file.read_bytes())
    content[place] ^= 1
    file.write_bytes(content)


def replace_by_link(file: Path, to: str) -> None:
    file.unlink()
    file.symlink_to(to)


def replace_by_pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def exchange(file: Path) -> None:
    """Put the sound file of another kernel there."""
    shutil.copy(next(path for path in file.parent.iterdir() if path != file), file)


def with_a_class_that_is_gone(file: Path) -> None:
    kernel_cache.save_data(file.name.removesuffix(file.suffix), b"cno_such_module\nClass\n.")


DAMAGE = {
    "empty": lambda file: file.write_bytes(b""),
    "cut": lambda file: file.write_bytes(file.read_bytes()[:-1]),
    "byte of the machine code": lambda file: flip(file, 2000),
    "dangling link": lambda file: replace_by_link(file, "nowhere"),
    "endless": lambda file: replace_by_link(file, "/dev/zero"),
    "pipe": replace_by_pipe,
    "another kernel": exchange,
    "a class that is gone": with_a_class_that_is_gone,
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damaged_file__is_compiled_again_and_replaced(damage: Callable, ask: Callable, tmp_path: Path) -> None:
    assert ask() == (42.0, 2, [])
    [file] = folder_of(tmp_path).glob("answer-*")
    damage(file)
    answer, compiled, warned = ask()
    assert (answer, compiled, len(warned)) == (42.0, 1, 1) and warned[0].startswith(f"{folder_of(tmp_path)}: answer-")
    assert ask() == (42.0, 0, []) and file.is_file() and not file.is_symlink()


def test_cache__with_all_files_damaged_warns_once(ask: Callable, tmp_path: Path) -> None:
    ask()
    files = [*folder_of(tmp_path).iterdir()]
    for file in files:
        file.write_bytes(b"")
    answer, compiled, warned = ask()
    assert (answer, compiled, len(warned)) == (42.0, 2, 1)
    assert ask() == (42.0, 0, []) and {*folder_of(tmp_path).iterdir()} == {*files}


def test_cache__that_is_deleted_is_made_again(ask: Callable, tmp_path: Path) -> None:
    for _ in range(2):
        assert ask() == (42.0, 2, [])
        shutil.rmtree(folder_of(tmp_path).parent)


def fail(monkeypatch: pytest.MonkeyPatch, owner: object, name: str, number: int = errno.ENOSPC) -> None:
    """Let a function of the system fail for the cache: by default because the disk is full."""
    real = getattr(owner, name)

    def failing(*given: object, **more: object) -> object:
        if name == "fsync" or any("ethbrake_marl" in str(each) and "cache" in str(each) for each in given):
            raise OSError(number, os.strerror(number))
        return real(*given, **more)

    monkeypatch.setattr(owner, name, failing)


def has_no_home(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", Mock(side_effect=RuntimeError))


def is_of_somebody_else(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(os.environ["NUMBA_CACHE_DIR"], "ethbrake_marl")
    folder.mkdir(parents=True, exist_ok=True)
    os.chown(folder, 54321, -1)
    monkeypatch.setattr(os, "getuid", lambda: 12345)


def can_be_written(mode: int) -> None:
    folder = Path(os.environ["NUMBA_CACHE_DIR"], "ethbrake_marl")
    folder.mkdir(parents=True, exist_ok=True)
    folder.chmod(mode)


def is_below_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    file = Path(os.environ["NUMBA_CACHE_DIR"]).with_name("file")
    file.touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(file / "cache"))


OBSTACLES = {
    "no space for a byte": (lambda m: fail(m, Path, "write_bytes"), "No space left on device", True),
    "no space at the end": (lambda m: fail(m, os, "fsync", errno.EDQUOT), "Disk quota exceeded", True),
    "no space for a name": (lambda m: fail(m, os, "replace"), "No space left on device", True),
    "only readable": (lambda m: fail(m, Path, "write_bytes", errno.EROFS), "Read-only file system", True),
    "no folder can be made": (lambda m: fail(m, Path, "mkdir", errno.EACCES), "Permission denied", False),
    "below a file": (is_below_a_file, "Not a directory", False),
    "no home": (has_no_home, "no cache folder: HOME and XDG_CACHE_HOME are not set", False),
    "of somebody else": (is_of_somebody_else, "belongs to another user", False),
    "others can write to it": (lambda m: can_be_written(0o707), "others can write to it", False),
    "a group can write to it": (lambda m: can_be_written(0o770), "others can write to it", False),
    "all can write to it, in turns": (lambda m: can_be_written(0o1777), "others can write to it", False),
}


def files_in(folder: Path) -> list[Path]:
    """Files in a folder, apart from Python's own byte code."""
    return [path for path in folder.rglob("*.*") if path.is_file() and path.suffix != ".pyc"]


WRITES = [(True, *case) for case in OBSTACLES.values()] + [(False, *OBSTACLES["no space for a byte"])]


@pytest.mark.parametrize("is_full, prepare, reason, is_readable", WRITES, ids=[*OBSTACLES, "an empty one"])
def test_cache__that_cannot_be_written(
    is_full: bool, prepare: Callable, reason: str, is_readable: bool, ask: Callable, tmp_path: Path, monkeypatch
) -> None:
    """Machine code that may be read is used without a word. Otherwise one warning says what to do."""
    if prepare is is_of_somebody_else and os.getuid() != 0:
        pytest.skip("only root can give files away")
    if is_full:
        ask()
    before = {*files_in(tmp_path)}
    prepare(monkeypatch)
    for _ in range(2):
        answer, compiled, warned = ask()
        is_used = is_full and is_readable
        assert (answer, compiled, len(warned)) == (42.0, 0 if is_used else 2, not is_used)
        assert all(reason in text and kernel_cache.UNSTORED in text for text in warned)
        assert "None" not in "".join(warned) and {*files_in(tmp_path)} <= before


@pytest.mark.parametrize("mask", [0o022, 0o002, 0o000])
def test_cache__is_made_for_its_user_alone_whatever_stands_above(mask: int, ask: Callable, tmp_path: Path) -> None:
    """Also where others can replace the folder: theirs is not read."""
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache").chmod(0o777)
    before = os.umask(mask)
    try:
        assert ask() == (42.0, 2, []) and ask() == (42.0, 0, [])
    finally:
        os.umask(before)
    assert folder_of(tmp_path).stat().st_mode & 0o777 == 0o700
    assert {path.stat().st_mode & 0o777 for path in folder_of(tmp_path).iterdir()} == {0o644}


def give_away(path: Path) -> None:
    os.chown(path, 54321, -1)


FOREIGN = {
    "others can write": lambda path: path.chmod(0o646),
    "a group can write": lambda path: path.chmod(0o664),
    "of somebody else": give_away,
}


@pytest.mark.parametrize("change", FOREIGN.values(), ids=FOREIGN)
def test_file__of_somebody_else_or_that_others_can_write_is_not_run(
    change: Callable, ask: Callable, tmp_path: Path
) -> None:
    if change is give_away and os.getuid() != 0:
        pytest.skip("only root can give files away")
    ask()
    for file in folder_of(tmp_path).iterdir():
        change(file)
    answer, compiled, warned = ask()
    assert (answer, compiled, len(warned)) == (42.0, 2, 1)
    assert "can be written by others, and is compiled again" in warned[0]
    assert ask() == (42.0, 0, [])


def test_file__of_root_is_run(ask: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As from a folder that an administrator has filled."""
    if os.getuid() != 0:
        pytest.skip("only root can try this")
    ask()
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert ask() == (42.0, 0, [])


def test_ctrl_c__that_llvm_loses_ends_the_compilation(
    ask: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python only prints what is raised in a function that LLVM calls; the machine code is then missing."""
    monkeypatch.setattr(sys, "unraisablehook", Mock())

    def interrupt(frame: FrameType, happened: str, argument: object) -> None:
        if frame.f_code.co_name == "_raw_object_cache_notify" and happened == "call":
            sys.setprofile(None)
            raise KeyboardInterrupt

    sys.setprofile(interrupt)
    with pytest.raises(KeyboardInterrupt):
        ask()
    assert sys.unraisablehook.called and not [*folder_of(tmp_path).glob("*")]


def test_kernel__without_a_source_is_not_stored(ask: Callable, tmp_path: Path) -> None:
    ask()
    before = {*folder_of(tmp_path).iterdir()}
    names: dict[str, Callable] = {"__name__": "typed"}
    exec(compile(KERNELS.format(factor=4.0), "<stdin>", "exec"), names)
    assert names["answer"](20.0) == 82.0 and {*folder_of(tmp_path).iterdir()} == before


def test_kernels__of_one_text_with_other_values_are_told_apart(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    def times(factor: float) -> Callable[[float], float]:
        return compiling.large(lambda x: factor * x)

    for _ in range(2):
        assert [times(factor)(10.0) for factor in (2.0, 3.0)] == [20.0, 30.0]
    assert len([*(tmp_path / "ethbrake_marl").iterdir()]) == 2


def test_kernel__has_machine_code_for_each_type_of_its_argument(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    def half(x: float) -> float:
        return x // 2

    for _ in range(2):
        answers = [compiling.large(half)(x) for x in (7, 7.5)]
        assert answers == [3, 3.0] and [type(each) for each in answers] == [int, float]


def test_kernel__of_another_kernel_as_an_argument_is_not_stored(tmp_path: Path, monkeypatch) -> None:
    """The name of such a type is an address in this process, at which the next one may have another kernel."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))

    def called(one: Callable[[float], float], x: float) -> float:
        return one(x)

    assert compiling.large(called)(compiling.large(abs_of), -3.0) == 3.0
    assert [path.name.partition("-")[0] for path in (tmp_path / "ethbrake_marl").iterdir()] == ["abs_of"]


def abs_of(x: float) -> float:
    return max(x, -x)


# ---------------------------------------------------------------- the suite's own cache


def test_suite__has_a_cache_of_its_own() -> None:
    assert kernel_cache.cache_folder().parent.name == OWN


def test_suite__begins_with_the_sound_files_of_the_users_cache(ask: Callable, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(os, "environ", os.environ.copy())
    ask()
    user = folder_of(tmp_path)
    sound, damaged = sorted(user.iterdir())
    damaged.write_bytes(b"")
    before = {path: path.stat() for path in user.iterdir()}
    for _ in range(2):
        give_own_cache()
        assert [path.name for path in kernel_cache.cache_folder().iterdir()] == [sound.name]
    assert kernel_cache.cache_folder().parent == user.parent / OWN
    assert {path: path.stat()[:-3] for path in user.iterdir()} == {path: old[:-3] for path, old in before.items()}


def test_files_of_tests__call_no_kernel_when_they_are_collected() -> None:
    halves, collection = numba.njit(lambda x: x / 2.0), pytest_collection()
    next(collection)
    with pytest.raises(AssertionError, match="is called at import"):
        halves(6.0)
    with pytest.raises(StopIteration):
        next(collection)
    assert halves(6.0) == 3.0


@pytest.mark.slow
def test_processes_of_xdist__compile_a_kernel_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "kernels.py").write_text(KERNELS.format(factor=2.0))
    monkeypatch.setenv("PYTEST_XDIST_WORKER", "gw0")
    counted = (
        "import atexit, tests.fixtures.kernels\natexit.register(lambda: print(kernels.answer.stats.cache_misses))\n"
    )
    begun = [begin(tmp_path, tmp_path / "cache", before=counted) for _ in range(4)]
    compiled = [process.communicate()[0].startswith("42.0\nCounter({(") for process in begun]
    assert sorted(compiled) == [False, False, False, True]
