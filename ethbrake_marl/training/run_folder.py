"""The folder of a run (a training and its results): the names of its files, and how they are written and read."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from filelock import FileLock, Timeout

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import new_folder, write_file
from ethbrake_marl.game.harm import HarmCount

RunStatus = Literal["running", "finished", "interrupted", "failed"]


class RunDirectory:
    """The folder of a run: paths of its files as attributes, and methods that read and write them.

    ``path`` is the folder, which need not exist yet.
    """

    # Columns of progress.csv, where keys of evaluations have the prefix ``eval/``.
    RETURN = "rollout/ep_rew_mean"  # mean over the last episodes, exploration included
    OBJECTIVE = "objective"  # mean of the learners' objectives, if one of them is not total harm
    HARM: ClassVar[dict[HarmCount, str]] = {"first": "first_impact_harm", "total": "total_harm"}

    WRITTEN = "written"  # key of run.json: names of the files that ``ethbrake run`` wrote after the training

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.json"  # recipe, scenario, seeds and versions of the run
        self.status = path / "run.json"  # progress of the run: a ``RunStatus``, steps, updates, wall time
        self.progress = path / "progress.csv"  # one row per update
        self.tensorboard = path / "tensorboard"  # the same numbers as TensorBoard events
        self.policy = path / "policy"  # bundle with the least harm on the fixed list, or the last one without a list
        self.last_policy = path / "policy-last"  # bundle at the end of the run
        self.team = path / "team.json"  # which bundle drives which vehicle
        self.checkpoints = path / "checkpoints"  # checkpoints for ``resume``; deleted when the training has finished
        self.lock = path / "run.lock"  # lock of the process that trains here

    def checkpoint(self, steps: int) -> Path:
        """Return the path of the checkpoint's folder after ``steps`` decisions of all learners."""
        return self.checkpoints / f"step_{steps:012d}"

    def create(
        self, config: Mapping[str, Any], *, team: Mapping[str, Any] | None = None, force: bool = False
    ) -> RunDirectory:
        """Create the folder with ``config.json`` and ``run.json``, atomically. From then on the run can be resumed.

        Args:
            config: content of ``config.json``.
            team: content of ``team.json``; None: no such file.
            force: replace an earlier run (a folder with a ``run.json``) or an empty folder.

        Returns this object. Raises ``AlreadyExists`` if the path exists and is not replaced.

        """
        path, is_run = self.path, self.status.is_file()
        replace = force and path.is_dir() and not path.is_symlink() and (is_run or not any(path.iterdir()))
        if not replace and (path.exists() or path.is_symlink()):
            if not is_run:
                raise AlreadyExists(f"{path}: exists already and is not a run; give another name")
            raise AlreadyExists(
                f"{path}: exists already; give another folder (--output), resume it (ethbrake train --resume),"
                " or replace it with force (--force; make run ARGS=--force)"
            )
        with new_folder(path, replace=replace) as partial:
            new = RunDirectory(partial)
            new.write_json(new.config, config)
            if team is not None:
                new.write_json(new.team, team)
            new.write_status("running")
        return self

    def write_json(self, file: Path, content: Mapping[str, Any]) -> None:
        """Write ``content`` as JSON to ``file``, a path in this folder, replacing the file completely or not at all."""
        write_file(file, json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")

    def write_status(self, status: RunStatus, **more: Any) -> None:
        """Replace ``run.json`` by this status.

        The start time does not change; a status other than ``running`` also records the end time. ``more`` are other
        entries.
        """
        now = datetime.now(UTC).isoformat(timespec="seconds")
        before = read_object(self.status) if self.status.exists() else {}
        times = {"started_utc": before.get("started_utc") or now}
        if status != "running":
            times["ended_utc"] = now
        self.write_json(self.status, {"format": "ethbrake-run", "format_version": 1, "status": status, **times, **more})

    def remove_results(self) -> None:
        """Delete the results and reports of ``ethbrake run``, because the training goes on to other weights."""
        own, written = {path.name for path in vars(self).values()}, read_object(self.status).get(self.WRITTEN)
        names = written if isinstance(written, list) else []
        for path in [*self.path.iterdir()]:
            if path.name in names and path.name not in own and (path.is_symlink() or path.is_file()):
                path.unlink()

    def read_config(self) -> dict[str, Any]:
        """Return the content of ``config.json``: recipe, scenario, seeds and versions.

        Raises ``InvalidInput`` if the folder holds no run, or if a file or folder in it is damaged.
        """
        if not (os.path.lexists(self.status) or os.path.lexists(self.config)):
            raise InvalidInput(f"{self.path}: contains no training; give the folder of a run, for instance runs/my-run")
        for folder in (self.checkpoints, self.tensorboard, self.policy, self.last_policy):
            if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
                raise InvalidInput(f"{folder}: is not a plain folder; a training deletes in it, or replaces it")
        status, config = read_object(self.status), read_object(self.config)
        for key, right in (("format", ("ethbrake-run",)), ("status", get_args(RunStatus))):
            if status.get(key) not in right:
                raise InvalidInput(f"{self.status}: {key} = {status.get(key)!r:.60}: must be {' or '.join(right)}")
        return config

    @property
    def is_finished(self) -> bool:
        """Whether the training in this folder has finished."""
        return self.status.is_file() and read_object(self.status).get("status") == "finished"

    def wait_for_others(self, longest_s: float) -> None:
        """Wait until no other process trains in this folder, at most ``longest_s`` seconds; never raise."""
        with suppress(Timeout, OSError), FileLock(self.lock, timeout=longest_s, mode=0o666):
            pass

    @classmethod
    def chosen_by(cls, evaluations: Sequence[Mapping[str, Any]], harm_count: HarmCount, prefix: str = "") -> str:
        """Return the name of the metric whose least value chooses the best policy.

        It is ``objective`` if every evaluation has one, else the harm of the line under ``harm_count``.

        Args:
            evaluations: evaluations, or rows of ``progress.csv``.
            harm_count: harm that the training minimises.
            prefix: text before the names of metrics in ``evaluations`` and in the result: ``eval/`` for rows.

        """
        with_objective = evaluations and all(
            entry.get(prefix + cls.OBJECTIVE) not in (None, "") for entry in evaluations
        )
        return prefix + (cls.OBJECTIVE if with_objective else cls.HARM[harm_count])

    def rows(self) -> list[dict[str, str]]:
        """Return the rows of ``progress.csv``, each as column -> text."""
        return list(csv.DictReader(self.progress.read_text("utf-8").splitlines()))

    def cpu_s(self) -> dict[int, float]:
        """Return number of decisions at each evaluation -> processor time of learning until then (s).

        Raises ``InvalidInput`` if none is recorded.
        """
        recorded = read_object(self.status).get("cpu_s") or {}
        if not recorded:
            raise InvalidInput(f"{self.path}: has no record of processor time; train again with this version")
        return {int(steps): float(spent) for steps, spent in recorded.items()}

    def column(self, name: str) -> dict[int, float]:
        """Return the column ``name`` of ``progress.csv`` as number of decisions -> value, without empty cells."""
        return {int(row["steps"]): float(row[name]) for row in self.rows() if row.get(name)}
