"""The catalogue: shipped and registered scenarios by name, and other scenario files by path."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName, unknown_name
from ethbrake_marl.files.model import NAME_PATTERN
from ethbrake_marl.files.yaml import Document, YamlPath, read_yaml
from ethbrake_marl.worlds.scenario import Scenario, plain
from ethbrake_marl.worlds.table import read_rows

_PACKAGE = Path(__file__).resolve().parents[1]
_SUFFIXES = (".yaml", ".yml")

FOLDERS: dict[str, Path] = {}  # registered folders: path as text -> path

BENCHMARK = (  # scenarios that ship with a table of best known harm, which the share of the possible reduction needs
    *("paper-random", "paper-random-brake-only", "paper-random-obstacle", "paper-delay-high", "paper-distance"),
    *("realistic-motorway", "realistic-mixed", "stress-wide", "cooperation-2-blocked", "cooperation-2-five"),
)


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """A shipped or registered scenario."""

    name: str
    title: str
    path: Path
    origin: str = "shipped"  # or the path of the registered folder

    @property
    def shipped(self) -> bool:
        return self.origin == "shipped"


def shipped_folder(folder: Literal["scenarios", "train"] = "scenarios") -> Path:
    """Return the folder of the shipped scenarios or recipes (``train``), in the checkout or the installed package."""
    checkout, installed = _PACKAGE.parent / folder, _PACKAGE / "_data" / folder
    if (_PACKAGE.parent / "pyproject.toml").is_file() and checkout.is_dir():
        return checkout
    if not installed.is_dir():
        meaning = "recipes" if folder == "train" else folder
        raise InvalidInput(
            f"the shipped {meaning} are missing: neither {checkout} nor {installed} exists; reinstall the package"
        )
    return installed


def register_scenarios(folder: str | os.PathLike[str]) -> None:
    """Register the scenarios of a folder by name: its file ``my-name.yaml`` becomes ``--scenario my-name``.

    A file is checked only when its scenario is used. Raises ``InvalidInput`` for a folder without such files, and
    ``AlreadyExists`` if one has the name of another scenario.
    """
    path = Path(folder).expanduser().resolve()
    if not path.is_dir():
        raise InvalidInput(f"folder of scenarios {os.fspath(folder)!r}: is not an existing folder")
    if not _files_of(path):
        raise InvalidInput(f"folder of scenarios {os.fspath(folder)!r}: has no file that ends in .yaml")
    known = str(path) in FOLDERS
    FOLDERS[str(path)] = path
    try:
        _known_paths()
    except AlreadyExists:
        if not known:
            del FOLDERS[str(path)]
        raise


def load_scenario(scenario: str | Path | Mapping[str, Any] | Scenario) -> Scenario:
    """Load a scenario by name, by the path of its file (``scenario_path``), or from the content of such a file.

    A ``Scenario`` is returned as it is. Raises ``UnknownName`` for an unknown name, and ``InvalidInput`` with file,
    line, key and value for a bad file, or one whose key ``name`` is not the name of the file.
    """
    if isinstance(scenario, Scenario):
        return scenario
    if isinstance(scenario, Mapping):
        document = _with_files(Document("scenario", plain(scenario), {}), Path())
        return Scenario(**document.content)
    return _load(scenario_path(scenario))


def scenario_path(name_or_path: str | Path, folder: Path = Path()) -> Path:
    """Return the path of a scenario's file; a path need not exist.

    What ends in ``.yaml`` or ``.yml`` is a path. Otherwise shipped and registered names come first, so that no file
    changes the meaning of a command: ``stress-wide``, or ``stress/wide`` unless there is such a file. Any other name
    means a file below ``folder``: ``my/folder/mine`` means ``my/folder/mine.yaml``. ``~`` is the user's home.
    """
    text = str(name_or_path)
    path = folder / Path(text).expanduser()
    if path.suffix in _SUFFIXES or "\\" in text or ("/" in text and os.path.isfile(path)):
        return path
    paths = _known_paths()
    if "/" in text:
        paths = {f"{p.parent.name}/{p.stem.removeprefix(p.parent.name + '-')}": p for p in _shipped_paths().values()}
    if text in paths:
        return paths[text]
    if os.path.isfile(beside := f"{path}.yaml"):
        return Path(beside)
    patterns = (f"{path.name}.yml", f"*/{path.name}.y*ml") if re.fullmatch(NAME_PATTERN, path.name) else ()
    if near := sorted(each for pattern in patterns for each in path.parent.glob(pattern)):
        raise UnknownName(f"unknown scenario {text!r}; did you mean {os.path.relpath(near[0], folder)}?")
    if "/" in text:
        return path
    raise unknown_name("scenario", text, paths)


def group_of_scenarios(name: str) -> list[str]:
    """Return the names in a group: ``benchmark``, or a folder of shipped scenarios; empty if there is no such group."""
    if name == "benchmark":
        return list(BENCHMARK)
    return sorted(stem for stem, path in _shipped_paths().items() if path.parent.name == name)


def list_scenarios() -> list[CatalogueEntry]:
    """Return every shipped and registered scenario, sorted by name, without checking it."""
    shipped = _shipped_paths()
    entries = []
    for name, path in _known_paths().items():
        content = read_yaml(path).content
        title = str(content.get("title", "")) if isinstance(content, dict) else ""
        entries.append(CatalogueEntry(name, title, path, "shipped" if name in shipped else str(path.parent)))
    return sorted(entries, key=lambda entry: entry.name)


def _known_paths() -> dict[str, Path]:
    shipped = _shipped_paths()
    known = dict(shipped)
    for folder in FOLDERS.values():
        for path in _files_of(folder):
            if path.stem in known:
                other = "a shipped scenario" if path.stem in shipped else f"{known[path.stem]}"
                raise AlreadyExists(f"scenario {path}: {other} already has the name {path.stem!r}; rename the file")
            known[path.stem] = path
    return known


def _files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*.yaml") if path.is_file())


def _shipped_paths() -> dict[str, Path]:
    return {path.stem: path for path in sorted(shipped_folder().rglob("*.yaml"))}


def _load(path: Path) -> Scenario:
    document = read_yaml(path)
    scenario = Scenario.from_document(_with_files(document, path.parent))
    if scenario.name != path.stem:
        raise InvalidInput(
            f"{document.where(('name',))}: name = {scenario.name}: must be the file's name without ending,"
            f" {path.stem}; change the name, or rename the file to {scenario.name}{path.suffix}"
        )
    return scenario


def _with_files(document: Document, folder: Path) -> Document:
    """Return the document with the content of the scenario and CSV files that it names, relative to ``folder``."""
    content = _with_rows(document, (), document.content, folder)
    listed = content.get("mixture") if isinstance(content, dict) else None
    if isinstance(listed, list | tuple):
        members = []
        for i, entry in enumerate(listed):
            member, at = entry.get("scenario") if isinstance(entry, dict) else None, ("mixture", i, "scenario")
            if isinstance(member, str):
                entry = {**entry, "scenario": _member(member, document.where(at), i, folder)}
            elif isinstance(member, dict):
                entry = {**entry, "scenario": _with_rows(document, at, member, folder)}
            members.append(entry)
        content = {**content, "mixture": members}
    return Document(document.file, content, document.lines)


def _with_rows(document: Document, at: YamlPath, content: Any, folder: Path) -> Any:
    """Return the content of one scenario, which stands at ``at`` in the document, with the rows of its table."""
    table = content.get("table") if isinstance(content, dict) else None
    if not (isinstance(table, dict) and isinstance(table.get("file"), str)) or "rows" in table:
        return content
    path, where = Path(table["file"]), document.where((*at, "table", "file"))
    if path.is_absolute() or ".." in path.parts:
        raise InvalidInput(f"{where}: table.file = {table['file']}: must be a relative path in the scenario's folder")
    with document.refusing_at((*at, "table", "file")):
        rows = read_rows(folder / path, table.get("columns"), table.get("weights"))
    entries = {key: value for key, value in table.items() if key != "file"}  # the file's name does not matter
    return {**content, "table": {**entries, **rows}}


def _member(name: str, where: str, i: int, folder: Path) -> dict[str, Any]:
    try:
        path = scenario_path(name, folder)
        document = read_yaml(path)
        if isinstance(document.content, dict) and "mixture" in document.content:
            raise InvalidInput(f"a mixture cannot contain another mixture; list the scenarios of {name} instead")
        return _load(path).declared()
    except InvalidInput as error:
        raise InvalidInput(f"{where}: mixture[{i}].scenario = {name}: {error}") from None
