"""The catalogue of scenarios: find shipped and registered scenarios by name, and other scenario files by path."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ethbrake_marl.errors import AlreadyExists, InvalidInput, UnknownName, unknown_name
from ethbrake_marl.files.json_schema import schema_lines
from ethbrake_marl.files.model import NAME_PATTERN
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text, read_yaml
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.mixtures import member_content
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.tables import WEIGHT, read_rows

_PACKAGE = Path(__file__).resolve().parents[2]


def shipped_folder(folder: Literal["scenarios", "train"] = "scenarios") -> Path:
    """Return the folder of the shipped scenarios, or of the shipped recipes if ``folder`` is ``"train"``.

    The folder is part of the source checkout or of the installed package. Raises ``InvalidInput`` if neither contains
    it.
    """
    checkout, installed = _PACKAGE.parent / folder, _PACKAGE / "_data" / folder
    if (_PACKAGE.parent / "pyproject.toml").is_file() and checkout.is_dir():
        return checkout
    if not installed.is_dir():
        meaning = "recipes" if folder == "train" else folder
        raise InvalidInput(
            f"the shipped {meaning} are missing: neither {checkout} nor {installed} exists; reinstall the package"
        )
    return installed


_SUFFIXES = (".yaml", ".yml")

FOLDERS: dict[str, Path] = {}  # registered folders: path as text -> path


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """Name, title and file of a shipped or registered scenario."""

    name: str  # name of the scenario
    title: str  # one-line title for lists and figures
    path: Path  # path of the scenario's file
    origin: str = "shipped"  # ``shipped``, or the path of the registered folder

    @property
    def shipped(self) -> bool:
        return self.origin == "shipped"


def register_scenarios(folder: str | os.PathLike[str]) -> None:
    """Register the scenarios of a folder by name: a file ``my-name.yaml`` in it becomes ``--scenario my-name``.

    Subfolders are ignored. A scenario file is checked only when its scenario is used. Registering the same folder again
    changes nothing. Raises ``InvalidInput`` if the folder does not exist or has no ``.yaml`` file, and
    ``AlreadyExists`` if a shipped scenario, or a scenario of another registered folder, has the same name as a scenario
    of this folder.
    """
    path = Path(folder).resolve()
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
    """Load a scenario by name, by path of its file, or from a mapping with the content of such a file.

    A ``Scenario`` is returned unchanged. The docstring of ``scenario_path`` explains how the file is found. Raises
    ``UnknownName`` with a suggestion for an unknown name. Raises ``InvalidInput``, which names file, line, key and
    value, if the file is not a valid scenario, or if its key ``name`` differs from the name of the file.
    """
    if isinstance(scenario, Scenario):
        return scenario
    if isinstance(scenario, Mapping):
        document = _with_members(Document("scenario", dict(scenario), {}), Path())
        return Scenario(**document.content)
    return _load(scenario_path(scenario))


def scenario_path(name_or_path: str | Path, folder: Path = Path()) -> Path:
    """Return the path of a scenario's file. If ``name_or_path`` is a path, the file need not exist.

    A text that ends in ``.yaml`` or ``.yml`` is a path. Shipped and registered scenarios are found by name, such as
    ``stress-wide``. The shipped scenario ``stress-wide`` in the folder ``stress`` can also be written ``stress/wide``,
    unless a file with this path exists. Any other name means a file below ``folder``: ``my/folder/mine`` means
    ``my/folder/mine.yaml``. Shipped and registered names have priority, so other files cannot change the meaning of a
    command. Raises ``UnknownName`` with a suggestion for an unknown name.
    """
    text = str(name_or_path)
    path = folder / text
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


BENCHMARK = (  # scenarios that ship with a table of best known harm, which the share of the possible reduction needs
    *("paper-random", "paper-random-brake-only", "paper-random-obstacle", "paper-delay-high", "paper-distance"),
    *("realistic-motorway", "realistic-mixed", "stress-wide", "cooperation-2-blocked", "cooperation-2-five"),
)


def group_of_scenarios(name: str) -> list[str]:
    """Return the names of the scenarios in a group: ``benchmark``, or a folder of shipped scenarios.

    The list is empty if there is no group ``name``.
    """
    if name == "benchmark":
        return list(BENCHMARK)
    return sorted(stem for stem, path in _shipped_paths().items() if path.parent.name == name)


def list_scenarios() -> list[CatalogueEntry]:
    """Return every shipped and registered scenario, sorted by name."""
    shipped = _shipped_paths()
    scenarios = [(_load(path), path) for path in _known_paths().values()]
    entries = [
        CatalogueEntry(s.name, s.title, path, "shipped" if s.name in shipped else str(path.parent))
        for s, path in scenarios
    ]
    return sorted(entries, key=lambda entry: entry.name)


def _known_paths() -> dict[str, Path]:
    """Return the file of every shipped and registered scenario by name; raise ``AlreadyExists`` for a repeated name."""
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
    scenario = Scenario.from_document(_with_members(document, path.parent))
    if scenario.name != path.stem:
        raise InvalidInput(
            f"{document.where(('name',))}: name = {scenario.name}: must be the file's name without ending,"
            f" {path.stem}; change the name, or rename the file to {scenario.name}{path.suffix}"
        )
    return scenario


def _with_members(document: Document, folder: Path) -> Document:
    """Return the document with the content of the scenario files and CSV files that the document names.

    Paths in the document are relative to ``folder``.
    """
    content = _with_rows(document, (), document.content, folder)
    listed = content.get("mixture") if isinstance(content, dict) else None
    if isinstance(listed, list | tuple):
        files = []
        for i, entry in enumerate(listed):
            member, at = entry.get("scenario") if isinstance(entry, dict) else None, ("mixture", i, "scenario")
            if isinstance(member, str):
                entry = {**entry, "scenario": _member(member, document.where(at), i, folder)}
            elif isinstance(member, dict):
                entry = {**entry, "scenario": _with_rows(document, at, member, folder)}
            files.append(entry)
        content = {**content, "mixture": files}
    return Document(document.file, content, document.lines)


def _with_rows(document: Document, at: YamlPath, content: Any, folder: Path) -> Any:
    """Return ``content``, the content of one scenario, with the rows of its table read from the table's file.

    The path of this file is relative to ``folder``. Error messages name ``document`` and ``at``, the keys and
    indices that lead to the scenario in ``document`` (``()``: the whole document is the scenario).
    """
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


_HEAD = """\
# Scenario {name}, started from {based_on}.
# A quantity is a fixed number, or a distribution from which every world draws a value:
#   {{uniform: [low, high]}}, {{loguniform: [low, high]}}
#   {{normal: {{mean: 20, sd: 1, low: 18, high: 22}}}}    truncated to [low, high]
#   {{lognormal: {{median: 1.1, sigma: 0.4, low: 0.3, high: 3}}}}    truncated to [low, high]
#   {{choice: [6, 7, 8]}}    optionally with weights: [1, 2, 1]
# A single entry is for all vehicles, each of which draws its own value. A list has one entry per vehicle.
"""


def check_file_name(kind: str, name: str) -> None:
    """Raise ``InvalidInput`` unless ``name`` is a valid name of a scenario or recipe (``kind``) and of its file."""
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"{kind} name {name!r}: must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or"
            " digit"
        )


def new_scenario_text(name: str, based_on: str = "paper-random", *, rows_file: str = "") -> str:
    """Return the text of a commented YAML file for a new scenario ``name`` with the values of ``based_on``.

    The text contains every key; a key that ``based_on`` does not use appears as a comment with an example. Save the
    text as ``<name>.yaml``. If ``rows_file`` is given, the text names this CSV file instead of containing the rows of
    the table; ``rows_text`` returns the content of that file. Raises ``InvalidInput`` for an invalid name or unknown
    ``based_on``.
    """
    check_file_name("scenario", name)
    base = load_scenario(based_on)
    base_keys = base.declared() if base.members else base.model_dump(mode="json", exclude_none=True)
    values = {
        **{key: value for key, value in base_keys.items() if not base.members or key == "mixture"},
        "name": name,
        "title": "One-line title for lists and figures",
        "description": "What this scenario is for.",
        "source": f"Values of {base.name}, to be changed." + f" Its table: {base.source}" * (base.table is not None),
    }
    if base.table is not None and rows_file:
        weights = {} if base.table.weights is None else {"weights": WEIGHT}
        values["table"] = {"file": rows_file, "columns": list(base.table.columns), **weights}
    if base.line_speed_mps is None:
        values.pop("speed_deviations_mps", None)
    if base.members:
        values["mixture"] = [_short_member(entry) for entry in values["mixture"]]
    keys = [f"\n# {_comment(key)}\n{_line(key, values)}\n" for key in Scenario.model_fields]
    return _HEAD.format(name=name, based_on=base.name) + schema_lines("scenario", "scenario schema") + "".join(keys)


_EXAMPLES = {
    "observation": "[own, front_1, rear_1]",
    "vehicle_types": "{car: {weight: 9, mass_t: 1.5}, truck: {mass_t: {with_load: [14, 40]}}}",
    "types": "[car, any, truck]",
    "mixture": "[{scenario: paper-random, weight: 2}, {scenario: paper-random-early}]",
    "table": "{file: rows.csv, columns: [gap_1_m, gap_2_m]}",
    "roles": "{vehicle_2: learner}",
    "v2x": "nominal",
}  # examples of optional keys that are not quantities


def _line(key: str, values: Mapping[str, object]) -> str:
    """Return the line ``key: value`` of a scenario file, or a comment with an example if ``values`` lacks the key."""
    if key in values:
        return f"{key}:{_value(values[key])}"
    if key in QUANTITY.declared:
        return f"# {key}: {QUANTITY.declared[key].example}"
    default = Scenario.model_fields[key].default
    return f"# {key}: {_EXAMPLES[key] if key in _EXAMPLES else flow_text(default)}"


def _short_member(entry: dict[str, Any]) -> dict[str, Any]:
    """Return an entry of the list ``mixture``, with the content of a shipped scenario replaced by its name."""
    content, name = entry["scenario"], entry["scenario"]["name"]
    as_shipped = name in _shipped_paths() and member_content(load_scenario(name)) == content
    return {**entry, "scenario": name} if as_shipped else entry


def _comment(key: str) -> str:
    rule = QUANTITY.declared.get(key)
    if rule is None:
        return str(Scenario.model_fields[key].description)
    other = {**QUANTITY.alternatives, **{new: usual for usual, new in QUANTITY.alternatives.items()}}.get(key)
    besides = f"; give either this key or {other}" if other else ""
    besides = "; only together with line_speed_mps" if key == "speed_deviations_mps" else besides
    return f"{rule.meaning}; {rule.interval}{', below horizon_s' if key == 'latency_s' else ''}{besides}"


def _value(value: object) -> str:
    """Return the text of a value in a scenario file; a mapping of texts, such as roles, has one line per entry."""
    if isinstance(value, dict) and all(isinstance(entry, str) for entry in value.values()):
        return "".join(f"\n  {key}: {flow_text(entry)}" for key, entry in value.items())
    return f" {flow_text(value)}"
