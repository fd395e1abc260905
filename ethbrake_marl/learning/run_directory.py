"""The folder of one training run: what stands where, made once, never overwritten unasked."""

from __future__ import annotations

import json
import shutil
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from ethbrake_marl.durable_files import write_file
from ethbrake_marl.errors import AlreadyExists

RunStatus = Literal["running", "finished", "interrupted", "failed"]


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """Names inside a run's folder."""

    path: Path

    @property
    def config(self) -> Path:
        """What was asked for: recipe, scenario, seeds, versions."""
        return self.path / "config.json"

    @property
    def status(self) -> Path:
        """How far it came: ``running``, ``finished``, ``interrupted`` or ``failed``, steps, updates, wall time."""
        return self.path / "run.json"

    @property
    def progress(self) -> Path:
        """One row per update."""
        return self.path / "progress.csv"

    @property
    def tensorboard(self) -> Path:
        """The same numbers as TensorBoard events."""
        return self.path / "tensorboard"

    @property
    def policy(self) -> Path:
        """The bundle at the end of the run."""
        return self.path / "policy"

    def checkpoint(self, steps: int) -> Path:
        """The bundle after ``steps`` decisions."""
        return self.path / "checkpoints" / f"step_{steps:09d}"

    def write_json(self, file: Path, content: Mapping[str, Any]) -> None:
        """Replace ``file`` in one step."""
        write_file(file, json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")


class RunRecord:
    """Keeps ``run.json``: ``running`` from the moment it is made, something else from ``end`` on."""

    def __init__(self, run: RunDirectory) -> None:
        self._run = run
        self._started, self._clock = _now(), time.monotonic()
        self._write("running", {})

    def end(
        self, status: RunStatus, reason: str | None, *, steps: int, updates: int, checkpoints: Sequence[str]
    ) -> None:
        """Say how the run ended, why if it failed, and what it leaves."""
        policy = self._run.policy.name if self._run.policy.is_dir() else None
        wall_s = round(time.monotonic() - self._clock, 3)
        left = {"steps": steps, "updates": updates, "policy": policy, "checkpoints": list(checkpoints)}
        self._write(status, {"ended_utc": _now(), "wall_s": wall_s, "reason": reason, **left})

    def _write(self, status: RunStatus, more: Mapping[str, Any]) -> None:
        head = {"format": "ethbrake-run", "format_version": 1, "status": status, "started_utc": self._started}
        self._run.write_json(self._run.status, {**head, **more})


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def create_run(path: Path, *, force: bool = False) -> RunDirectory:
    """Make the new, empty folder of a run.

    Raises ``AlreadyExists`` when there is something; with ``force`` an earlier run (a folder with a ``run.json``) or an
    empty folder is replaced, and anything else is still refused.
    """
    run = RunDirectory(path)
    if force and path.is_dir() and not path.is_symlink():
        _remove_run(run)
    try:
        path.mkdir(parents=True)
    except FileExistsError:
        if not run.status.is_file():
            raise AlreadyExists(f"{path}: is there already, and is no run; give another name") from None
        replace = "replace it with force (--force; make run ARGS=--force)"
        raise AlreadyExists(f"{path}: is there already; give another name (--name), or {replace}") from None
    return run


def _remove_run(run: RunDirectory) -> None:
    """Take the folder out of the way in one step, then delete it."""
    if run.status.is_file() or not any(run.path.iterdir()):
        aside = Path(tempfile.mkdtemp(dir=run.path.parent, prefix=f".{run.path.name}.", suffix=".old"))
        run.path.rename(aside / run.path.name)
        shutil.rmtree(aside)
