"""Find the cache folder of compiled kernels, and call functions before the first compilation; imports no numba."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

_TEMPORARY = "ethbrake_marl-"
_tellers: list[Callable[[Path, bool], None]] = []


@cache
def cache_folder() -> Path:
    """Return the folder of the compiled kernels: the user's cache, or a temporary folder if the cache is read-only."""
    try:
        home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "ethbrake_marl"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError):  # RuntimeError: no HOME, and the user id has no name
        temporary = Path(tempfile.mkdtemp(prefix=_TEMPORARY))
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        return temporary


def is_temporary(folder: Path) -> bool:
    """Return whether ``folder``, a result of ``cache_folder``, is deleted when this process ends."""
    return folder.name.startswith(_TEMPORARY)


def on_first_compilation(tell: Callable[[Path, bool], None]) -> None:
    """Call ``tell(folder, was_empty)`` once, just before this process compiles its first kernel.

    ``folder`` is the cache folder of the compiled kernels. ``was_empty`` is true if this process has not loaded any
    kernel from the cache yet. If a kernel is loaded from the cache, ``tell`` is not called.
    """
    _tellers.append(tell)


def tell_compilation(nothing_kept: bool) -> None:
    """Call each callback of ``on_first_compilation`` once, before a kernel is compiled.

    ``nothing_kept``: true if this process has not loaded any compiled kernel from the cache folder yet.
    """
    while _tellers:
        _tellers.pop()(cache_folder(), nothing_kept)
