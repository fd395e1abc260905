"""How kernels are compiled, and how their machine code is stored.

A kernel is a function on arrays of numbers, compiled by numba. Kernels use + - * / sqrt, min, max and comparisons only,
without fast-math: a world has the same bits in every batch and on every processor.

Numba's own cache does not notice a change in a function that a kernel calls, and a damaged cache file stops the
program. Here the name of a file of machine code is therefore a digest of everything that the code depends on: above
all, the sources of the core's kernels, of the kernels in the same folder, and of the kernels in the extensions that
these import. Paths and file times are not in the digest, so all copies of this package share one cache. ``python -OO``
uses the same files.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import numba
from numba.core.caching import NullCache
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.serialize import dumps

from ethbrake_marl.kernel_cache import announce_compilation, load_data, save_data

Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE = Path(__file__).parents[1]
SOURCES = ("motion", "episode")  # folders with the core's kernels
_MARK = b"motion.compiling import"  # in every other file with kernels
_EXTENSION = re.compile(rb"^from ethbrake_marl\.extensions\.(\w+)", re.MULTILINE)


class _Cache(NullCache):  # type: ignore[misc]
    """Stored machine code of one kernel, for all types of its arguments; numba calls the methods."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._stamp = function, stamp_of(function.__code__.co_filename)

    def _name(self, signature: Any, codegen: Any) -> str:
        """Name of the stored file: a digest of everything that the machine code depends on."""
        function = self._function
        versions = (numba.__version__, llvmlite.__version__, sys.version_info[:2], getattr(sys, "abiflags", ""))
        place = (function.__module__, function.__qualname__, function.__code__.co_firstlineno)
        values = dumps([cell.cell_contents for cell in function.__closure__ or ()])
        decided_by = repr((self._stamp, *versions, *place, values, signature, codegen.magic_tuple()))
        return f"{function.__name__}-{hashlib.sha256(decided_by.encode()).hexdigest()[:32]}"

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        target_context.refresh()
        name = self._name(sig, target_context.codegen())
        stored = load_data(name, lambda data: CompileResult._rebuild(target_context, *pickle.loads(data)))  # noqa: S301
        if stored is None:  # then numba compiles the function
            announce_compilation(self._function.__module__)
        return stored

    def save_overload(self, sig: Any, data: Any) -> None:
        if data.library.has_dynamic_globals or " at 0x" in repr(sig):  # addresses in this process
            return
        try:
            content = data._reduce()
        except RuntimeError:  # no machine code: Ctrl-C came while LLVM called Python, which then only prints it
            raise KeyboardInterrupt from None
        save_data(self._name(sig, data.codegen), dumps(content))


def _compile(function: Function, **options: Any) -> Function:
    compiled: Function = numba.njit(
        nogil=True, error_model="numpy", boundscheck=False, no_cfunc_wrapper=True, _nrt=False, **options
    )(function)
    if _source(Path(function.__code__.co_filename)):  # not typed at a prompt
        compiled._cache = _Cache(function)  # type: ignore[attr-defined]
    return compiled


class _PartLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code of a part of other kernels. They contain it and optimise it, so it is not optimised alone."""

    def _optimize_final_module(self) -> None:
        pass


class _PartCompiler(Compiler):  # type: ignore[misc]
    """Numba's compiler, with a ``_PartLibrary``."""

    def compile_extra(self, function: Callable[..., Any]) -> CompileResult:
        self.state.library = _PartLibrary(self.state.targetctx.codegen(), function.__qualname__)
        self.state.library.enable_object_caching()
        return super().compile_extra(function)


def kernel(function: Function) -> Function:
    """Compile a function that is inlined in every kernel that calls it. It is slow if Python code calls it."""
    return _compile(function, forceinline=True, pipeline_class=_PartCompiler)


def part(function: Function) -> Function:
    """Compile a function as ``kernel`` does, but without inlining it: for long functions with several callers."""
    return _compile(function, pipeline_class=_PartCompiler)


def large(function: Function) -> Function:
    """Compile a function that Python code calls. Kernels may call it, too."""
    return _compile(function)


@cache
def stamp_of(file: str) -> str:
    """Digest of all source files (names and texts) on which the machine code of the kernels in ``file`` depends."""
    folders, kernel_files = [Path(file).parent], set()
    for folder in folders:  # the loop appends to this list
        for path in folder.glob("*.py"):
            if _MARK in _source(path):
                kernel_files.add(path)
                imported = [PACKAGE / "extensions" / name.decode() for name in _EXTENSION.findall(_source(path))]
                folders += [extension for extension in dict.fromkeys(imported) if extension not in folders]
    core = {path for name in SOURCES for path in (PACKAGE / name).glob("*.py")}
    sources = {Path(file)} | kernel_files | core
    digests = sorted(hashlib.sha256(path.name.encode() + _source(path)).digest() for path in sources)
    return hashlib.sha256(b"".join(digests)).hexdigest()


@cache
def _source(path: Path) -> bytes:
    """Content of a source file; empty if the file does not exist or cannot be read."""
    return path.read_bytes() if path.is_file() and os.access(path, os.R_OK) else b""
