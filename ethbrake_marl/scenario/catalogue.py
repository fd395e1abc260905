"""The catalogue of scenarios: those that ship, those of registered folders, and files by path."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from ethbrake_marl.errors import AlreadyExists, InvalidInput, unknown_name
from ethbrake_marl.files.yaml import Document, explain, flow_text, read_yaml, schema_lines
from ethbrake_marl.scenario.lines import NAME_PATTERN
from ethbrake_marl.scenario.quantities import ALTERNATIVES, DECLARED
from ethbrake_marl.scenario.schema import Scenario, ScenarioWording, member_content
from ethbrake_marl.scenario.v2x import CHANNELS, V2X

_PACKAGE = Path(__file__).resolve().parents[1]


def shipped_folder(folder: str, meaning: str) -> Path:
    """The checkout's ``folder``, or the copy inside an installed package.

    Raises ``InvalidInput``, in which ``meaning`` says what is missing, when neither is there: the installation is
    damaged.
    """
    checkout, installed = _PACKAGE.parent / folder, _PACKAGE / "_data" / folder
    if (_PACKAGE.parent / "pyproject.toml").is_file() and checkout.is_dir():
        return checkout
    if not installed.is_dir():
        raise InvalidInput(f"the shipped {meaning} are missing: neither {checkout} nor {installed} exists; reinstall")
    return installed


_SUFFIXES = (".yaml", ".yml")
SHIPPED = "shipped"
FOLDERS: dict[str, Path] = {}  # registered, by their path


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """One shipped or registered scenario."""

    name: str
    title: str
    path: Path
    origin: str = SHIPPED  # or the registered folder


def register_scenarios(folder: str | os.PathLike[str]) -> None:
    """Make the scenarios of a folder known by name, ``--scenario my-name``: every ``my-name.yaml`` directly in it.

    Whether a file is in order is said when it is used. Registering the same folder again changes nothing. Raises
    ``InvalidInput`` for a folder that is missing or has no such file, ``AlreadyExists`` for one that has a name which a
    shipped scenario, or one of another registered folder, has.
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


def scenario_folder() -> Path:
    """The shipped scenarios: the checkout's ``scenarios/``, or the copy inside an installed package.

    Raises ``InvalidInput`` when neither is there, which means that the installation is damaged.
    """
    return shipped_folder("scenarios", "scenarios")


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Load a shipped or registered scenario by name, or a file by path; see ``scenario_path``.

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
    if "/" in text:
        paths = _shipped_paths()
        return {f"{p.parent.name}/{p.stem.removeprefix(p.parent.name + '-')}": p for p in paths.values()}.get(
            text, path
        )
    known = _known_paths()
    if text not in known:
        raise unknown_name("scenario", text, known)
    return known[text]


def list_scenarios() -> list[CatalogueEntry]:
    """Every shipped and registered scenario, sorted by name."""
    shipped = _shipped_paths()
    scenarios = [(_load(path), path) for path in _known_paths().values()]
    entries = [
        CatalogueEntry(s.name, s.title, path, SHIPPED if s.name in shipped else str(path.parent))
        for s, path in scenarios
    ]
    return sorted(entries, key=lambda entry: entry.name)


def _known_paths() -> dict[str, Path]:
    """Name -> file of every shipped and registered scenario; raises ``AlreadyExists`` for a name that two have."""
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
    return {path.stem: path for path in sorted(scenario_folder().rglob("*.yaml"))}


def _load(path: Path) -> Scenario:
    document = read_yaml(path)
    scenario = Scenario.from_document(_with_members(document, path.parent))
    if scenario.name != path.stem:
        raise InvalidInput(
            f"{document.where(('name',))}: name = {scenario.name}: must be the file's name, {path.stem}"
            f" (or rename the file to {scenario.name}{path.suffix})"
        )
    return scenario


def read_scenario(content: Mapping[str, Any]) -> Scenario:
    """A scenario from what its file would say; the members of a mixture may be named as there.

    Raises ``InvalidInput`` as ``Scenario``, and what ``load_scenario`` raises for a name.
    """
    document = _with_members(Document("scenario", dict(content), {}), Path())
    return Scenario(**document.content)


def _with_members(document: Document, folder: Path) -> Document:
    """The document of a mixture with the content of every member in place of its name, or of a path from ``folder``."""
    content = document.content
    listed = content.get("mixture") if isinstance(content, dict) else None
    if not isinstance(listed, list | tuple):
        return document
    found = [
        {**entry, "scenario": _member(entry["scenario"], _place(document, i), folder)}
        if isinstance(entry, dict) and isinstance(entry.get("scenario"), str)
        else entry
        for i, entry in enumerate(listed)
    ]
    return Document(document.file, {**content, "mixture": found}, document.lines)


def _place(document: Document, i: int) -> str:
    return f"{document.where(('mixture', i, 'scenario'))}: mixture[{i}].scenario"


def _member(name: str, where: str, folder: Path) -> dict[str, Any]:
    try:
        path = Path(scenario_path(name))
        if path not in _shipped_paths().values():
            path = folder / path
        document = read_yaml(path)
        if isinstance(document.content, dict) and "mixture" in document.content:
            raise InvalidInput(f"{name} is a mixture itself; list its scenarios here")
        return _load(path).declared()
    except InvalidInput as error:
        raise InvalidInput(f"{where} = {name}: {error}") from None


_HEAD = """\
# Scenario {name}, started from {based_on}.
# A quantity is a number, or is drawn for every world:
#   {{uniform: [low, high]}}, {{loguniform: [low, high]}}
#   {{normal: {{mean: 20, sd: 1, low: 18, high: 22}}}}    truncated to [low, high]
#   {{choice: [6, 7, 8]}}    optionally with weights: [1, 2, 1]
# One entry stands for every vehicle (each draws its own value); a list has one entry per vehicle, front to rear.
"""


def check_file_name(kind: str, name: str) -> None:
    """Raise ``InvalidInput`` for what cannot be the name of a scenario or recipe, which is that of its file."""
    if re.fullmatch(NAME_PATTERN, name) is None:
        raise InvalidInput(
            f"{kind} name {name!r}: must be 1 to 64 lower case letters, digits, - and _, beginning with a letter or"
            " digit"
        )


def new_scenario_text(name: str, based_on: str = "paper-random") -> str:
    """Text of a commented YAML file for a new scenario ``name`` with the values of ``based_on``, all keys written out.

    A key that stands for another way to declare gaps or speeds is there as a comment with an example.
    Save it as ``<name>.yaml``. Raises ``InvalidInput`` for a name that cannot be one, or an unknown ``based_on``.
    """
    check_file_name("scenario", name)
    base = load_scenario(based_on)
    given = base.declared() if base.members else base.model_dump(mode="json", exclude_none=True)
    values = {
        **{key: value for key, value in given.items() if not base.members or key == "mixture"},
        "name": name,
        "title": "One line for lists and figures",
        "description": "What this scenario is for.",
        "source": f"Values of {base.name}, to be changed.",
    }
    if base.line_speed_mps is None:
        values.pop("speed_deviations_mps", None)
    if base.members:
        values["mixture"] = [_short_member(entry) for entry in values["mixture"]]
    keys = [f"\n# {_comment(key)}\n{_line(key, values)}\n" for key in Scenario.model_fields]
    return _HEAD.format(name=name, based_on=base.name) + schema_lines("scenario") + "".join(keys)


_EXAMPLES = {
    "observation": "[own, front_1, rear_1]",
    "vehicle_types": "{car: {weight: 9, mass_t: 1.5}, truck: {mass_t: {with_load: [14, 40]}}}",
    "types": "[car, any, truck]",
    "mixture": "[{scenario: paper-random, weight: 2}, {scenario: paper-random-early}]",
    "roles": "{vehicle_2: learner}",
    "v2x": "nominal",
}  # of keys that are no quantity and may be left out


def _line(key: str, values: Mapping[str, object]) -> str:
    """``key: value``; a key that goes only with the other way to declare the same stands in a comment."""
    if key in values:
        return f"{key}:{_value(values[key])}"
    if key in DECLARED:
        return f"# {key}: {DECLARED[key].example}"
    default = Scenario.model_fields[key].default
    return f"# {key}: {_EXAMPLES[key] if key in _EXAMPLES else flow_text(default)}"


def _short_member(entry: dict[str, Any]) -> dict[str, Any]:
    """A member of a mixture by its name, where that is a shipped scenario that says the same."""
    content, name = entry["scenario"], entry["scenario"]["name"]
    as_shipped = name in _shipped_paths() and member_content(load_scenario(name)) == content
    return {**entry, "scenario": name} if as_shipped else entry


def _comment(key: str) -> str:
    rule = DECLARED.get(key)
    if rule is None:
        return str(Scenario.model_fields[key].description)
    other = {**ALTERNATIVES, **{new: usual for usual, new in ALTERNATIVES.items()}}.get(key)
    besides = f"; either this or {other}" if other else ""
    besides = "; only beside line_speed_mps" if key == "speed_deviations_mps" else besides
    return f"{rule.meaning}; {rule.interval}{', below horizon_s' if key == 'latency_s' else ''}{besides}"


def _value(value: object) -> str:
    """Roles one per line, everything else on the line of its key."""
    if isinstance(value, dict) and all(isinstance(entry, str) for entry in value.values()):
        return "".join(f"\n  {key}: {flow_text(entry)}" for key, entry in value.items())
    return f" {flow_text(value)}"


# Presets of the V2X channel that somebody registers.

_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


def register_preset(name: str, settings: Mapping[str, Any]) -> None:
    """Make ``v2x: name`` known to every scenario.

    Args:
        name: 1 to 64 of ``a-z``, digits, ``-`` and ``_``.
        settings: what a scenario would say, a preset and what differs from it: ``{"preset": "nominal", "lost": 0.1}``.

    Registering the same again changes nothing. Raises ``AlreadyExists`` for another channel under a name that is taken,
    ``InvalidInput`` for a name that is none and for settings that are no channel.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(f"preset {name!r:.80}: must be 1 to 64 of a-z, 0-9, - and _, not beginning with - or _")
    if not isinstance(settings, Mapping):
        raise InvalidInput(f"preset {name!r}: settings = {settings!r:.80}: must be a mapping such as {{'lost': 0.1}}")
    try:
        channel = V2X.model_validate(dict(settings)).channel
    except ValidationError as error:
        raise explain(error, Document(f"preset {name!r}", dict(settings), {}), ScenarioWording(V2X)) from None
    if CHANNELS.setdefault(name, channel) != channel:
        raise AlreadyExists(f"preset {name!r} is registered already; give another name")
