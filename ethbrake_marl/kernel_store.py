"""The cache of compiled physics code, and functions to call before the first compilation. Imports no numba.

Each file begins with a digest of its name and its data, which is checked before the data are used. Whatever the folder
contains, and wherever it cannot be written, programs compile again and warn once: no error comes from here.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile

from ethbrake_marl.errors import CacheFault
from ethbrake_marl.files.store import write_file

SUFFIX = ".compiled"
_DIGEST_BYTES = 32
_PROBE_BYTES = 100_000
_tellers: list[Callable[[bool], None]] = []
_warned: list[str] = []


def cache_folder() -> Path | None:
    """Return this package's folder in ``$NUMBA_CACHE_DIR`` or the user's cache; None without a home folder."""
    try:
        home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:
        return None
    return Path(home) / "ethbrake_marl"


def load(name: str) -> bytes | None:
    """Return the data that ``save`` has stored under a name; None if there are none, or if they are damaged."""
    try:
        path = _trusted_folder() / f"{name}{SUFFIX}"
    except OSError:
        return None
    if not os.path.lexists(path):
        return None
    data = _checked(path)
    if data is None:
        warn_damaged(name)
    return data


def save(name: str, data: bytes) -> None:
    """Store data under a name, which must contain all that decides the data."""
    try:
        path = _trusted_folder() / f"{name}{SUFFIX}"
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        write_file(path, _digest(path, data) + data)
    except OSError as error:
        _warn_once(
            f"{_reason(error)}, so every process compiles the physics again; set NUMBA_CACHE_DIR to a folder that can"
            " be written"
        )


def obstacle() -> str:
    """Return why compiled code cannot be stored; empty if it can."""
    try:
        with TemporaryFile(dir=_trusted_folder()) as file:
            file.write(bytes(_PROBE_BYTES))
    except OSError as error:
        return _reason(error)
    return ""


def delete_damaged(folder: Path) -> list[Path]:
    """Delete the damaged files of a cache, and return their paths. A file that cannot be deleted stays."""
    damaged = [path for path in folder.glob(f"*{SUFFIX}") if _checked(path) is None]
    for path in damaged:
        with suppress(OSError):
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    return damaged


def warn_damaged(name: str) -> None:
    _warn_once(f"{cache_folder()}: {name}{SUFFIX} is damaged and is compiled again; ethbrake doctor checks all files")


def on_first_compilation(tell: Callable[[bool], None]) -> None:
    """Call ``tell(is_empty)`` once, just before this process compiles for the first time.

    ``is_empty``: the cache contains no compiled code yet.
    """
    _tellers.append(tell)


def tell_compilation() -> None:
    folder = cache_folder()
    while _tellers:
        _tellers.pop()(folder is None or not any(folder.glob(f"*{SUFFIX}")))


def _trusted_folder() -> Path:
    """Return the folder, which is created if it is missing. Raises ``OSError`` if there is none to use.

    It must belong to this user or root, since machine code from it will be run.
    """
    folder = cache_folder()
    if folder is None:
        raise FileNotFoundError(errno.ENOENT, "HOME and XDG_CACHE_HOME are not set")
    folder.mkdir(parents=True, exist_ok=True)
    if hasattr(os, "getuid") and folder.stat().st_uid not in (0, os.getuid()):
        raise PermissionError(errno.EPERM, "belongs to another user")
    return folder


def _checked(path: Path) -> bytes | None:
    """Return the data of a file; None if the digest does not fit, or if it cannot be read or is no file."""
    try:
        content = path.read_bytes() if path.is_file() else b""
    except OSError:
        return None
    data = content[_DIGEST_BYTES:]
    return data if content[:_DIGEST_BYTES] == _digest(path, data) else None


def _digest(path: Path, data: bytes) -> bytes:
    return hashlib.blake2b(os.fsencode(path.name) + data, digest_size=_DIGEST_BYTES).digest()


def _reason(error: OSError) -> str:
    return f"{cache_folder() or 'no cache folder'}: {error.strerror}"


def _warn_once(text: str) -> None:
    if not _warned:
        _warned.append(text)
        warnings.warn(text, CacheFault, stacklevel=3)
