"""Atomic writing: a file or folder appears completely or not at all, even after a crash. Also lock files."""

from __future__ import annotations

import errno
import os
import shutil
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from uuid import uuid4

from filelock import FileLock, Timeout

from ethbrake_marl.errors import AlreadyExists, EthBrakeError, InvalidInput, NoLocks

# beginning and end of a temporary name; it does not contain the target's name, because names have a maximum length
_HIDDEN, _UNFINISHED = ".ethbrake-", ".partial"


def write_file(path: Path, data: bytes) -> None:
    """Write or replace a file. Other processes read either the old or the new content."""
    with new_file(path) as partial:
        partial.write_bytes(data)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """It is renamed to ``path`` if the block succeeds, otherwise deleted."""
    partial = _temporary(path.parent)
    try:
        yield partial
        with partial.open("rb+") as file:  # Windows cannot flush a file that is open for reading only
            os.fsync(file.fileno())
        os.replace(partial, path)
    except BaseException as error:
        if isinstance(error, OSError):
            error.filename = str(path)
        partial.unlink(missing_ok=True)
        raise


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Raises ``AlreadyExists`` for an existing file, unless ``force``. Raises ``InvalidInput`` if ``path`` cannot be
    written, or is a folder, device, pipe or symbolic link.
    """
    target = Path(path)
    try:
        if target.is_symlink():
            raise InvalidInput(f"{target}: is a symbolic link; give the path of the file to which it points")
        if target.is_dir():
            raise InvalidInput(f"{target}: is a folder; give the path of a file")
        if os.access(target, os.F_OK) and not target.is_file():  # unlike exists(), it raises for a NUL in the name
            raise InvalidInput(f"{target}: is a device or a pipe, not a plain file; give another name")
        if not target.parent.is_dir():
            raise InvalidInput(f"{target}: the folder {target.parent} does not exist; create it first")
        if os.path.lexists(target) and not force:
            raise AlreadyExists(
                f"{target}: already exists; give another name, or pass force=True (--force) to overwrite the file"
            )
        TemporaryFile(dir=target.parent).close()
    except (OSError, ValueError) as error:
        if isinstance(error, EthBrakeError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise InvalidInput(f"{target!s:.200}: cannot be written ({reason})") from None
    return target


def check_folder(path: Path, files: Collection[str] = (), *, force: bool = False) -> None:
    """The folder is not created.

    Raises ``InvalidInput`` if ``path`` is not a folder or cannot be written to. Raises ``AlreadyExists`` if the folder
    contains one of ``files``, unless ``force``.
    """
    try:
        places = (path, *path.absolute().parents)
        nearest = next(place for place in places if os.access(place, os.F_OK) or place.is_symlink())
        if nearest.is_dir():
            TemporaryFile(dir=nearest).close()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InvalidInput(f"{path!s:.200}: cannot be written to ({reason})") from None
    if not nearest.is_dir():
        raise InvalidInput(f"{path}: {nearest} is not a folder; give a new folder (--output)")
    for name in files if nearest == path else ():
        check_target(path / name, force=force)


def write_output(path: str | Path, data: bytes, *, force: bool = False) -> None:
    write_file(check_target(path, force=force), data)


@contextmanager
def new_folder(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """With ``replace`` an existing ``path`` is deleted after the block; without it, an existing ``path`` raises
    ``AlreadyExists``.
    """
    if not replace:
        _refuse_existing(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise InvalidInput(f"{path}: {path.parent} is not a folder; give a new folder") from None
    partial = _temporary(path.parent)
    partial.mkdir()
    try:
        yield partial
        if replace and path.is_dir() and not path.is_symlink():
            remove_folder(path)
        _refuse_existing(path)
        partial.rename(path)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


def remove_folder(path: Path) -> None:
    """Delete a folder. The folder is renamed first, so an interruption leaves no half-deleted folder at ``path``.

    On overlayfs a folder of a lower layer cannot be renamed, and is deleted in place.
    """
    aside = _temporary(path.parent)
    try:
        path.rename(aside)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        aside = path
    shutil.rmtree(aside)


def remove_unfinished(folder: Path) -> None:
    """No other process may be writing to this folder."""
    for leftover in folder.glob(f"{_HIDDEN}*{_UNFINISHED}"):
        if leftover.is_dir() and not leftover.is_symlink():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()


@contextmanager
def hold_lock(lock: Path, message: str) -> Iterator[None]:
    """The lock is also released if the process ends.

    Warns on a file system without locks. Raises ``InvalidInput`` with the text ``message`` if another process holds the
    lock, or if the file cannot be locked.
    """
    held = FileLock(lock, blocking=False, mode=0o666)
    try:
        held.acquire()
    except Timeout:
        raise InvalidInput(f"{lock.parent}: {message}") from None
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
            raise InvalidInput(f"{lock}: cannot be used as a lock ({error.strerror}); delete this file") from None
        warnings.warn(
            f"{lock.parent}: the file system has no locks; run one process at a time here", NoLocks, stacklevel=3
        )
    try:
        yield
    finally:
        held.release()


def _refuse_existing(path: Path) -> None:
    if path.is_symlink() or path.exists():
        raise AlreadyExists(f"{path}: already exists; give another name")


def _temporary(folder: Path) -> Path:
    return folder / f"{_HIDDEN}{uuid4().hex}{_UNFINISHED}"
