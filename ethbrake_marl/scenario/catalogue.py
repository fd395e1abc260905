"""The catalogue of scenarios. Shipped and registered scenarios are found by name, other files by path."""

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
from ethbrake_marl.scenario.fields import QUANTITY
from ethbrake_marl.scenario.mixtures import member_content
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.scenario.tables import WEIGHT, read_rows

_PACKAGE = Path(__file__).resolve().parents[1]


def shipped_folder(folder: Literal["scenarios", "train"] = "scenarios") -> Path:
    """Return the folder of the shipped scenarios, or of the shipped recipes if ``folder`` is ``"train"``.

    It lies in the checkout or in the installed package. Raises ``InvalidInput`` if neither folder exists: the
    installation is damaged.
    """
    checkout, installed = _PACKAGE.parent / folder, _PACKAGE / "_data" / folder
    if (_PACKAGE.parent / "pyproject.toml").is_file() and checkout.is_dir():
        return checkout
    if not installed.is_dir():
        meaning = "recipes" if folder == "train" else folder
        raise InvalidInput(f"the shipped {meaning} are missing: neither {checkout} nor {installed} exists; reinstall")
    return installed


_SUFFIXES = (".yaml", ".yml")

FOLDERS: dict[str, Path] = {}  # path as text -> registered folder


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """Name, title and file of a shipped or registered scenario."""

    name: str  # name of the scenario
    title: str  # one line for lists and figures
    path: Path  # its file
    origin: str = "shipped"  # ``shipped``, or the path of the registered folder

    @property
    def shipped(self) -> bool:
        """Whether the scenario ships with this package."""
        return self.origin == "shipped"


def register_scenarios(folder: str | os.PathLike[str]) -> None:
    """Register the scenarios of a folder by name: every ``my-name.yaml`` directly in it becomes ``--scenario my-name``.

    A file is checked when it is used. Registering the same folder again changes nothing. Raises ``InvalidInput`` for a
    folder that is missing or has no such file; ``AlreadyExists`` if one of its names belongs to a shipped scenario or
    to one of another registered folder.
    """
    path = Path(folder).resolve()
    if not path.is_dir():
        raise InvalidInput(f"scenarios {os.fspath(folder)!r}: there is no such folder")
    if not _files_of(path):
        raise InvalidInput(f"scenarios {os.fspath(folder)!r}: no file in it ends in .yaml")
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

    A ``Scenario`` is returned unchanged. ``scenario_path`` says how names and paths are found.

    Raises ``UnknownName`` with a suggestion for an unknown name; ``InvalidInput`` with file, line, path inside the file
    and value for a file that does not describe a scenario, or whose ``name`` differs from the file's name.
    """
    if isinstance(scenario, Scenario):
        return scenario
    if isinstance(scenario, Mapping):
        document = _with_members(Document("scenario", dict(scenario), {}), Path())
        return Scenario(**document.content)
    return _load(scenario_path(scenario))


def scenario_path(name_or_path: str | Path, folder: Path = Path()) -> Path:
    """Return the path of a scenario's file. If ``name_or_path`` is a path, the file need not exist.

    Text that ends in ``.yaml`` or ``.yml`` is a path. A shipped scenario is found by name, ``stress-wide``; if its name
    begins with the name of its folder, ``stress/wide`` means the same, unless such a file exists. A registered scenario
    is found by name. Any other name, ``mine`` or ``my/folder/mine``, means ``mine.yaml`` in ``folder``. Shipped and
    registered names come first, so a stray file cannot change what a command in a paper means. Raises ``UnknownName``
    with a suggestion for an unknown name.
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


BENCHMARK = (  # each ships with a table of best known harm, the basis of shares of the possible reduction
    *("paper-random", "paper-random-brake-only", "paper-random-obstacle", "paper-delay-high", "paper-distance"),
    *("realistic-motorway", "realistic-mixed", "stress-wide", "cooperation-2-blocked", "cooperation-2-five"),
)


def group_of_scenarios(name: str) -> list[str]:
    """Return the names of the scenarios in a group: ``benchmark``, or a folder of shipped ones such as ``standards``.

    The list is empty for any other name.
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
    """Return name -> file of every shipped and registered scenario.

    Raise ``AlreadyExists`` if two have the same name.
    """
    shipped = _shipped_paths()
    known = dict(shipped)
    for folder in FOLDERS.values():
        for path in _files_of(folder):
            if path.stem in known:
                other = "a shipped scenario" if path.stem in shipped else f"{known[path.stem]}"
                raise AlreadyExists(
                    f"scenario {path}: {other} has the name {path.stem!r} already; give the file another one"
                )
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
            f"{document.where(('name',))}: name = {scenario.name}: must be the file's name, {path.stem}"
            f" (or rename the file to {scenario.name}{path.suffix})"
        )
    return scenario


def _with_members(document: Document, folder: Path) -> Document:
    """Return the document with the content of other files inserted: scenarios of a mixture, and rows of tables.

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
    """Return the content of one scenario, with the rows of its table read from the table's file.

    Args:
        document: file that contains the scenario, for messages.
        at: path of the scenario inside the document; ``()``: all of it.
        content: the scenario's content.
        folder: folder that the path of the table's file starts from.

    """
    table = content.get("table") if isinstance(content, dict) else None
    if not (isinstance(table, dict) and isinstance(table.get("file"), str)) or "rows" in table:
        return content
    path, where = Path(table["file"]), document.where((*at, "table", "file"))
    if path.is_absolute() or ".." in path.parts:
        raise InvalidInput(f"{where}: table.file = {table['file']}: must be a path from the scenario's folder on")
    with document.refusing_at((*at, "table", "file")):
        rows = read_rows(folder / path, table.get("columns"), table.get("weights"))
        entries = {key: value for key, value in table.items() if key != "file"}  # the file's name does not matter
        return {**content, "table": {**entries, **rows}}


def _member(name: str, where: str, i: int, folder: Path) -> dict[str, Any]:
    try:
        path = scenario_path(name, folder)
        document = read_yaml(path)
        if isinstance(document.content, dict) and "mixture" in document.content:
            raise InvalidInput(f"{name} is a mixture itself; list its scenarios here")
        return _load(path).declared()
    except InvalidInput as error:
        raise InvalidInput(f"{where}: mixture[{i}].scenario = {name}: {error}") from None


_HEAD = """\
# Scenario {name}, started from {based_on}.
# A quantity is a number, or is drawn for every world:
#   {{uniform: [low, high]}}, {{loguniform: [low, high]}}
#   {{normal: {{mean: 20, sd: 1, low: 18, high: 22}}}}    truncated to [low, high]
#   {{lognormal: {{median: 1.1, sigma: 0.4, low: 0.3, high: 3}}}}    its logarithm is normal, truncated
#   {{choice: [6, 7, 8]}}    optionally with weights: [1, 2, 1]
# One entry stands for every vehicle (each draws its own value); a list has one entry per vehicle, front to rear.
"""


def check_file_name(kind: str, name: str) -> None:
    """Raise ``InvalidInput`` unless ``name`` is valid for a scenario or recipe, and so for its file.

    ``kind`` is ``"scenario"`` or ``"recipe"``, for the message.
    """
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"{kind} name {name!r}: must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or"
            " digit"
        )


def new_scenario_text(name: str, based_on: str = "paper-random", *, rows_file: str = "") -> str:
    """Return a commented YAML file for a new scenario ``name`` with the values of the scenario ``based_on``.

    All keys are written out. A key for another way to declare gaps or speeds is included as a comment with an example.
    Save the text as ``<name>.yaml``. With ``rows_file`` a table refers to this CSV file instead of holding its rows;
    ``rows_text`` is the file's text. Raises ``InvalidInput`` for an invalid name or an unknown ``based_on``.
    """
    check_file_name("scenario", name)
    base = load_scenario(based_on)
    base_keys = base.declared() if base.members else base.model_dump(mode="json", exclude_none=True)
    values = {
        **{key: value for key, value in base_keys.items() if not base.members or key == "mixture"},
        "name": name,
        "title": "One line for lists and figures",
        "description": "What this scenario is for.",
        "source": f"Values of {base.name}, to be changed." + f" Its rows: {base.source}" * (base.table is not None),
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
}  # examples for optional keys that are not quantities


def _line(key: str, values: Mapping[str, object]) -> str:
    """Return the line ``key: value`` of a scenario file, or a comment with an example if ``values`` lacks the key."""
    if key in values:
        return f"{key}:{_value(values[key])}"
    if key in QUANTITY.declared:
        return f"# {key}: {QUANTITY.declared[key].example}"
    default = Scenario.model_fields[key].default
    return f"# {key}: {_EXAMPLES[key] if key in _EXAMPLES else flow_text(default)}"


def _short_member(entry: dict[str, Any]) -> dict[str, Any]:
    """Return an entry of a mixture's list with a shorter ``scenario``: only the name, if it equals a shipped one."""
    content, name = entry["scenario"], entry["scenario"]["name"]
    as_shipped = name in _shipped_paths() and member_content(load_scenario(name)) == content
    return {**entry, "scenario": name} if as_shipped else entry


def _comment(key: str) -> str:
    rule = QUANTITY.declared.get(key)
    if rule is None:
        return str(Scenario.model_fields[key].description)
    other = {**QUANTITY.alternatives, **{new: usual for usual, new in QUANTITY.alternatives.items()}}.get(key)
    besides = f"; either this or {other}" if other else ""
    besides = "; only beside line_speed_mps" if key == "speed_deviations_mps" else besides
    return f"{rule.meaning}; {rule.interval}{', below horizon_s' if key == 'latency_s' else ''}{besides}"


def _value(value: object) -> str:
    """Format a value for the line of its key; a mapping of texts, such as roles, becomes one line per entry."""
    if isinstance(value, dict) and all(isinstance(entry, str) for entry in value.values()):
        return "".join(f"\n  {key}: {flow_text(entry)}" for key, entry in value.items())
    return f" {flow_text(value)}"
