"""The folder of a reproduction: its settings, and for each item its result, figures and data, each written whole."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from ethbrake_marl import __version__
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.per_world import write_output
from ethbrake_marl.figures.style import picture_bytes
from ethbrake_marl.files.durable import check_writable, write_file
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.learning.run_folder import read_object
from ethbrake_marl.studies.reproduction.item import Item, Made, Settings
from ethbrake_marl.studies.reproduction.items import ITEMS
from ethbrake_marl.studies.reproduction.verdicts import OUTCOMES, Verdict, summarise_verdicts

Json = dict[str, Any]

SETTINGS, RESULT, PAGE = "reproduction.json", "result.json", "index.html"
ENDINGS = (".svg", ".png")
_FORMAT = {"format": "ethbrake-reproduction", "format_version": 1}
_STEM = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
_LIMIT_BYTES = 16 << 20  # of a figure that is read again


@dataclass(frozen=True, slots=True)
class ReproductionFolder:
    """Names inside the folder."""

    path: Path

    @property
    def settings(self) -> Path:
        """What was asked for."""
        return self.path / SETTINGS

    @property
    def page(self) -> Path:
        """The page of everything."""
        return self.path / PAGE

    def result(self, name: str) -> Path:
        """What became of an item."""
        return self.path / name / RESULT

    def figure(self, name: str, stem: str, ending: str) -> Path:
        """A figure of an item; raises ``InvalidInput`` for a stem that is no plain name."""
        return self.path / name / f"{checked_stem(stem)}{ending}"


def checked_stem(stem: str) -> str:
    """The same name of a figure; raises ``InvalidInput`` for one that is no plain name."""
    if not _STEM.fullmatch(stem):
        raise InvalidInput(f"figure {stem!r:.60}: must be small letters, digits and -")
    return stem


def open_folder(settings: Settings, *, force: bool = False) -> ReproductionFolder:
    """Make the folder, or go on in it.

    Raises ``InvalidInput`` for one that cannot be made or written to; ``AlreadyExists`` for one that holds something
    else, or a reproduction with other settings, unless ``force``, which replaces its results and keeps its trainings.
    """
    folder, wanted = ReproductionFolder(settings.folder), _wanted(settings)
    if folder.path.is_symlink() or (folder.path.exists() and not folder.path.is_dir()):
        raise InvalidInput(f"{folder.path}: is no plain folder; give another (--output)")
    if folder.settings.is_file():
        kept = read_object(folder.settings)
        if kept.get("format") != _FORMAT["format"]:
            raise AlreadyExists(f"{folder.settings}: is not of a reproduction; give another folder (--output)")
        other = [
            f"{name} {kept.get(name)!s:.40}, here {value}" for name, value in wanted.items() if kept.get(name) != value
        ]
        if other and not force:
            raise AlreadyExists(
                f"{folder.path}: holds a reproduction with other settings ({'; '.join(other)}); give another folder"
                " (--output), or replace it with force (--force)"
            )
    elif folder.path.is_dir() and any(each.name != "trainings" for each in folder.path.iterdir()):
        raise AlreadyExists(f"{folder.path}: is there already and holds no reproduction; give another (--output)")
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        check_writable(folder.path)
    except OSError as error:
        raise InvalidInput(f"{folder.path}: cannot be written to ({error.strerror}); give another (--output)") from None
    if force:
        _forget(folder)
    write_file(folder.settings, _text({**_FORMAT, **wanted}))
    return folder


def _wanted(settings: Settings) -> Json:
    """What every result in a folder shares; the trainings behind a result stand in it."""
    return {"episodes": settings.episodes, "version": __version__}


def _forget(folder: ReproductionFolder) -> None:
    """Delete every result; figures and data are replaced as they are made again."""
    for item in ITEMS:
        folder.result(item.name).unlink(missing_ok=True)


def write_item(folder: ReproductionFolder, item: Item, made: Made, more: Mapping[str, Any]) -> Json:
    """Write figures and data of an item, then its result, which makes them count; gives the result."""
    place = folder.path / item.name
    if place.is_symlink() or (place.exists() and not place.is_dir()):
        raise InvalidInput(f"{place}: is no plain folder; move it away")
    place.mkdir(exist_ok=True)
    for drawn in made.figures:
        for ending in ENDINGS:
            file = folder.figure(item.name, drawn.stem, ending)
            write_output(file, picture_bytes(drawn.figure, file), force=True)
    for stem, text in (made.data or {}).items():
        write_output(place / f"{stem}.csv", text.encode(), force=True)
    result = item_json(item, made, more)
    write_output(folder.result(item.name), _text(result), force=True)
    return result


def item_json(item: Item, made: Made, more: Mapping[str, Any]) -> Json:
    """An item and what became of it as plain data."""
    return {
        "name": item.name,
        "labels": list(item.labels),
        "title": item.title,
        "what": item.what,
        **more,
        "verdict": made.verdict.to_json(),
        "comparisons": [verdict.to_json() for verdict in made.verdicts],
        "parameters": [{"name": p.name, "value": p.value, "origin": p.origin} for p in made.parameters],
        "tables": [table.to_json() for table in made.tables],
        "figures": [{"stem": each.stem, "title": each.title, "text": each.text} for each in made.figures],
        "data": sorted(f"{stem}.csv" for stem in made.data or {}),
        "notes": list(made.notes),
    }


def read_results(folder: ReproductionFolder) -> list[Json]:
    """The results that are there, in the order of the paper; raises ``InvalidInput`` for one that is damaged."""
    return [read_result(folder, item) for item in ITEMS if folder.result(item.name).is_file()]


def read_result(folder: ReproductionFolder, item: Item) -> Json:
    """The result of an item that was made; raises ``InvalidInput`` for one that is damaged, or another item's."""
    file = folder.result(item.name)
    content = checked_result(read_object(file), str(file))
    if content["name"] != item.name:
        raise _damaged(f"{file}: name")
    if any(Path(name).name != name for name in content["data"]):
        raise _damaged(f"{file}: data")
    compared = [Verdict(**each) for each in content["comparisons"]]
    if any(each.outcome not in OUTCOMES for each in compared):
        raise _damaged(f"{file}: comparisons")
    if content["verdict"] != summarise_verdicts(compared).to_json():
        raise _damaged(f"{file}: verdict")
    return content


_TEXT, _TEXTS, _ROWS = TypeAdapter(str), TypeAdapter(list[str]), TypeAdapter(list[list[str]])
_VERDICT = {"what": _TEXT, "outcome": _TEXT, "because": _TEXT}
_PARTS: dict[str, dict[str, TypeAdapter[Any]]] = {  # of a result, each a list of such objects
    "comparisons": _VERDICT,
    "parameters": {"name": _TEXT, "value": _TEXT, "origin": _TEXT},
    "tables": {"title": _TEXT, "head": _TEXTS, "rows": _ROWS, "note": _TEXT},
    "figures": {"stem": _TEXT, "title": _TEXT, "text": _TEXT},
}
_WHOLE: dict[str, TypeAdapter[Any]] = {
    **dict.fromkeys(("name", "title", "what", "made_utc", "machine"), _TEXT),
    **dict.fromkeys(("labels", "data", "notes", "trained"), _TEXTS),
    "processor_s": TypeAdapter(float),
    "verdict": TypeAdapter(dict[str, str]),
    **dict.fromkeys(_PARTS, TypeAdapter(list[dict[str, Any]])),
}


def checked_result(content: Json, where: str) -> Json:
    """The same result; raises ``InvalidInput`` where what pages show is not there or of another kind."""
    _check_keys(content, _WHOLE, where)
    _check_keys(content["verdict"], _VERDICT, f"{where}: verdict")
    for name, keys in _PARTS.items():
        for each in content[name]:
            _check_keys(each, keys, f"{where}: {name}")
    for table in content["tables"]:
        if {len(row) for row in table["rows"]} - {len(table["head"])} or not table["head"]:
            raise _damaged(f"{where}: tables: rows")
    return content


def _check_keys(content: Json, keys: Mapping[str, TypeAdapter[Any]], where: str) -> None:
    for key, kind in keys.items():
        try:
            kind.validate_python(content.get(key), strict=True)
        except ValidationError:
            raise _damaged(f"{where}: {key}") from None


def _damaged(where: str) -> InvalidInput:
    return InvalidInput(f"{where}: is not what a reproduction writes; make it again (--force)")


def read_figure(folder: ReproductionFolder, name: str, stem: str, ending: str) -> bytes:
    """A figure that was written; raises ``InvalidInput`` where it is not there."""
    return read_plain(folder.figure(name, stem, ending), _LIMIT_BYTES)


def _text(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()
