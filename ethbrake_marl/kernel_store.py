"""The folder of compiled kernels, and who is told that one is compiled; unlike what compiles, it imports no numba."""

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
    """Folder of the compiled kernels: the user's cache; if that cannot be written, one for this process."""
    try:
        home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "ethbrake_marl"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except (OSError, RuntimeError):  # RuntimeError: without HOME, for a user id that has no name
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


def tell_compilation(nothing_kept: bool) -> None:
    """Call whom ``on_first_compilation`` has noted: a kernel is about to be compiled."""
    while _tellers:
        _tellers.pop()(cache_folder(), nothing_kept)
