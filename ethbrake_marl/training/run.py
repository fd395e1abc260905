"""The folder of a training run, and its logs."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args

from stable_baselines3.common.logger import CSVOutputFormat, KVWriter, TensorBoardOutputFormat
from tensorboard.compat.proto.event_pb2 import Event, SessionLog

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import hold_lock, new_folder, remove_unfinished, write_file
from ethbrake_marl.training.training import STATUS_FILE, Training, check_new_run
from ethbrake_marl.worlds.scenario import Scenario

Status = Literal["running", "finished", "interrupted", "failed"]

RUN_FORMAT = "ethbrake-run"


class RunFolder:
    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path).expanduser()
        self.config = self.path / "config.json"  # recipe and scenario in full, seeds, versions
        self.status = self.path / STATUS_FILE  # steps, status and reason, evaluations
        self.policy = self.path / "policy"  # the best policies, or the last ones if nothing was measured
        self.last_policy = self.path / "policy-last"
        self.progress = self.path / "progress.csv"  # a row per update
        self.tensorboard = self.path / "tensorboard"  # the numbers of progress.csv
        self.checkpoints = self.path / "checkpoints"  # until the training has finished

    def create(self, config: Mapping[str, Any], *, force: bool = False) -> None:
        """With ``force`` it replaces an earlier run.

        Raises the errors of ``check_new_run``, and ``InvalidInput`` if a process is training in the earlier run.
        """
        exists = check_new_run(self.path, force=force)
        # The lock ends before the folder is replaced: Windows cannot move a folder with an open file.
        with new_folder(self.path, replace=exists) as partial, self.held() if exists else nullcontext():
            new = RunFolder(partial)
            write_json(new.config, config)
            new.write_status("running")

    def held(self) -> AbstractContextManager[None]:
        """Raises ``InvalidInput`` if another process trains here."""
        return hold_lock(self.path / "run.lock", "another process is training in this folder")

    def write_status(self, status: Status, **more: Any) -> None:
        now = datetime.now(UTC).isoformat(timespec="seconds")
        before = read_object(self.status) if self.status.exists() else {"format": RUN_FORMAT, "format_version": 1}
        times = {"started_utc": before.get("started_utc", now), "ended_utc": None if status == "running" else now}
        write_json(self.status, {**before, "status": status, **times, **more})

    @contextmanager
    def stage(self, name: str, status: Status) -> Iterator[None]:
        """Record the block in ``run.json`` as a stage after the training: its name, how it ended, and the files it
        wrote.
        """
        with self.held():
            self.write_status("running", stage=name)
            before = set(os.listdir(self.path))
            ended: Status = status
            reason: str | None = None
            try:
                yield
            except BaseException as error:
                ended = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
                reason = repr(error)
                raise
            finally:
                written = sorted(set(os.listdir(self.path)) - before)
                self.write_status(ended, reason=reason, written=written)

    def training(self) -> Training:
        """Raises ``InvalidInput`` if this is no folder of a run, if a file is damaged, or if a folder is a link."""
        if not (os.path.lexists(self.status) or os.path.lexists(self.config)):
            raise InvalidInput(
                f"{self.path}: is not the folder of a run; name the folder of a run, for instance runs/my-run"
            )
        for folder in (self.checkpoints, self.tensorboard, self.policy, self.last_policy):
            if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
                raise InvalidInput(
                    f"{folder}: must be a plain folder, not a link or a file, because the training replaces its content"
                )
        status, config = read_object(self.status).get("status"), read_object(self.config)
        if status not in get_args(Status):
            raise InvalidInput(f"{self.status}: status = {status!r:.60}: must be {' or '.join(get_args(Status))}")
        try:
            return Training.of(config["recipe"], Scenario(**config["scenario"]))
        except (KeyError, TypeError) as error:
            raise InvalidInput(f"{self.config}: does not describe a training ({error})") from None
        except InvalidInput as error:
            raise InvalidInput(f"{self.config}: {error}") from None

    def clear(self) -> None:
        for folder in (self.path, self.checkpoints):
            remove_unfinished(folder)
        written = read_object(self.status).get("written", ())
        for path in [*self.path.iterdir()]:
            if path.name in written and not path.is_dir():
                path.unlink()

    def open_logs(self, progress: str, steps: int | None) -> list[KVWriter]:
        """``steps``: number of decisions so far of a training that is resumed; None for a new one, which deletes old
        events.
        """
        self.progress.unlink(missing_ok=True)  # it may be a link, whose target must not be overwritten
        if steps is None:
            for event_file in self.tensorboard.glob("events.out.tfevents.*"):
                event_file.unlink()
        table = CSVOutputFormat(str(self.progress))
        table.file.write(progress)
        table.file.flush()
        table.keys = [name for name in progress.partition("\n")[0].split(",") if name]
        events: Any = TensorBoardOutputFormat(str(self.tensorboard))  # torch declares its attribute ``writer`` as None
        if steps is not None:
            restart = Event(step=steps + 1, session_log=SessionLog(status=SessionLog.START))
            events.writer.file_writer.add_event(restart)  # TensorBoard then drops all events from this step on
        return [table, events]


def write_json(file: Path, content: Mapping[str, Any]) -> None:
    write_file(file, json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")
