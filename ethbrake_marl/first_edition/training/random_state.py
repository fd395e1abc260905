"""Protect, capture and restore the global random generators, which Stable-Baselines3 uses."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray


@contextmanager
def own_random_state() -> Iterator[None]:
    """Context manager that restores the states of the global random generators (Python, NumPy, torch) at its end.

    Inside the ``with`` block, torch uses one thread. Our networks are so small that a second thread makes training 3 to
    15 times slower if another process uses the processor cores.
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


def capture_generators() -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return the states of the global random generators of Python, NumPy and torch, for ``restore_generators``.

    The result is two dictionaries: plain data for JSON, and arrays by name.
    """
    state: Any = np.random.get_state(legacy=False)  # noqa: NPY002
    version, python_state, gauss = random.getstate()
    numbers = {
        "numpy": [int(state["state"]["pos"]), int(state["has_gauss"]), float(state["gauss"])],
        "python": [version, gauss],
    }
    arrays = {
        "random.torch": torch.get_rng_state().numpy().copy(),
        "random.numpy": np.array(state["state"]["key"], np.uint32),
        "random.python": np.array(python_state, np.uint64),
    }
    return numbers, arrays


def restore_generators(numbers: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Set the global random generators to the states that ``capture_generators`` returned.

    ``arrays`` may contain further arrays, which are ignored.
    """
    position, has_gauss, cached = numbers["numpy"]
    np.random.set_state(("MT19937", arrays["random.numpy"], position, has_gauss, cached))  # noqa: NPY002
    version, gauss = numbers["python"]
    random.setstate((version, tuple(arrays["random.python"].tolist()), gauss))
    torch.set_rng_state(torch.from_numpy(arrays["random.torch"].copy()))
