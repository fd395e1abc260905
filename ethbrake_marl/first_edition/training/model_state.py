"""Capture the state of a model during training as plain data and arrays, and restore the model from them."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ethbrake_marl.first_edition.engine.memory import Arrays
from ethbrake_marl.first_edition.training.algorithm import Algorithm
from ethbrake_marl.first_edition.training.checkpoint import TrainingState
from ethbrake_marl.first_edition.training.models import Model
from ethbrake_marl.first_edition.training.random_state import capture_generators, restore_generators

COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining", "_total_timesteps")

REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def capture_model(model: Model, algorithm: Algorithm) -> tuple[dict[str, Any], Arrays]:
    """Return the state of a model between two updates, for a checkpoint.

    Returns two dictionaries: counters and settings as plain data for JSON, and arrays by name.
    """
    environment: Any = model.env
    generators, random_arrays = capture_generators()
    memory: Any = getattr(model, "replay_buffer", None)  # PPO has no replay buffer
    numbers = {
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "learning_rates": {
            name: float(each.param_groups[0]["lr"]) for name, each in algorithm.optimizers(model).items()
        },
        "random": {**generators, "actions": model.action_space.np_random.bit_generator.state},
        "log": _captured_log(model),
        "replay": None if memory is None else [memory.pos, memory.full],
    }
    arrays = {
        **_captured_weights(model, algorithm),
        **{f"environment.{name}": array for name, array in environment.snapshot().items()},
        **random_arrays,
        **_captured_rows(model),
    }
    if memory is not None:
        arrays |= {f"replay.{name}": getattr(memory, name)[: memory.size()] for name in REPLAY}
    return numbers, arrays


def restore_model(model: Model, algorithm: Algorithm, state: TrainingState) -> None:
    """Put a state that ``capture_model`` returned into a new model of the same recipe.

    The new model must have a logger. Raises various errors of Python, NumPy and torch if the state does not fit the
    model.
    """
    numbers, arrays = state
    environment: Any = model.env
    _restore_weights(model, algorithm, numbers["learning_rates"], arrays)
    environment.restore(group_of(arrays, "environment."))
    for name in COUNTERS:
        check_counter(name, numbers["counters"][name], type(getattr(model, name)))
        setattr(model, name, numbers["counters"][name])
    _restore_rows(model, arrays)
    restore_generators(numbers["random"], arrays)
    model.action_space.np_random.bit_generator.state = numbers["random"]["actions"]
    _restore_log(model, numbers["log"])
    memory: Any = getattr(model, "replay_buffer", None)
    if memory is not None:
        _restore_replay(memory, numbers["replay"], arrays)


def _captured_weights(model: Model, algorithm: Algorithm) -> Arrays:
    """Return the weights of the model's policy, other learned tensors, and the states of the optimisers, by name."""
    arrays = {f"policy.{name}": _copy(tensor) for name, tensor in model.policy.state_dict().items()}
    arrays |= {name: _copy(tensor) for name, tensor in algorithm.learned_beside(model).items()}
    for name, optimizer in algorithm.optimizers(model).items():
        for index, entries in optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer.{name}.{index}.{key}": _copy(value) for key, value in entries.items()}
    return arrays


def _restore_weights(model: Model, algorithm: Algorithm, rates: Mapping[str, float], arrays: Arrays) -> None:
    model.policy.load_state_dict({name: torch.from_numpy(array) for name, array in group_of(arrays, "policy.").items()})
    for name, tensor in algorithm.learned_beside(model).items():
        tensor.data.copy_(torch.from_numpy(arrays[name]))
    for name, optimizer in algorithm.optimizers(model).items():
        entries: dict[int, dict[str, torch.Tensor]] = {}
        for place, array in group_of(arrays, f"optimizer.{name}.").items():
            index, key = place.split(".")
            entries.setdefault(int(index), {})[key] = torch.from_numpy(array.copy())
        groups = optimizer.state_dict()["param_groups"]
        for group in groups:
            group["lr"] = rates[name]
        optimizer.load_state_dict({"state": entries, "param_groups": groups})
        _try_step(optimizer)


def _captured_rows(model: Model) -> Arrays:
    """Return the latest observation of every learner, and the returns and lengths of the latest episodes.

    Stable-Baselines3 needs the observations to continue the rollouts, and the returns and lengths to log their means.
    """
    observations: Any = model._last_obs
    episodes = list(model.ep_info_buffer or ())
    return {
        "last.observations": observations.copy(),
        "last.episode_starts": np.array(model._last_episode_starts, np.bool_),
        "episodes.return": np.array([episode["r"] for episode in episodes], np.float64),
        "episodes.steps": np.array([episode["l"] for episode in episodes], np.int64),
    }


def _restore_rows(model: Model, arrays: Arrays) -> None:
    environment: Any = model.env
    space = environment.observation_space
    seen = np.zeros((environment.num_envs, *space.shape), space.dtype)
    model._last_obs = _like(seen, arrays, "last.observations").copy()
    model._last_episode_starts = _like(np.zeros(len(seen), np.bool_), arrays, "last.episode_starts").copy()
    model.ep_info_buffer, model.ep_success_buffer = (deque[Any](maxlen=model._stats_window_size) for _ in range(2))
    for gained, steps in zip(arrays["episodes.return"].tolist(), arrays["episodes.steps"].tolist(), strict=True):
        model.ep_info_buffer.append({"r": gained, "l": steps, "t": 0.0})


def _captured_log(model: Model) -> dict[str, list[Any]]:
    """Return the logger's values for its next row: name of a column -> [value, count, formats that omit the column]."""
    log, pending = model.logger, {}
    for name, value in log.name_to_value.items():
        number = value.item() if isinstance(value, np.generic | torch.Tensor) else value
        pending[name] = [number, log.name_to_count[name], list(log.name_to_excluded[name] or ())]
    return pending


def _restore_log(model: Model, pending: Mapping[str, Any]) -> None:
    for name, (value, count, excluded) in pending.items():
        model.logger.name_to_value[name] = value
        model.logger.name_to_count[name] = count
        model.logger.name_to_excluded[name] = tuple(excluded)


def _restore_replay(memory: Any, place: Any, arrays: Arrays) -> None:
    """Restore the captured content of a replay buffer.

    ``place`` has the position of the buffer's next entry, and whether the buffer is full. In ``arrays``, the names of
    the buffer's arrays begin with ``replay.``. Raises ``ValueError`` if the position in ``place`` is invalid, or if an
    array does not fit the buffer.
    """
    position, full = place
    if (type(position), type(full)) != (int, bool) or not 0 <= position < memory.buffer_size:
        raise ValueError(
            f"replay = {place!r:.60}: must be [position, full]: the next position in the replay buffer, from 0 to below"
            f" {memory.buffer_size}, and whether the buffer is full"
        )
    memory.pos, memory.full = position, full
    for name in REPLAY:
        filled = getattr(memory, name)[: memory.size()]
        filled[:] = _like(filled, arrays, f"replay.{name}")


def _try_step(optimizer: torch.optim.Optimizer) -> None:
    """Make a trial step with a copy of ``optimizer``; torch raises an error if optimiser and weights do not fit."""
    tried = copy.deepcopy(optimizer)
    for group in tried.param_groups:
        for weights in group["params"]:
            weights.grad = torch.zeros_like(weights)
    tried.step()


def check_counter(name: str, value: object, kind: type) -> None:
    """Raise ``ValueError`` unless a counter of a checkpoint has the type ``kind``.

    A counter of type ``int`` must be from 0 to 2^53 - 1.
    """
    if type(value) is not kind or (kind is int and not 0 <= value < 1 << 53):  # type: ignore[operator]  # an int
        right = "a whole number, at least 0" if kind is int else f"of type {kind.__name__}"
        raise ValueError(f"{name} = {value!r:.60}: must be {right}")


def _like(model: NDArray[Any], arrays: Arrays, name: str) -> NDArray[Any]:
    """Return ``arrays[name]``; raise ``ValueError`` if it is not finite, or if shape or type differ from ``model``."""
    array = arrays[name]
    if (array.shape, array.dtype) != (model.shape, model.dtype) or not np.isfinite(array).all():
        raise ValueError(f"{name}: must be finite numbers of type {model.dtype} and shape {model.shape}")
    return array


def group_of(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    """Return the arrays whose names begin with ``prefix``, by their names without the prefix."""
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _copy(tensor: Any) -> NDArray[Any]:
    return np.array(torch.as_tensor(tensor).detach().cpu().numpy())
