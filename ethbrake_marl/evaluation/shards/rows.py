"""One row per world and agent of a shard, as a Parquet file: world by world, whatever the shards and blocks are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.knowledge import knowledge_text
from ethbrake_marl.errors import naming_extras
from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.evaluation.per_world import Columns, initial_columns, objective_columns, outcome_columns
from ethbrake_marl.files.durable import new_file

_TEXTS = {"agent", "scenario", "ended", "knows"}
_WHOLE = {"world", "collided", "impacts", "chosen_policy", "hidden"}


def row_columns(evaluation: Evaluation, objectives: Sequence[str]) -> Columns:
    """The columns of ``--per-world`` but those of the best known harm, and with every quantity; world by world."""
    n, agents = evaluation.worlds.n, evaluation.outcomes
    initial, hidden = initial_columns(evaluation, every=True), evaluation.hidden.astype(int).tolist()
    found: Columns = {}
    for agent, outcome in agents.items():
        columns: Columns = {"agent": [agent] * n, **initial, **outcome_columns(outcome)}
        columns |= objective_columns(outcome, objectives)
        columns |= {"knows": [knowledge_text(outcome.knows)] * n, "hidden": hidden}
        found = {name: [*found.get(name, ()), *values] for name, values in columns.items()}
    order = np.arange(n * len(agents)).reshape(len(agents), n).T.ravel().tolist()
    return {name: [values[k] for k in order] for name, values in found.items()}


@contextmanager
def rows_file(path: Path, objectives: Sequence[str]) -> Iterator[Callable[[Evaluation], None]]:
    """Give what adds the rows of evaluations to the file, which appears at ``path`` when the block ends well.

    Worlds that were left out have no row. Raises ``MissingExtra`` without pyarrow.
    """
    with naming_extras():
        import pyarrow
        from pyarrow.parquet import ParquetWriter

    def type_of(name: str) -> Any:
        if name in _TEXTS or (name.startswith("vehicle_") and name.endswith("_type")):
            return pyarrow.string()
        return pyarrow.int64() if name in _WHOLE else pyarrow.float64()

    writer = None
    with new_file(path) as partial:

        def add(evaluation: Evaluation) -> None:
            nonlocal writer
            columns = row_columns(evaluation, objectives)
            table = pyarrow.table({name: pyarrow.array(values, type_of(name)) for name, values in columns.items()})
            if writer is None:
                writer = ParquetWriter(partial, table.schema, compression="zstd")
            writer.write_table(table)

        try:
            yield add
        finally:
            if writer is not None:
                writer.close()
