"""Cache of compiled physics code, and notices before the first compilation. Does not import numba.

Each file begins with a digest of its name and data, which is checked before the data are used. A damaged file, a
folder that cannot be written, or a file or folder of somebody else is no error: the program compiles again and warns
once.
"""

from __future__ import annotations

import hashlib
import os
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import CacheFault
from ethbrake_marl.files.store import new_file

SUFFIX = ".compiled"
UNSTORED = "every process compiles the physics again; set NUMBA_CACHE_DIR to a folder that you alone can write"
_DIGEST_BYTES = 32
_warned: list[str] = []
_announced: list[str] = []


def cache_folder() -> Path | None:
    """Folder of compiled code, below ``$NUMBA_CACHE_DIR`` or the user's cache; None without a home folder."""
    try:
        home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(home) / "ethbrake_marl"


def load_data(name: str, read: Callable[[bytes], Any]) -> Any:
    """Result of ``read`` for the data that are stored under a name; None if there are none.

    Also None, with a warning, if the data are damaged, others can write them, or ``read`` raises an error.
    """
    try:
        path = _own_folder() / f"{name}{SUFFIX}"
        path.lstat()  # is there anything?
    except OSError:
        return None
    content = _read(path, read)
    if content is None:
        _warn_once(
            f"{path.parent}: {path.name} is damaged or can be written by others, and is compiled again; ethbrake doctor"
            " checks all files"
        )
    return content


def save_data(name: str, data: bytes) -> None:
    """Store data under a name, which must differ whenever the data may differ. Warns if storing is impossible."""
    try:
        path = _own_folder() / f"{name}{SUFFIX}"
        try:
            with new_file(path) as partial:
                partial.touch(0o644)
                partial.write_bytes(_digest(path, data) + data)
        except PermissionError:  # Windows cannot replace a file that another process reads
            if _read(path, bytes) is None:
                raise
    except OSError as error:
        _warn_once(_reason(error))


def cache_fault() -> str:
    """Why the stored code cannot be used; "" if it can be used."""
    try:
        folder = _own_folder()
    except OSError as error:
        return _reason(error)
    unsound = sum(_read(path, bytes) is None for path in _stored_files())
    return f"{folder}: {unsound} of its files are damaged or can be written by others; delete it" if unsound else ""


def announce_compilation(module: str) -> None:
    """Print a line on stderr, once in this process, just before it first compiles; ``module``: a function's place."""
    if _announced:
        return
    _announced.append(module)
    parts = f"parts of the physics that no earlier command needed, first of {module}"
    what = parts if _stored_files() else "the physics for the first time, which takes a minute or more"
    with suppress(AttributeError, OSError, ValueError):  # there is no stderr
        sys.stderr.write(f"compiling {what}\n")
        sys.stderr.flush()


def _stored_files() -> list[Path]:
    folder = cache_folder()
    return [*folder.glob(f"*{SUFFIX}")] if folder else []


def _own_folder() -> Path:
    """Folder of compiled code, created if it is missing. Raises ``OSError`` if it cannot be used."""
    folder = cache_folder()
    if folder is None:
        raise OSError(0, "HOME and XDG_CACHE_HOME are not set")
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_own(folder.stat()):
        raise OSError(0, "belongs to another user, or others can write to it")
    return folder


def _is_own(status: os.stat_result) -> bool:
    """Whether a file or folder belongs to this user or root, and nobody else can write it: its code will be run."""
    return not hasattr(os, "getuid") or (status.st_uid in (0, os.getuid()) and not status.st_mode & 0o022)


def _read(path: Path, read: Callable[[bytes], Any]) -> Any:
    """Result of ``read`` for the data in a file; None if the file is damaged or others can write it."""
    try:
        if not path.is_file():  # such as a pipe, whose reader would wait
            return None
        with path.open("rb") as file:  # its folder may have been replaced since it was checked
            content = file.read() if _is_own(os.fstat(file.fileno())) else b""
        data = content[_DIGEST_BYTES:]
        return read(data) if content[:_DIGEST_BYTES] == _digest(path, data) else None
    except Exception:  # of reading, or of `read`: such as a class that is gone
        return None


def _digest(path: Path, data: bytes) -> bytes:
    return hashlib.blake2b(os.fsencode(path.name) + data, digest_size=_DIGEST_BYTES).digest()


def _reason(error: OSError) -> str:
    return f"{cache_folder() or 'no cache folder'}: {error.strerror}, so {UNSTORED}"


def _warn_once(text: str) -> None:
    if not _warned:
        _warned.append(text)
        warnings.warn(text, CacheFault, stacklevel=3)
