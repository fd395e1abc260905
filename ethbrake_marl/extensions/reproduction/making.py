"""Reproduce figures and tables of the paper, and store the results in a folder."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime

from ethbrake_marl import __version__
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.extensions.reproduction.folder import (
    FORMAT,
    RESULT,
    SETTINGS,
    Item,
    Reproduction,
    Result,
    Table,
    json_text,
)
from ethbrake_marl.extensions.reproduction.items import ITEMS, read_results
from ethbrake_marl.extensions.reproduction.pages import render_page
from ethbrake_marl.extensions.reproduction.verdicts import summarise_verdicts
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import write_file, write_output


def choose_items(names: Sequence[str]) -> list[Item]:
    """Return the items with these names, in the order of the paper; without names, all items.

    Raises ``UnknownName``, with a suggestion, if a name is unknown, and ``InvalidInput`` if a name is repeated.
    """
    known = {item.name: item for item in ITEMS}
    for k, name in enumerate(names):
        if name not in known:
            raise unknown_name("item", name, known)
        if name in names[:k]:
            raise InvalidInput(f"item {name!r} is given twice; give each item only once")
    return [item for item in ITEMS if not names or item.name in names]


def open_folder(asked: Reproduction, *, force: bool = False) -> StudyFolder:
    """Return the ``StudyFolder`` of a reproduction, in which a reproduction with the same settings continues.

    With ``force``, existing results in the folder are deleted first; training runs are never deleted. Raises
    ``InvalidInput`` if the path of the folder is a symbolic link.
    """
    path, question = asked.folder, {"episodes": asked.episodes, "version": __version__}
    if path.is_symlink():
        raise InvalidInput(f"{path}: this is a symbolic link; give the path of a folder (--output)")
    if force and (path / SETTINGS).is_file() and read_object(path / SETTINGS).get("format") == FORMAT["format"]:
        for item in ITEMS:  # figures and data are overwritten later
            (path / item.name / RESULT).unlink(missing_ok=True)
        write_file(path / SETTINGS, json_text({**FORMAT, **question}))
    advice = "give another folder (--output), or replace its results (--force)"
    return StudyFolder(
        path, "a reproduction", question, record=SETTINGS, more=FORMAT, advice=advice, beside=("trainings",),
        writes=("index.html",),
    )  # fmt: skip


def make_items(asked: Reproduction, items: Sequence[Item], *, force: bool = False) -> tuple[list[Result], bool]:
    """Reproduce items; return all results in the folder, and whether all training runs are finished.

    Items that need no training runs are reproduced first. Without ``force``, an item is not reproduced again if its
    stored result comes from the same training runs. The HTML page with all results is written again after each item.

    Ctrl-C during a training run stops all training runs; the items are then reproduced with the finished training runs.
    A second Ctrl-C stops the command at once.

    Raises the exceptions of ``open_folder`` and ``StudyFolder.work``.
    """
    full, finished = asked.mode == "full", True
    with open_folder(asked, force=force).work():
        for item in sorted(items, key=lambda each: len(each.trained) if full else 0):
            if full and finished:
                finished = asked.train(item.trained)
            trained = list(asked.trained(item.trained))
            stored = {result.name: list(result.trained) for result in read_results(asked.folder)}
            if stored.get(item.name) != trained:
                _make_item(asked, item, trained)
                write_file(asked.folder / "index.html", render_page(asked.folder, read_results(asked.folder)).encode())
        return read_results(asked.folder), finished


def _make_item(asked: Reproduction, item: Item, trained: Sequence[str]) -> None:
    """Reproduce an item; write its figures, its data and then its result file, which marks the item as complete.

    ``trained`` are the recipes whose finished training runs the item uses, as ``group/recipe``.
    """
    place, started = asked.folder / item.name, time.process_time()
    product = item.make(asked)
    result = Result(
        name=item.name,
        labels=item.labels,
        title=item.title,
        what=item.what,
        mode=asked.mode,
        episodes=asked.episodes,
        trained=trained,
        processor_s=round(time.process_time() - started, 1),
        made_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        machine=asked.machine,
        verdict=summarise_verdicts(product.verdicts),
        comparisons=product.verdicts,
        parameters=product.parameters,
        tables=[
            Table(each.title, each.headings, [row for row in each.shown() if not isinstance(row, str)], each.note)
            for each in product.tables
        ],
        figures=list(product.figures),
        data=sorted(f"{stem}.csv" for stem in product.data),
        notes=product.notes,
    )
    if place.is_symlink() or (place.exists() and not place.is_dir()):
        raise InvalidInput(f"{place}: must be a folder, but is a file or a symbolic link; move it away")
    place.mkdir(exist_ok=True)
    for drawn, figure in product.figures.items():
        for ending in (".svg", ".png"):
            write_picture(place / f"{drawn.stem}{ending}", figure, force=True)
    for stem, text in product.data.items():
        write_output(place / f"{stem}.csv", text.encode(), force=True)
    write_output(place / RESULT, json_text(asdict(result)), force=True)
