"""A running engine as plain arrays, and back: its worlds go on as if nothing had happened, to the same bits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.running import RUNNING
from ethbrake_marl.engine.stream import Roster
from ethbrake_marl.errors import InvalidInput

Arrays = dict[str, NDArray[Any]]


def engine_snapshot(engine: Engine) -> Arrays:
    """Copies of everything that changes while the engine runs: its rows, its place in the stream, scripts' memories.

    The stream is one number: worlds are pure functions of the seed and of where they stand in it.
    """
    arrays: Arrays = {name.lstrip("_"): getattr(engine, name).copy() for name in RUNNING}
    stream = engine._stream
    arrays["stream"] = np.array([stream.seed, stream.position], np.uint64)
    for vehicle, script in engine._remembering.items():
        arrays |= {f"script.{vehicle}.{name}": array.copy() for name, array in _memory(script).items()}
    return arrays


def restore_engine(engine: Engine, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Bring an engine of the same scenario, size and scripts to the state of ``engine_snapshot``.

    Raises ``InvalidInput``, before anything is changed, naming the array that is missing or has another shape, and
    where a shield follows the engine, which would know nothing of these worlds.
    """
    if engine.watchers:
        raise InvalidInput("engine snapshot: a shield follows this engine; restore first, then put the shield around")
    for name in RUNNING:
        have, wanted = arrays.get(name.lstrip("_")), getattr(engine, name)
        if have is None or have.shape != wanted.shape:
            shape = "nothing" if have is None else have.shape
            raise InvalidInput(f"engine snapshot: {name.lstrip('_')} is {shape}; {wanted.shape} is needed")
    for name in RUNNING:
        setattr(engine, name, np.array(arrays[name.lstrip("_")], np.float64))
    seed, taken = (int(number) for number in arrays["stream"])
    engine._stream.restart(seed)
    engine._stream._drawn = taken
    engine.roster = Roster(engine.n, seed, None)  # a snapshot does not keep the numbers of running episodes
    for vehicle, script in engine._remembering.items():
        prefix = f"script.{vehicle}."
        _remember(script, {n.removeprefix(prefix): a for n, a in arrays.items() if n.startswith(prefix)})


def _memory(owner: object) -> Arrays:
    """Arrays that an agent keeps, by attribute; those of records (named tuples) and of agents inside it with a dot."""
    arrays: Arrays = {}
    for name, value in vars(owner).items() if hasattr(owner, "__dict__") else ():
        if isinstance(value, np.ndarray):
            arrays[name] = value
        elif _is_record(value):
            arrays |= {f"{name}.{field}": part for field, part in value._asdict().items()}
        elif hasattr(value, "begin") and hasattr(value, "act"):
            arrays |= {f"{name}.{inner}": part for inner, part in _memory(value).items()}
    return arrays


def _remember(owner: Any, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Give an agent its arrays back."""
    groups: dict[str, dict[str, NDArray[Any]]] = {}
    for name, array in arrays.items():
        head, dot, inner = name.partition(".")
        if dot:
            groups.setdefault(head, {})[inner] = array
        else:
            setattr(owner, head, array.copy())
    for head, inside in groups.items():
        value = getattr(owner, head)
        if _is_record(value):
            setattr(owner, head, type(value)(**{field: part.copy() for field, part in inside.items()}))
        else:
            _remember(value, inside)


def _is_record(value: object) -> bool:
    """Whether it is a named tuple of arrays."""
    return isinstance(value, tuple) and hasattr(value, "_asdict") and all(isinstance(v, np.ndarray) for v in value)
