"""Files and folders that are either there completely or not at all, also after a crash; locks end with the process."""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import stat
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any, NoReturn

from filelock import FileLock, Timeout

from ethbrake_marl.errors import AlreadyExists, EthBrakeError, InvalidInput

_LARGEST_OBJECT_BYTES = 16 << 20
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


# Files that somebody else may have written: plain files only, no more of them than is expected, and strict JSON.

_FLAGS = ("O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC", "O_BINARY")  # those that this system has


def read_plain(
    path: str | os.PathLike[str],
    limit_bytes: int,
    *,
    refusal: type[EthBrakeError] = InvalidInput,
    follow_links: bool = True,
) -> bytes:
    """The content of a plain file of at most ``limit_bytes``; raises ``refusal`` as ``open_plain``.

    Of a file that grows no more than that is read.
    """
    with open_plain(path, limit_bytes, refusal=refusal, follow_links=follow_links) as stream:
        data = _read(stream.fileno(), limit_bytes + 1)
    if len(data) > limit_bytes:
        raise _too_large(Path(path), limit_bytes, refusal)
    return data


@contextmanager
def open_plain(
    path: str | os.PathLike[str],
    limit_bytes: int,
    *,
    refusal: type[EthBrakeError] = InvalidInput,
    follow_links: bool = True,
) -> Iterator[BufferedReader]:
    """A plain file of at most ``limit_bytes``, open for reading.

    Its kind and size are looked at before anything of it is read: a pipe or device is not even opened, so nothing
    waits for a writer and no device notices; what takes its place in between is opened without waiting and looked at
    again. Raises ``refusal`` naming the path and the reason: nothing there, a folder, a device, a pipe, too large, not
    to be read (inside the block too), or a symbolic link where none is to be followed.
    """
    file = Path(path)
    try:
        _check_kind(file, (os.stat if follow_links else os.lstat)(file), limit_bytes, refusal)
        flags = os.O_RDONLY | (0 if follow_links else getattr(os, "O_NOFOLLOW", 0))
        for name in _FLAGS:
            flags |= getattr(os, name, 0)
        with os.fdopen(os.open(file, flags), "rb") as stream:
            _check_kind(file, os.fstat(stream.fileno()), limit_bytes, refusal)
            yield stream
    except FileNotFoundError:
        raise refusal(f"{file}: no such file") from None
    except OSError as error:
        raise refusal(f"{file}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        if isinstance(error, EthBrakeError):
            raise
        raise refusal(f"{file}: cannot be read ({error})") from None


def _read(descriptor: int, most_bytes: int) -> bytes:
    """Up to so many bytes; raises ``OSError`` where there is nothing to read without waiting."""
    parts: list[bytes] = []
    while most_bytes > 0 and (part := os.read(descriptor, min(most_bytes, 1 << 20))):
        parts.append(part)
        most_bytes -= len(part)
    return b"".join(parts)


def _check_kind(file: Path, found: os.stat_result, limit_bytes: int, refusal: type[EthBrakeError]) -> None:
    if stat.S_ISLNK(found.st_mode):
        raise refusal(f"{file}: is a symbolic link; give the file it points to")
    if stat.S_ISDIR(found.st_mode):
        raise refusal(f"{file}: is not a plain file but a folder")
    if not stat.S_ISREG(found.st_mode):
        raise refusal(f"{file}: is not a plain file but a device, a pipe or a socket")
    if found.st_size > limit_bytes:
        raise _too_large(file, limit_bytes, refusal)


def _too_large(file: Path, limit_bytes: int, refusal: type[EthBrakeError]) -> EthBrakeError:
    size = f"{limit_bytes >> 20} MiB" if limit_bytes >= 1 << 20 else f"{limit_bytes >> 10} KiB"
    return refusal(f"{file}: larger than {size}, the limit for such a file")


def parse_strict_json(data: bytes) -> Any:
    """Parse ``data``; raises ``ValueError`` with a one-line reason on anything ambiguous or not in the standard."""
    try:
        return json.loads(
            data.decode("utf-8"), object_pairs_hook=_object, parse_constant=_not_a_number, parse_float=_finite
        )
    except RecursionError:
        raise ValueError("nested too deeply") from None


def read_object(file: Path) -> dict[str, Any]:
    """The JSON object in a file of a run; raises ``InvalidInput`` naming the file and what is wrong with it."""
    if not os.path.lexists(file):
        raise InvalidInput(f"{file}: is missing; nothing goes on without it")
    data = read_plain(file, _LARGEST_OBJECT_BYTES)
    try:
        content = parse_strict_json(data)
    except ValueError as error:
        raise InvalidInput(f"{file}: is damaged: {error}") from None
    if not isinstance(content, dict):
        raise InvalidInput(f"{file}: is damaged: holds no JSON object")
    return content


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    parsed: dict[str, Any] = {}
    for key, value in pairs:
        if key in parsed:
            raise ValueError(f"key {key!r} stands twice")
        parsed[key] = value
    return parsed


def _not_a_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a JSON number")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is too large for a number")
    return number
