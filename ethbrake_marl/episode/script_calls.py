"""Calls of scripts: their memories and commands, and a guard around the scripts of users."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ethbrake_marl.episode.state import NUMBER, State, arrays_of, map_arrays
from ethbrake_marl.errors import AgentFailed, EthBrakeError, describe_error
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.layout import BRAKING, DRIVING, Floats

ASKED_TWICE = 8  # worlds for which a script must answer twice alike


class UserScript:
    """Guards a script from outside this package: its states and memories are read-only, its results are checked.

    Simulations share states and memories, so a script must not change either. The first alert is shown twice, because
    a script that then answers differently would give each agent other emergencies.
    """

    def __init__(self, script: Any) -> None:
        self.script, self.name = script, name_of(script)
        self.knows, self.needs_ahead = getattr(script, "knows", None), getattr(script, "needs_ahead", ())
        self.is_asked_twice = False

    def begin(self, alert: State, body: int) -> Any:
        memory = self._begin(alert, body)
        if memory is not None and not self.is_asked_twice:
            few = alert.take(slice(ASKED_TWICE))
            first, second = (
                [array.tobytes() for array in arrays_of(self._begin(few, body)) if not array.dtype.hasobject]
                for _ in range(2)
            )
            if first != second:
                raise AgentFailed(
                    self.name,
                    None,
                    f"vehicle_{body}: begin answers differently for the same worlds; must draw random numbers from"
                    " alert.generators(body), which are the same for every agent",
                )
            self.is_asked_twice = True
        return memory

    def _begin(self, alert: State, body: int) -> Any:
        return self._read_only(self.script.begin(alert.read_only(), body), alert.n, body)

    def act(self, state: State, memory: Any, body: int) -> tuple[Any, Any]:
        answer = self.script.act(state.read_only(), memory, body)
        if not isinstance(answer, tuple) or len(answer) != 2:
            right = "must return commands and memory"
            raise AgentFailed(self.name, None, f"vehicle_{body}: act returned {answer!r:.60}; {right}")
        return answer[0], self._read_only(answer[1], state.n, body)

    def _read_only(self, memory: Any, n: int, body: int) -> Any:
        def view_of(array: Any) -> Any:
            if not isinstance(array, np.ndarray) or array.shape[:1] != (n,):
                raise AgentFailed(
                    self.name,
                    None,
                    f"vehicle_{body}: its memory is {array!r:.60}; must be None, an array with one row for each of the"
                    f" {n} worlds, or a tuple or mapping of these",
                )
            view = array.view()
            view.setflags(write=False)
            return view

        return map_arrays(view_of, memory)


def guard_scripts(scripts: Mapping[int, Any]) -> dict[int, Any]:
    """The scripts, body -> script, with each script from outside this package in a ``UserScript``.

    Scripts of this package are trusted.
    """
    return {
        body: script if type(script).__module__.startswith("ethbrake_marl.") else UserScript(script)
        for body, script in scripts.items()
    }


def name_of(script: Any) -> str:
    return str(getattr(script, "name", type(script).__name__))


def begin_script(script: Any, alert: State, body: int) -> Any:
    """Memory of a script at the ``alert`` of new episodes. Raises ``AgentFailed`` if the script fails."""
    return _call(script, "begin", alert, body)


def ask_script(script: Any, state: State, memory: Any, body: int) -> tuple[Floats, Any]:
    """Commands of a script, [n] m/s2, and its new memory.

    Raises ``AgentFailed`` if the script fails, or if its commands are not numbers or exceed a capacity.
    """
    answer, memory = _call(script, "act", state, memory, body)
    try:
        commands = np.asarray(answer)
    except ValueError:  # lists of different lengths
        commands = np.empty(())
    if commands.shape != (state.n,) or commands.dtype.kind not in "fiu":
        right = f"must be numbers of the shape ({state.n},)"
        raise AgentFailed(name_of(script), None, f"vehicle_{body}: its commands are {answer!r:.60}; {right}")
    low = -capacities(state.car, BRAKING)[:, body]
    high = capacities(state.car, DRIVING)[:, body]
    good = (commands >= low) & (commands <= high)
    if not good.all():
        k = int(np.argmin(good))
        number = int(state.clock[k, NUMBER])
        raise AgentFailed(
            name_of(script),
            k if number < 0 else number,
            f"vehicle_{body} at {state.time_s[k]:.2f} s: command {commands[k]:g} m/s2; must be in"
            f" [{low[k]:g}, {high[k]:g}] m/s2",
        )
    return commands, memory


def ask_scripts(scripts: Mapping[int, Any], state: State) -> State:
    """State with new commands and memories of the ``scripts``; its commands are a new array."""
    wanted, memories = state.wanted.copy(), dict(state.memories)
    running = ~state.ended  # nothing changes in an episode that has ended
    for i, script in scripts.items():
        commands, memories[i] = ask_script(script, state, memories[i], i)
        np.copyto(wanted[:, i], commands, where=running)
    return state._replace(wanted=wanted, memories=memories)


def _call(script: Any, method: str, state: State, *arguments: Any) -> Any:
    """Result of a script's ``method``. An error of the script becomes ``AgentFailed``."""
    try:
        return getattr(script, method)(state, *arguments)
    except EthBrakeError:
        raise
    except Exception as error:
        problem = f"vehicle_{arguments[-1]}: {method} fails: {describe_error(error)}"
        raise AgentFailed(name_of(script), None, problem) from error
