"""Compiled kernels are kept for later processes: one file for each kernel and signature, named by all that makes it.

The name holds a hash of the sources, of the versions, of the signature and of the processor, and nothing of where the
package lies: an edit compiles anew what can call it, and a second environment or a moved checkout finds what the first
one compiled. There is no index. A file is written under another name and renamed when it is whole, so any number of
processes may share a folder.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.util import find_spec
from pathlib import Path

_PACKAGE = Path(__file__).resolve().parent
_MARK = b"\n@compiled"  # of a decorator, at the start of its line
_IMPORT = re.compile(rb"^from (ethbrake_marl[.\w]*) import (\([^)]*\)|.*)$", re.MULTILINE)
_CONSTANT = re.compile(r"\b[A-Z][A-Z0-9_]*\b")
_TEMPORARY = "ethbrake_marl-"
_DIGEST_BYTES = 32
_LONGEST_WAIT_S = 600.0  # for another process that compiles the same kernel: it may have been stopped
_UNKEPT = "each process compiles for itself; set the clock, or their dates (find FOLDER -exec touch {} +)"
_IMPORTED_S = time.time()
_tellers: list[Callable[[Path, bool], None]] = []
_loaded: list[str] = []


@cache
def cache_folder() -> Path:
    """Folder of the compiled kernels: the user's cache, or where that cannot be written one for this process alone."""
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "ethbrake_marl"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        temporary = Path(tempfile.mkdtemp(prefix=_TEMPORARY))
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        return temporary


def is_temporary(folder: Path) -> bool:
    """Whether a ``cache_folder`` goes when this process ends."""
    return folder.name.startswith(_TEMPORARY)


def on_first_compilation(tell: Callable[[Path, bool], None]) -> None:
    """Call ``tell`` once, when this process begins to compile: the store's folder, and whether it had nothing for it.

    Kernels that are loaded are not compiled. It had nothing if none was loaded before the first one is compiled.
    """
    _tellers.append(tell)


def tell_compilation() -> None:
    """Call whom ``on_first_compilation`` has noted: a kernel is about to be compiled."""
    while _tellers:
        _tellers.pop()(cache_folder(), not _loaded)


def load_kernel(name: str, *, ready_made: bool = False) -> bytes | None:
    """What was kept, or installed, under a name; nothing where it is missing, damaged, or not this user's or root's.

    Who else could write there could have us run anything.
    """
    folder = _ready_made_folder() if ready_made else cache_folder()
    try:
        with (folder / name).open("rb") as file:
            about, content = os.fstat(file.fileno()), file.read()
    except OSError:
        return None
    digest, kept = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    trusted = not hasattr(os, "getuid") or about.st_uid in (0, os.getuid())
    if not trusted or _digest_of(name, kept) != digest:
        return None
    _loaded.append(name)
    return kept


def keep_kernel(name: str, content: bytes) -> None:
    """Keep what ``load_kernel`` gives back; a disk that is full costs a warning, and the next process compiles anew."""
    folder = cache_folder()
    try:
        handle, part = tempfile.mkstemp(dir=folder, prefix=".")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(_digest_of(name, content) + content)
            os.replace(part, folder / name)
        except OSError:
            Path(part).unlink(missing_ok=True)
            raise
    except OSError as error:
        warnings.warn(f"{folder}: a compiled kernel could not be kept: {error}", stacklevel=2)


def _digest_of(name: str, content: bytes) -> bytes:
    return hashlib.sha256(name.encode() + content).digest()


@contextmanager
def alone(name: str) -> Iterator[None]:
    """No other process that asks for the same name is inside meanwhile, unless the folder's disk knows no locks."""
    if not name:
        yield
        return
    from filelock import FileLock, Timeout  # needed by who compiles only

    lock = FileLock(cache_folder() / f".{name}.lock", timeout=_LONGEST_WAIT_S)
    with suppress(Timeout, OSError, NotImplementedError):
        lock.acquire()
    try:
        yield
    finally:
        if lock.is_locked:
            Path(lock.lock_file).unlink(missing_ok=True)
            lock.release()


@cache
def _ready_made_folder() -> Path:
    """Folder of the kernels that the distribution ethbrake-marl-kernels brings, or one that does not exist."""
    found = find_spec("ethbrake_marl_kernels")
    return Path(found.origin).parent if found and found.origin else Path(os.devnull)


@cache
def digest_of_sources(source: Path) -> str:
    """Hash of all files that the kernels of one file may be made of; empty where that is not known.

    That is so for code in no file (a shell), and for a file that was edited after this process began: its code may
    have been read before. A date in the future cannot be told from that, and costs a warning.
    """
    digest = hashlib.sha256()
    for file in kernel_sources(source) if source.is_file() else ():
        written_s = file.stat().st_mtime
        if written_s > time.time():
            warnings.warn(f"{_PACKAGE}: dates of files lie in the future: {_UNKEPT}", stacklevel=2)
        if written_s > _IMPORTED_S:
            return ""
        digest.update(f"{place_of(file)} {file.stat().st_size} ".encode() + file.read_bytes())
    return digest.hexdigest() if source.is_file() else ""


def place_of(file: Path) -> str:
    """Where a file lies inside this package, wherever that lies; of another file its whole path."""
    return file.relative_to(_PACKAGE).as_posix() if file.is_relative_to(_PACKAGE) else str(file)


def kernel_sources(source: Path) -> list[Path]:
    """The file, and all of this package that its kernels may be made of, sorted by name.

    These are the files with kernels that it imports, theirs, and so on; and files from which any of them imports a
    constant (a name in capitals).
    """
    found, follow = {source}, [source]
    while follow:
        for imported, has_kernels in _imports(follow.pop()):
            if imported not in found:
                found.add(imported)
                follow += [imported] * has_kernels
    return sorted(found)


@cache
def _imports(source: Path) -> list[tuple[Path, bool]]:
    """The files with kernels or constants that a file imports, and whether they have kernels."""
    found = []
    for module, names in _IMPORT.findall(source.read_bytes()):
        for imported in _files(module.decode(), names.decode()):
            has_kernels = _MARK in imported.read_bytes()
            if has_kernels or _CONSTANT.search(names.decode()):
                found.append((imported, has_kernels))
    return found


def _files(module: str, names: str) -> list[Path]:
    """The files of a module of this package; of a package its own, and those of the names that are modules."""
    place = _PACKAGE.joinpath(*module.split(".")[1:])
    if place.with_suffix(".py").is_file():
        return [place.with_suffix(".py")]
    within = [place / f"{name}.py" for name in re.findall(r"\w+", names)]
    return [place / "__init__.py", *(file for file in within if file.is_file())]
