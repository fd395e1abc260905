"""Episodes as a Parquet file: one row per agent, world and decision, one row group per batch of worlds."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import naming_extras
from ethbrake_marl.evaluation.dataset.recording import Recording
from ethbrake_marl.files.durable import new_file

KEY = "ethbrake_marl"  # of the file's metadata: what was recorded, as JSON

Columns = dict[str, NDArray[Any]]


@contextmanager
def parquet_file(path: Path, told: Mapping[str, Any]) -> Iterator[Callable[[Recording], None]]:
    """Give what adds recordings to the file, which appears at ``path`` when the block ends well.

    ``told`` is read at the end, and stands in the file's metadata under ``KEY``. Raises ``MissingExtra``.
    """
    with naming_extras():
        import pyarrow
        from pyarrow.parquet import ParquetWriter

    writer = None
    with new_file(path) as partial:

        def add(recording: Recording) -> None:
            nonlocal writer
            columns = {name: pyarrow.array(values) for name, values in decision_columns(recording).items()}
            columns["agent"] = columns["agent"].dictionary_encode()
            table = pyarrow.table(columns)
            if writer is None:
                writer = ParquetWriter(partial, table.schema)
            writer.write_table(table, row_group_size=max(table.num_rows, 1))

        try:
            yield add
        finally:
            if writer is not None:
                writer.add_key_value_metadata({KEY: json.dumps(told)})
                writer.close()


def decision_columns(recording: Recording) -> Columns:
    """One entry per decision, world by world; docs/datasets.md lists the columns."""
    running = recording.running
    before, after = recording.told, recording.reports[1:]

    def each(values: NDArray[Any]) -> NDArray[Any]:
        """Values [T or T + 1, n, ...], of each decision's begin, decision by decision."""
        return values[: running.shape[1]].swapaxes(0, 1)[running]

    def whole(values: NDArray[Any]) -> NDArray[Any]:
        """A value of each episode [n] in all of its rows."""
        return np.repeat(values, recording.decisions)

    columns: Columns = {
        "agent": np.full(int(running.sum()), recording.agent),
        "world_seed": np.full(int(running.sum()), recording.task.seed),
        "world": whole(recording.index),
        "decision": np.nonzero(running)[1],
        "time_s": each(before("time_s")[:, :, 0]),
    }
    in_force = before("command_in_force_mps2")
    for i in range(recording.task.scenario.vehicles):
        columns[f"position_{i + 1}_m"] = each(recording.positions_m[:, :, i])
        columns[f"speed_{i + 1}_mps"] = each(recording.speeds_mps[:, :, i])
        columns[f"command_in_force_{i + 1}_mps2"] = each(in_force[:, :, i])
    columns |= _learner_columns(recording, each)
    columns["cost"] = each(np.stack([told.cost for told in after]))
    columns["terminated"] = each(np.stack([step.terminated for step in recording.steps]))
    columns["truncated"] = each(np.stack([step.truncated for step in recording.steps]))
    columns["first_impact_harm"] = whole(recording.ledger.world_harm("first"))
    columns["total_harm"] = whole(recording.ledger.world_harm("total"))
    return columns


def _learner_columns(recording: Recording, each: Callable[[NDArray[Any]], NDArray[Any]]) -> Columns:
    """What each learner observes, does, and is rewarded with."""
    columns: Columns = {}
    chosen, terms = recording.told("chosen_command_mps2")[1:], recording.terms()
    reward = np.stack([step.reward for step in recording.steps])
    for c, i in enumerate(recording.learners):
        for f, feature in enumerate(recording.task.observation.features):
            columns[f"observation_{i + 1}.{feature.name}"] = each(recording.observations[:, :, c, f])
        columns[f"action_{i + 1}"] = each(recording.actions[:, :, c])
        columns[f"chosen_command_{i + 1}_mps2"] = each(chosen[:, :, i])
        columns[f"reward_{i + 1}"] = each(reward[:, :, i])
        columns |= {f"reward_{name}_{i + 1}": each(term[1:, :, c]) for name, term in terms.items()}
    return columns
