"""Memories of scripts (nested tuples and mappings of arrays), and functions that call scripts and check the results.

Arguments that several functions share: ``vehicle`` is the index of the script's vehicle (0 = front), and ``scripts``
maps the index of each scripted vehicle to its script.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import AgentFailed, EthBrakeError, InvalidInput, count_of, describe_error
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds

Memory = Any  # of a script, for n worlds: None, an array [n, ...], or a tuple or mapping of memories

_SHAPES = (
    "an agent with memory has begin(alert, vehicle, scripts) -> memory and act(worlds, memory, vehicle) -> (command,"
    " memory); an agent without memory has no begin, and act(worlds, vehicle) -> command"
)


def map_memory(function: Callable[..., Any], memory: Memory, *others: Memory) -> Memory:
    """Return a copy of ``memory`` in which every array is replaced by ``function(array, *other_arrays)``.

    ``others`` are memories with the same keys and lengths as ``memory``. For each array of ``memory``,
    ``other_arrays`` are the arrays at the same place in ``others``.
    """
    if memory is None:
        return None
    if isinstance(memory, Mapping):
        return {key: map_memory(function, part, *(other[key] for other in others)) for key, part in memory.items()}
    if isinstance(memory, tuple | list):
        return tuple(map_memory(function, *parts) for parts in zip(memory, *others, strict=True))
    return function(memory, *others)


def take_memory(memory: Memory, rows: Ints) -> Memory:
    return map_memory(lambda array: array[rows], memory)


def renew_memory(memory: Memory, rows: Ints, part: Memory) -> Memory:
    """Return a copy of ``memory`` in which the memory of the worlds with the indices ``rows`` is replaced by ``part``.

    Arrays of ``memory`` that are missing or None in ``part`` keep their old values. Raises ``InvalidInput`` if ``part``
    has keys that ``memory`` lacks.
    """
    if part is None:
        return memory
    if memory is None or (isinstance(part, Mapping) and not part.keys() <= memory.keys()):
        raise InvalidInput(
            "agent: begin returned a memory with keys that are not in the memory of earlier episodes; must return the"
            " same keys in every episode"
        )
    if isinstance(part, Mapping):
        return {key: renew_memory(of, rows, part.get(key)) for key, of in memory.items()}
    if isinstance(part, tuple | list):
        return tuple(renew_memory(old, rows, new) for old, new in zip(memory, part, strict=True))
    renewed = memory[np.arange(len(memory))]
    renewed[rows] = part
    return renewed


def checked_memory(memory: Memory, n: int, what: str = "state") -> Memory:
    """Return the memory of a script if it is valid; otherwise raise ``InvalidInput``.

    Every array must have ``n`` rows. Arrays of objects are invalid, because a copy of such an array still contains the
    same objects. Keys of mappings must be identifiers, because a snapshot joins the keys with dots. ``what`` is the
    name of the memory in error messages.
    """

    def check(array: Any) -> Any:
        shape = tuple(getattr(array, "shape", ()))
        if not shape or shape[0] != n:
            raise InvalidInput(
                f"{what}: contains {type(array).__name__} of shape {shape}; must contain only arrays of length {n}, the"
                " number of worlds"
            )
        if array.dtype.hasobject:
            raise InvalidInput(f"{what}: contains an array of objects; arrays must contain numbers, booleans or texts")
        return array

    parts = [memory]
    for part in parts:
        if isinstance(part, Mapping):
            for key in part:
                if not (isinstance(key, str) and key.isidentifier()):
                    raise InvalidInput(f"{what}: key {key!r}: must be a Python identifier, for instance 'asked_s'")
            parts += part.values()
        elif isinstance(part, tuple | list):
            parts += part
    return map_memory(check, memory)


Arrays = dict[str, NDArray[Any]]


def flat(memory: Memory) -> Arrays:
    """Return the arrays of a nested memory as a dictionary from the path of an array to the array.

    For the memory ``{"a": x, "b": (y, z)}`` the result is ``{"a": x, "b.0": y, "b.1": z}``. None in the memory becomes
    an empty array.
    """
    if isinstance(memory, Mapping | tuple):
        parts = memory.items() if isinstance(memory, Mapping) else enumerate(memory)
        return {f"{key}.{name}" if name else str(key): array for key, of in parts for name, array in flat(of).items()}
    return {"": np.zeros(0) if memory is None else np.array(memory)}


def unflat(arrays: Mapping[str, NDArray[Any]], place: str) -> Memory:
    """Return a copy of the memory that ``flat`` wrote to ``arrays`` under the path ``place``, such as ``script.2``.

    Raises ``InvalidInput`` if ``arrays`` has no array under this path.
    """
    if place in arrays:
        return np.array(arrays[place]) if arrays[place].shape != (0,) else None
    inner = dict.fromkeys(name[len(place) + 1 :].partition(".")[0] for name in arrays if name.startswith(f"{place}."))
    if not inner:
        raise InvalidInput(
            f"engine snapshot: the array {place}, which contains the memory of a vehicle's script, is missing"
        )
    parts = {name: unflat(arrays, f"{place}.{name}") for name in inner}
    return tuple(parts[str(k)] for k in range(len(parts))) if "0" in parts else parts


def _check_kept(before: Memory, after: Memory, who: str) -> None:
    """Raise ``InvalidInput`` if a call of ``act`` changed the keys, shapes or dtypes of a memory.

    After such a change the engine could not replace the memory of single worlds when new episodes start.
    """
    began, kinds = (map_memory(lambda array: (array.dtype, *array.shape[1:]), each) for each in (before, after))
    if began != kinds:
        raise InvalidInput(
            f"{who}: act got a memory of the form {began}, but returned a memory of the form {kinds}; keys, shapes and"
            " dtypes must stay as in the memory that begin returned"
        )


def is_state_free(script: Script) -> bool:
    """Return whether the script says, by its attribute ``state_free``, that its command is constant in an episode."""
    return bool(getattr(script, "state_free", False))


def is_ours(script: Script) -> bool:
    """Return whether the script's class belongs to this package.

    Scripts from outside this package get read-only worlds and copies of their memory.
    """
    return type(script).__module__.startswith("ethbrake_marl.")


def begin_script(script: Script, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
    """Return the first memory of a script for new episodes; None for a script without a memory.

    Raises ``InvalidInput``, which names the script, if a user's script raises an exception or its memory is invalid.
    """
    begin = getattr(script, "begin", None)
    if begin is None:
        return None
    try:
        if is_ours(script):
            return begin(alert, vehicle, scripts)
        if len(inspect.signature(script.act).parameters) == 2:
            raise InvalidInput(
                f"{_who(script, vehicle)}: the agent has a method begin, but its method act has no argument memory;"
                f" {_SHAPES}"
            )
        with _as_it_was(script, vehicle):
            return checked_memory(
                begin(alert.read_only(), vehicle, scripts), alert.n, f"{_who(script, vehicle)}: memory"
            )
    except Exception as error:
        raise _named(error, script, "begin", alert, vehicle) from error


def ask_script(script: Script, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
    """Return a script's command for ``vehicle``, [n] m/s2, and the script's new memory.

    ``memory`` is None for a script without memory. Raises ``AgentFailed``, which names the script, world and time, if
    the script does not return one number per world. Raises ``InvalidInput``, which names the script, if a user's script
    raises an exception or changes its own attributes.
    """
    remembers = hasattr(script, "begin")
    try:
        if is_ours(script):
            answer = script.act(worlds, memory, vehicle) if remembers else script.act(worlds, vehicle)
        else:
            own = (take_memory(memory, np.arange(worlds.n)),) if remembers else ()
            with _as_it_was(script, vehicle):
                answer = script.act(worlds.read_only(), *own, vehicle)
            if remembers:
                if not (isinstance(answer, tuple) and len(answer) == 2):
                    raise InvalidInput(f"{_who(script, vehicle)}: act returned {type(answer).__name__}; {_SHAPES}")
                who = f"{_who(script, vehicle)}: memory"
                _check_kept(memory, checked_memory(answer[1], worlds.n, who), who)
    except Exception as error:
        raise _named(error, script, "act", worlds, vehicle) from error
    command, memory = answer if remembers else (answer, None)
    commands = np.asarray(command)
    if commands.shape != (worlds.n,) or commands.dtype.kind not in "fiub":
        short = commands.ndim > 0 and len(commands) < worlds.n
        row = len(commands) if short else 0
        raise AgentFailed(
            getattr(script, "name", type(script).__name__),
            row if worlds.n else None,
            f"vehicle_{vehicle + 1} at {worlds.time_s[row : row + 1].min(initial=np.inf):.2f} s: act returned"
            f" {commands.dtype} of shape {commands.shape}; must return one number per world, shape ({worlds.n},)",
        )
    return command, memory


@contextmanager
def _as_it_was(script: Script, vehicle: int) -> Iterator[None]:
    """Raise ``InvalidInput`` if a script changes its own attributes, which all episodes share."""
    before = dict(getattr(script, "__dict__", {}))
    yield
    for name in {**before, **getattr(script, "__dict__", {})}:
        is_cached = name not in before and isinstance(getattr(type(script), name, None), cached_property)
        if not is_cached and (name not in before or getattr(script, name, None) is not before[name]):
            raise InvalidInput(
                f"{_who(script, vehicle)}: the agent changed its attribute {name!r}, which all episodes share; keep"
                f" such values in the memory: {_SHAPES}"
            )


def _who(script: Script, vehicle: int) -> str:
    return f"agent {getattr(script, 'name', type(script).__name__)!r} of vehicle_{vehicle + 1}"


def _named(error: Exception, script: Script, what: str, worlds: Worlds, vehicle: int) -> Exception:
    """Return the exception to raise instead of ``error``, which the script's method ``what`` raised.

    The result is an ``InvalidInput`` whose message names the script. If the script belongs to this package, or if
    ``error`` is an ``EthBrakeError``, the result is ``error`` itself.
    """
    if isinstance(error, EthBrakeError) or is_ours(script):
        return error
    who = _who(script, vehicle)
    moment = f"{count_of(worlds.n, 'world')} at {worlds.time_s.min(initial=np.inf):.2f} s"
    return InvalidInput(f"{who}: {what} on {moment}: {describe_error(error)}")


def within_capacity(
    command_mps2: Floats, worlds: Worlds, vehicle: int, script: Script, due: Bools | None = None
) -> Floats:
    """Return a script's command [n] m/s2 if it is within the vehicle's capacities; otherwise raise ``AgentFailed``.

    ``due`` [n] says in which worlds to check the command; None: in all worlds.
    """
    low, high = -worlds.vehicles.braking_capacity_mps2[:, vehicle], worlds.vehicles.driving_capacity_mps2[:, vehicle]
    good = (command_mps2 >= low) & (command_mps2 <= high)
    if due is not None:
        good |= ~due
    if not good.all():
        k = int(np.argmin(good))
        raise AgentFailed(
            getattr(script, "name", type(script).__name__),
            k,
            f"vehicle_{vehicle + 1} at {worlds.time_s[k]:.2f} s: command {command_mps2[k]:g} m/s2; must be in"
            f" [{low[k]:g}, {high[k]:g}] m/s2",
        )
    return command_mps2
