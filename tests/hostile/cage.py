"""Runs one case in a process of its own, which can neither wait, grow, execute nor write unnoticed, and judges it."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
import signal
import stat
import sys
import traceback
from dataclasses import dataclass, replace
from pathlib import Path

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import EthBrakeError
from tests.hostile.case import INSIDE, OUTSIDE, PRECIOUS, Case, placed, write
from tests.hostile.confined import can_confine, confine
from tests.hostile.surroundings import names_of, strays
from tests.hostile.watch import keep_inside, tell, watch

CPU_LIMIT_S = 10  # of a case
WALL_LIMIT_S = 90.0  # on a machine that does other things too
MEMORY_LIMIT_BYTES = 2 << 30  # beyond what the libraries take
LINE_LIMIT = 2_000  # characters
REFUSED = 2
BROKEN = 99  # exit status of a traceback


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


def judge(case: Case, folder: Path, names: set[str]) -> Verdict:
    """Build the case in the new ``folder``, run it, and compare what happened with the rules.

    A case that names a place outside the folder above is not run. ``names`` gains the names that a case uses.
    """
    inside, own = folder / INSIDE, folder.parent
    case, beside = placed(case, inside), frozenset(os.listdir(own))
    write(folder / OUTSIDE / PRECIOUS, "years of work")
    write(folder / OUTSIDE / "step_000000000001" / "kept.txt", "years of work")
    inside.mkdir(parents=True)
    case.build(inside)
    names.update(names_of(case, inside))
    outside = tuple(f"names a place outside: {place:.200}" for place in strays(case, inside, own))
    verdict = Verdict(BROKEN, 0.0, 0, "not run", outside) if outside else _run(case, folder)
    shutil.rmtree(folder, ignore_errors=True)
    left = sorted(frozenset(os.listdir(own)) - beside)
    return replace(verdict, faults=(*verdict.faults, *(f"left beside its folder: {name}" for name in left)))


def _run(case: Case, folder: Path) -> Verdict:
    inside, before = folder / INSIDE, _content(folder)
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
        if can_confine():
            confine(inside)
        sys.addaudithook(lambda event, arguments: watch(event, arguments, seen))
        sys.addaudithook(lambda event, arguments: keep_inside(event, arguments, own, seen))
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
            tell(seen, f"message of {type(error).__name__}: {text!r:.200}")
    except MemoryError:
        tell(seen, "memory: through Python")
    except Exception as error:
        tell(seen, f"python: {type(error).__name__}: {error!r:.200}")
    else:
        if case.certain:
            tell(seen, "python: no error")


def _fork_meanwhile(case: Case, inside: Path) -> int:
    child = os.fork()
    if child:
        return child
    try:
        assert case.meanwhile is not None
        if can_confine():
            confine(inside)
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
    kept = "\t" if status else "\t\N{NO-BREAK SPACE}"  # the latter stands between the numbers and units of a result
    coloured = status == 0 and not case.environment.keys().isdisjoint(
        ("FORCE_COLOR", "TTY_COMPATIBLE")
    )  # as it was asked to be
    for line in (out + err).split("\n"):
        if not line.translate({ord(character): " " for character in kept}).isprintable() and not coloured:
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
