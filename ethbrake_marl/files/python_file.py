"""Python files of the user's own: run once when a person names one, and remembered with their SHA-256.

Nothing here is found by itself: a file is run because it was named (``--agents my_file.py:make_agent``). What a run's
folder, a recipe or a scenario names is never run.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from ethbrake_marl.errors import InvalidInput, describe_error
from ethbrake_marl.files.plain import read_plain

_LIMIT_BYTES = 1 << 20

_RUN: dict[Path, tuple[str, ModuleType]] = {}  # files of this process, with their SHA-256

_BEING_RUN: set[Path] = set()

_READ: dict[str, set[str]] = {}


def load_from_file(path: str, name: str, reads: str | None = None) -> Any:
    """What a Python file calls by this name. The file is run, once, and can do whatever you can do.

    Of the file that it ``reads``, such as weights, the SHA-256 is remembered; nothing of what is no file. Raises
    ``InvalidInput`` for a file that is missing, that raises (naming its line), that was changed since it was run, or
    that has no such name.
    """
    _, module = _run_file(Path(path), f"file {path!r}")
    if not hasattr(module, name):
        raise InvalidInput(f"file {path!r}: has no {name!r}; name what it defines: {path}:NAME")
    if reads is not None and Path(reads).is_file():
        _READ.setdefault(Path(reads).name, set()).add(file_sha256(Path(reads)))
    return getattr(module, name)


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_run() -> dict[str, str]:
    """Name -> SHA-256 of every file that this process ran, and of every file that was named for an agent.

    Of all of that name, where there are several.
    """
    found = {name: set(several) for name, several in _READ.items()}
    for path, (sha256, _) in _RUN.items():
        found.setdefault(path.name, set()).add(sha256)
    return {name: ", ".join(sorted(several)) for name, several in found.items()}


def _run_file(path: Path, what: str) -> tuple[str, ModuleType]:
    """SHA-256 and module of a file; run now unless it was run before."""
    if not path.is_file():
        raise InvalidInput(f"{what}: {'is not a plain file' if path.exists() else 'there is no such file'}")
    content = read_plain(path, _LIMIT_BYTES)
    sha256, resolved = hashlib.sha256(content).hexdigest(), path.resolve()
    if resolved not in _RUN:
        _RUN[resolved] = sha256, _run(content, resolved, sha256, what)
    if _RUN[resolved][0] != sha256:
        raise InvalidInput(f"{what}: was changed since it was loaded; begin a new process")
    return _RUN[resolved]


def _run(content: bytes, path: Path, sha256: str, what: str) -> ModuleType:
    """Run the content of a file as a module, which classes of it are pickled by."""
    module = ModuleType(f"ethbrake_file_{path.stem}_{sha256[:12]}")
    module.__file__ = str(path)
    if path in _BEING_RUN:
        raise InvalidInput(f"{what}: loads itself")
    _BEING_RUN.add(path)
    sys.modules[module.__name__] = module
    try:
        exec(compile(content, str(path), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        raise InvalidInput(f"{what}, {describe_error(error, str(path))}") from error
    finally:
        _BEING_RUN.discard(path)
    return module
