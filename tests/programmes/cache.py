"""The cache of compiled code: damage, full disks, folders that cannot be used, eight processes, a second clone.

Each case runs ``reset`` and ``ethbrake evaluate`` in new processes: their results must be those of a sound cache, with
one warning each if something is wrong, and without one the next time. Only root can mount the small disks in memory.
"""

import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple

from ethbrake_marl.kernel_store import SUFFIX
from tests.programmes import ROOT, Cases, Given, Told
from tests.programmes.bugs import copy_of_the_repository

DRAWN = 20
RESET = "import ethbrake_marl as eb; env = eb.EthBrakeEnv(); print(env.reset(seed=1)[0].tobytes().hex())"
COUNT = f"""
from numba.core import event
from ethbrake_marl.motion import compiling
with event.install_recorder("numba:compile") as compiled:
    {RESET}
print(len(compiled.buffer))
"""
PROGRAMS = {
    "reset": ("-c", RESET),
    "evaluate": ("-m", "ethbrake_marl", "evaluate", "--agents", "full_brake,e_v2x_bm", "--episodes", "20"),
}


class Ended(NamedTuple):
    status: int
    said: str
    warnings: int
    errors: str  # the last line of stderr


def begin(program: tuple[str, ...], cache: Path, place: Path = ROOT, **variables: str) -> subprocess.Popen[str]:
    given = {name: text for name, text in os.environ.items() if name != "PYTHONWARNINGS"}
    given |= {"PYTHONPATH": str(place), "NUMBA_CACHE_DIR": str(cache), "OMP_NUM_THREADS": "1", **variables}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *program], cwd=place, env=given, **pipes)


def end(begun: subprocess.Popen[str]) -> Ended:
    said, errors = begun.communicate()
    warned = [line for line in errors.splitlines() if "CacheFault: " in line or line.startswith("warning: ")]
    return Ended(begun.returncode, said, len(warned), errors.strip().rpartition("\n")[2])


def run(name: str, cache: Path) -> Ended:
    return end(begin(PROGRAMS[name], cache))


# ---------------------------------------------------------------- damage


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[random.randrange(len(content))] ^= 1 << random.randrange(8)
    file.write_bytes(content)


def replace_by_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()
    (file / "inside").touch()


def replace_by_link(file: Path) -> None:
    file.unlink()
    file.symlink_to("nowhere")


def exchange(file: Path) -> None:
    shutil.copy(next(path for path in sorted(file.parent.iterdir()) if path != file), file)


DAMAGE: dict[str, Callable[[Path], object]] = {
    "empty": lambda file: file.write_bytes(b""),
    "cut": lambda file: os.truncate(file, random.randrange(1, file.stat().st_size)),
    "with a flipped bit": flip,
    "replaced by folders": replace_by_folder,
    "replaced by dangling links": replace_by_link,
    "replaced by those of other kernels": exchange,
}


def damaged(damage: Callable[[Path], object], whole: bool, sound: Path, expected: dict[str, str]) -> Told:
    with tempfile.TemporaryDirectory(prefix="ethbrake-cache-") as folder:
        told = []
        for name in PROGRAMS:
            cache = Path(folder) / name
            shutil.copytree(sound, cache)
            files = sorted((cache / "ethbrake_marl").glob(f"*{SUFFIX}"))
            for file in files if whole else random.sample(files, DRAWN):
                damage(file)
            first, second = run(name, cache), run(name, cache)
            # a program may need none of the drawn files
            told += problems(name, first, expected, 1 if whole else 0, 1) + problems(name, second, expected, 0, 0)
    return Told(not told, "; ".join(told))


def problems(name: str, ended: Ended, expected: dict[str, str], least: int, most: int) -> list[str]:
    if (ended.status, ended.said) == (0, expected[name]) and least <= ended.warnings <= most:
        return []
    return [f"{name}: status {ended.status}, {ended.warnings} warnings, {ended.errors[:200]}"]


# ---------------------------------------------------------------- the folder


@contextmanager
def disk(folder: Path, *options: str) -> Iterator[bool]:
    """A file system in memory at a folder; False if this user cannot mount one."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", *options, "tmpfs", str(folder)]
    mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)


def full(options: str, expected: dict[str, str]) -> Told:
    with tempfile.TemporaryDirectory(prefix="ethbrake-cache-") as folder:
        told = []
        for name in PROGRAMS:
            cache = Path(folder) / name
            with disk(cache, "-o", options) as mounted:
                if not mounted:
                    return Told(None, "only root can mount a file system")
                told += problems(name, run(name, cache), expected, 1, 1)
                told += [f"{path}: is left" for path in cache.rglob("*.partial")]
    return Told(not told, "; ".join(told))


def only_readable(content: Path | None, expected: dict[str, str]) -> Told:
    with tempfile.TemporaryDirectory(prefix="ethbrake-cache-") as folder, disk(Path(folder) / "cache") as mounted:
        if not mounted:
            return Told(None, "only root can mount a file system")
        cache = Path(folder) / "cache"
        if content:
            shutil.copytree(content, cache, dirs_exist_ok=True)
        subprocess.run(["mount", "-o", "remount,ro", str(cache)], check=True)
        count = int(content is None)
        told = [each for name in PROGRAMS for each in problems(name, run(name, cache), expected, count, count)]
    return Told(not told, "; ".join(told))


def deleted_while_running(expected: dict[str, str]) -> Told:
    with tempfile.TemporaryDirectory(prefix="ethbrake-cache-") as folder:
        cache = Path(folder) / "cache"
        begun = begin(PROGRAMS["reset"], cache)
        while begun.poll() is None:
            shutil.rmtree(cache, ignore_errors=True)
            with suppress(subprocess.TimeoutExpired):
                begun.wait(0.2)
        told = problems("reset", end(begun), expected, 0, 1)
    return Told(not told, "; ".join(told))


def at_once(number: int, expected: dict[str, str]) -> Told:
    with tempfile.TemporaryDirectory(prefix="ethbrake-cache-") as folder:
        begun = [begin(PROGRAMS["reset"], Path(folder)) for _ in range(number)]
        told = [each for process in begun for each in problems("reset", end(process), expected, 0, 0)]
        told += problems("reset", run("reset", Path(folder)), expected, 0, 0)
    return Told(not told, "; ".join(told))


def cloned(sound: Path, **variables: str) -> Told:
    """Count the compilations of a clone in another folder, with other times."""
    with tempfile.TemporaryDirectory(prefix="ethbrake-cache-") as folder:
        copy = copy_of_the_repository(Path(folder) / "second" / "clone")
        for path in (copy / "ethbrake_marl").rglob("*.py"):
            path.touch()
        ended = end(begin(("-c", COUNT), sound, copy, **variables))
    lines = ended.said.split()
    return Told(ended.status == 0 and lines[-1:] == ["0"], f"{lines[-1] if lines else ended.errors} compilations")


def cases(given: Given) -> Cases:
    random.seed(1)
    with tempfile.TemporaryDirectory(prefix="ethbrake-cache-") as folder:
        sound = Path(folder) / "sound"
        expected = {} if given.list else {name: run(name, sound).said for name in PROGRAMS}
        for name, damage in DAMAGE.items():
            for whole in (False, True):
                which = "all files" if whole else f"{DRAWN} files"
                yield f"{which} {name}", partial(damaged, damage, whole, sound, expected)
        for options in ("size=4k", "size=300k", "size=1m", "nr_inodes=20"):
            yield f"a disk that is full: {options}", partial(full, options, expected)
        yield "an empty folder that can only be read", partial(only_readable, None, expected)
        yield "a full folder that can only be read", partial(only_readable, sound, expected)
        yield "a folder that is deleted again and again", partial(deleted_while_running, expected)
        yield "eight processes begin with an empty cache", partial(at_once, 8, expected)
        yield "a second clone compiles nothing", partial(cloned, sound)
        yield "nor with python -OO", partial(cloned, sound, PYTHONOPTIMIZE="2")
