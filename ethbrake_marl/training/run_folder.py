"""The folder of a run: the names of its files, and how they are written and read."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from filelock import FileLock, Timeout

from ethbrake_marl.agents.learned import LearnedAgent
from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.store import new_folder, read_object, write_file
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.recipe import TrainingRecipe
from ethbrake_marl.training.team import read_team
from ethbrake_marl.training.training import Training

RunStatus = Literal["running", "finished", "interrupted", "failed"]


class RunDirectory:
    """A run's folder: the names inside, and what its files say."""

    # Columns of its table, and keys of its evaluations (``eval/`` stands before them in the table)
    RETURN = "rollout/ep_rew_mean"  # mean over the last episodes, exploration included
    OBJECTIVE = "objective"  # mean over the learners of their objectives' harm, where one is another than total
    HARM: ClassVar[dict[HarmCount, str]] = {"first": "first_impact_harm", "total": "total_harm"}

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.json"  # what was asked for: recipe, scenario, seeds, versions
        self.status = path / "run.json"  # how far it came: a ``RunStatus``, steps, updates, wall time
        self.progress = path / "progress.csv"  # one row per update
        self.tensorboard = path / "tensorboard"  # the same numbers as TensorBoard events
        self.policy = path / "policy"  # the bundle of least harm on the fixed list, or the last where none is measured
        self.last_policy = path / "policy-last"  # the bundle at the end of the run
        self.team = path / "team.json"  # which bundle drives which vehicle
        self.checkpoints = path / "checkpoints"  # where the training can go on; empty once it has finished
        self.lock = path / "run.lock"  # held while a process trains here

    def checkpoint(self, steps: int) -> Path:
        """The checkpoint after ``steps`` decisions."""
        return self.checkpoints / f"step_{steps:012d}"

    def create(
        self, config: Mapping[str, Any], *, team: Mapping[str, Any] | None = None, force: bool = False
    ) -> RunDirectory:
        """Make the folder with its configuration and its record, in one step: it can be resumed from then on.

        ``team`` is the content of ``team.json``. Raises ``AlreadyExists`` when there is something; with ``force`` an
        earlier run (a folder with a ``run.json``) or an empty folder is replaced, and anything else is still refused.
        """
        path, is_run = self.path, self.status.is_file()
        replace = force and path.is_dir() and not path.is_symlink() and (is_run or not any(path.iterdir()))
        if not replace and (path.exists() or path.is_symlink()):
            if not is_run:
                raise AlreadyExists(f"{path}: is there already, and is no run; give another name")
            raise AlreadyExists(
                f"{path}: is there already; give another folder (--output), go on with it (ethbrake train --resume),"
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
        """Replace ``file`` in one step."""
        write_file(file, json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")

    def write_status(self, status: RunStatus, **more: Any) -> None:
        """Replace ``run.json``: when it was started stays, and when it ended is now."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        before = read_object(self.status) if self.status.exists() else {}
        times = {"started_utc": before.get("started_utc") or now}
        if status != "running":
            times["ended_utc"] = now
        self.write_json(self.status, {"format": "ethbrake-run", "format_version": 1, "status": status, **times, **more})

    def read_config(self) -> dict[str, Any]:
        """The configuration; raises ``InvalidInput`` where there is no run, or naming the file that is damaged."""
        if not (os.path.lexists(self.status) or os.path.lexists(self.config)):
            raise InvalidInput(f"{self.path}: holds no training; give the folder of a run, for instance runs/my-run")
        for folder in (self.checkpoints, self.tensorboard, self.policy, self.last_policy):
            if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
                raise InvalidInput(f"{folder}: is not a plain folder; a training deletes in it, or replaces it")
        status, config = read_object(self.status), read_object(self.config)
        for key, right in (("format", ("ethbrake-run",)), ("status", get_args(RunStatus))):
            if status.get(key) not in right:
                raise InvalidInput(f"{self.status}: {key} = {status.get(key)!r:.60}: must be {' or '.join(right)}")
        return config

    def training(self, config: Mapping[str, Any]) -> Training:
        """The training of its configuration.

        Raises ``InvalidInput`` naming what is wrong with it, and for a training of another library.
        """
        if "library" in config:
            raise InvalidInput(
                f"{self.path}: was trained by {config['library']}, which leaves nothing to go on from; train again"
            )
        try:
            recipe = TrainingRecipe.of(config["recipe"])
            scenario = Scenario.from_document(Document("scenario", config["scenario"], {}))
        except KeyError as error:
            raise InvalidInput(f"{self.config}: is not the configuration of a training: {error} is missing") from None
        except InvalidInput as error:
            raise InvalidInput(f"{self.config}: {error}") from None
        return Training.of(recipe, scenario)

    def check_same(self, training: Training) -> None:
        """Raise ``InvalidInput`` unless it holds this training, naming the keys in which they differ."""
        found = self.training(read_object(self.config))
        if found.identity == training.identity:
            return
        kept, wanted = found.content(), training.content()
        other = [
            f"{part} {key}"
            for part in wanted
            for key in dict.fromkeys([*wanted[part], *kept[part]])
            if key not in kept[part] or key not in wanted[part] or kept[part][key] != wanted[part][key]
        ]
        raise InvalidInput(
            f"{self.path}: holds another training (here other: {', '.join(other)}); give another folder (--output)"
        )

    @property
    def is_finished(self) -> bool:
        """Whether it holds a training that came to its end."""
        return self.status.is_file() and read_object(self.status).get("status") == "finished"

    @property
    def is_team(self) -> bool:
        """Whether its learners have a policy each, so that no policy alone drives all of them."""
        return os.path.lexists(self.team) and len(set(read_team(self.team).drivers.values())) > 1

    def load_team(
        self, scenario: str | Path | Scenario, name: str = "team", vehicles: Collection[int] | None = None
    ) -> Team:
        """The ``vehicles`` (None: the learners of ``scenario``) driven as they were trained together in this run.

        A learner of the run that is none of them is left out. Raises ``InvalidInput`` where there is no team, for one
        of another line length, or for a learner that it does not drive; ``CorruptBundle`` (file, what is wrong) for a
        damaged one.
        """
        scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        path, file = self.path, self.team
        if not os.path.lexists(file):
            raise InvalidInput(
                f"{path}: holds no team ({file.name}); give the folder of a run, or a bundle as ppo@{path}"
            )
        team = read_team(file)
        if team.vehicles != scenario.vehicles:
            shared = len(set(team.drivers.values())) == 1
            raise InvalidInput(
                f"{path}: is a team for a line of {team.vehicles} vehicles, scenario {scenario.name!r} has"
                f" {scenario.vehicles}; "
                + (
                    f"its one policy can drive other lines: policy@{path}"
                    if shared
                    else "only a shared policy can drive others"
                )
            )
        wanted = {scenario.vehicle_names[i]: i for i in (scenario.learners if vehicles is None else vehicles)}
        missing = [each for each in wanted if each not in team.drivers]
        if missing or not wanted:
            who = ", ".join(missing) or "nobody"
            raise InvalidInput(
                f"{path}: drives {', '.join(team.drivers)}; scenario {scenario.name!r} has {who} to drive"
            )
        return Team({i: LearnedAgent(load_policy(path / team.drivers[each]), name) for each, i in wanted.items()}, name)

    def wait_for_others(self, longest_s: float) -> None:
        """Wait until no other process trains here, so long at most: one that was left alone ends by itself."""
        with suppress(Timeout, OSError), FileLock(self.lock, timeout=longest_s, mode=0o666):
            pass

    @classmethod
    def chosen_by(cls, evaluations: Sequence[Mapping[str, Any]], harm_count: HarmCount, prefix: str = "") -> str:
        """What the best policy has least of: the objective, or the line's harm where an evaluation tells none."""
        found = evaluations and all(entry.get(prefix + cls.OBJECTIVE) not in (None, "") for entry in evaluations)
        return prefix + (cls.OBJECTIVE if found else cls.HARM[harm_count])

    def rows(self) -> list[dict[str, str]]:
        """Its table, one row per update."""
        return list(csv.DictReader(self.progress.read_text("utf-8").splitlines()))

    def cpu_s(self) -> dict[int, float]:
        """Processor seconds of learning until each evaluation, by step; raises ``InvalidInput`` where none are kept."""
        kept = read_object(self.status).get("cpu_s") or {}
        if not kept:
            raise InvalidInput(f"{self.path}: tells no processor time; train again with this version")
        return {int(steps): float(spent) for steps, spent in kept.items()}

    def column(self, name: str) -> dict[int, float]:
        """A column of its table: step -> value, where there is one."""
        return {int(row["steps"]): float(row[name]) for row in self.rows() if row.get(name)}
