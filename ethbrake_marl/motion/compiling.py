"""How kernels are compiled, and how their machine code is stored.

A kernel is a function on arrays of numbers, compiled by numba. Kernels use + - * / sqrt, min, max and comparisons only,
without fast-math: a world has the same bits in every batch and on every processor.

Numba's own cache does not notice when a function that a kernel calls changes, and stops programs if its files are
damaged. A file of machine code is therefore named by the digest of everything that decides it, above all of the sources
of the core's kernels, of all kernels beside it, and of those in the folders of extensions that these import. Paths and
times do not count, so all copies of this package share one cache. Code in ``python -OO`` is the same.
"""

from __future__ import annotations

import hashlib
import pickle
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import numba
from numba.core import event
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from ethbrake_marl.kernel_store import load, save, tell_compilation, warn_damaged

Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE = Path(__file__).parents[1]
SOURCES = ("motion", "episode")  # folders with the core's kernels
_MARK = b"motion.compiling import"  # in every other file with kernels
_EXTENSION = re.compile(rb"^from ethbrake_marl\.extensions\.(\w+)", re.MULTILINE)
_COMPILER = (numba.__version__, llvmlite.__version__, sys.version_info[:2], sys.abiflags)


class _Teller(event.Listener):  # type: ignore[misc]  # numba has no types
    """Announce the first compilation of a kernel in this process."""

    def on_start(self, happened: event.Event) -> None:
        tell_compilation()

    def on_end(self, happened: event.Event) -> None:
        pass


event.register("numba:compile", _Teller())


class _Cache(NullCache):  # type: ignore[misc]
    """The machine code of one kernel for all types of arguments, as numba asks for it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        code = function.__code__
        self._name, self._cells = f"{Path(code.co_filename).stem}.{code.co_name}", function.__closure__ or ()
        place = (function.__module__, function.__qualname__, code.co_firstlineno)
        self._decided_by = (stamp_of(code.co_filename), *place, *_COMPILER)

    def _file(self, signature: Any, codegen: Any) -> str:
        values = dumps([cell.cell_contents for cell in self._cells])
        decided_by = repr((*self._decided_by, signature, values, codegen.magic_tuple()))
        return f"{self._name}-{hashlib.sha256(decided_by.encode()).hexdigest()[:32]}"

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        target_context.refresh()
        name = self._file(sig, target_context.codegen())
        data = load(name)
        if data is None:
            return None
        try:
            return CompileResult._rebuild(target_context, *pickle.loads(data))  # noqa: S301  # the digest is checked
        except Exception:  # such as a class that is gone
            warn_damaged(name)
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        if not data.library.has_dynamic_globals:  # addresses in this process
            save(self._file(sig, data.codegen), dumps(data._reduce()))


def _compile(function: Function, **options: Any) -> Function:
    compiled: Function = numba.njit(
        nogil=True, error_model="numpy", boundscheck=False, no_cfunc_wrapper=True, _nrt=False, **options
    )(function)
    if _source(Path(function.__code__.co_filename)):  # not typed at a prompt
        compiled._cache = _Cache(function)  # type: ignore[attr-defined]
    return compiled


def kernel(function: Function) -> Function:
    """Compile a function that becomes a part of every kernel that calls it."""
    return _compile(function, forceinline=True)


def large(function: Function) -> Function:
    """Compile a function once for all its callers, among them Python."""
    return _compile(function)


@cache
def stamp_of(file: str) -> str:
    """Digest of all sources that decide the machine code of the kernels in ``file``, and of their names."""
    folders, beside = [Path(file).parent], set()
    for folder in folders:  # which grow
        for path in folder.glob("*.py"):
            if _MARK in _source(path):
                beside.add(path)
                imported = [PACKAGE / "extensions" / name.decode() for name in _EXTENSION.findall(_source(path))]
                folders += [other for other in dict.fromkeys(imported) if other not in folders]
    core = {path for name in SOURCES for path in (PACKAGE / name).glob("*.py")}
    digests = sorted(_digest(path) for path in {Path(file)} | beside | core)
    return hashlib.sha256(b"".join(digests)).hexdigest()


@cache
def _digest(path: Path) -> bytes:
    return hashlib.sha256(path.name.encode() + _source(path)).digest()


@cache
def _source(path: Path) -> bytes:
    """Content of a source file; empty if it cannot be read, and nothing can be imported from it."""
    try:
        return path.read_bytes()
    except OSError:
        return b""
