"""A training at rest between two updates, as a folder of plain files: whole or not there, and checked when read.

``checkpoint.json`` lists every other file with its size and SHA-256; numbers are JSON, safetensors and ``.npy``
without objects, so reading one runs no code from it.
"""

from __future__ import annotations

import copy
import hashlib
import json
import os
import random
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import safetensors.numpy
import torch
from gymnasium.spaces import Space
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field
from safetensors import SafetensorError
from typing_extensions import TypedDict

from ethbrake_marl.engine.snapshot import Arrays
from ethbrake_marl.errors import CorruptBundle, EthBrakeError, InvalidInput
from ethbrake_marl.files.arrays import ArrayHeader, ArrayRow, check_arrays, map_npy, safetensors_headers
from ethbrake_marl.files.store import new_folder, open_plain, parse_strict_json, read_plain, remove_folder, write_file
from ethbrake_marl.files.yaml import FileModel, read_json_model
from ethbrake_marl.learning.progress import EPISODE_COLUMNS, Model, parse_progress
from ethbrake_marl.learning.training import Algorithm
from ethbrake_marl.policies.actor import Sha256, installed_versions
from ethbrake_marl.policies.bundle import Policy, Trained, drivers_of, read_trained, save_trained

# The schema of a checkpoint's JSON files: their keys, types and bounds.

Count = Annotated[int, Field(ge=0, lt=2**63)]
Number = Annotated[int | float, Field(ge=-1e300, le=1e300)]
Seconds = Annotated[float, Field(strict=False, ge=0.0, allow_inf_nan=False)]


class _ListedFile(FileModel):
    bytes: Count
    sha256: Sha256


class Listing(FileModel):
    """``checkpoint.json``: every other file of the checkpoint, and from where and when it is."""

    format: Literal["ethbrake-checkpoint"]
    format_version: Literal[1]
    steps: Count
    updates: Count
    versions: dict[str, str]
    files: dict[str, _ListedFile]


# The names of Stable-Baselines3's own counters begin with an underscore.
class _Counters(TypedDict):
    num_timesteps: Count
    _n_updates: Count
    _episode_num: Count
    _current_progress_remaining: Number
    _total_timesteps: Count


_Counters.__pydantic_config__ = ConfigDict(strict=True, extra="forbid")  # type: ignore[attr-defined]


class _Words(FileModel):
    state: Annotated[int, Field(ge=0, lt=2**128)]
    inc: Annotated[int, Field(ge=0, lt=2**128)]


class _ActionGenerator(FileModel):
    bit_generator: Literal["PCG64"]
    state: _Words
    has_uint32: Literal[0, 1]
    uinteger: Annotated[int, Field(ge=0, lt=2**32)]


class _Generators(FileModel):
    numpy: tuple[Annotated[int, Field(ge=0, le=624)], Literal[0, 1], Number]
    python: tuple[Literal[3], Number | None]
    actions: _ActionGenerator


class _Replay(FileModel):
    pos: Count | None = None
    full: bool | None = None


def _check_place(evaluation: dict[str, Number]) -> dict[str, Number]:
    for key in ("steps", "updates"):
        if not isinstance(evaluation.get(key), int):
            raise ValueError(f"{key} is missing or no whole number")
    return evaluation


class _Course(FileModel):
    evaluations: list[Annotated[dict[str, Number], AfterValidator(_check_place)]]
    alarms: list[str]
    best_harm: Number | None
    wall_s: Seconds


def _every_column(ended: dict[str, list[Number]]) -> dict[str, list[Number]]:
    if ended.keys() != EPISODE_COLUMNS.keys():
        raise ValueError(f"the columns must be {', '.join(EPISODE_COLUMNS)}")
    return ended


class _Between(FileModel):
    updates: Count
    ended: Annotated[dict[str, list[Number]], AfterValidator(_every_column)]
    course: _Course


class Numbers(FileModel):
    """``state.json``: what ``capture_model`` and the session keep of a training."""

    training: Sha256  # which one, see ``Training.identity``
    counters: _Counters
    learning_rates: dict[str, Annotated[float, Field(strict=False, ge=0.0, le=1.0)]]
    random: _Generators
    log: dict[str, tuple[Number, Count, list[str]]]
    between: _Between
    replay: _Replay
    events: dict[str, Count]


FORMAT_VERSION = 1
LISTING = "checkpoint.json"
KEPT = 2  # checkpoints of a running training; a torn last one leaves the one before

_NUMBERS, _ARRAYS, _TABLE, _POLICY, _BEST, _MEMORY = (
    "state.json",
    "arrays.safetensors",
    "progress.csv",
    "policy",
    "best",
    "replay",
)
_LISTING_LIMIT_BYTES = 1 << 20
_HELD_LIMITS_BYTES = {_NUMBERS: 256 << 20, _ARRAYS: 1 << 30, _TABLE: 256 << 20}  # of what is read as a whole
_SIZE_LIMIT_BYTES = 1 << 36  # of any other file: a replay memory of ten million decisions
_DTYPES = {"BOOL", "F32", "F64", "I32", "I64", "U8", "U32", "U64"}


@dataclass(frozen=True, slots=True)
class TrainingState:
    """What a training needs to go on."""

    steps: int
    updates: int
    numbers: dict[str, Any]  # plain JSON
    arrays: Arrays
    replay: Arrays  # memory-mapped when read
    policy: Trained  # as it was checked last
    best: Trained | None  # of least harm so far
    table: bytes  # progress.csv
    versions: Mapping[str, str]


def write_checkpoint(folder: Path, state: TrainingState) -> None:
    """Write ``folder``, completely or not at all, with every byte on the disk before it has its name; old ones go."""
    with new_folder(folder) as partial:
        write_file(partial / _NUMBERS, json.dumps(state.numbers, allow_nan=False).encode())
        arrays = {name: np.ascontiguousarray(array).reshape(array.shape) for name, array in state.arrays.items()}
        write_file(partial / _ARRAYS, safetensors.numpy.save(arrays))
        write_file(partial / _TABLE, state.table)
        save_trained(state.policy, partial / _POLICY)
        if state.best is not None:
            save_trained(state.best, partial / _BEST)
        for name, array in state.replay.items():
            _write_array(partial / f"{_MEMORY}-{name}.npy", array)
        files = sorted(path for path in partial.rglob("*") if path.is_file())
        listing = {
            "format": "ethbrake-checkpoint",
            "format_version": FORMAT_VERSION,
            "steps": state.steps,
            "updates": state.updates,
            "versions": dict(state.versions),
            "files": {
                path.relative_to(partial).as_posix(): {"bytes": path.stat().st_size, "sha256": _sha256(path)}
                for path in files
            },
        }
        write_file(partial / LISTING, json.dumps(listing, indent=2).encode() + b"\n")
    for old in checkpoint_folders(folder.parent)[KEPT:]:
        remove_folder(old)


def read_checkpoint(folder: Path) -> TrainingState:
    """Read and check every file of ``folder``; raises ``CorruptBundle`` naming the file that is damaged.

    Raises ``InvalidInput`` where all files are as they were written, and one is not as this version writes it.
    """
    listing, data = _check_files(folder)
    place = folder / _NUMBERS
    try:
        numbers, _ = read_json_model(data[_NUMBERS], Numbers)
        place = folder / _ARRAYS
        arrays = _arrays(data[_ARRAYS])
        replay = {}
        for place in sorted(folder.glob(f"{_MEMORY}-*.npy")):
            with open_plain(place, _SIZE_LIMIT_BYTES, refusal=CorruptBundle, follow_links=False) as stream:
                replay[place.stem.removeprefix(f"{_MEMORY}-")] = map_npy(stream, place.stem)
        place = folder / _TABLE
        parse_progress(data[_TABLE])
        place = folder / _POLICY
        policy = read_trained(place)
        place = folder / _BEST
        best = read_trained(place) if place.is_dir() else None
    except KeyError:
        raise CorruptBundle(f"{place}: is missing") from None
    except (ValueError, EthBrakeError, SafetensorError) as error:
        raise _of_another_version(f"{place}: {error}", listing.versions) from None
    return TrainingState(
        listing.steps, listing.updates, numbers, arrays, replay, policy, best, data[_TABLE], listing.versions
    )


def _of_another_version(what: str, versions: Mapping[str, Any]) -> InvalidInput:
    """The error for a checkpoint that is not damaged: nobody deletes it."""
    wrote, here = versions.get("ethbrake-marl"), installed_versions()["ethbrake-marl"]
    return InvalidInput(
        f"{what}; every file of this checkpoint is as version {wrote} of this package wrote it, and version {here}"
        " would write another one: go on with that version, or delete the checkpoint to go on from the one before"
    )


def _arrays(data: bytes) -> Arrays:
    for name, header in safetensors_headers(data).items():
        if header.dtype not in _DTYPES:
            raise ValueError(f"array {name!r} is {header.dtype}; must be one of {', '.join(sorted(_DTYPES))}")
    return dict(safetensors.numpy.load(data))


def checkpoint_folders(folder: Path) -> list[Path]:
    """Checkpoints in ``folder``, the newest first; whether they are whole is not known yet."""
    return sorted((path for path in folder.glob("step_*") if _is_folder(path)), reverse=True)


def newest_usable(folder: Path) -> tuple[TrainingState | None, list[str]]:
    """The newest checkpoint in ``folder`` that is whole, and why each newer one is not; damaged ones are deleted.

    Raises ``InvalidInput`` at one of another version, which stays.
    """
    reasons: list[str] = []
    for path in checkpoint_folders(folder):
        try:
            return read_checkpoint(path), reasons
        except CorruptBundle as error:
            reasons.append(str(error))
            remove_folder(path)
    return None, reasons


def _check_files(folder: Path) -> tuple[Listing, dict[str, bytes]]:
    """The listing, and the content of the files beside it; every file is there, and is what the listing says."""
    path = folder / LISTING
    try:
        data = _read(path, _LISTING_LIMIT_BYTES)
        content = parse_strict_json(data)
        version = content.get("format_version") if isinstance(content, dict) else None
        if type(version) is int and version != FORMAT_VERSION:
            versions = content.get("versions")
            what = f"{path}: format_version = {version}: must be {FORMAT_VERSION}"
            raise _of_another_version(what, versions if isinstance(versions, dict) else {})
        _, listing = read_json_model(data, Listing)
        found = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if not _is_folder(path)}
    except OSError as error:
        raise CorruptBundle(f"{folder}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        if isinstance(error, EthBrakeError):
            raise
        raise CorruptBundle(f"{path}: is damaged ({error})") from None
    files = listing.files
    if found.keys() != files.keys() | {LISTING}:
        different = sorted(found.keys() ^ (files.keys() | {LISTING}))[0]
        raise CorruptBundle(f"{folder / different}: is {'extra' if different in found else 'missing'}")
    held = {}
    for name, entry in files.items():
        if name in _HELD_LIMITS_BYTES:
            held[name] = _read(found[name], _HELD_LIMITS_BYTES[name])
            digest, size = hashlib.sha256(held[name]), len(held[name])
        else:
            with open_plain(found[name], _SIZE_LIMIT_BYTES, refusal=CorruptBundle, follow_links=False) as stream:
                digest, size = hashlib.file_digest(stream, "sha256"), stream.tell()
        if (size, digest.hexdigest()) != (entry.bytes, entry.sha256):
            raise CorruptBundle(f"{found[name]}: is not the file that was written (size or SHA-256 differ)")
    return listing, held


def _read(path: Path, limit_bytes: int) -> bytes:
    return read_plain(path, limit_bytes, refusal=CorruptBundle, follow_links=False)


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _write_array(path: Path, array: NDArray[Any]) -> None:
    with path.open("wb") as file:
        np.lib.format.write_array(file, np.asarray(array), allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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


REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining", "_total_timesteps")


def capture_model(model: Model, algorithm: Algorithm) -> tuple[Arrays, dict[str, Any], Arrays]:
    """Weights, optimisers, environment, random generators, counters and log between two updates, and replay memory.

    Of the replay memory (nothing without one, as in PPO) the filled part, as views.
    """
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
    log = model.logger
    pending = {}
    for name, value in log.name_to_value.items():
        number = value.item() if isinstance(value, np.generic | torch.Tensor) else value
        pending[name] = [number, log.name_to_count[name], list(log.name_to_excluded[name] or ())]
    memory: Any = getattr(model, "replay_buffer", None)
    place = {} if memory is None else {"pos": memory.pos, "full": memory.full}
    replay = {} if memory is None else {name: getattr(memory, name)[: memory.size()] for name in REPLAY}
    numbers = {"counters": counters, "learning_rates": rates, "random": random_plain, "log": pending, "replay": place}
    return arrays, numbers, replay


def restore_model(model: Model, algorithm: Algorithm, state: TrainingState) -> None:
    """Bring a freshly built model of the same recipe, whose logger is set, to the state of ``capture_model``."""
    arrays, plain = state.arrays, state.numbers
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
    model.ep_info_buffer, model.ep_success_buffer = (deque[Any](maxlen=model._stats_window_size) for _ in range(2))
    for gained, steps in zip(arrays["episodes.return"].tolist(), arrays["episodes.steps"].tolist(), strict=True):
        model.ep_info_buffer.append({"r": gained, "l": steps, "t": 0.0})
    restore_random(model.action_space, arrays, plain["random"])
    for name, (value, count, excluded) in plain["log"].items():
        model.logger.name_to_value[name] = value
        model.logger.name_to_count[name] = count
        model.logger.name_to_excluded[name] = tuple(excluded)
    memory: Any = getattr(model, "replay_buffer", None)
    if memory is not None:
        for name in REPLAY:
            getattr(memory, name)[: len(state.replay[name])] = state.replay[name]
        memory.pos, memory.full = plain["replay"]["pos"], plain["replay"]["full"]


def _restore_optimizer(optimizer: torch.optim.Optimizer, arrays: Arrays, rate: float) -> None:
    content = optimizer.state_dict()
    state: dict[int, dict[str, torch.Tensor]] = {}
    for name, array in arrays.items():
        index, key = name.split(".")
        state.setdefault(int(index), {})[key] = torch.from_numpy(array.copy())
    for group in content["param_groups"]:
        group["lr"] = rate
    optimizer.load_state_dict({"state": state, "param_groups": content["param_groups"]})


def _group(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _copy(tensor: Any) -> NDArray[Any]:
    return np.array(torch.as_tensor(tensor).detach().cpu().numpy())


# The check that a checkpoint belongs to a model: arrays, counters and policies as this model would write them.
#
# A listing whose hashes agree says that a checkpoint was not damaged, not that it is of this training.

_ENGINE = "environment.engine."
_SCRIPT = f"{_ENGINE}script."
_MAY_BE_INFINITE = (f"{_ENGINE}state", f"{_ENGINE}params")  # no obstacle; news that never comes
_STREAM = f"{_ENGINE}stream"
_DRAWN_LIMIT = 1 << 53  # worlds


def check_fits(folder: Path, state: TrainingState, model: Model, algorithm: Algorithm, policy: Trained) -> None:
    """Raise ``CorruptBundle`` unless ``state`` is one of this freshly built ``model``, whose policy is ``policy``.

    ``folder`` is where the checkpoints stand, for the message.

    Resets the model's environment, which the state is going to replace.
    """
    try:
        _check_arrays(state.arrays, model, algorithm)
        _check_generators(state.arrays)
        _check_numbers(state, tuple(algorithm.optimizers(model)))
        _check_replay(state, model)
        for name, trained in (("policy", state.policy), ("best", state.best)):
            if trained is not None:
                _check_policy(name, trained, policy)
    except ValueError as error:
        raise CorruptBundle(
            f"{folder}: the checkpoint of step {state.steps} is not of this training: {error}; delete it to go on from"
            " the one before"
        ) from None


def _check_arrays(arrays: Arrays, model: Model, algorithm: Algorithm) -> None:
    environment: Any = model.env
    environment.reset()
    rows = [_row(f"policy.{name}", tensor.numpy()) for name, tensor in model.policy.state_dict().items()]
    rows += [_row(name, tensor.numpy()) for name, tensor in algorithm.learned_beside(model).items()]
    for name, optimizer in algorithm.optimizers(model).items():
        rows += _optimizer_rows(f"optimizer.{name}.", optimizer, arrays)
    fresh: Arrays = {f"environment.{name}": array for name, array in environment.snapshot().items()}
    rows += [_environment_row(name, array) for name, array in fresh.items()]
    last = np.empty((environment.num_envs, *environment.observation_space.shape), np.float32)
    rows += [
        _row("last.observations", last),
        _row("last.episode_starts", np.empty(environment.num_envs, np.bool_)),
        ArrayRow("random.torch", "|u1", torch.get_rng_state().numpy().shape),
        ArrayRow("random.numpy", "<u4", (624,)),
        ArrayRow("random.python", "<u8", (625,)),
        ArrayRow("episodes.return", "<f8", ("episodes",)),
        ArrayRow("episodes.steps", "<i8", ("episodes",)),
    ]
    check_arrays(_headers(arrays), rows)
    (seed, drawn), (right, _) = arrays[_STREAM].tolist(), fresh[_STREAM].tolist()
    if seed != right or drawn > _DRAWN_LIMIT:
        raise ValueError(f"array {_STREAM!r} is [{seed}, {drawn}]; must be [{right}, worlds drawn so far]")
    for name in sorted(arrays):
        if not name.startswith(_SCRIPT) and arrays[name].dtype.kind == "f":
            wrong = np.isnan(arrays[name]) if name in _MAY_BE_INFINITE else ~np.isfinite(arrays[name])
            if wrong.any():
                raise ValueError(f"array {name!r} holds a number that is not finite")


def _optimizer_rows(prefix: str, optimizer: torch.optim.Optimizer, arrays: Arrays) -> Iterator[ArrayRow]:
    """What this optimiser keeps of each parameter that has had a gradient, shown by one step of a copy of it."""
    shown = copy.deepcopy(optimizer)  # its hooks are not copied
    for parameter in shown.param_groups[0]["params"]:
        parameter.grad = torch.zeros_like(parameter)
    shown.step()
    had = {name.removeprefix(prefix).partition(".")[0] for name in arrays if name.startswith(prefix)}
    for index, kept in shown.state_dict()["state"].items():
        if str(index) in had:
            yield from (_row(f"{prefix}{index}.{key}", torch.as_tensor(value).numpy()) for key, value in kept.items())


def _environment_row(name: str, array: NDArray[Any]) -> ArrayRow:
    """The environment's arrays are known to the last axis, a script's memory only where it does not depend on worlds.

    What a script keeps of a plan has as many columns as its longest plan.
    """
    if not name.startswith(_SCRIPT):
        return _row(name, array)
    record = name.rpartition(".")[0]
    return ArrayRow(name, array.dtype.str, (*array.shape[:1], *(f"axis {k} of {record}" for k in range(1, array.ndim))))


def _check_generators(arrays: Arrays) -> None:
    numbers = arrays["random.python"]
    if not ((numbers < 2**32).all() and numbers[-1] <= 624):
        raise ValueError("array 'random.python' is no state of Python's generator")
    try:
        torch.Generator().set_state(torch.from_numpy(arrays["random.torch"].copy()))
    except RuntimeError as error:
        raise ValueError(f"array 'random.torch' is no state of torch's generator ({error})") from None


def _check_numbers(state: TrainingState, optimizers: tuple[str, ...]) -> None:
    """The counters agree with each other, and there is a learning rate for every optimiser."""
    counters = state.numbers["counters"]
    if counters["num_timesteps"] != state.steps or state.numbers["between"]["updates"] != state.updates:
        raise ValueError("state.json: steps or updates are not those of the listing")
    if counters["_total_timesteps"] < counters["num_timesteps"]:
        raise ValueError("state.json: counters._total_timesteps is below the steps done")
    if state.numbers["learning_rates"].keys() != set(optimizers):
        raise ValueError(f"state.json: learning_rates must be of {', '.join(optimizers)}")


def _check_replay(state: TrainingState, model: Model) -> None:
    memory: Any = getattr(model, "replay_buffer", None)
    place = state.numbers["replay"]
    if memory is None:
        if state.replay or place:
            raise ValueError("it has a replay memory, and this algorithm has none")
        return
    arrays = {name: getattr(memory, name) for name in REPLAY}
    rows = [ArrayRow(name, array.dtype.str, ("filled", *array.shape[1:])) for name, array in arrays.items()]
    filled = check_arrays(_headers(state.replay), rows)["filled"]
    position, full = place.get("pos"), place.get("full")
    somewhere = full is True and filled == memory.buffer_size and position is not None and position < filled
    if filled > memory.buffer_size or not (somewhere or (position, full) == (filled, False)):
        raise ValueError(f"state.json: replay = {place}: does not go with a memory of {filled} entries")


def _check_policy(name: str, trained: Trained, policy: Trained) -> None:
    learners = policy.manifest.learners if isinstance(policy, Policy) else tuple(policy.members)
    right, found = drivers_of(policy, learners), drivers_of(trained, learners)
    same = found.keys() == right.keys() and all(
        (found[each].manifest.network, found[each].manifest.observation, found[each].manifest.learners)
        == (right[each].manifest.network, right[each].manifest.observation, right[each].manifest.learners)
        for each in right
    )
    if type(trained) is not type(policy) or not same:
        raise ValueError(f"{name}: is not a policy of these learners and this network")


def _row(name: str, array: NDArray[Any]) -> ArrayRow:
    return ArrayRow(name, array.dtype.str, array.shape)


def _headers(arrays: Arrays) -> dict[str, ArrayHeader]:
    return {name: ArrayHeader(array.dtype.str, array.shape) for name, array in arrays.items()}
