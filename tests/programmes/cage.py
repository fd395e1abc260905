"""Hostile cases, and the cage in which each case runs: a case can neither hang, grow, execute nor write unnoticed.

Each case runs in its own process and folder, which is deleted afterwards. A Python audit hook prevents writing anywhere
else. The content of the folder and of its surroundings is compared before and after.
"""

import collections
import contextlib
import dataclasses
import errno
import hashlib
import inspect
import json
import os
import random
import resource
import shutil
import signal
import stat
import sys
import traceback
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ethbrake_marl.cli.app import app, run_command
from ethbrake_marl.cli.command import Out
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.extensions.search.best_harm import search_list
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.tables import read_worlds
from tests.learning.tiny import OUTSIDE, PRECIOUS

CPU_LIMIT_S = 10  # processor time of a case
WALL_LIMIT_S = 90.0  # wall-clock time of a case, on a busy machine
MEMORY_LIMIT_BYTES = 2 << 30  # in addition to the memory of the loaded libraries
LINE_LIMIT = 2_000  # characters per line
REFUSED = 2
BROKEN = 99  # exit status of a traceback

Build = Callable[[Path], object]
INSIDE = "inside"  # subfolder of a case's folder in which the command runs
HERE = "/@here"  # in a command or variable it stands for the absolute path of that subfolder

# Texts that try to move the cursor, to hide or reverse the following text, or to break a line.
NASTY = (
    "\x1b[2J\x1b[1;1H", "\x1b]0;owned\x07", "\x1b[31mred", "\r\nethbrake: OK", "\u202egnp.exe", "\u2066\u2069",
    "\u200b\u200d", "\u2028line", "\u2029", "\x85", "\x9b31m", "\x08\x08\x08", "\x7f", "\ufeff",
    "\U000e0001\U000e0041", "\xa0", "a\tb", "\u061c",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One attempt. ``build`` fills a folder, which becomes the current folder of ``command``."""

    category: str
    command: tuple[str, ...]
    build: Build
    certain: bool = True  # True: it must be refused; False: it may be valid
    reader: Callable[[], object] | None = None  # reads the file in Python; must raise an ``EthBrakeError``
    environment: Mapping[str, str] = field(default_factory=dict)
    may_change: tuple[str, ...] = ()  # files in the folder that a command may write if it is not refused


Generator = Callable[[random.Random], Iterator[Case]]


def write(path: Path, content: bytes | str) -> None:
    """Write a file, and create the folders above it. Text is written in UTF-8, with lone surrogates."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8", "surrogatepass"))


def damaged(rng: random.Random, data: bytes) -> bytes:
    """Return data as after damage by a disk or network: bits, bytes or blocks are changed, lost, repeated or zero."""
    at, length = rng.randrange(len(data)), rng.choice((1, 2, 16, 512))
    before, lost, after = data[:at], data[at : at + length], data[at + length :]
    changed = bytes([data[at] ^ 1 << rng.randrange(8)])
    middle = rng.choice((changed + lost[1:], b"", bytes(len(lost)), rng.randbytes(length) + lost, data[:length] + lost))
    return before + middle + (after if rng.random() < 0.8 else b"")


@dataclass(frozen=True)
class Verdict:
    """How a case ended; ``faults`` are the broken rules."""

    status: int
    cpu_s: float
    longest: int  # characters of the longest line
    faults: tuple[str, ...]


def judge(case: Case, folder: Path) -> Verdict:
    """Build the case in the new ``folder``, run it, and check the rules."""
    inside, beside = folder / INSIDE, frozenset(os.listdir(folder.parent))
    write(folder / OUTSIDE / PRECIOUS, "years of work")
    write(folder / OUTSIDE / "step_000000000001" / "kept.txt", "years of work")
    inside.mkdir()
    case.build(inside)
    before = _content(folder)
    streams = [folder.with_suffix(suffix) for suffix in (".out", ".err", ".seen")]
    child = _forked(lambda: _run(case, inside, streams))
    status, cpu_s = _wait(child)
    out, err, seen = (path.read_bytes().decode("utf-8", "backslashreplace") for path in streams)
    after, allowed = _content(folder), tuple(f"{INSIDE}/{name}" for name in case.may_change)
    names = [name for name in sorted(before | after) if before.get(name) != after.get(name)]
    changed = [f"changed: {name}" for name in names if not (allowed and name.startswith(allowed))]
    shutil.rmtree(folder, ignore_errors=True)
    for path in streams:
        path.unlink()
    left = [f"left a file outside its folder: {name}" for name in sorted(frozenset(os.listdir(folder.parent)) - beside)]
    deeds = [*map(json.loads, seen.splitlines()), *changed][:5]
    faults = (*_faults_of_end(case, status, out, err), *deeds, *left)
    return Verdict(status, cpu_s, max(map(len, (out + err).splitlines() or [""])), faults)


def _forked(work: Callable[[], int]) -> int:
    """Start a child process that calls ``work`` and exits with its result. Return the process id."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        return child
    status = BROKEN
    try:
        status = work()
    except BaseException:
        traceback.print_exc()
    with contextlib.suppress(BaseException):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


def read_states(file: Path) -> None:
    """Command for the cases: evaluate an agent on a table of initial states."""
    with Out():
        paper = load_scenario("paper-random")
        evaluate(read_worlds(paper, file), "coast", scenario=paper)


def read_table(file: Path) -> None:
    """Command for the cases: continue a search from a table of best known harm."""
    with Out():
        paper = load_scenario("paper-random")
        search_list(paper, paper.sample(3, 7), budget=1, threads=1, known=BestHarmTable.load(file))


def _run(case: Case, inside: Path, streams: list[Path]) -> int:
    for number, path in zip((1, 2), streams, strict=False):
        os.dup2(os.open(path, os.O_CREAT | os.O_WRONLY), number)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    seen = os.open(streams[2], os.O_CREAT | os.O_WRONLY | os.O_APPEND)
    os.chdir(inside)
    os.environ.update({name: value.replace(HERE, f"{inside}") for name, value in case.environment.items()})
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    for what, most in (("AS", size + MEMORY_LIMIT_BYTES), ("CPU", CPU_LIMIT_S), ("CORE", 0)):
        resource.setrlimit(getattr(resource, f"RLIMIT_{what}"), (most, most))
    own = os.path.realpath(inside) + os.sep
    sys.addaudithook(lambda event, arguments: _watch(event, arguments, seen))
    sys.addaudithook(lambda event, arguments: _keep_inside(event, arguments, own, seen))
    if case.reader is not None:
        _read(case, seen)
    app.command("read-states")(read_states)
    app.command("read-table")(read_table)
    return run_command([word.replace(HERE, f"{inside}") for word in case.command])


def _read(case: Case, seen: int) -> None:
    """Read the file in Python as well, and report wrong exceptions to the judge."""
    try:
        case.reader()
    except EthBrakeError as error:
        text = str(error)
        if not text.isprintable() or len(text) > LINE_LIMIT:
            _tell(seen, f"message of {type(error).__name__}: {text!r:.200}")
    except MemoryError:
        _tell(seen, "python: MemoryError")
    except Exception as error:
        _tell(seen, f"python: {type(error).__name__}: {error!r:.200}")
    else:
        if case.certain:
            _tell(seen, "python: no error")


def _wait(child: int) -> tuple[int, float]:
    """Return exit status (negative: signal) and processor time of a child. Kill it after the time limit."""
    before = signal.signal(signal.SIGALRM, lambda *_: os.kill(child, signal.SIGKILL))
    signal.setitimer(signal.ITIMER_REAL, WALL_LIMIT_S)
    try:
        _, status, used = os.wait4(child, 0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime


def _faults_of_end(case: Case, status: int, out: str, err: str) -> Iterator[str]:
    errors = [line for line in err.split("\n") if line.startswith("ethbrake: error: ")]
    if status not in (0, REFUSED):
        yield f"exit status {status}: {err.strip().splitlines()[-1:]}"[:300]
    if status == 0 and case.certain:
        yield "the file was not refused"
    if status == REFUSED and (len(errors) != 1 or not err.endswith(errors[-1] + "\n")):
        yield f"not one line of error: {err!r:.300}"
    if status == REFUSED and case.certain and "not enough memory" in err:
        yield "the file was unpacked before it was refused"
    if "Traceback" in err + out:
        yield "traceback"
    kept = "\t" if status else "\t\N{NO-BREAK SPACE}"  # results have no-break spaces between number and unit
    asked = {"FORCE_COLOR", "TTY_COMPATIBLE"} & case.environment.keys()  # colours
    for line in (out + err).split("\n"):
        if not line.translate({ord(character): " " for character in kept}).isprintable() and (status or not asked):
            yield f"a line has control characters: {line!r:.200}"
        if status == REFUSED and len(line) > LINE_LIMIT:
            yield f"a line of {len(line)} characters"


def _content(folder: Path) -> dict[str, str]:
    """Return the content of a folder: name -> kind, and for plain files size and hash."""
    found = {}
    for path in sorted(folder.rglob("*")):
        about = path.lstat()
        text = f"{stat.S_IFMT(about.st_mode)}"
        if stat.S_ISREG(about.st_mode):
            digest = hashlib.sha256(path.read_bytes()).hexdigest() if about.st_size < 1 << 24 else ""
            text += f" {about.st_size} {digest}"
        elif stat.S_ISLNK(about.st_mode):
            text += f" {os.readlink(path)!r}"
        found[os.fspath(path.relative_to(folder))] = text
    return found


# ---------------------------------------------------------------- the audit hooks

_EXECUTING = (
    "os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.forkpty", "pty.spawn", "subprocess.Popen",
    "pickle.find_class", "marshal.load", "marshal.loads", "ctypes.dlopen", "code.__new__", "function.__new__",
    "socket.connect", "socket.bind", "webbrowser.open", "builtins.input",
)  # fmt: skip
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
# Event -> indices of its arguments: (changed path, folder of a relative path or None).
_CHANGING: dict[str, tuple[tuple[int, int | None], ...]] = {
    "os.mkdir": ((0, 2),), "os.remove": ((0, 1),), "os.rmdir": ((0, 1),), "os.truncate": ((0, None),),
    "os.chmod": ((0, 2),), "os.chown": ((0, 3),), "os.utime": ((0, 3),), "os.link": ((1, 3),), "os.symlink": ((1, 2),),
    "os.rename": ((0, 2), (1, 3)), "shutil.rmtree": ((0, 1),),
}  # fmt: skip
_READ_ANNOTATIONS = {inspect.__file__, typing.__file__, dataclasses.__file__, collections.__file__}


def _watch(event: str, arguments: tuple[Any, ...], seen: int) -> None:
    """Report executed code, except code and annotations of modules that are imported late."""
    if event not in _EXECUTING and event != "exec":
        return  # looking up the caller below is an event, too
    caller = sys._getframe(2)
    file = caller.f_code.co_filename
    if event.startswith("marshal.") and file.startswith("<frozen importlib"):
        return
    late = os.path.isfile(getattr(arguments[0], "co_filename", "")) or file in _READ_ANNOTATIONS
    if event != "exec" or not late:
        _tell(seen, f"executed: {event} {arguments!r:.60} by {file}:{caller.f_lineno}")


def _keep_inside(event: str, arguments: tuple[Any, ...], own: str, seen: int) -> None:
    """Refuse and report every change outside the case's folder, so that an attack cannot harm the machine."""
    if event == "open":
        name, flags = arguments[0], arguments[2]
        writes = isinstance(flags, int) and flags & _WRITING and not isinstance(name, int)
        follow = _entry if writes and flags & os.O_NOFOLLOW else lambda path, _: os.path.realpath(path)
        places = [follow(os.fsdecode(name), None)] if writes else []
    else:
        places = [
            _entry(os.fsdecode(arguments[k]), None if base is None else arguments[base])
            for k, base in _CHANGING.get(event, ())
            if not isinstance(arguments[k], int)
        ]
    for place in places:
        if place != os.devnull and not f"{place}{os.sep}".startswith(own):
            _tell(seen, f"tried to change a file outside: {event} {place}"[:300])
            raise PermissionError(errno.EPERM, "outside the case's folder", place)


def _entry(path: str, base: int | None) -> str:
    """Return the real path, without following a link in its last part.

    ``base``: an open folder to which the path is relative, or -1.
    """
    if isinstance(base, int) and base >= 0:
        path = os.path.join(os.readlink(f"/proc/self/fd/{base}"), path)
    return os.path.join(os.path.realpath(os.path.dirname(path) or "."), os.path.basename(path))


def _tell(seen: int, what: str) -> None:
    """Write one line to the judge."""
    os.write(seen, (json.dumps(what) + "\n").encode())
