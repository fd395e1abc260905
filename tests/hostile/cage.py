"""Runs one case in a process of its own, which can neither wait, grow, execute nor write unnoticed, and judges it."""

from __future__ import annotations

import collections
import dataclasses
import errno
import hashlib
import inspect
import json
import os
import resource
import shutil
import signal
import stat
import sys
import traceback
import typing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import EthBrakeError
from tests.hostile.case import INSIDE, OUTSIDE, PRECIOUS, Case, write

CPU_LIMIT_S = 10  # of a case
WALL_LIMIT_S = 90.0  # on a machine that does other things too
MEMORY_LIMIT_BYTES = 2 << 30  # beyond what the libraries take
LINE_LIMIT = 2_000  # characters
REFUSED = 2
BROKEN = 99  # exit status of a traceback

_EXECUTING = (
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.fork",
    "os.forkpty",
    "pty.spawn",
    "subprocess.Popen",
    "pickle.find_class",
    "marshal.load",
    "marshal.loads",
    "ctypes.dlopen",
    "code.__new__",
    "function.__new__",
    "socket.connect",
    "socket.bind",
    "webbrowser.open",
    "builtins.input",
)
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_CHANGING = {  # which of its arguments an event changes
    "os.mkdir": (0,), "os.remove": (0,), "os.rmdir": (0,), "os.truncate": (0,), "os.chmod": (0,), "os.chown": (0,),
    "os.link": (1,), "os.symlink": (1,), "os.rename": (0, 1), "os.utime": (0,), "shutil.rmtree": (0,),
}  # fmt: skip
_BY_FOLDER = {"os.mkdir": 2, "os.remove": 1, "os.rmdir": 1}
_READ_ANNOTATIONS = {inspect.__file__, typing.__file__, dataclasses.__file__, collections.__file__}


@dataclass(frozen=True)
class Verdict:
    """How a case ended; ``faults`` are the rules that it broke."""

    status: int
    cpu_s: float
    longest: int  # characters of the longest line
    message: str
    faults: tuple[str, ...]

    @property
    def refused(self) -> bool:
        """Whether it was refused, rather than found to be in order."""
        return self.status == REFUSED


def judge(case: Case, folder: Path) -> Verdict:
    """Build the case in the new ``folder``, run it, and compare what happened with the rules."""
    inside = folder / INSIDE
    write(folder / OUTSIDE / PRECIOUS, "years of work")
    write(folder / OUTSIDE / "step_000000000001" / "kept.txt", "years of work")
    inside.mkdir(parents=True)
    case.build(inside)
    before = _content(folder)
    streams = [folder.with_suffix(suffix) for suffix in (".out", ".err", ".seen")]
    child = _fork(case, inside, streams)
    beside = None if case.meanwhile is None else _fork_meanwhile(case, inside)
    status, cpu_s = _wait(child)
    if beside is not None:
        os.kill(beside, signal.SIGKILL)
        os.waitpid(beside, 0)
    out, err, seen = (path.read_bytes().decode("utf-8", "backslashreplace") for path in streams)
    changed = [] if case.meanwhile else _changed(before, _content(folder))
    faults = [*_faults_of_end(case, status, out, err), *_faults_of_deeds(case, status, changed, seen)]
    for path in streams:
        path.unlink()
    _remove(folder)
    lines = (out + err).splitlines() or [""]
    return Verdict(status, cpu_s, max(map(len, lines)), err.strip()[-LINE_LIMIT:], tuple(faults))


def _fork(case: Case, inside: Path, streams: list[Path]) -> int:
    """A process that runs the case and exits with its status."""
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        return child
    status = BROKEN
    try:
        for number, path in zip((1, 2), streams, strict=False):
            os.dup2(os.open(path, os.O_CREAT | os.O_WRONLY), number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        seen = os.open(streams[2], os.O_CREAT | os.O_WRONLY | os.O_APPEND)
        os.chdir(inside)
        os.environ.update(case.environment)
        _limit()
        own = os.path.realpath(inside) + os.sep
        sys.addaudithook(lambda event, arguments: _watch(event, arguments, seen))
        sys.addaudithook(lambda event, arguments: _keep_inside(event, arguments, own, seen))
        if case.reader is not None:
            _read(case, seen)
        status = run_command(list(case.command))
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    os._exit(status)


def _limit() -> None:
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    for what, most in (
        (resource.RLIMIT_AS, size + MEMORY_LIMIT_BYTES),
        (resource.RLIMIT_CPU, CPU_LIMIT_S),
        (resource.RLIMIT_CORE, 0),
    ):
        resource.setrlimit(what, (most, most))


def _read(case: Case, seen: int) -> None:
    """The same through Python; what comes back is told to the judge."""
    assert case.reader is not None
    try:
        case.reader()
    except EthBrakeError as error:
        text = str(error)
        if not text.isprintable() or len(text) > LINE_LIMIT:
            _tell(seen, f"message of {type(error).__name__}: {text!r:.200}")
    except MemoryError:
        _tell(seen, "memory: through Python")
    except Exception as error:
        _tell(seen, f"python: {type(error).__name__}: {error!r:.200}")
    else:
        if case.certain:
            _tell(seen, "python: no error")


def _watch(event: str, arguments: tuple[object, ...], seen: int) -> None:
    """Called by the interpreter for everything that touches the world."""
    if event.startswith("marshal.") and sys._getframe(2).f_code.co_filename.startswith("<frozen importlib"):
        return
    if event in _EXECUTING or (event == "exec" and not _of_a_module(arguments[0])):
        _tell(seen, f"executed: {event} {arguments!r:.60} by {_callers()}")


def _keep_inside(event: str, arguments: tuple[Any, ...], own: str, seen: int) -> None:
    """Refuse, and tell, whatever would change something outside the case's own folder, whoever runs the attack."""
    if event == "open":
        writes = isinstance(arguments[2], int) and arguments[2] & _WRITING
        places = [os.path.realpath(os.fsdecode(arguments[0]))] if writes and not isinstance(arguments[0], int) else []
    else:
        given = [arguments[k] for k in _CHANGING.get(event, ()) if not isinstance(arguments[k], int)]
        inside_a_folder = event in _BY_FOLDER and arguments[_BY_FOLDER[event]] != -1  # where its name is relative to
        places = [] if inside_a_folder else [_entry(os.fsdecode(path)) for path in given]
    for place in places:
        if place != os.devnull and not f"{place}{os.sep}".startswith(own):
            if not f"{place}/".startswith(("/dev/", "/proc/")):  # asked for, and impossible for everybody
                _tell(seen, f"would have changed what is outside: {event} {place}"[:300])
            raise PermissionError(errno.EPERM, "outside the case's folder", place)


def _entry(path: str) -> str:
    """A path whose last part is not followed."""
    return os.path.join(os.path.realpath(os.path.dirname(path) or "."), os.path.basename(path))


def _callers() -> str:
    frame = sys._getframe(3)
    names = []
    while frame is not None and len(names) < 7:
        names.append(f"{os.path.basename(frame.f_code.co_filename)}:{frame.f_lineno}")
        frame = frame.f_back
    return " < ".join(names)


def _of_a_module(code: object) -> bool:
    """Whether a code object is of a file that is imported late, or an annotation in such a file."""
    caller = sys._getframe(3).f_code.co_filename
    return os.path.isfile(getattr(code, "co_filename", "")) or caller in _READ_ANNOTATIONS


def _tell(seen: int, what: str) -> None:
    os.write(seen, (json.dumps(what) + "\n").encode())


def _fork_meanwhile(case: Case, inside: Path) -> int:
    child = os.fork()
    if child:
        return child
    try:
        assert case.meanwhile is not None
        while True:
            case.meanwhile(inside)
    finally:
        os._exit(0)


def _wait(child: int) -> tuple[int, float]:
    """Exit status (negative: signal) and processor time; what takes too long is killed."""
    before = signal.signal(signal.SIGALRM, lambda *_: os.kill(child, signal.SIGKILL))
    signal.setitimer(signal.ITIMER_REAL, WALL_LIMIT_S)
    try:
        _, status, used = os.wait4(child, 0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    return os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime


def _faults_of_end(case: Case, status: int, out: str, err: str) -> list[str]:
    faults = []
    errors = [line for line in err.split("\n") if line.startswith("ethbrake: error: ")]
    if status not in (0, REFUSED):
        faults.append(f"exit status {status}: {err.strip().splitlines()[-1:]}"[:300])
    if status == 0 and case.certain:
        faults.append("was not refused")
    if status == REFUSED and (len(errors) != 1 or not err.endswith(errors[-1] + "\n")):
        faults.append(f"not one line of error: {err!r:.300}")
    if status == REFUSED and case.certain and "not enough memory" in err:
        faults.append("was unpacked before it was refused")
    if "Traceback" in err + out:
        faults.append("traceback")
    for line in (out + err).split("\n"):
        if not line.replace("\t", " ").isprintable():
            faults.append(f"a line commands the terminal: {line!r:.200}")
        if status == REFUSED and len(line) > LINE_LIMIT:
            faults.append(f"a line of {len(line)} characters")
    return faults


def _faults_of_deeds(case: Case, status: int, changed: list[str], seen: str) -> list[str]:
    told = [json.loads(line) for line in seen.splitlines()]
    faults = list(told)
    allowed = tuple(f"{INSIDE}/{name}" for name in case.may_change)
    faults += [f"changed: {name}" for name in changed if not (allowed and name.startswith(allowed))]
    return faults[:5]


def _content(folder: Path) -> dict[str, str]:
    """What stands in a folder: for each name its kind, and for a plain file what it holds."""
    found = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        kind = stat.S_IFMT(mode)
        text = f"{kind}"
        if stat.S_ISREG(mode):
            size = path.lstat().st_size
            digest = hashlib.sha256(path.read_bytes()).hexdigest() if size < 1 << 24 else ""
            text += f" {size} {digest}"
        elif stat.S_ISLNK(mode):
            text += f" {os.readlink(path)!r}"
        found[os.fspath(path.relative_to(folder))] = text
    return found


def _changed(before: dict[str, str], after: dict[str, str]) -> list[str]:
    return [name for name in sorted(before.keys() | after.keys()) if before.get(name) != after.get(name)]


def _remove(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
