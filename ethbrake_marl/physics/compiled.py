"""The one way in which this package compiles a kernel: strict floating point, cached safely.

numba keys its cache on a function's own file, so editing a *callee* in another file would silently keep the
stale machine code. Here the cache folder carries a hash of every kernel source and of the numba version.
"""

from __future__ import annotations

import atexit
import hashlib
import os
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
_TEMPORARY = "ethbrake_marl-"


@cache
def cache_folder() -> Path:
    """Folder of the compiled kernels: the user's cache, or where that cannot be written one for this process alone."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(_PACKAGE.rglob("*.py")):
        text = source.read_bytes()
        if _MARK in text:
            digest.update(text)
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "ethbrake_marl" / digest.hexdigest()[:16]
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
    """Call ``tell`` once, when this process begins to compile: the folder of the kernels, and whether it was empty.

    Kernels that are loaded from the folder are not compiled.
    """
    events: Any = event  # numba's own types end here

    class Once(event.Listener):
        def on_start(self, event_: event.Event) -> None:
            events.unregister("numba:compile", self)
            tell(cache_folder(), not any(cache_folder().rglob("*.nbi")))

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
    config.CACHE_DIR = str(cache_folder())
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
