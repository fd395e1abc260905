"""All that changes in a model while it learns, as plain numbers and arrays."""

from __future__ import annotations

import copy
import random
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ethbrake_marl.engine.memory import Arrays
from ethbrake_marl.training.algorithm import Algorithm
from ethbrake_marl.training.checkpoint import TrainingState
from ethbrake_marl.training.models import Model

COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining", "_total_timesteps")

REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def capture_model(model: Model, algorithm: Algorithm) -> tuple[dict[str, Any], Arrays]:
    """Plain numbers and arrays of a model between two updates: all that changes in it while it learns."""
    arrays: Arrays = {f"policy.{name}": _copy(tensor) for name, tensor in model.policy.state_dict().items()}
    arrays |= {name: _copy(tensor) for name, tensor in algorithm.learned_beside(model).items()}
    optimizers = algorithm.optimizers(model)
    for name, optimizer in optimizers.items():
        for index, entries in optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer.{name}.{index}.{key}": _copy(value) for key, value in entries.items()}
    environment: Any = model.env
    arrays |= {f"environment.{name}": array for name, array in environment.snapshot().items()}
    numpy_state: Any = np.random.get_state(legacy=False)  # noqa: NPY002
    version, python_state, gauss = random.getstate()
    observations: Any = model._last_obs
    episodes = list(model.ep_info_buffer or ())
    arrays |= {
        "random.torch": torch.get_rng_state().numpy().copy(),
        "random.numpy": np.array(numpy_state["state"]["key"], np.uint32),
        "random.python": np.array(python_state, np.uint64),
        "last.observations": observations.copy(),
        "last.episode_starts": np.array(model._last_episode_starts, np.bool_),
        "episodes.return": np.array([episode["r"] for episode in episodes], np.float64),
        "episodes.steps": np.array([episode["l"] for episode in episodes], np.int64),
    }
    memory: Any = getattr(model, "replay_buffer", None)  # none in PPO
    if memory is not None:
        arrays |= {f"replay.{name}": getattr(memory, name)[: memory.size()] for name in REPLAY}
    log, pending = model.logger, {}
    for name, value in log.name_to_value.items():
        number = value.item() if isinstance(value, np.generic | torch.Tensor) else value
        pending[name] = [number, log.name_to_count[name], list(log.name_to_excluded[name] or ())]
    numbers = {
        "counters": {name: getattr(model, name) for name in COUNTERS},
        "learning_rates": {name: float(each.param_groups[0]["lr"]) for name, each in optimizers.items()},
        "random": {
            "numpy": [int(numpy_state["state"]["pos"]), int(numpy_state["has_gauss"]), float(numpy_state["gauss"])],
            "python": [version, gauss],
            "actions": model.action_space.np_random.bit_generator.state,
        },
        "log": pending,
        "replay": None if memory is None else [memory.pos, memory.full],
    }
    return numbers, arrays


def restore_model(model: Model, algorithm: Algorithm, state: TrainingState) -> None:
    """Bring a freshly built model of the same recipe, whose logger is set, to the state of ``capture_model``."""
    plain, arrays = state
    model.policy.load_state_dict({name: torch.from_numpy(array) for name, array in group_of(arrays, "policy.").items()})
    for name, tensor in algorithm.learned_beside(model).items():
        tensor.data.copy_(torch.from_numpy(arrays[name]))
    for name, optimizer in algorithm.optimizers(model).items():
        kept: dict[int, dict[str, torch.Tensor]] = {}
        for place, array in group_of(arrays, f"optimizer.{name}.").items():
            index, key = place.split(".")
            kept.setdefault(int(index), {})[key] = torch.from_numpy(array.copy())
        groups = optimizer.state_dict()["param_groups"]
        for group in groups:
            group["lr"] = plain["learning_rates"][name]
        optimizer.load_state_dict({"state": kept, "param_groups": groups})
        _try_step(optimizer)
    environment: Any = model.env
    environment.restore(group_of(arrays, "environment."))
    for name in COUNTERS:
        check_counter(name, plain["counters"][name], type(getattr(model, name)))
        setattr(model, name, plain["counters"][name])
    space = environment.observation_space
    seen = np.zeros((environment.num_envs, *space.shape), space.dtype)
    model._last_obs = _like(seen, arrays, "last.observations").copy()
    model._last_episode_starts = _like(np.zeros(len(seen), np.bool_), arrays, "last.episode_starts").copy()
    model.ep_info_buffer, model.ep_success_buffer = (deque[Any](maxlen=model._stats_window_size) for _ in range(2))
    for gained, steps in zip(arrays["episodes.return"].tolist(), arrays["episodes.steps"].tolist(), strict=True):
        model.ep_info_buffer.append({"r": gained, "l": steps, "t": 0.0})
    position, has_gauss, cached = plain["random"]["numpy"]
    np.random.set_state(("MT19937", arrays["random.numpy"], position, has_gauss, cached))  # noqa: NPY002
    version, gauss = plain["random"]["python"]
    random.setstate((version, tuple(arrays["random.python"].tolist()), gauss))
    torch.set_rng_state(torch.from_numpy(arrays["random.torch"].copy()))
    model.action_space.np_random.bit_generator.state = plain["random"]["actions"]
    for name, (value, count, excluded) in plain["log"].items():
        model.logger.name_to_value[name] = value
        model.logger.name_to_count[name] = count
        model.logger.name_to_excluded[name] = tuple(excluded)
    memory: Any = getattr(model, "replay_buffer", None)
    if memory is not None:
        position, full = plain["replay"]
        if (type(position), type(full)) != (int, bool) or not 0 <= position < memory.buffer_size:
            raise ValueError(f"replay = {plain['replay']!r:.60}: is no place in its memory")
        memory.pos, memory.full = position, full
        for name in REPLAY:
            filled = getattr(memory, name)[: memory.size()]
            filled[:] = _like(filled, arrays, f"replay.{name}")


def _try_step(optimizer: torch.optim.Optimizer) -> None:
    """Make a step in a copy; raises what a state raises that is not of these weights."""
    tried = copy.deepcopy(optimizer)
    for group in tried.param_groups:
        for weights in group["params"]:
            weights.grad = torch.zeros_like(weights)
    tried.step()


def check_counter(name: str, value: object, kind: type) -> None:
    if type(value) is not kind or (kind is int and not 0 <= value < 1 << 53):  # type: ignore[operator]  # an int
        raise ValueError(f"{name} = {value!r:.60}: must be of type {kind.__name__}, and a whole number at least 0")


def _like(model: NDArray[Any], arrays: Arrays, name: str) -> NDArray[Any]:
    """The array of this name; raises ``ValueError`` unless it is finite, and of shape and type as ``model``."""
    found = arrays[name]
    if (found.shape, found.dtype) != (model.shape, model.dtype) or not np.isfinite(found).all():
        raise ValueError(f"{name}: {model.shape} finite {model.dtype} are needed")
    return found


def group_of(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}


def _copy(tensor: Any) -> NDArray[Any]:
    return np.array(torch.as_tensor(tensor).detach().cpu().numpy())
