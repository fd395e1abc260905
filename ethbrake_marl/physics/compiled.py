"""The one way in which this package compiles a kernel: strict floating point, cached safely.

numba keys its cache on a function's own file, so editing a *callee* in another file would silently keep the
stale machine code. Here the kernels of a file lie in a folder that carries a hash of this file, of the kernel sources
that it imports, and of the numba version: an edit compiles anew what can call it, and nothing else.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import config as numba_config
from numba.core import event

from ethbrake_marl.errors import check_whole_number

Function = TypeVar("Function", bound=Callable[..., Any])
_PACKAGE = Path(__file__).resolve().parents[1]
_MARK = b"@compiled"
_IMPORT = re.compile(r"^from (ethbrake_marl[.\w]*) import (\([^)]*\)|.*)$", re.MULTILINE)
_CONSTANT = re.compile(r"\b[A-Z][A-Z0-9_]*\b")
_TEMPORARY = "ethbrake_marl-"


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


@cache
def kernel_folder(source: Path) -> Path:
    """Folder of the kernels of one file, below ``cache_folder``: another one after every edit that can change them.

    Code that is in no file (a shell, a test) has one folder for all of it.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    for needed in kernel_sources(source) if source.is_file() else ():
        digest.update(needed.read_bytes())
    return cache_folder() / digest.hexdigest()[:16]


def kernel_sources(source: Path) -> list[Path]:
    """The file, and all of this package that its kernels may be made of, sorted by name.

    These are the files with kernels that it imports, theirs, and so on; and files from which any of them imports a
    constant (a name in capitals).
    """
    found, follow = {source}, [source]
    while follow:
        for module, names in _IMPORT.findall(follow.pop().read_text("utf-8")):
            for imported in _files(module, names):
                has_kernels = _MARK in imported.read_bytes()
                if imported not in found and (has_kernels or _CONSTANT.search(names)):
                    found.add(imported)
                    follow += [imported] * has_kernels
    return sorted(found)


def _files(module: str, names: str) -> list[Path]:
    """The files of a module of this package; of a package its own, and those of the names that are modules."""
    place = _PACKAGE.joinpath(*module.split(".")[1:])
    if place.with_suffix(".py").is_file():
        return [place.with_suffix(".py")]
    within = [place / f"{name}.py" for name in re.findall(r"\w+", names)]
    return [place / "__init__.py", *(file for file in within if file.is_file())]


def is_temporary(folder: Path) -> bool:
    """Whether a ``cache_folder`` goes when this process ends."""
    return folder.name.startswith(_TEMPORARY)


def on_first_compilation(tell: Callable[[Path, bool], None]) -> None:
    """Call ``tell`` once, when this process begins to compile: the folder of the kernels, and whether it was empty.

    Kernels that are loaded from the folder are not compiled. Empty means: not even the physics of today is there.
    """
    events: Any = event  # numba's own types end here

    class Once(event.Listener):
        def on_start(self, event_: event.Event) -> None:
            events.unregister("numba:compile", self)
            physics = kernel_folder(Path(__file__).with_name("advance.py"))
            tell(cache_folder(), not any(physics.rglob("*.nbi")))

        def on_end(self, event_: event.Event) -> None:
            """Nothing: it does not listen any more."""

    events.register("numba:compile", Once())


def compiled(function: Function) -> Function:
    """Compile ``function`` with numba: no fast-math, no bounds checks, releases the GIL, cached on disk.

    What a kernel calls becomes part of it (``forceinline``): a call would count references to its arrays, atomically,
    which cost more than half of the physics.
    """
    return _compile(function, inline=True)


def compiled_apart(function: Function) -> Function:
    """Compile as ``compiled`` does, but leave calls of it calls: for what is large, shared, and seldom called.

    Made part of every caller, such functions would be compiled once for each of them: minutes instead of seconds.
    """
    return _compile(function, inline=False)


def compiled_within(function: Function) -> Function:
    """Compile as ``compiled`` does, and write it into its callers before they are compiled: for a level of its own.

    ``forceinline`` still counts references at each level through which an array is handed on; this does not.
    """
    return _compile(function, inline=False, within=True)


def compiled_bare(function: Function) -> Function:
    """Compile as ``compiled`` does, without any counting of references: for what makes no array and gives none back.

    Whoever calls it holds the arrays. What is ``forceinline`` inside still counts them, unless it is bare, too.
    """
    return _compile(function, inline=True, bare=True)


def compiled_bare_apart(function: Function) -> Function:
    """Compile as ``compiled_bare`` does, but leave calls of it calls."""
    return _compile(function, inline=False, bare=True)


def _compile(function: Function, *, inline: bool, within: bool = False, bare: bool = False) -> Function:
    config: Any = numba_config  # its settings are made at run time
    before = config.CACHE_DIR
    config.CACHE_DIR = str(kernel_folder(Path(function.__code__.co_filename)))
    try:
        how: dict[str, Any] = {"inline": "always"} if within else {"forceinline": inline}
        if bare:
            how["_nrt"] = False
        compiler: Any = numba.njit(cache=True, fastmath=False, nogil=True, error_model="numpy", **how)
        return cast(Function, compiler(function))
    finally:
        config.CACHE_DIR = before


Result = TypeVar("Result")


def by_parts(work: Callable[[slice], Result], n: int, threads: int) -> list[Result]:
    """Results of ``work`` on up to ``threads`` neighbouring parts of ``n`` rows, in order of the rows.

    The first part is done by the caller's own thread, so 1 thread means no others. If parts fail, the error of the
    first of them is raised after all have ended. Raises ``InvalidInput`` unless ``threads`` is a whole number >= 1.
    """
    check_whole_number("threads", threads, 1)
    parts = min(int(threads), n)
    if parts <= 1:
        return [work(slice(0, n))]
    bounds = [n * p // parts for p in range(parts + 1)]
    slices = [slice(low, high) for low, high in pairwise(bounds)]
    with ThreadPoolExecutor(parts - 1) as pool:
        others = [pool.submit(work, part) for part in slices[1:]]
        return [work(slices[0]), *(other.result() for other in others)]
