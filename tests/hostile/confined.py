"""The kernel's own cage: what a process may change, whoever runs it and in whatever language the writing is done."""

from __future__ import annotations

import ctypes
import os
import signal
import struct
from pathlib import Path

OLDEST_ABI = 3  # of Landlock, Linux 6.2: before it, truncation could not be forbidden
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # system calls, the same numbers on every machine
_VERSION_ONLY, _BENEATH = 1, 1
_SIGNAL_AT_DEATH_OF_PARENT, _NO_NEW_PRIVILEGES = 1, 38  # of prctl
_WRITE_FILE, _TRUNCATE = 1 << 1, 1 << 14
_CHANGE = _WRITE_FILE | sum(1 << k for k in range(4, 14)) | _TRUNCATE  # write, remove, make, rename, cut

_kernel = ctypes.CDLL(None, use_errno=True)  # loaded before a case is watched: its audit hook tells what is loaded


def die_with_parent() -> None:
    """Let the kernel end this process when the one that forked it ends."""
    if _kernel.prctl(_SIGNAL_AT_DEATH_OF_PARENT, signal.SIGKILL, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "cannot be told of the parent's end")


def can_confine() -> bool:
    """Whether this kernel can keep a process, the superuser's too, from writing outside a folder."""
    return int(_kernel.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), _VERSION_ONLY)) >= OLDEST_ABI


def confine(folder: Path) -> None:
    """From here on this process and its children write below ``folder`` (and to /dev/null) or not at all.

    Cannot be undone; a second call only narrows it. Raises ``OSError`` where the kernel refuses.
    """
    rules = _called(_CREATE_RULESET, struct.pack("<Q", _CHANGE), ctypes.c_size_t(8), 0)
    for place, allowed in ((os.fspath(folder), _CHANGE), (os.devnull, _WRITE_FILE | _TRUNCATE)):
        opened = os.open(place, os.O_PATH | os.O_CLOEXEC)
        _called(_ADD_RULE, rules, _BENEATH, struct.pack("<Qi", allowed, opened), 0)
        os.close(opened)
    if _kernel.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "privileges cannot be given up")
    _called(_RESTRICT_SELF, rules, 0)
    os.close(rules)


def _called(number: int, *arguments: object) -> int:
    answer = int(_kernel.syscall(number, *arguments))
    if answer < 0:
        raise OSError(ctypes.get_errno(), f"system call {number} was refused")
    return answer
