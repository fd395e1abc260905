"""The progress of a training: its policies, its evaluations, and alarms when it is lost or its return misleads."""

from __future__ import annotations

import csv
import io
import math
import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.files.store import write_file
from ethbrake_marl.learning.training import Algorithm
from ethbrake_marl.policies.bundle import Trained

Model = BaseAlgorithm  # of Stable-Baselines3

# Column of the log -> info of an episode's end; means over the episodes since the last row, exploration included.
EPISODE_COLUMNS = {
    "rollout/first_impact_harm": "world_first_impact_harm",
    "rollout/total_harm": "world_total_harm",
    "rollout/collision_rate": "collided",
}
HARM_METRIC: dict[HarmCount, str] = {"first": "first_impact_harm", "total": "total_harm"}
OBJECTIVE = "objective"  # mean over the learners of their objectives' harm, where one is another than total
RETURN = "episode_return"
AT_HORIZON = "horizon_rate"  # share of the fixed list's episodes in which something still moves at the horizon

ALARM_AFTER = 3  # evaluations that are compared with as many before them
RISEN = 0.05  # by this share of its size the harm must have grown to count as risen

LOST_AFTER = 2  # evaluations in a row; one may be an accident
TIMES_LEAST = 1.5  # so much harm, in the least harm so far
GIVEN_BACK = 0.1  # and so much of what the training had gained since its first evaluation
CUT_OFF = 0.5  # or any harm that has risen, with so many more of the episodes cut off by the horizon


@dataclass
class Course:
    """The last good policy, the best one, and the evaluations on the way.

    The best is that of least harm on the fixed list, by the learners' objectives and in the ``harm_count`` of the
    reward, not that of highest return; where no harm is measured there is none.
    """

    harm_count: HarmCount = "first"
    policy: Trained | None = None  # none until the first weights were checked
    best: Trained | None = None
    best_harm: float = math.inf
    steps: int = 0
    updates: int = 0
    evaluations: list[dict[str, float]] = field(default_factory=list)  # steps, updates and what ``evaluate`` gave
    alarms: list[str] = field(default_factory=list)
    lost: str | None = None  # the alarm of the last evaluation, if by that one the training is lost
    wall_before_s: float = 0.0  # of the parts of this training that other processes did
    started: float = field(default_factory=time.monotonic)

    @property
    def wall_s(self) -> float:
        """Seconds of training, the time between a kill and the resume left out."""
        return self.wall_before_s + time.monotonic() - self.started

    @property
    def kept(self) -> Trained | None:
        """The policy to use: the best, or the last where nothing was measured."""
        return self.best or self.policy

    def add_evaluation(self, policy: Trained, metrics: Mapping[str, float], episode_return: float | None) -> str | None:
        """Take in an evaluation of ``policy``; gives the alarm, if this one raises it."""
        extra = {} if episode_return is None else {RETURN: episode_return}
        self.evaluations.append({"steps": self.steps, "updates": self.updates, **metrics, **extra})
        name = chosen_by(self.evaluations, self.harm_count)
        if name in metrics and metrics[name] < self.best_harm:
            self.best, self.best_harm = policy, metrics[name]
        self.lost = lost_training(self.evaluations, name)
        alarm = self.lost or misleading_return(self.evaluations, name)
        if alarm is not None:
            self.alarms.append(alarm)
        return alarm

    def to_json(self) -> dict[str, Any]:
        """Everything but the policies."""
        return {
            "evaluations": self.evaluations,
            "alarms": self.alarms,
            "best_harm": None if math.isinf(self.best_harm) else self.best_harm,
            "wall_s": self.wall_s,
        }

    def restore(self, content: Mapping[str, Any]) -> None:
        """Take back what ``to_json`` gave."""
        self.evaluations = [dict(entry) for entry in content["evaluations"]]
        self.alarms = list(content["alarms"])
        self.best_harm = math.inf if content["best_harm"] is None else float(content["best_harm"])
        self.wall_before_s = float(content["wall_s"])


def chosen_by(evaluations: Sequence[Mapping[str, Any]], harm_count: HarmCount, prefix: str = "") -> str:
    """Name of what the best policy has least of: the objective, or the line's harm where an evaluation tells none."""
    found = evaluations and all(entry.get(prefix + OBJECTIVE) not in (None, "") for entry in evaluations)
    return prefix + (OBJECTIVE if found else HARM_METRIC[harm_count])


def misleading_return(evaluations: Sequence[Mapping[str, float]], harm: str) -> str | None:
    """The alarm if each of the last three evaluations has more return, and more harm, than each of the three before.

    The return is the mean of the training's recent episodes, exploration included. The mean harm must have risen by a
    twentieth. A policy that learns to please the reward instead of sparing people looks like this. At an optimum harm
    stays, while the return rises as exploration shrinks: no alarm.
    """
    last = [entry for entry in evaluations if RETURN in entry and harm in entry][-2 * ALARM_AFTER :]
    if len(last) < 2 * ALARM_AFTER:
        return None
    before, now = last[:ALARM_AFTER], last[ALARM_AFTER:]
    if not all(min(e[name] for e in now) > max(e[name] for e in before) for name in (RETURN, harm)):
        return None
    (gained, harmed), (gains, harms) = ([_mean(part, name) for name in (RETURN, harm)] for part in (before, now))
    if not harms > harmed + RISEN * abs(harmed):
        return None
    return (
        f"step {int(last[-1]['steps']):,}: since step {int(before[-1]['steps']):,} the return rose from {gained:.4g} to"
        f" {gains:.4g}, and {harm} from {harmed:.4g} to {harms:.4g} (means of {ALARM_AFTER} evaluations); does the"
        " reward say what you mean?"
    )


def _mean(entries: Sequence[Mapping[str, float]], name: str) -> float:
    return sum(entry[name] for entry in entries) / len(entries)


def lost_training(evaluations: Sequence[Mapping[str, float]], harm: str) -> str | None:
    """The alarm if the last two evaluations have lost what the training had learned.

    Each has half as much harm again as the least so far, and that is a tenth of what had been gained since the first
    evaluation; or its harm has risen by a twentieth, and half of all episodes that ended by themselves at the least
    harm are cut off by the horizon now.
    """
    measured = [entry for entry in evaluations if harm in entry]
    if len(measured) <= LOST_AFTER:
        return None
    least = min(measured, key=lambda entry: entry[harm])
    limit = max(TIMES_LEAST * least[harm], least[harm] + GIVEN_BACK * (measured[0][harm] - least[harm]))

    def is_lost(entry: Mapping[str, float]) -> bool:
        risen = entry[harm] > least[harm] + RISEN * abs(least[harm])
        return entry[harm] > limit or (risen and _cut_off_since(least, entry) > CUT_OFF)

    if not all(is_lost(entry) for entry in measured[-LOST_AFTER:]):
        return None
    last, at_horizon = measured[-1], ""
    if AT_HORIZON in last and AT_HORIZON in least:
        at_horizon = (
            f"; the horizon cuts off {100.0 * last[AT_HORIZON]:.1f} % of the episodes"
            f" (then {100.0 * least[AT_HORIZON]:.1f} %)"
        )
    return (
        f"step {int(last['steps']):,}: training is lost: {harm} is {last[harm]:.4g}, and was {least[harm]:.4g} at step"
        f" {int(least['steps']):,}{at_horizon}; the policy of then is kept"
    )


def _cut_off_since(before: Mapping[str, float], now: Mapping[str, float]) -> float:
    """By how much the share of episodes that the horizon cuts off has risen; 0 where it is not measured."""
    return now[AT_HORIZON] - before[AT_HORIZON] if AT_HORIZON in now and AT_HORIZON in before else 0.0


_LOSSES = (
    "loss",
    "policy_loss",
    "value_loss",
    "policy_gradient_loss",
    "actor_loss",
    "critic_loss",
    "ent_coef_loss",
)


class TrainingDiverged(EthBrakeError, ArithmeticError):
    """A reward, a loss or a weight is no longer a finite number; the last good policy was kept."""


def watch_gradients(model: Model, algorithm: Algorithm) -> None:
    """Refuse every optimiser step whose gradients are not finite, so that the weights stay as they were."""
    hint = "learning_rate or max_grad_norm" if hasattr(model, "max_grad_norm") else "learning_rate"

    def check(optimizer: torch.optim.Optimizer, args: Any, kwargs: Any) -> None:
        sums = [p.grad.sum() for group in optimizer.param_groups for p in group["params"] if p.grad is not None]
        if not torch.isfinite(torch.stack(sums)).all():
            raise TrainingDiverged(
                f"training: the gradient of the loss is not finite at step {model.num_timesteps}; try a smaller {hint}"
            )

    for optimizer in algorithm.optimizers(model).values():
        optimizer.register_step_pre_hook(check)


def check_losses(model: Model) -> None:
    """Refuse an update whose losses are not finite; an infinite loss may well leave finite weights."""
    logged = model.logger.name_to_value  # train/loss, or vehicle_2/loss where learners are independent
    found = ((name, float(logged[name])) for loss in _LOSSES for name in logged if name.rpartition("/")[2] == loss)
    for name, value in found:
        if not np.isfinite(value):
            raise TrainingDiverged(
                f"training: {name} = {value} after step {model.num_timesteps}: must be finite;"
                " try a smaller learning_rate, or smaller weights of the reward"
            )


def check_weights(model: Model, algorithm: Algorithm) -> None:
    """Refuse weights that are not finite."""
    if not weights_are_finite(model, algorithm):
        raise TrainingDiverged(f"training: a weight is not finite after step {model.num_timesteps}")


def check_step(model: Model, rewards: Any, observations: Any) -> None:
    """Refuse a step with a reward or observation that is not finite; names which."""
    for name, entries in (("observations", observations), ("rewards", rewards)):
        good = np.isfinite(entries)
        if not good.all():
            row = np.argwhere(~good)[0][0]
            raise TrainingDiverged(
                f"training: {name}[row {row}] = {entries[~good][0]} at step {model.num_timesteps}: must be finite;"
                " the environment or its reward is at fault"
            )


def weights_are_finite(model: Model, algorithm: Algorithm) -> bool:
    """Whether every weight is finite, and the exploration noise a usable one."""
    finite = all(bool(torch.isfinite(p).all()) for p in model.policy.parameters())
    logarithm = algorithm.log_noise(model)
    if logarithm is None:
        return finite
    noise = torch.exp(logarithm)
    return finite and bool((torch.isfinite(noise) & (noise > 0.0)).all())


# The logs of a run while it learns: ``progress.csv`` and TensorBoard's event files.
#
# ``progress.csv`` has one row per update, its columns in an order that is the same in every run.


class ProgressTable(KVWriter):
    """Writer for Stable-Baselines3's logger; its own CSV writer orders columns by the hash of their names."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows: list[dict[str, Any]] = []
        self._columns: list[str] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Add a row; when a column is new the table is written again, in one step, with that column."""
        values = {"steps": step} | filter_excluded_keys(key_values, key_excluded, "csv")
        row = {name: value.item() if isinstance(value, np.generic) else value for name, value in values.items()}
        self._rows.append(row)
        if row.keys() <= set(self._columns):
            with self._path.open("a", newline="", encoding="utf-8") as file:
                file.write(_lines([row], self._columns))
            return
        self._columns = ["steps", *sorted({name for row in self._rows for name in row} - {"steps"})]
        heading = _lines([dict(zip(self._columns, self._columns, strict=True))], self._columns)
        write_file(self._path, (heading + _lines(self._rows, self._columns)).encode())

    def content(self) -> bytes:
        """The file as it is; empty before the first row."""
        return self._path.read_bytes() if self._rows else b""

    def restore(self, content: bytes) -> None:
        """Go back to an earlier ``content``, in the file too."""
        self._columns, self._rows = parse_progress(content)
        write_file(self._path, content)

    def close(self) -> None:
        """Nothing is held open between rows."""


def parse_progress(content: bytes) -> tuple[list[str], list[dict[str, Any]]]:
    """Columns and rows of a progress table, whose first column is ``steps``; what is empty is not there.

    Raises ``ValueError`` for anything that no ``ProgressTable`` has written.
    """
    try:
        lines = list(csv.reader(io.StringIO(content.decode("utf-8"), newline=""), strict=True))
    except csv.Error as error:
        raise ValueError(f"the progress table is no CSV ({error})") from None
    columns, rows = (lines[0], lines[1:]) if lines else ([], [])
    if columns and (columns[0] != "steps" or len(set(columns)) < len(columns)):
        raise ValueError("the progress table must have the column steps first, and no column twice")
    for number, row in enumerate(rows, start=1):
        if len(row) != len(columns) or not row[0].isdecimal():
            raise ValueError(f"row {number} of the progress table must have {len(columns)} values, the first one steps")
    return columns, [{n: value for n, value in zip(columns, row, strict=True) if value != ""} for row in rows]


def _lines(rows: list[dict[str, Any]], columns: list[str]) -> str:
    text = io.StringIO()
    csv.DictWriter(text, columns, restval="", lineterminator="\n").writerows(rows)
    return text.getvalue()


_PREFIX = "events.out.tfevents."
_VERSION = "brain.Event:2"  # first record of every file


class EventFile(KVWriter):
    """Writer for Stable-Baselines3's logger: a new file of numbers, which TensorBoard reads after all that are there.

    Its name ends in a number of ten digits, one more than the largest in the folder (files of TensorBoard's own writer
    carry their second in that place); the first is 1. Every row is in the file when ``write`` returns.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        found = (re.match(rf"{re.escape(_PREFIX)}(\d{{10}})", path.name) for path in folder.iterdir())
        number = max((int(match[1]) for match in found if match), default=0) + 1
        self._file = (folder / f"{_PREFIX}{number:010d}").open("xb")
        self._records = RecordWriter(self._file)
        self._add(Event(wall_time=time.time(), file_version=_VERSION))

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        """Add one row of numbers."""
        row = filter_excluded_keys(key_values, key_excluded, "tensorboard")
        values = [Summary.Value(tag=name, simple_value=float(row[name])) for name in sorted(row)]
        self._add(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _add(self, event: Any) -> None:
        self._records.write(event.SerializeToString())
        self._file.flush()


def event_sizes(folder: Path) -> dict[str, int]:
    """Name -> bytes of the event files."""
    return {path.name: path.stat().st_size for path in sorted(folder.iterdir())} if folder.is_dir() else {}


def cut_back(folder: Path, sizes: Mapping[str, int]) -> None:
    """Drop what was written after ``event_sizes`` gave ``sizes``: later records, and later files.

    Only plain files are cut; links and pipes in their place go, folders stay.
    """
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            continue  # nothing that a training wrote
        if path.name not in sizes or path.is_symlink() or not path.is_file():
            path.unlink()  # of a link the link alone
        elif path.stat().st_size > sizes[path.name]:
            os.truncate(path, sizes[path.name])
