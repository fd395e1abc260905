"""The audit hooks of a case: what it executes or would change outside its own folder is told to the judge."""

from __future__ import annotations

import collections
import dataclasses
import errno
import inspect
import json
import os
import sys
import typing
from typing import Any

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
# The arguments that an event changes, each with the one that may hold the folder to which its name is relative.
_CHANGING: dict[str, tuple[tuple[int, int | None], ...]] = {
    "os.mkdir": ((0, 2),), "os.remove": ((0, 1),), "os.rmdir": ((0, 1),), "os.truncate": ((0, None),),
    "os.chmod": ((0, 2),), "os.chown": ((0, 3),), "os.utime": ((0, 3),), "os.link": ((1, 3),), "os.symlink": ((1, 2),),
    "os.rename": ((0, 2), (1, 3)), "shutil.rmtree": ((0, 1),),
}  # fmt: skip
_READ_ANNOTATIONS = {inspect.__file__, typing.__file__, dataclasses.__file__, collections.__file__}


def watch(event: str, arguments: tuple[object, ...], seen: int) -> None:
    """Called by the interpreter for everything that touches the world."""
    if event.startswith("marshal.") and sys._getframe(2).f_code.co_filename.startswith("<frozen importlib"):
        return
    if event in _EXECUTING or (event == "exec" and not _of_a_module(arguments[0])):
        tell(seen, f"executed: {event} {arguments!r:.60} by {_callers()}")


def keep_inside(event: str, arguments: tuple[Any, ...], own: str, seen: int) -> None:
    """Refuse, and tell, whatever would change something outside the case's own folder, whoever runs the attack."""
    if event == "open":
        writes = isinstance(arguments[2], int) and arguments[2] & _WRITING
        places = [os.path.realpath(os.fsdecode(arguments[0]))] if writes and not isinstance(arguments[0], int) else []
    else:
        places = [
            _entry(os.fsdecode(arguments[k]), None if base is None else arguments[base])
            for k, base in _CHANGING.get(event, ())
            if not isinstance(arguments[k], int)
        ]
    for place in places:
        if place != os.devnull and not f"{place}{os.sep}".startswith(own):
            tell(seen, f"would have changed what is outside: {event} {place}"[:300])
            raise PermissionError(errno.EPERM, "outside the case's folder", place)


def _entry(path: str, base: int | None) -> str:
    """A path whose last part is not followed; ``base`` is an open folder to which it is relative, or -1."""
    if isinstance(base, int) and base >= 0:
        path = os.path.join(os.readlink(f"/proc/self/fd/{base}"), path)
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


def tell(seen: int, what: str) -> None:
    """Write one line to the judge."""
    os.write(seen, (json.dumps(what) + "\n").encode())
