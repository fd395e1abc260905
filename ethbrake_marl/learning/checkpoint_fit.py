"""The check that a checkpoint belongs to a model: arrays, counters and policies as this model would write them.

A listing whose hashes agree says that a checkpoint was not damaged, not that it is of this training.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ethbrake_marl.engine.snapshot import Arrays
from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.files.arrays import ArrayHeader, ArrayRow, check_arrays
from ethbrake_marl.learning.algorithms.protocol import Algorithm
from ethbrake_marl.learning.checkpoint import TrainingState
from ethbrake_marl.learning.model_state import REPLAY, Model
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.team import Trained, drivers_of

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
    rows = [ArrayRow(name, array.dtype.str, ("filled", *array.shape[1:])) for name, array in _replay_of(memory)]
    filled = check_arrays(_headers(state.replay), rows)["filled"]
    position = place.get("pos"), place.get("full")
    if filled > memory.buffer_size or position not in ((filled, False), *_full_at(memory.buffer_size, filled, place)):
        raise ValueError(f"state.json: replay = {place}: does not go with a memory of {filled} entries")


def _full_at(size: int, filled: int, place: Mapping[str, Any]) -> list[tuple[Any, bool]]:
    """Where a full memory may go on: anywhere in it."""
    position = place.get("pos")
    return [(position, True)] if filled == size and position is not None and position < size else []


def _replay_of(memory: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    for name in REPLAY:
        yield name, getattr(memory, name)


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
