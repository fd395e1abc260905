"""Cache of compiled physics code, and notices before the first compilation. Does not import numba.

Each file begins with a digest of its name and data, which is checked before the data are used. A damaged file, a
folder that cannot be written, or a file or folder that others can write is no error: the program compiles again and
warns once.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
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

    Data that are damaged, or for which ``read`` raises an error, are deleted with a warning; the result is then None.
    """
    try:
        path = _trusted_folder() / f"{name}{SUFFIX}"
        path.lstat()  # is there anything?
    except OSError:
        return None
    content = _read(path, read)
    if content is None:
        _warn_once(
            f"{path.parent}: {path.name} is damaged or can be written by others, and is compiled again; ethbrake doctor"
            " checks all files"
        )
        _delete(path)
    return content


def save_data(name: str, data: bytes) -> None:
    """Store data under a name, which must differ whenever the data may differ. Warns if storing is impossible."""
    try:
        path = _trusted_folder() / f"{name}{SUFFIX}"
        try:
            with new_file(path) as partial:
                partial.touch(0o644)
                partial.write_bytes(_digest(path, data) + data)
        except PermissionError:  # Windows cannot replace a file that another process reads
            if _read(path, bytes) is None:
                raise
    except OSError as error:
        _warn_once(f"{_reason(error)}, so {UNSTORED}")


def obstacle() -> str:
    """Why compiled code cannot be stored; "" if it can be stored."""
    try:
        with TemporaryFile(dir=_trusted_folder()) as file:
            file.write(bytes(100_000))  # a disk that is full may still have names
    except OSError as error:
        return _reason(error)
    return ""


def delete_damaged() -> tuple[int, int]:
    """Delete damaged files. Return how many are damaged, and how many of these cannot be deleted."""
    damaged = [path for path in _stored_files() if _read(path, bytes) is None]
    return len(damaged), sum(not _delete(path) for path in damaged)


def announce_compilation(module: str) -> None:
    """Print a line on stderr, once in this process, just before it first compiles; ``module``: a function's place."""
    if _announced:
        return
    _announced.append(module)
    parts = f"parts of the physics that no earlier command needed, first of {module}"
    what = parts if _stored_files() else "the physics for the first time, which takes a minute or more"
    advice = "" if obstacle() else "; later processes use the stored result"
    with suppress(AttributeError, OSError, ValueError):  # there is no stderr
        sys.stderr.write(f"compiling {what}{advice}\n")
        sys.stderr.flush()


def _stored_files() -> list[Path]:
    folder = cache_folder()
    return [*folder.glob(f"*{SUFFIX}")] if folder else []


def _trusted_folder() -> Path:
    """Folder of compiled code, created if it is missing. Raises ``OSError`` if it cannot be used.

    Machine code from it will be run, so nobody but this user and root may write to it, or replace it by another folder.
    """
    folder = cache_folder()
    if folder is None:
        raise OSError(0, "HOME and XDG_CACHE_HOME are not set")
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    real = folder.resolve()
    for place in dict.fromkeys((folder, *folder.absolute().parents, real, *real.parents)):
        if _others_can_write(place, may_be_sticky=place not in (folder, real)):
            raise OSError(0, f"{place} belongs to another user, or others can write to it")
    return folder


def _others_can_write(path: Path, *, may_be_sticky: bool = False) -> bool:
    """Whether another user than root can write a file or folder. In a sticky folder others can only add names."""
    status = path.stat()
    is_protected = may_be_sticky and status.st_mode & stat.S_ISVTX
    owners = {status.st_uid, path.lstat().st_uid}
    return hasattr(os, "getuid") and (
        not owners <= {0, os.getuid()} or bool(status.st_mode & _bits_of_others(status.st_gid) and not is_protected)
    )


def _bits_of_others(group: int) -> int:
    """Bits of a mode that let others write; a group of the user's name without another member is the user alone."""
    import grp
    import pwd

    try:
        name, _, _, members = grp.getgrgid(group)
        return 0o002 if {name, *members} == {pwd.getpwuid(os.getuid()).pw_name} else 0o022
    except KeyError:  # without a name
        return 0o022


def _read(path: Path, read: Callable[[bytes], Any]) -> Any:
    """Result of ``read`` for the data in a file; None if the file is damaged or others can write it."""
    try:
        content = path.read_bytes() if path.is_file() and not _others_can_write(path) else b""
        data = content[_DIGEST_BYTES:]
        return read(data) if content[:_DIGEST_BYTES] == _digest(path, data) else None
    except Exception:  # of reading, or of `read`: such as a class that is gone
        return None


def _delete(path: Path) -> bool:
    """Delete the file, folder or link at ``path``. Return whether this was possible."""
    try:
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink(missing_ok=True)
    except OSError:
        return False
    return True


def _digest(path: Path, data: bytes) -> bytes:
    return hashlib.blake2b(os.fsencode(path.name) + data, digest_size=_DIGEST_BYTES).digest()


def _reason(error: OSError) -> str:
    return f"{cache_folder() or 'no cache folder'}: {error.strerror}"


def _warn_once(text: str) -> None:
    if not _warned:
        _warned.append(text)
        warnings.warn(text, CacheFault, stacklevel=3)
