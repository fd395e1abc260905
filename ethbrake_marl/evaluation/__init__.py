"""Measuring agents on fixed lists of worlds: outcomes, statistics, tables, figures, the report.

``figures``, ``trajectories`` and ``report`` load matplotlib and Jinja2; import those modules where they are used.
"""

from ethbrake_marl.evaluation.episodes import EpisodeRecord, record_episode
from ethbrake_marl.evaluation.outcome import Evaluation, LeftOut, Outcome, parameter_line, parameters
from ethbrake_marl.evaluation.results import check_target, write_per_world_csv
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.summary import (
    Rescored,
    SummaryRow,
    SummaryTable,
    declared_objectives,
    horizon_note,
    markdown_table,
    rescore,
    rescored_table,
    rich_table,
    summarise,
)
from ethbrake_marl.files.sheet import Estimate

__all__ = [
    "EpisodeRecord",
    "Estimate",
    "Evaluation",
    "LeftOut",
    "Outcome",
    "Rescored",
    "SummaryRow",
    "SummaryTable",
    "check_target",
    "declared_objectives",
    "evaluate",
    "horizon_note",
    "markdown_table",
    "parameter_line",
    "parameters",
    "record_episode",
    "rescore",
    "rescored_table",
    "rich_table",
    "summarise",
    "write_per_world_csv",
]
