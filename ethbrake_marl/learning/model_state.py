"""The random generators that a training uses: kept apart from the caller's, written down, and brought back."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm

from ethbrake_marl.engine.snapshot import Arrays
from ethbrake_marl.learning.algorithms.protocol import Algorithm


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
