"""How kernels are compiled, and where their machine code is kept.

A kernel is a function on arrays of numbers, compiled by numba. Kernels use + - * / sqrt, min, max and comparisons only,
without fast-math: a world has the same bits in every batch and on every processor.

Numba does not notice when a function that a kernel calls changes. The folder of the machine code is therefore named by
the digest of the core's kernels, of all kernels beside it, and of those in the folders of extensions that these import.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core import config, event
from numba.core.compiler_lock import global_compiler_lock

from ethbrake_marl.kernel_store import cache_folder, can_be_trusted, home_folder, is_temporary, tell_compilation
from ethbrake_marl.stopping import Postponed

Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE = Path(__file__).parents[1]
SOURCES = ("motion", "episode")  # folders with the core's kernels
_MARK = b"motion.compiling import"  # in every other file with kernels
_EXTENSION = re.compile(rb"^from ethbrake_marl\.extensions\.(\w+)", re.MULTILINE)


class _Teller(event.Listener):  # type: ignore[misc]  # numba has no types
    """Announce the first compilation of a kernel in this process."""

    def on_start(self, happened: event.Event) -> None:
        tell_compilation()

    def on_end(self, happened: event.Event) -> None:
        pass


class _Postponer(event.Listener):  # type: ignore[misc]
    """Postpone Ctrl-C until numba has compiled and stored a function: LLVM's calls of Python lose every exception."""

    postponed = Postponed()

    def on_start(self, happened: event.Event) -> None:
        self.postponed.begin()

    def on_end(self, happened: event.Event) -> None:
        self.postponed.end(only_arrived=global_compiler_lock.is_locked())


event.register("numba:compile", _Teller())
event.register("numba:compiler_lock", _Postponer())


def _compile(function: Function, **options: Any) -> Function:
    before, config.CACHE_DIR = config.CACHE_DIR, str(folder_of(function.__code__.co_filename))
    try:
        compiled: Function = numba.njit(
            cache=True, nogil=True, error_model="numpy", boundscheck=False, no_cfunc_wrapper=True, _nrt=False, **options
        )(function)
    finally:
        config.CACHE_DIR = before
    return compiled


def kernel(function: Function) -> Function:
    """Compile a function that becomes a part of every kernel that calls it."""
    return _compile(function, forceinline=True)


def large(function: Function) -> Function:
    """Compile a function once for all its callers, among them Python."""
    return _compile(function)


@cache
def folder_of(file: str) -> Path:
    """Folder with the machine code of the kernels in ``file``, which may call those that it imports.

    If the cache folder is temporary, machine code that may only be read (a container's image) is copied into it. Warns
    if there is none to copy.
    """
    digest, folders, beside = hashlib.sha256(), [Path(file).parent], set()
    for folder in folders:  # which grow
        for path in folder.glob("*.py"):
            content = path.read_bytes()
            if _MARK in content:
                beside.add(path)
                imported = [PACKAGE / "extensions" / name.decode() for name in _EXTENSION.findall(content)]
                folders += [other for other in dict.fromkeys(imported) if other not in folders]
    core = {path for name in SOURCES for path in (PACKAGE / name).glob("*.py")}
    for path in sorted({Path(file)} | beside | core):
        digest.update(path.name.encode() + path.read_bytes())
    folder = cache_folder() / digest.hexdigest()[:16]
    if is_temporary(cache_folder()) and not _has_copied(home_folder(), folder):
        _warn_once()
    return folder


def _has_copied(home: Path | None, folder: Path) -> bool:
    """Copy the machine code for a temporary ``folder``; False if there is none that may be read and trusted."""
    try:
        kept = None if home is None or not can_be_trusted(home) else home / folder.name
        if kept is None or not any(kept.rglob("*.*")):
            return False
        shutil.copytree(kept, folder, dirs_exist_ok=True)
    except OSError:
        return False
    return True


@cache
def _warn_once() -> None:
    warnings.warn(
        f"{home_folder()}: cannot be written, or its disk is full, so every process compiles the physics again (20 s);"
        " set NUMBA_CACHE_DIR to a folder that can be written",
        stacklevel=2,
    )
