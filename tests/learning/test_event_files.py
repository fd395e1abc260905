"""Event files are read in the order in which they were begun, whatever the clock and the processes."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer.event_file_writer import EventFileWriter

from ethbrake_marl.learning.runs import EventFile, cut_back, event_sizes

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def scalars(folder: Path, tag: str) -> list[tuple[int, float]]:
    """(step, value) as TensorBoard reads them."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return [(event.step, event.value) for event in events.Scalars(tag)]


def write_one(folder: Path, step: int) -> None:
    """A file with one row, as one stretch of a training leaves it."""
    file = EventFile(folder)
    file.write({"loss": step / 2}, {"loss": ()}, step)
    file.close()


def test_order__is_that_of_their_beginning_even_where_the_clock_stands_still_or_goes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter([1e9] * 20 + [9e8] * 20)
    monkeypatch.setattr(time, "time", lambda: next(clock))
    for step in range(1, 13):  # 9 to 12: a name of more digits must not come before
        monkeypatch.setattr(os, "getpid", lambda pid=1000 - step: pid)
        write_one(tmp_path, step)
    monkeypatch.undo()
    assert scalars(tmp_path, "loss") == [(step, step / 2) for step in range(1, 13)]
    assert [path.name for path in sorted(tmp_path.iterdir())][::11] == [
        "events.out.tfevents.0000000001",
        "events.out.tfevents.0000000012",
    ]


def test_order__goes_on_after_files_that_are_named_by_the_clock(tmp_path: Path) -> None:
    EventFileWriter(str(tmp_path)).close()
    write_one(tmp_path, 1)
    first, second = sorted(tmp_path.iterdir())
    assert int(second.name.rpartition(".")[2]) == int(first.name.split(".")[3]) + 1
    assert scalars(tmp_path, "loss") == [(1, 0.5)]


def test_file__holds_every_number_at_once_and_can_be_cut_between_two_rows(tmp_path: Path) -> None:
    file = EventFile(tmp_path)
    for step in (1, 2):
        file.write(
            {"loss": np.float32(step), "count": step, "csv only": 1},
            {"loss": (), "count": (), "csv only": ("tensorboard",)},
            step,
        )
        if step == 1:
            sizes = event_sizes(tmp_path)  # before it is closed
    assert scalars(tmp_path, "loss") == [(1, 1.0), (2, 2.0)]
    file.close()
    write_one(tmp_path, 3)
    cut_back(tmp_path, sizes)
    assert scalars(tmp_path, "loss") == scalars(tmp_path, "count") == [(1, 1.0)]
    assert len(list(tmp_path.iterdir())) == 1
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    assert events.Tags()["scalars"] == ["count", "loss"]
