"""One row per agent and world: its columns, and its file, written whole and never over another by accident."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.knowledge import knowledge_text
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.harm_metrics import COLUMN
from ethbrake_marl.evaluation.outcome import Evaluation, Outcome
from ethbrake_marl.evaluation.regret import Regrets, assess
from ethbrake_marl.files.durable import check_writable, write_file
from ethbrake_marl.harm import HARM_COUNTS
from ethbrake_marl.objectives import Declared, scored
from ethbrake_marl.scenario.sample import quantity, quantity_rules


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Refuse a file that exists (``AlreadyExists``, unless ``force``) or cannot be written (``InvalidInput``).

    Even ``force`` replaces plain files only: no folder, device, pipe or symbolic link. Call it before long work whose
    result goes there.
    """
    target = Path(path)
    try:
        _check_place(target)
        if os.path.lexists(target) and not force:
            raise AlreadyExists(f"{target}: is there already; give another name or use force (--force)")
        check_writable(target.parent)
    except (InvalidInput, AlreadyExists):
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InvalidInput(f"{target!s:.200}: cannot be written ({reason})") from None
    return target


def _check_place(target: Path) -> None:
    if target.is_symlink():
        raise InvalidInput(f"{target}: is a symbolic link; give the file it points to")
    if target.is_dir():
        raise InvalidInput(f"{target}: is a folder; give the name of a file")
    if target.exists() and not target.is_file():
        raise InvalidInput(f"{target}: is a device or a pipe, not a plain file; give another name")
    if not target.parent.is_dir():
        raise InvalidInput(f"{target}: there is no folder {target.parent}; make it first")


def write_output(path: str | Path, data: bytes, *, force: bool = False) -> None:
    """Write ``data`` in one step; raises as ``check_target``."""
    write_file(check_target(path, force=force), data)


Columns = dict[str, list[Any]]

REGRET_COLUMNS = (
    "avoidable",
    "unavoidable_reason",
    "best_known_first_impact_harm",
    "best_known_total_harm",
    "best_known_source",
    "impact_proven",
    "proven_harm",
    "regret_first_impact_harm",
    "regret_total_harm",
)

PER_WORLD = "per_world.csv"  # its name in the folder of a run

_ALWAYS = ("gaps_m", "speeds_mps", "obstacle_gap_m")


def write_per_world_csv(
    path: str | Path, evaluation: Evaluation, *, objectives: Sequence[Declared] = (), force: bool = False
) -> None:
    """Write one row per agent and world; docs/evaluation.md lists the columns. ``objectives`` adds theirs.

    A world that was left out has a row with nothing but its number and, in ``ended``, why.

    The file appears whole or not at all. Raises ``AlreadyExists`` unless ``force``, ``InvalidInput`` without a folder.
    """
    check_target(path, force=force)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    columns = per_world_columns(evaluation, objectives)
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_output(path, text.getvalue().encode(), force=force)


def per_world_columns(evaluation: Evaluation, objectives: Sequence[Declared] = ()) -> Columns:
    """The columns of ``write_per_world_csv``, agent by agent, then world by world; None where there is no value."""
    found: Columns = {}
    initial, regrets = initial_columns(evaluation), assess(evaluation)
    hidden: Columns = {"hidden": evaluation.hidden.astype(int).tolist()}
    for agent, outcome in evaluation.outcomes.items():
        columns = {"agent": [agent] * evaluation.worlds.n, **initial, **outcome_columns(outcome)}
        columns |= regret_columns(outcome, regrets) | objective_columns(outcome, objectives)
        columns |= {"knows": [knowledge_text(outcome.knows)] * evaluation.worlds.n, **hidden}
        for left in evaluation.left_out:
            told = {"agent": agent, "world": left.world, "ended": f"left out: {left.agent}: {left.reason}"}
            columns = {name: [*values, told.get(name)] for name, values in columns.items()}
        found = {name: [*found.get(name, ()), *values] for name, values in columns.items()}
    return found


def initial_columns(evaluation: Evaluation, *, every: bool = False) -> Columns:
    """World number and its initial state: gaps, speeds, and any other quantity that differs between worlds, or every.

    Where there is such, also the scenario of a mixture, and each vehicle's type. Quantities are named
    as in a table of initial states: ``gap_1_m``, ``speed_1_mps``, ``latency_2_s``, ``restitution``.
    """
    columns: Columns = {"world": evaluation.index.tolist()}
    columns |= {name: column.tolist() for name, column in evaluation.kinds.items()}
    for field, rule in quantity_rules(evaluation.worlds).items():
        values = quantity(evaluation.worlds, field)
        if every or field in _ALWAYS or np.ptp(values, axis=0).any():
            columns |= {rule.column_of(i): values[:, i].tolist() for i in range(values.shape[1])}
    return columns


def regret_columns(outcome: Outcome, regrets: Regrets | None) -> Columns:
    """What was avoidable and the best known in each world; empty where nothing is proven."""
    if regrets is None:
        return {name: [None] * len(outcome.collided) for name in REGRET_COLUMNS}
    n, proof = len(outcome.collided), regrets.limits.proof
    columns = (
        np.full(n, None) if proof.avoidable is None else proof.avoidable.astype(int),
        np.full(n, None) if proof.reason is None else proof.reason,
        regrets.first_impact_harm,
        regrets.total_harm,
        regrets.source,
        proof.impact.astype(int),
        proof.harm,
        regrets.regret(outcome, "first"),
        regrets.regret(outcome, "total"),
    )
    return {name: column.tolist() for name, column in zip(REGRET_COLUMNS, columns, strict=True)}


def objective_columns(outcome: Outcome, objectives: Sequence[Declared]) -> Columns:
    """What each objective is for each vehicle under both counts (m2/s2): ``social:45_first_2``."""
    return {
        f"{objective}_{harm_count}_{i + 1}": values[:, i].tolist()
        for objective in objectives
        for harm_count in HARM_COUNTS
        for values in scored(outcome.ledger, harm_count, [objective]).values()
        for i in range(values.shape[1])
    }


def outcome_columns(outcome: Outcome) -> Columns:
    """What happened in each world; a column that the agent says nothing about is empty."""
    n = len(outcome.collided)
    columns: Columns = {"collided": outcome.collided.astype(int).tolist(), "impacts": outcome.impacts.tolist()}
    for name, harm in (
        ("first_impact_harm", outcome.vehicle_harm("first")),
        ("total_harm", outcome.vehicle_harm("total")),
    ):
        columns |= {f"{name}_{i + 1}": harm[:, i].tolist() for i in range(harm.shape[1])}
    columns |= {"first_impact_harm": outcome.first_impact_harm.tolist(), "total_harm": outcome.total_harm.tolist()}
    for name, column in (("sampled_harm", outcome.sampled_harm), ("vehicle_1_shoved_m", outcome.shoved_m)):
        columns[name] = [None] * n if column is None else column.tolist()
    final = outcome.final
    if np.isfinite(final.obstacle_gap_m).all():  # of the harm above, what Vehicle 1's impacts with the obstacle did
        columns |= {"obstacle_first_impact_harm": outcome.ledger.obstacle_harm("first").tolist()}
        columns |= {"obstacle_total_harm": outcome.ledger.obstacle_harm("total").tolist()}
        columns |= {"final_obstacle_gap_m": final.obstacle_gap_m.tolist()}
    columns |= {f"final_gap_{p + 1}_m": final.gaps_m[:, p].tolist() for p in range(final.N - 1)}
    columns |= {f"final_speed_{i + 1}_mps": final.speeds_mps[:, i].tolist() for i in range(final.N)}
    columns |= {"end_s": final.time_s.tolist(), "ended": outcome.ended.tolist()}
    predicted, chosen = outcome.predicted_harm, outcome.chosen_policy
    columns["predicted_harm"] = [None] * n if predicted is None else predicted.tolist()
    columns["chosen_policy"] = [None] * n if chosen is None else chosen.astype(int).tolist()
    columns |= {f"{COLUMN}{name}": column.tolist() for name, column in outcome.metrics.items()}
    return columns
