"""Files and folders that are either there completely or not at all, also after a crash; locks end with the process."""

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

_HIDDEN, _UNFINISHED = ".ethbrake-", ".partial"  # short whatever the target is called: file names have a longest length


def write_file(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path``, replacing it in one step; a reader sees the old or the new content, whole."""
    with new_file(path) as partial:
        partial.write_bytes(data)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Give a temporary file beside ``path`` that takes its place when the block ends well, and vanishes otherwise."""
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
    """Make a file in ``folder`` and remove it again; raises the ``OSError`` that a later write would meet."""
    descriptor, name = tempfile.mkstemp(dir=folder, prefix=_HIDDEN, suffix=_UNFINISHED)
    os.close(descriptor)
    Path(name).unlink()


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Refuse a file that exists (``AlreadyExists``, unless ``force``) or cannot be written (``InvalidInput``).

    Even ``force`` replaces plain files only: no folder, device, pipe or symbolic link. Call it before long work whose
    result goes there.
    """
    target = Path(path)
    try:
        if target.is_symlink():
            raise InvalidInput(f"{target}: is a symbolic link; give the file it points to")
        if target.is_dir():
            raise InvalidInput(f"{target}: is a folder; give the name of a file")
        if os.access(target, os.F_OK) and not target.is_file():  # unlike exists, it does not take a NUL for no file
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
    """Refuse a folder for results that is none or cannot be written to, or that holds one of these ``files``.

    Raises ``InvalidInput``, and ``AlreadyExists`` unless ``force``. Makes nothing.
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
    """Write ``data`` in one step; raises as ``check_target``."""
    write_file(check_target(path, force=force), data)


@contextmanager
def new_folder(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Give a temporary folder beside ``path`` that takes its name when the block ends well, and vanishes otherwise.

    Raises ``AlreadyExists`` when there is something at ``path``, at the start or at the end; with ``replace`` a folder
    there goes when the block has ended well, and only then.
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
        error.filename = str(path)  # what was asked for, not the passing name
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
    """Take a folder out of the way in one step, then delete it."""
    aside = Path(tempfile.mkdtemp(dir=path.parent, prefix=_HIDDEN, suffix=_UNFINISHED))
    path.rename(aside / path.name)
    shutil.rmtree(aside)


def remove_unfinished(folder: Path) -> None:
    """Delete what writers that were killed left in ``folder``: nobody may be writing in it."""
    for left in folder.glob(f"{_HIDDEN}*{_UNFINISHED}"):
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left)
        else:
            left.unlink()


@contextmanager
def hold_lock(lock: Path, other: str) -> Iterator[None]:
    """Hold the file ``lock`` while the block runs.

    Raises ``InvalidInput`` where another process holds it, which ``other`` names, and where it is no file for that.
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
    """Make renames inside ``path`` survive a power cut (a folder cannot be opened for this outside POSIX)."""
    if os.name == "posix":
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _umask() -> int:
    """The permissions that new files do not get; temporary ones are private until they are named."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
