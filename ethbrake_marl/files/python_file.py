"""Run Python files of the user, and record their SHA-256.

A Python file runs only if the user names it on the command line (``--agents my_file.py:make_agent``) or in code. A
Python file named only by a run's folder, a recipe or a scenario is never run.
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

_RUN: dict[Path, tuple[str, ModuleType]] = {}  # SHA-256 and module of each Python file that this process ran

_BEING_RUN: set[Path] = set()  # Python files that are running now

_READ: dict[str, set[str]] = {}  # SHA-256 of the other files that Python files read, by file name


def load_from_file(path: str, name: str, reads: str | None = None) -> Any:
    """Run a Python file, once per process, and return the object ``name`` that it defines.

    The code runs without restrictions. ``reads`` is the path of a file that the Python file uses, such as weights; its
    SHA-256 is recorded if it exists. Raises ``InvalidInput`` if the Python file is missing, raises an error (the
    message gives the line number), has changed since it ran, or does not define ``name``.
    """
    _, module = _run_file(Path(path).expanduser(), f"file {path!r}")
    if not hasattr(module, name):
        raise InvalidInput(
            f"file {path!r}: does not define {name!r}; write FILE.py:NAME with a name that the file defines"
        )
    if reads is not None and Path(reads).is_file():
        _READ.setdefault(Path(reads).name, set()).add(file_sha256(Path(reads)))
    return getattr(module, name)


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def files_run() -> dict[str, str]:
    """Return the SHA-256 of every Python file that this process ran, and of the files that they use, by file name.

    If several files have the same name, the value is a text with all their hashes, separated by commas.
    """
    files = {name: set(several) for name, several in _READ.items()}
    for path, (sha256, _) in _RUN.items():
        files.setdefault(path.name, set()).add(sha256)
    return {name: ", ".join(sorted(several)) for name, several in files.items()}


def _run_file(path: Path, what: str) -> tuple[str, ModuleType]:
    """Return SHA-256 and module of a Python file; run the file unless this process has run it already.

    ``what`` is how error messages name the file.
    """
    if not path.is_file():
        raise InvalidInput(f"{what}: {'is not a plain file' if path.exists() else 'does not exist'}")
    content = read_plain(path, _LIMIT_BYTES)
    sha256, resolved = hashlib.sha256(content).hexdigest(), path.resolve()
    if resolved not in _RUN:
        _RUN[resolved] = sha256, _run(content, resolved, sha256, what)
    if _RUN[resolved][0] != sha256:
        raise InvalidInput(f"{what}: has changed since it was loaded; start a new Python process")
    return _RUN[resolved]


def _run(content: bytes, path: Path, sha256: str, what: str) -> ModuleType:
    """Run the content of a Python file as a new module, in ``sys.modules`` so that its classes can be pickled."""
    module = ModuleType(f"ethbrake_file_{path.stem}_{sha256[:12]}")
    module.__file__ = str(path)
    if path in _BEING_RUN:
        raise InvalidInput(f"{what}: loads itself")
    _BEING_RUN.add(path)
    sys.modules[module.__name__] = module
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # the file may import its neighbours, as where Python itself runs it
    try:
        exec(compile(content, str(path), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[module.__name__]
        raise InvalidInput(f"{what}, {describe_error(error, str(path))}") from error
    finally:
        _BEING_RUN.discard(path)
    return module
