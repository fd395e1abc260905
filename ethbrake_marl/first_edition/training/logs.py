"""Logs of a training run, which are ``progress.csv`` and TensorBoard events."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.logger import CSVOutputFormat, KVWriter, TensorBoardOutputFormat
from tensorboard.compat.proto.event_pb2 import Event, SessionLog

from ethbrake_marl.first_edition.training.checkpoint import TrainingState
from ethbrake_marl.first_edition.training.run_folder import RunDirectory


def open_logs(run: RunDirectory, state: TrainingState | None) -> list[KVWriter]:
    """Open ``progress.csv`` and the TensorBoard events of a run for writing.

    ``state`` is the checkpoint from which the training run continues: log rows that are newer than the checkpoint
    are dropped. None: the logs begin empty. Returns a writer for ``progress.csv`` and a writer for the TensorBoard
    events, both for the argument ``output_formats`` of Stable-Baselines3's ``Logger``.
    """
    run.progress.unlink(missing_ok=True)  # the path may be a link, whose target must not be overwritten
    if state is None:
        for left in run.tensorboard.glob("events.out.tfevents.*"):
            left.unlink()
    table = CSVOutputFormat(str(run.progress))
    events: Any = TensorBoardOutputFormat(str(run.tensorboard))  # torch declares its attribute ``writer`` as None
    if state is not None:
        table.file.write(state.numbers["progress"])
        table.file.flush()
        table.keys = [name for name in state.numbers["progress"].partition("\n")[0].split(",") if name]
        restart = Event(step=state.steps + 1, session_log=SessionLog(status=SessionLog.START))
        events.writer.file_writer.add_event(restart)  # TensorBoard then drops all events from this step on
    return [table, events]
