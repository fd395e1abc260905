"""Finding scenarios: the shipped ones by name, the user's own by path."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.shipped_files import shipped_folder
from ethbrake_marl.scenario.yaml_loading import read_yaml

_SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """One shipped scenario."""

    name: str
    title: str
    path: Path


def scenario_folder() -> Path:
    """The shipped scenarios: the checkout's ``scenarios/``, or the copy inside an installed package.

    Raises ``InvalidInput`` when neither is there, which means that the installation is damaged.
    """
    return shipped_folder("scenarios", "scenarios")


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Load a shipped scenario by name, or a file by path; see ``scenario_path``.

    Raises ``UnknownName`` with a suggestion for an unknown name, and ``InvalidInput`` with file, line, path inside
    it and value for a file that does not describe a scenario, or whose name differs from the file's.
    """
    return _load(scenario_path(name_or_path))


def scenario_path(name_or_path: str | Path) -> Path:
    """The file of a scenario; it need not exist when a path is given.

    A path is anything with a separator, ``.yaml`` or ``.yml``. A shipped scenario has its name, ``stress-wide``; where
    that begins with its folder's, ``stress/wide`` means the same unless there is such a file.
    Raises ``UnknownName`` with a suggestion for an unknown name.
    """
    text = str(name_or_path)
    path = Path(text)
    if path.suffix in _SUFFIXES or "\\" in text or ("/" in text and os.path.exists(path)):
        return path
    paths = _shipped_paths()
    if "/" in text:
        return {f"{p.parent.name}/{p.stem.removeprefix(p.parent.name + '-')}": p for p in paths.values()}.get(
            text, path
        )
    if text not in paths:
        raise unknown_name("scenario", text, paths)
    return paths[text]


def list_scenarios() -> list[CatalogueEntry]:
    """Every shipped scenario, sorted by name."""
    scenarios = [(_load(path), path) for path in _shipped_paths().values()]
    return sorted((CatalogueEntry(s.name, s.title, path) for s, path in scenarios), key=lambda entry: entry.name)


def _shipped_paths() -> dict[str, Path]:
    return {path.stem: path for path in sorted(scenario_folder().rglob("*.yaml"))}


def _load(path: Path) -> Scenario:
    document = read_yaml(path)
    scenario = Scenario.from_document(document)
    if scenario.name != path.stem:
        line = document.line_of(("name",))
        raise InvalidInput(
            f"{path}, line {line}: name = {scenario.name}: must be the file's name, {path.stem}"
            f" (or rename the file to {scenario.name}{path.suffix})"
        )
    return scenario
