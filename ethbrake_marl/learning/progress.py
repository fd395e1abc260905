"""The progress of a training: its policies, its evaluations, and alarms when it is lost or its return misleads."""

from __future__ import annotations

import csv
import io
import math
import os
import random
import re
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import KVWriter, filter_excluded_keys
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine.snapshot import Arrays
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.files.store import write_file
from ethbrake_marl.learning.algorithms.protocol import Algorithm
from ethbrake_marl.policies.bundle import Trained

# The random generators that a training uses: kept apart from the caller's, written down, and brought back.


@contextmanager
def own_random_state() -> Iterator[None]:
    """Stable-Baselines3 seeds and uses the global generators: give them back as they were. One torch thread.

    A second thread makes a network this small 3 to 15 times slower as soon as another process wants a core.
    """
    states = random.getstate(), np.random.get_state(), torch.get_rng_state(), torch.get_num_threads()  # noqa: NPY002
    torch.set_num_threads(1)
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002
        torch.set_rng_state(states[2])
        torch.set_num_threads(states[3])


def capture_random(actions: Space[Any]) -> tuple[Arrays, dict[str, Any]]:
    """States of Python's, numpy's and torch's global generators, and of the generator of random actions.

    The arrays are named ``random.*``; the rest is plain JSON.
    """
    numpy_state: Any = np.random.get_state(legacy=False)  # noqa: NPY002
    version, numbers, gauss = random.getstate()
    arrays: Arrays = {
        "random.torch": torch.get_rng_state().numpy().copy(),
        "random.numpy": np.array(numpy_state["state"]["key"], np.uint32),
        "random.python": np.array(numbers, np.uint64),
    }
    plain = {
        "numpy": [int(numpy_state["state"]["pos"]), int(numpy_state["has_gauss"]), float(numpy_state["gauss"])],
        "python": [version, gauss],
        "actions": actions.np_random.bit_generator.state,
    }
    return arrays, plain


def restore_random(actions: Space[Any], arrays: Mapping[str, NDArray[Any]], plain: Mapping[str, Any]) -> None:
    """Bring the generators to the state of ``capture_random``."""
    position, has_gauss, cached = plain["numpy"]
    np.random.set_state(("MT19937", arrays["random.numpy"], position, has_gauss, cached))  # noqa: NPY002
    version, gauss = plain["python"]
    random.setstate((version, tuple(int(number) for number in arrays["random.python"]), gauss))
    torch.set_rng_state(torch.from_numpy(arrays["random.torch"].copy()))
    actions.np_random.bit_generator.state = plain["actions"]


Model = BaseAlgorithm  # of Stable-Baselines3

REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining", "_total_timesteps")


def capture_model(model: Model, algorithm: Algorithm) -> tuple[Arrays, dict[str, Any]]:
    """Weights, optimisers, environment, random generators and counters between two updates, replay memory aside."""
    arrays: Arrays = {f"policy.{name}": _copy(tensor) for name, tensor in model.policy.state_dict().items()}
    arrays |= {name: _copy(tensor) for name, tensor in algorithm.learned_beside(model).items()}
    rates: dict[str, float] = {}
    for name, optimizer in algorithm.optimizers(model).items():
        content = optimizer.state_dict()
        rates[name] = float(content["param_groups"][0]["lr"])
        for index, entries in content["state"].items():
            arrays |= {f"optimizer.{name}.{index}.{key}": _copy(value) for key, value in entries.items()}
    environment: Any = model.env
    arrays |= {f"environment.{name}": array for name, array in environment.snapshot().items()}
    generators, random_plain = capture_random(model.action_space)
    observations: Any = model._last_obs
    episodes = list(model.ep_info_buffer or ())
    arrays |= generators | {
        "last.observations": observations.copy(),
        "last.episode_starts": np.array(model._last_episode_starts, np.bool_),
        "episodes.return": np.array([episode["r"] for episode in episodes], np.float64),
        "episodes.steps": np.array([episode["l"] for episode in episodes], np.int64),
    }
    counters = {name: getattr(model, name) for name in _COUNTERS}
    return arrays, {"counters": counters, "learning_rates": rates, "random": random_plain, "log": _pending_log(model)}


def restore_model(
    model: Model, algorithm: Algorithm, arrays: Mapping[str, NDArray[Any]], plain: Mapping[str, Any]
) -> None:
    """Bring a freshly built model of the same recipe to the state of ``capture_model``."""
    model.policy.load_state_dict({name: torch.from_numpy(array) for name, array in _group(arrays, "policy.").items()})
    for name, tensor in algorithm.learned_beside(model).items():
        tensor.data.copy_(torch.from_numpy(arrays[name]))
    for name, optimizer in algorithm.optimizers(model).items():
        _restore_optimizer(optimizer, _group(arrays, f"optimizer.{name}."), plain["learning_rates"][name])
    environment: Any = model.env
    environment.restore(_group(arrays, "environment."))
    for name in _COUNTERS:
        setattr(model, name, plain["counters"][name])
    model._last_obs = arrays["last.observations"].copy()
    model._last_episode_starts = arrays["last.episode_starts"].copy()
    model.ep_info_buffer, model.ep_success_buffer = _deques(model)
    for gained, steps in zip(arrays["episodes.return"].tolist(), arrays["episodes.steps"].tolist(), strict=True):
        model.ep_info_buffer.append({"r": gained, "l": steps, "t": 0.0})
    restore_random(model.action_space, arrays, plain["random"])


def restore_log(model: Model, plain: Mapping[str, Any]) -> None:
    """Give the model's logger what was recorded and not yet written."""
    for name, (value, count, excluded) in plain["log"].items():
        model.logger.name_to_value[name] = value
        model.logger.name_to_count[name] = count
        model.logger.name_to_excluded[name] = tuple(excluded)


def replay_arrays(model: Model) -> tuple[Arrays, dict[str, Any]]:
    """The filled part of the replay memory, as views, and where it goes on; nothing without one (PPO)."""
    memory: Any = getattr(model, "replay_buffer", None)
    if memory is None:
        return {}, {}
    return {name: getattr(memory, name)[: memory.size()] for name in REPLAY}, {"pos": memory.pos, "full": memory.full}


def restore_replay(model: Model, arrays: Mapping[str, NDArray[Any]], plain: Mapping[str, Any]) -> None:
    """Fill the replay memory of a fresh model."""
    memory: Any = getattr(model, "replay_buffer", None)
    if memory is None:
        return
    for name in REPLAY:
        getattr(memory, name)[: len(arrays[name])] = arrays[name]
    memory.pos, memory.full = plain["pos"], plain["full"]


def _restore_optimizer(optimizer: torch.optim.Optimizer, arrays: Arrays, rate: float) -> None:
    content = optimizer.state_dict()
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, array in arrays.items():
        index, key = name.split(".")
        state.setdefault(int(index), {})[key] = torch.from_numpy(array.copy())
    for group in content["param_groups"]:
        group["lr"] = rate
    optimizer.load_state_dict({"state": state, "param_groups": content["param_groups"]})


def _pending_log(model: Model) -> dict[str, Any]:
    log = model.logger
    pending = {}
    for name, value in log.name_to_value.items():
        number = value.item() if isinstance(value, np.generic | torch.Tensor) else value
        pending[name] = [number, log.name_to_count[name], list(log.name_to_excluded[name] or ())]
    return pending


def _deques(model: Model) -> tuple[Any, Any]:
    size = model._stats_window_size
    return deque(maxlen=size), deque(maxlen=size)


def _group(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _copy(tensor: Any) -> NDArray[Any]:
    return np.array(torch.as_tensor(tensor).detach().cpu().numpy())


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


def check_rollout(model: OnPolicyAlgorithm) -> None:
    """Refuse a rollout that holds a reward or observation that is not finite; names which."""
    for name in ("observations", "rewards"):
        entries = getattr(model.rollout_buffer, name)
        good = np.isfinite(entries)
        if not good.all():
            step, row = np.argwhere(~good)[0][:2]
            raise TrainingDiverged(
                f"training: {name}[step {step}, row {row}] = {entries[~good][0]} in the rollout that ends at step"
                f" {model.num_timesteps}: must be finite; the environment or its reward is at fault"
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
