"""Runs the user's Python files, and records their SHA-256.

A file runs only if the user names it in code or on the command line (``--agents my_file.py:make_agent``, ``--load
my_file.py``), never because of a run's folder, a recipe or a scenario.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from ethbrake_marl.errors import InvalidInput, describe_error
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.parallel import PREPARATIONS

_LIMIT_BYTES = 1 << 20

_RUN: dict[Path, ModuleType] = {}  # module of each Python file that this process ran

_SHA256: dict[Path, str] = {}  # of each Python file, and of the files that they use


def load_file(path: str) -> None:
    """Run a Python file that registers components, also in every process that ``parallel`` starts from now on."""
    run_file(path)
    whole_path = str(Path(path).expanduser().resolve())
    PREPARATIONS[whole_path] = (run_file, whole_path)


def loaded_files() -> list[str]:
    return [path for path, (function, *_) in PREPARATIONS.items() if function is run_file]


def load_from_file(path: str, name: str, reads: str | None = None) -> Any:
    """``reads``: another file that the code uses, such as weights; its SHA-256 is recorded, too. Raises
    ``InvalidInput`` also if the file does not define ``name``.
    """
    module = run_file(path)
    if not hasattr(module, name):
        raise InvalidInput(
            f"file {path!r}: does not define {name!r}; write FILE.py:NAME with a name that the file defines"
        )
    if reads is not None and Path(reads).is_file():
        with Path(reads).open("rb") as file:
            _SHA256[Path(reads).resolve()] = hashlib.file_digest(file, "sha256").hexdigest()
    return getattr(module, name)


def files_run() -> dict[str, str]:
    """SHA-256 of every Python file that this process ran, and of the files that they use: file name -> hash."""
    names = dict.fromkeys(path.name for path in _SHA256)
    return {name: ", ".join(sorted({sha for path, sha in _SHA256.items() if path.name == name})) for name in names}


def run_file(file: str) -> ModuleType:
    """The file runs once per process, and its code has all rights of the user.

    Raises ``InvalidInput`` if the file is missing, fails, or has changed since it ran.
    """
    path, what = Path(file).expanduser(), f"file {file!r}"
    if not path.is_file():
        raise InvalidInput(f"{what}: {'is not a plain file' if path.exists() else 'does not exist'}")
    content, path = read_plain(path, _LIMIT_BYTES), path.resolve()
    sha256 = hashlib.sha256(content).hexdigest()
    if path not in _RUN:
        _SHA256[path] = sha256
        _run(content, path, sha256, what)
    if _SHA256[path] != sha256:
        raise InvalidInput(f"{what}: has changed since it was loaded; start a new Python process")
    return _RUN[path]


def _run(content: bytes, path: Path, sha256: str, what: str) -> None:
    """Raises ``InvalidInput`` if the code fails."""
    module = ModuleType(f"ethbrake_file_{path.stem}_{sha256[:12]}")
    module.__file__ = str(path)
    _RUN[path] = sys.modules[module.__name__] = module
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # the file may import its neighbours, as where Python itself runs it
    try:
        exec(compile(content, str(path), "exec", dont_inherit=True), module.__dict__)
    except (Exception, SystemExit) as error:
        del _RUN[path], sys.modules[module.__name__]
        raise InvalidInput(f"{what}, {describe_error(error, str(path))}") from error
    from cloudpickle import register_pickle_by_value  # slow to import

    register_pickle_by_value(module)
