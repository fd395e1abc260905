"""The decorator ``compiled``, which compiles functions with strict floating point and caches the machine code on disk.

A compiled function is called a *kernel*. Numba's own cache has two problems. First, it checks only the file that
contains the kernel: if a kernel calls a function of another file and this file is edited, numba still uses the old
machine code. Second, each process reads numba's index file, changes it and writes it back, which is not safe if several
processes share a folder.

The cache of this module has one file for each kernel and signature. The name of the file is a hash of everything that
determines the machine code: sources, versions, signature and processor, but not the folder of the package. After an
edit, only the kernels that may use the edited code are compiled again. A second Python environment, or a copy of the
package in another folder, reuses the existing files. A file is written under a temporary name and renamed when it is
complete, so any number of processes may share a folder.

An argument ``way`` is ``"entry"`` for a kernel called from Python, ``"linked"`` for a kernel called from other kernels.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from types import CodeType
from typing import Any, TypeVar, overload

import llvmlite
import numba
from llvmlite.binding import parse_assembly, parse_bitcode
from numba.core import config as numba_config
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompileResult, Flags, compile_extra
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from numba.core.types.misc import unliteral
from numba.core.typing import make_concrete_template

from ethbrake_marl.errors import check_whole_number
from ethbrake_marl.kernel_store import cache_folder, tell_compilation

Function = TypeVar("Function", bound=Callable[..., Any])

_OPTIONS = {"nopython": True, "boundscheck": None, "fastmath": False, "nogil": True, "error_model": "numpy"}

_KNOWN = numba.__version__.startswith("0.68.")  # other versions are untested with numba's internals: use plain numba

_SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO_DEFAULT")  # change the code

_PACKAGE = Path(__file__).resolve().parents[2]

_MARK = b"\n@compiled"  # the decorator at the start of a line

_IMPORT = re.compile(rb"^ *from (ethbrake_marl[.\w]*) import (\([^)]*\)|.*)$", re.MULTILINE)

_CONSTANT = re.compile(r"\b[A-Z][A-Z0-9_]*\b")

_DIGEST_BYTES = 32

_LONGEST_WAIT_S = 600.0  # for another process that compiles the same kernel


_IMPORTED_S = time.time()

_loaded: list[str] = []


class _Linkable(JITCodeLibrary):  # type: ignore[misc]
    """Code of a kernel that is only inlined into its callers, so numba generates no machine code for it alone."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """A compiled function, like the result of numba's ``njit``, that uses the cache of this module and compiles faster.

    If one compiled function calls another, numba generates machine code and two wrappers for the called function,
    although the caller already contains the code of the called function. Numba also compiles a function again for each
    integer literal that is passed as an argument. This class avoids both.
    """

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self._compiler._customize_flags = _without_c_wrapper
        self._linked: dict[tuple[Any, ...], Any] = {}  # types of the arguments -> signature, library, environments

    def compile(self, sig: Any) -> Any:
        """Load or compile the machine code for one numba signature ``sig``, and return its entry point."""
        with global_compiler_lock:
            arguments, returned = normalize_signature(sig)
            if tuple(arguments) not in self.overloads:
                self._obtain("entry", (*arguments, returned), lambda: self._compile(sig), self._load)
            return self.overloads[tuple(arguments)].entry_point

    def _compile(self, sig: Any) -> Any:
        tell_compilation(not _loaded)
        super().compile(sig)
        compiled = self.overloads[tuple(normalize_signature(sig)[0])]
        if not _KNOWN:
            return compiled.library.has_dynamic_globals, compiled._reduce()
        library = compiled.library
        for environment in compiled._find_referenced_environments():  # of the linked callees; its own is set already
            library.codegen.set_env(environment.env_name, environment)
        parts = list(compiled._replace(type_annotation="")._reduce())
        stub = "".join(f'define void @"{name}"() {{ ret void }}\n' for name in _symbols(library))
        parts[0] = (library.name, "object", (parts[0][2][0], parse_assembly(stub).as_bitcode()))
        return library.has_dynamic_globals, parts

    def _load(self, *parts: Any) -> None:
        self.targetctx.refresh()
        compiled = CompileResult._rebuild(self.targetctx, *parts)
        self.targetctx.insert_user_function(compiled.entry_point, compiled.fndesc, [compiled.library])
        self.add_overload(compiled)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the template with which numba determines the types when another kernel calls this kernel.

        This method is part of numba's protocol for dispatchers. ``args`` and ``kws`` are the numba types of the
        positional and keyword arguments of the call.
        """
        if not _KNOWN:
            return super().get_call_template(args, kws)
        pysig, folded = self._compiler.fold_argument_types(args, kws)
        arguments = tuple(unliteral(kind) for kind in folded)
        if arguments not in self._linked:
            self._obtain("linked", arguments, lambda: self._compile_linked(arguments), self._load_linked)
        signatures = [signature for signature, *_ in self._linked.values()]
        return make_concrete_template(self.__name__, self.__name__, signatures), pysig, arguments, {}

    def get_overload(self, sig: Any) -> Any:
        """Return the key under which numba stores the code for the signature ``sig`` (part of numba's protocol)."""
        return self._linked[tuple(normalize_signature(sig)[0])][1] if _KNOWN else super().get_overload(sig)

    def _compile_linked(self, arguments: tuple[Any, ...]) -> Any:
        flags = Flags()
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        library = _Linkable(self.targetctx.codegen(), self.__qualname__)
        with self._compiling_counter:
            compiled = compile_extra(
                self.typingctx, self.targetctx, self.py_func, arguments, None, flags, self.locals, library=library
            )
        self._link(compiled.signature, compiled.fndesc, library, compiled.environment)
        compiled.fndesc.typemap = compiled.fndesc.calltypes = None
        library._ensure_finalized()
        bitcode = library._final_module.as_bitcode()
        environments = [compiled.environment, *compiled._find_referenced_environments()]
        return library.has_dynamic_globals, (compiled.signature, compiled.fndesc, library.name, bitcode, environments)

    def _load_linked(self, signature: Any, fndesc: Any, name: str, bitcode: bytes, environments: Any) -> None:
        self.targetctx.refresh()
        library = _Linkable(self.targetctx.codegen(), name)
        library._final_module, library._finalized = parse_bitcode(bitcode), True
        self._link(signature, fndesc, library, environments)

    def _link(self, signature: Any, fndesc: Any, library: _Linkable, environments: Any) -> None:
        self.targetctx.insert_user_function(library, fndesc, [library])
        self._linked[signature.args] = signature, library, environments

    def _obtain(self, way: str, kinds: tuple[Any, ...], make: Callable[[], Any], load: Callable[..., None]) -> None:
        """Load a kernel from the cache, or compile and cache it while other processes wait for the same kernel.

        ``kinds`` are the numba types of the arguments; for an ``"entry"``, also the type of the result. ``make``
        compiles the kernel and returns two values: True if the kernel must not be cached, and the compiled code as
        objects that can be pickled. ``load`` makes a kernel in this process from this code.
        """
        name = self._name(way, kinds)
        stored = load_kernel(name)
        if stored is None:
            with _alone(name):
                stored = load_kernel(name)  # another process may have compiled it meanwhile
                if stored is None:
                    unkept, compiled = make()
                    if name and not unkept:
                        keep_kernel(name, dumps(compiled))
                    return
        load(*pickle.loads(stored))

    def _name(self, way: str, kinds: tuple[Any, ...]) -> str:
        """Return the cache file name for argument types ``kinds``; empty if the kernel must not be cached.

        A kernel must not be cached if its source files have no valid hash (``digest_of_sources``), or if it is a
        closure.
        """
        code, source = self.py_func.__code__, Path(self.py_func.__code__.co_filename)
        digest, own = digest_of_sources(source), digest_of_sources(Path(__file__))
        if not digest or not own or self.py_func.__closure__:
            return ""
        made_of = (
            (way, sys.implementation.cache_tag, sys.flags.optimize, numba.__version__, llvmlite.__version__),
            [str(getattr(numba_config, setting)) for setting in _SETTINGS],
            self.targetctx.codegen().magic_tuple(),
            (own, digest, _place_of(source), self.__module__, self.__qualname__, code.co_firstlineno, code.co_code),
            [constant for constant in code.co_consts if not isinstance(constant, CodeType)],
            sorted(self.targetoptions.items()),
            [_described(kind) for kind in kinds],
        )
        return f"{self.__name__.strip('<>')}-{hashlib.sha256(repr(made_of).encode()).hexdigest()[:40]}.{way}"


def _without_c_wrapper(flags: Any) -> Any:
    """Change numba's compiler ``flags`` so that kernels get no C wrapper, because no C code calls kernels."""
    flags.no_cfunc_wrapper = _KNOWN
    return flags


def _symbols(library: Any) -> list[str]:
    """Return the names of the functions in ``library`` (numba's code of one kernel) that other kernels can call."""
    return [function.name for function in library._final_module.functions if function.name.startswith("_ZN7cpython")]


def _described(kind: Any) -> str:
    """Return a text for the numba type ``kind`` with the field names of named tuples, which numba's own text omits."""
    parts = [_described(part) for part in getattr(kind, "types", ())]
    return f"{kind} {getattr(kind, 'fields', '')} {parts}"


def load_kernel(name: str) -> bytes | None:
    """Return the content of the cache file ``name`` (as ``keep_kernel`` wrote it); None if the file cannot be used.

    A file cannot be used if it is missing or damaged, or if its owner is neither this user nor root. The owner is
    checked because the cached code is executed.
    """
    try:
        with (cache_folder() / name).open("rb") as file:
            about, content = os.fstat(file.fileno()), file.read()
    except OSError:
        return None
    digest, stored = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    trusted = not hasattr(os, "getuid") or about.st_uid in (0, os.getuid())
    if not trusted or _digest_of(name, stored) != digest:
        return None
    _loaded.append(name)
    return stored


def keep_kernel(name: str, content: bytes) -> None:
    """Write ``content`` to the cache file ``name`` for ``load_kernel``; warn if this fails (for example, disk full)."""
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
        warnings.warn(f"{folder}: compiled code could not be written to this folder: {error}", stacklevel=2)


def _digest_of(name: str, content: bytes) -> bytes:
    return hashlib.sha256(name.encode() + content).digest()


@contextmanager
def _alone(name: str) -> Iterator[None]:
    """Context manager: hold a lock on the cache file ``name`` against other processes, if the file system can lock."""
    if not name:
        yield
        return
    from filelock import FileLock, Timeout  # imported here because only compiling needs it

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
def digest_of_sources(source: Path) -> str:
    """Return a hash of all files that determine the kernels in the file ``source``; empty if there is no valid hash.

    There is no valid hash if the code is not in a file (for example, typed in an interactive shell), or if one of the
    files was edited after this process started, because the process may have imported the older version. A file with a
    date in the future is treated as edited, and the function warns.
    """
    digest = hashlib.sha256()
    for file in kernel_sources(source) if source.is_file() else ():
        written_s = file.stat().st_mtime
        if written_s > time.time():
            warnings.warn(
                f"{_PACKAGE}: a file in this folder has a date in the future, so each process compiles the physics"
                " again; correct the clock of this machine, or the dates of the files (find FOLDER -exec touch {} +)",
                stacklevel=2,
            )
        if written_s > _IMPORTED_S:
            return ""
        digest.update(f"{_place_of(file)} {file.stat().st_size} ".encode() + file.read_bytes())
    return digest.hexdigest() if source.is_file() else ""


def _place_of(file: Path) -> str:
    """Return the path of ``file`` relative to this package's folder, or the full path of a file outside this folder."""
    return file.relative_to(_PACKAGE).as_posix() if file.is_relative_to(_PACKAGE) else str(file)


def kernel_sources(source: Path) -> list[Path]:
    """Return ``source`` and all other files of this package whose code its kernels may contain, sorted by name.

    A file with kernels is in the result if ``source`` imports it, directly or through other files with kernels. A file
    without kernels is in the result if ``source``, or a file with kernels in the result, imports a constant (a name in
    capitals) from it.
    """
    sources, follow = {source}, [source]
    while follow:
        for imported, has_kernels in _imports(follow.pop()):
            if imported not in sources:
                sources.add(imported)
                follow += [imported] * has_kernels
    return sorted(sources)


@cache
def _imports(source: Path) -> list[tuple[Path, bool]]:
    """Return the files from which ``source`` imports kernels or constants, as pairs (file, True if it has kernels)."""
    modules = []
    for module, names in _IMPORT.findall(source.read_bytes()):
        for imported, taken in _homes(module.decode(), set(re.findall(r"\w+", names.decode()))):
            has_kernels = _MARK in imported.read_bytes()
            if has_kernels or any(_CONSTANT.fullmatch(name) for name in taken):
                modules.append((imported, has_kernels))
    return modules


def _homes(module: str, names: set[str]) -> list[tuple[Path, set[str]]]:
    """Return the files that define the imported ``names``, as pairs (file, names that this file defines).

    ``module`` is the name after ``from`` in the import statement: a module, or a folder whose ``__init__`` imports the
    names from other modules.
    """
    place = _PACKAGE.joinpath(*module.split(".")[1:])
    if place.with_suffix(".py").is_file():
        return [(place.with_suffix(".py"), names)]
    files = [(place / f"{name}.py", set[str]()) for name in names if (place / f"{name}.py").is_file()]
    for home, offered in _IMPORT.findall((place / "__init__.py").read_bytes()):
        if taken := names & set(re.findall(r"\w+", offered.decode())):
            files += _homes(home.decode(), taken)
    return files


@overload
def compiled(function: Function) -> Function: ...


@overload
def compiled(*, apart: bool = False, within: bool = False, bare: bool = False) -> Callable[[Function], Function]: ...


def compiled(function: Any = None, *, apart: bool = False, within: bool = False, bare: bool = False) -> Any:
    """Compile a function with numba: no fast-math, no bounds checks, no GIL, cached on disk.

    By default a kernel is inlined into its callers (numba's option ``forceinline``). If a call is not inlined, numba
    counts the references to its arrays with atomic operations, which takes more than half as long as the physics
    itself.

    Args:
        function: the function to compile; None if the decorator is used with arguments.
        apart: if True, do not inline this kernel. Use this option for a large kernel that many kernels call, but
            rarely: inlined, it would be compiled once per caller, which takes minutes instead of seconds.
        within: if True, inline this kernel into the code of its callers before numba compiles them. In contrast to
            ``forceinline``, ``within`` avoids the counting of references in each function that passes an array on.
        bare: if True, compile this kernel without any counting of references. Use this option for kernels that neither
            create nor return arrays. A kernel that is inlined into a bare kernel still counts references unless it is
            bare, too.

    """
    if function is None:
        return partial(compiled, apart=apart, within=within, bare=bare)
    config: Any = numba_config  # its attributes are set at run time
    if config.DISABLE_JIT:
        return function
    how: dict[str, Any] = {"inline": "always"} if within else {"forceinline": not apart}
    if bare:
        how["_nrt"] = False
    return Kernel(function, targetoptions=_OPTIONS | how)


Result = TypeVar("Result")


def by_parts(work: Callable[[slice], Result], n: int, threads: int) -> list[Result]:
    """Call ``work`` for contiguous slices of the rows 0 to n - 1; return the results in the order of the slices.

    There are at most ``threads`` slices, one per thread. The calling thread works on the first slice, so ``threads=1``
    starts no thread. If ``work`` raises errors, the function finishes the other slices and then raises the error of the
    first slice that has one. Raises ``InvalidInput`` unless ``threads`` is a whole number of at least 1.
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
