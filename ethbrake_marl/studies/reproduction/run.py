"""A reproduction: train what is asked for, make item after item, and keep the page up to date as they are finished."""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import UTC, datetime

from ethbrake_marl.errors import count_of
from ethbrake_marl.files.durable import write_file
from ethbrake_marl.studies.reproduction.folder import (
    Json,
    ReproductionFolder,
    open_folder,
    read_result,
    read_results,
    write_item,
)
from ethbrake_marl.studies.reproduction.item import FULL, Item, Settings
from ethbrake_marl.studies.reproduction.page import render_page
from ethbrake_marl.studies.reproduction.trainings import seconds_left, train_groups, trained_names


def tell_cost(items: Sequence[Item], settings: Settings) -> str:
    """What is left to do and about how long it takes, in one line."""
    wanted = _groups(items) if settings.mode == FULL else set()
    training_s = seconds_left(settings.folder, wanted)
    told = f"to do: {count_of(len(items), 'item')}, at most about {sum(item.most_s for item in items)} s of one core"
    return f"{told}; trainings before them about {training_s / 60.0:.0f} min of one core" if wanted else told


def reproduce(items: Sequence[Item], settings: Settings, *, force: bool = False) -> tuple[list[Json], bool]:
    """Make the items; gives every result that the folder then holds, and whether nothing stopped the trainings.

    Items that need no training come first. One whose result is there, with the same trainings behind it, is kept. After
    each item the page is written anew. Ctrl-C during a training ends all trainings, and the items are made of those
    that are finished; a second one stops at once. Raises what ``open_folder`` raises.
    """
    folder, finished = open_folder(settings, force=force), True
    for item in sorted(items, key=lambda each: len(each.trained) if settings.mode == FULL else 0):
        if settings.mode == FULL and finished:
            finished = train_groups(settings.folder, item.trained, settings.tell)
        make_item(folder, item, settings)
    return read_results(folder), finished


def make_item(folder: ReproductionFolder, item: Item, settings: Settings) -> Json:
    """Make one item, or keep it, and bring the page up to date."""
    trained = trained_names(settings.folder, item.trained) if settings.mode == FULL else []
    kept = _kept(folder, item, trained)
    if kept is not None:
        return kept
    started = time.process_time()
    made = item.make(settings)
    more = {
        "mode": settings.mode,
        "trained": trained,
        "processor_s": round(time.process_time() - started, 1),
        "made_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": settings.machine,
    }
    result = write_item(folder, item, made, more)
    write_file(folder.page, render_page(folder, read_results(folder)).encode())
    return result


def _kept(folder: ReproductionFolder, item: Item, trained: list[str]) -> Json | None:
    """The result that is there already, if the same trainings stand behind it."""
    if not folder.result(item.name).is_file():
        return None
    content = read_result(folder, item)
    return content if content.get("trained") == trained else None


def _groups(items: Sequence[Item]) -> set[str]:
    return {group for item in items for group in item.trained}
