"""The one way in which this package compiles a kernel: strict floating point, kept safely by ``kernel_store``.

numba's own cache goes by a function's own file: editing a *callee* in another file would silently keep the stale
machine code; and its index, which is read, changed and written back, is not safe where processes share a folder.
"""

from __future__ import annotations

import hashlib
import pickle
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from types import CodeType
from typing import Any, TypeVar, cast

import llvmlite
import numba
from numba.core import config as numba_config
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature

from ethbrake_marl.errors import check_whole_number
from ethbrake_marl.kernel_store import (
    alone,
    digest_of_sources,
    keep_kernel,
    load_kernel,
    place_of,
    tell_compilation,
)

Function = TypeVar("Function", bound=Callable[..., Any])
_OPTIONS = {"nopython": True, "boundscheck": None, "fastmath": False, "nogil": True, "error_model": "numpy"}
_SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO_DEFAULT")  # numba's, of the code made


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """A compiled function as numba's ``njit`` makes it, but for where its code is kept."""

    def compile(self, sig: Any) -> Any:
        """The code for one signature: at hand, loaded, or compiled and kept."""
        with global_compiler_lock:
            arguments, returned = normalize_signature(sig)
            name = "" if tuple(arguments) in self.overloads else self._name(*arguments, returned)
            if not name:
                return super().compile(sig)
            if not self._load(name):
                tell_compilation()
                with alone(name):
                    if not self._load(name):  # another process may have compiled it meanwhile
                        super().compile(sig)
                        made = self.overloads[tuple(arguments)]
                        if not made.library.has_dynamic_globals:
                            keep_kernel(name, dumps(made._reduce()))
            return self.overloads[tuple(arguments)].entry_point

    def _name(self, *types: Any) -> str:
        """Name of a signature's file in the store; empty where not all that makes the code is known."""
        code, source = self.py_func.__code__, Path(self.py_func.__code__.co_filename)
        digest = digest_of_sources(source)
        if not digest or self.py_func.__closure__:
            return ""
        made_of = (
            (sys.implementation.cache_tag, sys.flags.optimize, numba.__version__, llvmlite.__version__),
            [str(getattr(numba_config, setting)) for setting in _SETTINGS],
            self.targetctx.codegen().magic_tuple(),
            (digest, place_of(source), self.__module__, self.__qualname__, code.co_firstlineno, code.co_code),
            [constant for constant in code.co_consts if not isinstance(constant, CodeType)],
            sorted(self.targetoptions.items()),
            [_described(kind) for kind in types],
        )
        return f"{self.__name__.strip('<>')}-{hashlib.sha256(repr(made_of).encode()).hexdigest()[:40]}"

    def _load(self, name: str) -> bool:
        """Whether the store had it."""
        kept = load_kernel(name)
        if kept is not None:
            self.targetctx.refresh()
            made = CompileResult._rebuild(self.targetctx, *pickle.loads(kept))
            self.targetctx.insert_user_function(made.entry_point, made.fndesc, [made.library])
            self.add_overload(made)
        return kept is not None


def _described(kind: Any) -> str:
    """A type with the names of the fields that it and its parts have: of a named tuple numba's own name has none."""
    parts = [_described(part) for part in getattr(kind, "types", ())]
    return f"{kind} {getattr(kind, 'fields', '')} {parts}"


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
    if config.DISABLE_JIT:
        return function
    how: dict[str, Any] = {"inline": "always"} if within else {"forceinline": inline}
    if bare:
        how["_nrt"] = False
    return cast(Function, Kernel(function, targetoptions=_OPTIONS | how))


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
