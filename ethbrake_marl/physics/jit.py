"""The one way in which this package compiles a kernel: strict floating point, kept safely for later processes.

numba's own cache goes by a function's own file: editing a *callee* in another file would silently keep the stale
machine code; and its index, which is read, changed and written back, is not safe where processes share a folder.

Here each kernel and signature has one file, named by all that makes it: a hash of the sources, of the versions, of the
signature and of the processor, and nothing of where the package lies. An edit compiles anew what can call it, and a
second environment or a moved checkout finds what the first one compiled. There is no index. A file is written under
another name and renamed when it is whole, so any number of processes may share a folder.
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

_KNOWN = numba.__version__.startswith("0.68.")  # of others these inner parts were not tried: numba goes its own way

_SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO_DEFAULT")  # numba's, of the code made

_PACKAGE = Path(__file__).resolve().parents[1]

_MARK = b"\n@compiled"  # of a decorator, at the start of its line

_IMPORT = re.compile(rb"^ *from (ethbrake_marl[.\w]*) import (\([^)]*\)|.*)$", re.MULTILINE)

_CONSTANT = re.compile(r"\b[A-Z][A-Z0-9_]*\b")

_DIGEST_BYTES = 32

_LONGEST_WAIT_S = 600.0  # for another process that compiles the same kernel: it may have been stopped

_UNKEPT = "each process compiles for itself; set the clock, or their dates (find FOLDER -exec touch {} +)"

_IMPORTED_S = time.time()

_loaded: list[str] = []


class _Linkable(JITCodeLibrary):  # type: ignore[misc]
    """The code of a kernel for those that call it, which make it a part of theirs: no machine code is made of it."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """A compiled function as numba's ``njit`` makes it, but for where its code is kept, and for what is not compiled.

    numba makes machine code, and two wrappers, of whatever one compiled function calls of others, though the caller
    holds all of that code already; and it compiles once for each whole number that stands as an argument in a source.
    """

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self._compiler._customize_flags = _without_c_wrapper
        self._linked: dict[tuple[Any, ...], Any] = {}  # types of the arguments -> signature, library, environments

    def compile(self, sig: Any) -> Any:
        """The machine code for one signature: at hand, loaded, or compiled and kept."""
        with global_compiler_lock:
            arguments, returned = normalize_signature(sig)
            if tuple(arguments) not in self.overloads:
                self._obtain("entry", (*arguments, returned), lambda: self._compile(sig), self._load)
            return self.overloads[tuple(arguments)].entry_point

    def _compile(self, sig: Any) -> Any:
        tell_compilation(not _loaded)
        super().compile(sig)
        made = self.overloads[tuple(normalize_signature(sig)[0])]
        if not _KNOWN:
            return made.library.has_dynamic_globals, made._reduce()
        library = made.library
        for environment in made._find_referenced_environments():  # of what it has linked: its own is set
            library.codegen.set_env(environment.env_name, environment)
        parts = list(made._replace(type_annotation="")._reduce())
        stub = "".join(f'define void @"{name}"() {{ ret void }}\n' for name in _symbols(library))
        parts[0] = (library.name, "object", (parts[0][2][0], parse_assembly(stub).as_bitcode()))
        return library.has_dynamic_globals, parts

    def _load(self, *parts: Any) -> None:
        self.targetctx.refresh()
        made = CompileResult._rebuild(self.targetctx, *parts)
        self.targetctx.insert_user_function(made.entry_point, made.fndesc, [made.library])
        self.add_overload(made)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What another kernel that calls this one needs to know of it."""
        if not _KNOWN:
            return super().get_call_template(args, kws)
        pysig, folded = self._compiler.fold_argument_types(args, kws)
        arguments = tuple(unliteral(kind) for kind in folded)
        if arguments not in self._linked:
            self._obtain("linked", arguments, lambda: self._compile_linked(arguments), self._load_linked)
        signatures = [signature for signature, *_ in self._linked.values()]
        return make_concrete_template(self.__name__, self.__name__, signatures), pysig, arguments, {}

    def get_overload(self, sig: Any) -> Any:
        """By what the code for a signature is known to numba."""
        return self._linked[tuple(normalize_signature(sig)[0])][1] if _KNOWN else super().get_overload(sig)

    def _compile_linked(self, arguments: tuple[Any, ...]) -> Any:
        flags = Flags()
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        library = _Linkable(self.targetctx.codegen(), self.__qualname__)
        with self._compiling_counter:
            made = compile_extra(
                self.typingctx, self.targetctx, self.py_func, arguments, None, flags, self.locals, library=library
            )
        self._link(made.signature, made.fndesc, library, made.environment)
        made.fndesc.typemap = made.fndesc.calltypes = None
        library._ensure_finalized()
        bitcode = library._final_module.as_bitcode()
        environments = [made.environment, *made._find_referenced_environments()]
        return library.has_dynamic_globals, (made.signature, made.fndesc, library.name, bitcode, environments)

    def _load_linked(self, signature: Any, fndesc: Any, name: str, bitcode: bytes, environments: Any) -> None:
        self.targetctx.refresh()
        library = _Linkable(self.targetctx.codegen(), name)
        library._final_module, library._finalized = parse_bitcode(bitcode), True
        self._link(signature, fndesc, library, environments)

    def _link(self, signature: Any, fndesc: Any, library: _Linkable, environments: Any) -> None:
        self.targetctx.insert_user_function(library, fndesc, [library])
        self._linked[signature.args] = signature, library, environments

    def _obtain(self, way: str, kinds: tuple[Any, ...], make: Callable[[], Any], load: Callable[..., None]) -> None:
        """Load what is kept under this name, or make and keep it, while no other process does."""
        name = self._name(way, kinds)
        kept = load_kernel(name)
        if kept is None:
            with _alone(name):
                kept = load_kernel(name)  # another process may have made it meanwhile
                if kept is None:
                    unkept, made = make()
                    if name and not unkept:
                        keep_kernel(name, dumps(made))
                    return
        load(*pickle.loads(kept))

    def _name(self, way: str, kinds: tuple[Any, ...]) -> str:
        """Name of a signature's file in the store; empty where not all that makes the code is known."""
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
    """Python calls these functions, other kernels do, and nothing written in C."""
    flags.no_cfunc_wrapper = _KNOWN
    return flags


def _symbols(library: Any) -> list[str]:
    """Names of what a library defines for callers from outside."""
    return [function.name for function in library._final_module.functions if function.name.startswith("_ZN7cpython")]


def _described(kind: Any) -> str:
    """A type with the names of the fields that it and its parts have: of a named tuple numba's own name has none."""
    parts = [_described(part) for part in getattr(kind, "types", ())]
    return f"{kind} {getattr(kind, 'fields', '')} {parts}"


def load_kernel(name: str) -> bytes | None:
    """What was kept under a name; nothing where it is missing, damaged, or not this user's or root's.

    Who else could write there could have us run anything.
    """
    try:
        with (cache_folder() / name).open("rb") as file:
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
def _alone(name: str) -> Iterator[None]:
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
        digest.update(f"{_place_of(file)} {file.stat().st_size} ".encode() + file.read_bytes())
    return digest.hexdigest() if source.is_file() else ""


def _place_of(file: Path) -> str:
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
        for imported, taken in _homes(module.decode(), set(re.findall(r"\w+", names.decode()))):
            has_kernels = _MARK in imported.read_bytes()
            if has_kernels or any(_CONSTANT.fullmatch(name) for name in taken):
                found.append((imported, has_kernels))
    return found


def _homes(module: str, names: set[str]) -> list[tuple[Path, set[str]]]:
    """(file, names taken from it) for names of a module or, through its front door, of a folder."""
    place = _PACKAGE.joinpath(*module.split(".")[1:])
    if place.with_suffix(".py").is_file():
        return [(place.with_suffix(".py"), names)]
    found = [(place / f"{name}.py", set[str]()) for name in names if (place / f"{name}.py").is_file()]
    for home, offered in _IMPORT.findall((place / "__init__.py").read_bytes()):
        if taken := names & set(re.findall(r"\w+", offered.decode())):
            found += _homes(home.decode(), taken)
    return found


@overload
def compiled(function: Function) -> Function: ...


@overload
def compiled(*, apart: bool = False, within: bool = False, bare: bool = False) -> Callable[[Function], Function]: ...


def compiled(function: Any = None, *, apart: bool = False, within: bool = False, bare: bool = False) -> Any:
    """Compile a function with numba: no fast-math, no bounds checks, releases the GIL, cached on disk.

    What a kernel calls becomes part of it (``forceinline``): a call would count references to its arrays, atomically,
    which cost more than half of the physics. ``apart``: calls of it stay calls, for what is large, shared, and seldom
    called. Made part of every caller, such functions would be compiled once for each: minutes instead of seconds.

    ``within``: it is written into its callers before they are compiled, for a level of its own. ``forceinline`` still
    counts references at each level through which an array is handed on; this does not.

    ``bare``: without any counting of references, for what makes no array and gives none back. Whoever calls it holds
    the arrays. What is ``forceinline`` inside still counts them, unless it is bare, too.
    """
    if function is None:
        return partial(compiled, apart=apart, within=within, bare=bare)
    config: Any = numba_config  # its settings are made at run time
    if config.DISABLE_JIT:
        return function
    how: dict[str, Any] = {"inline": "always"} if within else {"forceinline": not apart}
    if bare:
        how["_nrt"] = False
    return Kernel(function, targetoptions=_OPTIONS | how)


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
