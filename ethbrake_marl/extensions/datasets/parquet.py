"""Write recorded episodes to a Parquet file, with one row per agent, world and decision.

Letters in shapes mean the same as in ``recording``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import naming_extras
from ethbrake_marl.extensions.datasets.recording import Recording
from ethbrake_marl.files.sheet import parquet_file

KEY = "ethbrake_marl"  # key in the metadata of the file; its value describes the recording as JSON

Columns = dict[str, NDArray[Any]]

OF_STEPS = ("reward", "terminated", "truncated")


@contextmanager
def parquet_dataset(path: Path, told: Mapping[str, Any]) -> Iterator[Callable[[Recording], None]]:
    """Context manager that opens a new Parquet file, and yields a function that adds a recording to the file.

    The file appears at ``path`` when the ``with`` block ends without an exception. The metadata ``told`` (result of
    ``tell``) are then stored as JSON under the key ``ethbrake_marl``; the caller may add entries until then. Raises
    ``MissingExtra`` if pyarrow is not installed.
    """
    with naming_extras():
        import pyarrow

    with parquet_file(path, told=lambda: {KEY: json.dumps(told)}) as write:

        def add(recording: Recording) -> None:
            columns = decision_columns(recording)
            write(columns | {"agent": pyarrow.array(columns["agent"]).dictionary_encode()}, together=True)

        yield add


def decision_columns(recording: Recording) -> Columns:
    """Return the columns of the Parquet file for one recording, by name.

    A column has one value for each decision, ordered by world, then by time. docs/extensions/datasets.md describes the
    columns.
    """
    running = recording.running
    before = recording.told

    def each(values: NDArray[Any]) -> NDArray[Any]:
        """Return, for each decision, its element of ``values`` [T or T + 1, n, ...]."""
        return values[: running.shape[1]].swapaxes(0, 1)[running]

    def whole(values: NDArray[Any]) -> NDArray[Any]:
        """Return, for each decision, the element of ``values`` [n] for its episode."""
        return np.repeat(values, recording.decisions)

    in_force, chosen = before("command_in_force_mps2"), before("chosen_command_mps2")[1:]
    terms = recording.terms()
    stacked = {name: np.stack([getattr(step, name) for step in recording.steps]) for name in OF_STEPS}
    columns: Columns = {
        "agent": np.full(int(running.sum()), recording.agent),
        "world_seed": np.full(int(running.sum()), recording.task.seed),
        "world": whole(recording.index),
        "decision": np.nonzero(running)[1],
        "time_s": each(before("time_s")[:, :, 0]),
    }
    for i in range(recording.task.scenario.vehicles):
        columns |= {
            f"position_{i + 1}_m": each(recording.positions_m[:, :, i]),
            f"speed_{i + 1}_mps": each(recording.speeds_mps[:, :, i]),
            f"command_in_force_{i + 1}_mps2": each(in_force[:, :, i]),
        }
    for c, i in enumerate(recording.learners):
        seen = {feature.name: f for f, feature in enumerate(recording.task.observation.features)}
        columns |= {
            **{f"observation_{i + 1}.{name}": each(recording.observations[:, :, c, f]) for name, f in seen.items()},
            f"action_{i + 1}": each(recording.actions[:, :, c]),
            f"chosen_command_{i + 1}_mps2": each(chosen[:, :, i]),
            f"reward_{i + 1}": each(stacked["reward"][:, :, i]),
            **{f"reward_{name}_{i + 1}": each(term[1:, :, c]) for name, term in terms.items()},
        }
    return columns | {
        "cost": each(np.stack([report.cost for report in recording.reports[1:]])),
        "terminated": each(stacked["terminated"]),
        "truncated": each(stacked["truncated"]),
        "first_impact_harm": whole(recording.ledger.world_harm("first")),
        "total_harm": whole(recording.ledger.world_harm("total")),
    }
