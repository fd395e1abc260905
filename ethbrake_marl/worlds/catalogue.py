"""The catalogue of scenarios: shipped and registered scenarios by name, other scenario files by path."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ethbrake_marl.errors import AlreadyExists, IgnoredName, InvalidInput, unknown_name
from ethbrake_marl.files.package import package_folder
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text, read_yaml
from ethbrake_marl.worlds.mixture import DESCRIPTIVE_KEYS, changed_content
from ethbrake_marl.worlds.scenario import Scenario, plain
from ethbrake_marl.worlds.table import read_rows

_PACKAGE = package_folder()

FOLDERS: dict[str, Path] = {}  # registered folders: path as text -> path

DEEPEST = 50  # largest number of files that are based on each other

THREE_TESTS = ("paper-random", "paper-random-brake-only", "paper-random-obstacle")


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    name: str
    title: str
    path: Path
    origin: str = "shipped"  # or the path of the registered folder

    @property
    def shipped(self) -> bool:
        return self.origin == "shipped"


def shipped_folder(folder: Literal["scenarios", "train"] = "scenarios") -> Path:
    checkout = _PACKAGE.parent / folder
    return checkout if (_PACKAGE.parent / "pyproject.toml").is_file() else _PACKAGE / "_data" / folder


def register_scenarios(folder: str | os.PathLike[str]) -> None:
    """Register the scenario files in a folder: the file ``my-name.yaml`` becomes the scenario ``my-name``.

    Raises ``InvalidInput`` for a folder without YAML files, and ``AlreadyExists`` for a name in use.
    """
    path = Path(folder).expanduser().resolve()
    files = sorted(path.glob("*.yaml"))
    if not files:
        raise InvalidInput(f"folder of scenarios {os.fspath(folder)!r}: has no file that ends in .yaml")
    known = {
        name: registered_path for name, registered_path in scenario_paths().items() if registered_path.parent != path
    }
    for file in files:
        if file.stem in known:
            raise AlreadyExists(
                f"scenario {file}: {known[file.stem]} already has the name {file.stem!r}; rename the file"
            )
    FOLDERS[str(path)] = path


def load_scenario(scenario: str | Path | Mapping[str, Any] | Scenario) -> Scenario:
    """Load a scenario from its name, from the path of its file, or from the content of such a file.

    Raises ``UnknownName`` for an unknown name, ``InvalidInput`` for a bad file. If the key ``name`` differs from the
    file's name, warns (``IgnoredName``): the file's name counts, with ``-`` for characters that no name has.
    """
    if isinstance(scenario, Scenario):
        return scenario
    if isinstance(scenario, Mapping):
        return _build_scenario(Document("scenario", plain(scenario), {}), Path(), ())
    return _load(scenario_path(scenario), ())


def _load(path: Path, above: tuple[Path, ...]) -> Scenario:
    """``above``: chain of files that need it; each of them needs the next one."""
    document = read_yaml(path)
    loaded = _build_scenario(document, path.parent, (*above, path))
    name = re.sub("[^a-z0-9_-]", "-", path.stem.lower()).lstrip("-_")[:64] or loaded.name
    if name != loaded.name:
        warnings.warn(
            f"{document.where(('name',))}: name = {loaded.name} is ignored: the file's name counts, so this is {name}",
            IgnoredName,
            stacklevel=4,
        )
        loaded = loaded.replace(name=name)
    return loaded


def scenario_path(name_or_path: str | Path, folder: Path = Path()) -> Path:
    """Path of a scenario's file.

    A text that ends in ``.yaml`` or ``.yml`` is a path relative to ``folder``. Any other text is the name of a shipped
    or registered scenario. If there is no such scenario, the text is the path of an existing file, without the ending.
    Raises ``UnknownName`` if there is no such file either.
    """
    text, paths = str(name_or_path), scenario_paths()
    path = folder / Path(text).expanduser()
    if path.suffix in (".yaml", ".yml"):
        return path
    if text in paths:
        return paths[text]
    for beside in (f"{path}.yaml", f"{path}.yml"):
        if os.path.isfile(beside):
            return Path(beside)
    raise unknown_name("scenario", text, paths)


def group_of_scenarios(name: str) -> list[str]:
    return sorted(path.stem for path in shipped_folder().glob("*/*.yaml") if path.parent.name == name)


def list_scenarios() -> list[CatalogueEntry]:
    """Shipped and registered scenarios, sorted by name. Their files are not checked."""
    entries = []
    for name, path in sorted(scenario_paths().items()):
        content = read_yaml(path).content
        title = str(content.get("title", "")) if isinstance(content, dict) else ""
        origin = "shipped" if path.is_relative_to(shipped_folder()) else str(path.parent)
        entries.append(CatalogueEntry(name, title, path, origin))
    return entries


def scenario_paths() -> dict[str, Path]:
    registered = (path for folder in FOLDERS.values() for path in folder.glob("*.yaml"))
    return {path.stem: path for path in (*registered, *shipped_folder().rglob("*.yaml"))}


def _build_scenario(document: Document, folder: Path, above: tuple[Path, ...]) -> Scenario:
    """Scenario from a parsed file, completed from the other files that its keys name.

    These are the scenario after ``based_on``, the members of a mixture and the CSV file of a table; paths are relative
    to ``folder``. ``above``: as in ``_load``. Raises ``InvalidInput`` for a key that repeats a value of the base.
    """
    content, base = document.content, None
    if isinstance(content, dict) and "based_on" in content:
        base = _base(document, content["based_on"], folder, above)
        changes = {key: value for key, value in content.items() if key != "based_on"}
        unknown = {key: value for key, value in changes.items() if key not in Scenario.model_fields}
        inherited = {key: value for key, value in base.declared().items() if key not in ("name", *DESCRIPTIVE_KEYS)}
        content = {**changed_content(inherited, changes), **unknown}
    content = _with_rows(document, (), content, folder)
    entries = content.get("mixture") if isinstance(content, dict) else None
    if isinstance(entries, list | tuple):
        content = {
            **content,
            "mixture": [_member(document, i, entry, folder, above) for i, entry in enumerate(entries)],
        }
    scenario = Scenario.from_document(Document(document.file, content, document.lines))
    if base is not None:
        for key in document.content.keys() - {"name", *DESCRIPTIVE_KEYS, "based_on"}:
            with document.refusing_at((key,)):
                new_values, base_values = (
                    [getattr(member, key) for member in version.members or (version,)] for version in (scenario, base)
                )
                if new_values == base_values and key != "mixture":
                    raise InvalidInput(f"{key}: has the same value in {base.name}; leave it out")
    return scenario


def _base(document: Document, name: Any, folder: Path, above: tuple[Path, ...]) -> Scenario:
    with document.refusing_at(("based_on",)):
        if not isinstance(name, str):
            right = "must be the name of a scenario or the path of its file"
            raise InvalidInput(f"based_on = {flow_text(name, 60)}: {right}")
        return _load_below(f"based_on = {name}", scenario_path(name, folder), above)


def _load_below(what: str, path: Path, above: tuple[Path, ...]) -> Scenario:
    """Load the file ``path``, which the last file of ``above`` needs; a circle raises ``InvalidInput``."""
    places = [file.resolve() for file in above]
    if path.resolve() in places:
        circle = " -> ".join(file.stem for file in (*above[places.index(path.resolve()) :], path))
        raise InvalidInput(f"{what}: {circle} is a circle; base one of them on another scenario")
    if len(above) == DEEPEST:
        raise InvalidInput(f"{what}: more than {DEEPEST} files are based on each other; base this one on a nearer one")
    return _load(path, above)


def _member(document: Document, i: int, entry: Any, folder: Path, above: tuple[Path, ...]) -> Any:
    if not isinstance(entry, dict) or "scenario" not in entry:
        return entry
    at: YamlPath = ("mixture", i, "scenario")
    member = entry["scenario"]
    if isinstance(member, dict) and "based_on" in member:
        with document.refusing_at(at):
            loaded = _build_scenario(Document(f"mixture[{i}].scenario", member, {}), folder, above)
        return {**entry, "scenario": loaded.declared()}
    if not isinstance(member, str):
        return {**entry, "scenario": _with_rows(document, at, member, folder)}
    with document.refusing_at(at):
        loaded = _load_below(f"mixture[{i}].scenario = {member}", scenario_path(member, folder), above)
        return {**entry, "scenario": loaded.declared()}


def _with_rows(document: Document, at: YamlPath, content: Any, folder: Path) -> Any:
    table = content.get("table") if isinstance(content, dict) else None
    if not (isinstance(table, dict) and isinstance(table.get("file"), str)) or "rows" in table:
        return content
    path = Path(table["file"])
    with document.refusing_at((*at, "table", "file")):
        if path.is_absolute() or ".." in path.parts:
            raise InvalidInput(f"table.file = {path}: must be a relative path in the scenario's folder")
        rows = read_rows(folder / path, table.get("columns"))
    entries = {key: value for key, value in table.items() if key != "file"}  # the file's name does not matter
    return {**content, "table": {**entries, "rows": rows}}
