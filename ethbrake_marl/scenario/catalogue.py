"""Finding scenarios: the shipped ones by name, the user's own by path."""

from __future__ import annotations

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
    """Load a shipped scenario by name, or a file by path (anything with a separator, ``.yaml`` or ``.yml``).

    Raises ``UnknownName`` with a suggestion for an unknown name, and ``InvalidInput`` with file, line, path inside
    it and value for a file that does not describe a scenario, or whose name differs from the file's.
    """
    text = str(name_or_path)
    if Path(text).suffix in _SUFFIXES or "/" in text or "\\" in text:
        return _load(Path(text))
    paths = _shipped_paths()
    if text not in paths:
        raise unknown_name("scenario", text, paths)
    return _load(paths[text])


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
