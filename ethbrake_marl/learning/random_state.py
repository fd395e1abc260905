"""The random generators that a training uses: kept apart from the caller's, written down, and brought back."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Space
from numpy.typing import NDArray

from ethbrake_marl.snapshots import Arrays


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
