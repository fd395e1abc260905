"""Atomic writing: files and folders appear completely or not at all, even after a crash. Locks end with the process."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ethbrake_marl.errors import AlreadyExists, InvalidInput

LARGEST_OBJECT_BYTES = 16 << 20

_HIDDEN, _UNFINISHED = ".ethbrake-", ".partial"  # not the target's name: file names have a maximum length


def write_file(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path`` in one step, replacing an existing file; readers see the old or the new content."""
    with new_file(path) as partial:
        partial.write_bytes(data)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Context manager: yield the path of a temporary file that replaces ``path`` if the block succeeds.

    Otherwise the temporary file is deleted.
    """
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=_HIDDEN, suffix=_UNFINISHED)
    os.close(descriptor)
    partial = Path(name)
    try:
        yield partial
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.chmod(0o666 & ~_umask())
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    _folder_to_disk(path.parent)


def check_writable(folder: Path) -> None:
    """Raise ``OSError`` unless ``folder`` is writable, tested by creating and deleting a file."""
    descriptor, name = tempfile.mkstemp(dir=folder, prefix=_HIDDEN, suffix=_UNFINISHED)
    os.close(descriptor)
    Path(name).unlink()


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Check that the file ``path`` may be written; return it as a ``Path``. Call this before long work.

    Raises ``AlreadyExists`` for an existing file unless ``force``; ``InvalidInput`` if it cannot be written. Even
    ``force`` replaces plain files only, not a folder, device, pipe or symbolic link.
    """
    target = Path(path)
    try:
        if target.is_symlink():
            raise InvalidInput(f"{target}: is a symbolic link; give the file it points to")
        if target.is_dir():
            raise InvalidInput(f"{target}: is a folder; give the name of a file")
        if os.access(target, os.F_OK) and not target.is_file():  # unlike exists(), it raises for a NUL in the name
            raise InvalidInput(f"{target}: is a device or a pipe, not a plain file; give another name")
        if not target.parent.is_dir():
            raise InvalidInput(f"{target}: there is no folder {target.parent}; make it first")
        if os.path.lexists(target) and not force:
            raise AlreadyExists(f"{target}: is there already; give another name or use force (--force)")
        check_writable(target.parent)
    except (InvalidInput, AlreadyExists):
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InvalidInput(f"{target!s:.200}: cannot be written ({reason})") from None
    return target


def check_folder(path: Path, files: Collection[str] = (), *, force: bool = False) -> None:
    """Check that ``path`` can be a folder for results, without creating anything.

    Raises ``InvalidInput`` if it is not a folder or cannot be written to; ``AlreadyExists`` if it already contains one
    of the file names in ``files``, unless ``force``.
    """
    try:
        places = (path, *path.absolute().parents)
        there = next(each for each in places if os.access(each, os.F_OK) or each.is_symlink())
        if there.is_dir():
            check_writable(there)
    except (OSError, ValueError) as error:
        raise InvalidInput(
            f"{path!s:.200}: cannot be written to ({getattr(error, 'strerror', None) or error})"
        ) from None
    if not there.is_dir():
        raise InvalidInput(f"{path}: {there} is no folder; give a folder of its own (--output)")
    for name in files if there == path else ():
        check_target(path / name, force=force)


def write_output(path: str | Path, data: bytes, *, force: bool = False) -> None:
    """Write ``data`` to ``path`` in one step; ``force`` replaces an existing file.

    Raises ``AlreadyExists`` or ``InvalidInput`` like ``check_target``.
    """
    write_file(check_target(path, force=force), data)


@contextmanager
def new_folder(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Context manager: yield a temporary folder that becomes ``path`` if the block succeeds, else is deleted.

    Raises ``AlreadyExists`` if ``path`` exists, at the start or at the end. With ``replace`` an existing folder is
    deleted, but only after the block has succeeded.
    """
    if not replace:
        _refuse_existing(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(errno.ENOTDIR, "Not a directory", str(path.parent)) from None
    try:
        partial = Path(tempfile.mkdtemp(dir=path.parent, prefix=_HIDDEN, suffix=_UNFINISHED))
    except OSError as error:
        error.filename = str(path)  # report the requested name, not the temporary one
        raise
    try:
        yield partial
        partial.chmod(0o777 & ~_umask())
        _folder_to_disk(partial)
        if replace and path.is_dir() and not path.is_symlink():
            remove_folder(path)
        _refuse_existing(path)
        partial.rename(path)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    _folder_to_disk(path.parent)


def remove_folder(path: Path) -> None:
    """Delete the folder ``path``, after renaming it, so that no half-deleted folder has its name."""
    aside = Path(tempfile.mkdtemp(dir=path.parent, prefix=_HIDDEN, suffix=_UNFINISHED))
    path.rename(aside / path.name)
    shutil.rmtree(aside)


def remove_unfinished(folder: Path) -> None:
    """Delete temporary files that killed writers left in ``folder``; no other process may be writing there."""
    for left in folder.glob(f"{_HIDDEN}*{_UNFINISHED}"):
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left)
        else:
            left.unlink()


@contextmanager
def hold_lock(lock: Path, other: str) -> Iterator[None]:
    """Context manager: hold the lock file ``lock`` while the block runs.

    Raises ``InvalidInput`` if another process holds it, or if the file cannot be used as a lock. ``other``: reason in
    the message in the first case.
    """
    held = FileLock(lock, blocking=False, mode=0o666)
    try:
        held.acquire()
    except Timeout:
        raise InvalidInput(f"{lock.parent}: {other}") from None
    except OSError as error:
        raise InvalidInput(f"{lock}: cannot be used as a lock ({error.strerror}); delete it") from None
    try:
        yield
    finally:
        held.release()


def _refuse_existing(path: Path) -> None:
    if path.is_symlink() or path.exists():
        raise AlreadyExists(f"{path}: is there already; give another name")


def _folder_to_disk(path: Path) -> None:
    """Flush the folder ``path``, so that renames in it survive a power failure (POSIX only)."""
    if os.name == "posix":
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _umask() -> int:
    """Return the permission bits that new files do not get. Temporary files are private until they are renamed."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
