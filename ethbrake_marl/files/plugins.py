"""Python files of the user's own: run once when a person names them, and remembered with their SHA-256.

Nothing here is found by itself: a file is run because it was named (``--plugin``, ``--agents my_file.py:make_agent``),
a plug-in of an installed distribution because its name was. What a run's folder or a scenario names is never run.
"""

from __future__ import annotations

import hashlib
import os
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from ethbrake_marl.errors import InvalidInput, describe_error, unknown_name
from ethbrake_marl.files.store import read_plain

GROUP = "ethbrake_marl.plugins"  # of entry points
_LIMIT_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Plugin:
    """A plug-in, as ``config.json`` of a run notes it."""

    name: str  # of the file without its folder, or of the entry point
    source: str  # as it was named
    sha256: str  # of the file, or of the file of the entry point's module


_RUN: dict[Path, tuple[str, ModuleType]] = {}  # files of this process, with their SHA-256
_BEING_RUN: set[Path] = set()
_READ: dict[str, set[str]] = {}
_LOADED: dict[str, Plugin] = {}  # by file, or by the entry point's name


def load_plugin(source: str | os.PathLike[str]) -> None:
    """Run a plug-in, once: a Python file that registers agents, reward terms, features, algorithms and so on.

    It can do whatever you can do. ``source`` is a file ``my_file.py``, or the name of an entry point of the group
    ``ethbrake_marl.plugins``. Runs that are trained from then on note it, with its SHA-256, in their ``config.json``.

    Raises ``InvalidInput`` for a file that is missing, that raises (naming its line) or that was changed since it was
    run, ``UnknownName`` for an entry point that no installed distribution has.
    """
    named = os.fspath(source)
    if not named.endswith(".py") and os.sep not in named:
        _load_entry_point(named)
        return
    path = Path(named)
    if path.suffix != ".py":
        raise InvalidInput(f"plug-in {named!r}: must be a Python file (.py), or the name of an installed plug-in")
    sha256, _ = _run_file(path, f"plug-in {named!r}")
    _LOADED.setdefault(str(path.resolve()), Plugin(path.name, named, sha256))


def load_function(path: str, function: str, reads: str | None = None) -> Any:
    """A function of a Python file, which is run, once, and can do whatever you can do.

    Of the file that it ``reads``, such as weights, the SHA-256 is remembered; nothing of what is no file. Raises
    ``InvalidInput`` as ``load_plugin``, and if there is no such function.
    """
    found = getattr(_run_file(Path(path), f"file {path!r}")[1], function, None)
    if not callable(found):
        raise InvalidInput(f"file {path!r}: has no function {function!r}; name the one that makes the agent")
    if reads is not None and Path(reads).is_file():
        with Path(reads).open("rb") as file:
            _READ.setdefault(Path(reads).name, set()).add(hashlib.file_digest(file, "sha256").hexdigest())
    return found


def files_run() -> dict[str, str]:
    """Name -> SHA-256 of every plug-in and agent file of this process, and of every file that was named for an agent.

    Of all of that name, where there are several.
    """
    found = {name: set(several) for name, several in _READ.items()}
    for path, (sha256, _) in _RUN.items():
        found.setdefault(path.name, set()).add(sha256)
    for plugin in _LOADED.values():
        found.setdefault(plugin.name, set()).add(plugin.sha256)
    return {name: ", ".join(sorted(several)) for name, several in found.items()}


def noted_plugins() -> list[dict[str, str]]:
    """The plug-ins of this process in the order in which they were loaded, as ``config.json`` has them."""
    return [asdict(plugin) for plugin in _LOADED.values()]


def load_the_same(noted: list[dict[str, str]]) -> None:
    """Load, in a worker process, what its parent has noted; raises ``InvalidInput`` where a file is another now."""
    for plugin in noted:
        load_plugin(plugin["source"])
    check_plugins(noted, "the process that started this one", "start again")


def check_plugins(noted: object, where: str, advice: str) -> None:
    """Raise ``InvalidInput`` unless the plug-ins of this process are the ``noted`` ones, by their SHA-256.

    ``where`` begins the message, ``advice`` ends it.
    """
    then = _read_noted(noted, where)
    now = {plugin.sha256: plugin for plugin in _LOADED.values()}
    for plugin in then:
        if plugin.sha256 in now:
            continue
        other = next((one for one in now.values() if one.name == plugin.name), None)
        if other is None:
            raise InvalidInput(
                f"{where}: needs the plug-in {plugin.name}, which is not loaded; name it: --plugin {plugin.source}"
                " (in Python: load_plugin)"
            )
        raise InvalidInput(
            f"{where}: the plug-in {plugin.name} was another file then (SHA-256 {plugin.sha256[:12]}..., now"
            f" {other.sha256[:12]}...); put it back as it was, {advice}"
        )
    more = now.keys() - {plugin.sha256 for plugin in then}
    if more:
        names = ", ".join(sorted(now[sha256].source for sha256 in more))
        raise InvalidInput(f"{where}: was made without the plug-in {names}; leave it out, {advice}")


def _read_noted(noted: object, where: str) -> list[Plugin]:
    try:
        if not isinstance(noted, list):
            raise TypeError
        found = [Plugin(**each) for each in noted]
        if not all(isinstance(value, str) for plugin in found for value in asdict(plugin).values()):
            raise TypeError
    except TypeError:
        raise InvalidInput(f"{where}: plugins must be a list of name, source and sha256") from None
    return found


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


def _load_entry_point(name: str) -> None:
    if name in _LOADED:
        return
    found = {point.name: point for point in entry_points(group=GROUP)}
    if name not in found:
        if not found:
            raise InvalidInput(
                f"plug-in {name!r}: must be a Python file (my_file.py), or the name of an installed one; none is"
            )
        raise unknown_name("plug-in", name, found)
    _LOADED[name] = Plugin(name, name, _import(found[name]))


def _import(point: EntryPoint) -> str:
    """Import the module of an entry point; gives the SHA-256 of its file."""
    try:
        point.load()
        return hashlib.sha256(Path(sys.modules[point.module].__file__ or "").read_bytes()).hexdigest()
    except (Exception, SystemExit) as error:
        raise InvalidInput(f"plug-in {point.name!r} ({point.value}): {describe_error(error)}") from error
