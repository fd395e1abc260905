"""``RunDirectory``: the folder of a run, which contains a training run and its results."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import new_folder, write_file
from ethbrake_marl.first_edition.game.harm import HarmCount

RunStatus = Literal["running", "finished", "interrupted", "failed"]


class RunDirectory:
    """The paths of a run's files, and methods that read and write them. The folder ``path`` need not exist yet."""

    # Columns of progress.csv. Columns with results of evaluations have the prefix ``eval/``.
    RETURN = "rollout/ep_rew_mean"  # mean return of the latest training episodes, which include exploration
    OBJECTIVE = "objective"  # mean of the learners' objectives, if one of them is not the harm of the line
    HARM: ClassVar[dict[HarmCount, str]] = {"first": "first_impact_harm", "total": "total_harm"}

    WRITTEN = "written"  # key of run.json: names of the files that ``ethbrake run`` wrote after the training

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.json"  # recipe, scenario, seeds and versions of the run
        self.status = path / "run.json"  # state of the run: a ``RunStatus``, steps, updates, wall time
        self.progress = path / "progress.csv"  # log of the training, with one row per update
        self.tensorboard = path / "tensorboard"  # TensorBoard events with the numbers of progress.csv
        self.policy = path / "policy"  # bundle of the best policy, or of the last policy if nothing was measured
        self.last_policy = path / "policy-last"  # bundle of the policy at the end of the training
        self.team = path / "team.json"  # which bundle drives which vehicle
        self.checkpoints = path / "checkpoints"  # checkpoints for ``resume``; deleted when the training has finished
        self.lock = path / "run.lock"  # lock file of the process that trains in this folder

    def checkpoint(self, steps: int) -> Path:
        """Return the path of the checkpoint after ``steps`` decisions of all learners together."""
        return self.checkpoints / f"step_{steps:012d}"

    def create(
        self, config: Mapping[str, Any], *, team: Mapping[str, Any] | None = None, force: bool = False
    ) -> RunDirectory:
        """Create the folder with ``config.json`` and ``run.json`` atomically, so that the run can be resumed; return
        this object.

        ``config`` and ``team`` are the contents of ``config.json`` and ``team.json``; without ``team``, ``team.json``
        is not written. With ``force``, an earlier run (a folder with a ``run.json``) or an empty folder is replaced.
        Raises ``AlreadyExists`` for any other existing path.
        """
        path, is_run = self.path, self.status.is_file()
        replace = force and path.is_dir() and not path.is_symlink() and (is_run or not any(path.iterdir()))
        if not replace and (path.exists() or path.is_symlink()):
            if not is_run:
                raise AlreadyExists(f"{path}: already exists and is not the folder of a run; choose another name")
            raise AlreadyExists(
                f"{path}: this run already exists; choose another folder (--output), resume the run (ethbrake train"
                " --resume), or replace it (--force; make run ARGS=--force)"
            )
        with new_folder(path, replace=replace) as partial:
            new = RunDirectory(partial)
            new.write_json(new.config, config)
            if team is not None:
                new.write_json(new.team, team)
            new.write_status("running")
        return self

    def write_json(self, file: Path, content: Mapping[str, Any]) -> None:
        """Write ``content`` as JSON to ``file``, a path in this folder. If writing fails, the old file is unchanged."""
        write_file(file, json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")

    def write_status(self, status: RunStatus, **more: Any) -> None:
        """Write ``run.json`` anew: status, start time, end time (unless the status is ``running``), and the entries
        ``more``.
        """
        now = datetime.now(UTC).isoformat(timespec="seconds")
        before = read_object(self.status) if self.status.exists() else {}
        times = {"started_utc": before.get("started_utc") or now}
        if status != "running":
            times["ended_utc"] = now
        self.write_json(self.status, {"format": "ethbrake-run", "format_version": 1, "status": status, **times, **more})

    def remove_results(self) -> None:
        """Delete results and reports of ``ethbrake run``, because they do not apply to the continued training run."""
        own, written = {path.name for path in vars(self).values()}, read_object(self.status).get(self.WRITTEN)
        names = written if isinstance(written, list) else []
        for path in [*self.path.iterdir()]:
            if path.name in names and path.name not in own and (path.is_symlink() or path.is_file()):
                path.unlink()

    def read_config(self) -> dict[str, Any]:
        """Return the content of ``config.json``: recipe, scenario, seeds and versions.

        Raises ``InvalidInput`` if the folder does not contain a run, or if a file or folder in it is damaged.
        """
        if not (os.path.lexists(self.status) or os.path.lexists(self.config)):
            raise InvalidInput(
                f"{self.path}: is not the folder of a run; name the folder of a run, for instance runs/my-run"
            )
        for folder in (self.checkpoints, self.tensorboard, self.policy, self.last_policy):
            if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
                raise InvalidInput(
                    f"{folder}: must be a plain folder, not a link or a file, because the training replaces its content"
                )
        status, config = read_object(self.status), read_object(self.config)
        for key, right in (("format", ("ethbrake-run",)), ("status", get_args(RunStatus))):
            if status.get(key) not in right:
                raise InvalidInput(f"{self.status}: {key} = {status.get(key)!r:.60}: must be {' or '.join(right)}")
        return config

    @property
    def is_finished(self) -> bool:
        return self.status.is_file() and read_object(self.status).get("status") == "finished"

    @classmethod
    def chosen_by(cls, evaluations: Sequence[Mapping[str, Any]], harm_count: HarmCount, prefix: str = "") -> str:
        """Return the name of the metric that is smallest for the best policy.

        The metric is ``objective`` if every evaluation has such an entry, and otherwise the harm of the line
        (``first_impact_harm`` or ``total_harm``, as ``harm_count`` says). ``evaluations`` are evaluations of a training
        run (``TrainResult.evaluations``), or rows of ``progress.csv``. For these rows, ``prefix`` must be ``eval/``;
        the prefix is also part of the result.
        """
        with_objective = evaluations and all(
            entry.get(prefix + cls.OBJECTIVE) not in (None, "") for entry in evaluations
        )
        return prefix + (cls.OBJECTIVE if with_objective else cls.HARM[harm_count])

    def rows(self) -> list[dict[str, str]]:
        """Return the rows of ``progress.csv``: name of a column -> text."""
        return list(csv.DictReader(self.progress.read_text("utf-8").splitlines()))

    def cpu_s(self) -> dict[int, float]:
        """Return the processor time of learning (s) before each evaluation, by the number of decisions until then.

        Raises ``InvalidInput`` if ``run.json`` does not record the processor time.
        """
        recorded = read_object(self.status).get("cpu_s") or {}
        if not recorded:
            raise InvalidInput(f"{self.status}: cpu_s (processor time) is missing; train again with this version")
        return {int(steps): float(spent) for steps, spent in recorded.items()}

    def column(self, name: str) -> dict[int, float]:
        """Return a column of ``progress.csv``: number of decisions so far -> value, for each row with a value in this
        column.
        """
        return {int(row["steps"]): float(row[name]) for row in self.rows() if row.get(name)}
