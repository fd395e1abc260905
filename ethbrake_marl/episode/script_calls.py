"""Calls of scripts: their memories and commands, and a guard around the scripts of users."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ethbrake_marl.episode.plans import PHASES, PlanMemory, are_plans
from ethbrake_marl.episode.state import NUMBER, State, arrays_of, map_arrays
from ethbrake_marl.errors import AgentFailed, EthBrakeError, describe_error
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.layout import BRAKING, DRIVING, Floats


class UserScript:
    """Guards a script from outside this package: its states and memories are read-only, its results are checked.

    Simulations share states and memories, so a script must not change either. In its first episodes ``begin`` and
    ``act`` are called twice, because a script that then answers differently would give each agent other emergencies.
    Of an agent only ``begin`` is called twice: its actions may be random.
    """

    def __init__(self, script: Any, is_agent: bool, first_alerts: dict[int, State | None] | None = None) -> None:
        """``first_alerts``: body -> alert of its first episodes until they are over."""
        self.script, self.name, self.is_agent = script, name_of(script), is_agent
        self.knows, self.needs_ahead = getattr(script, "knows", None), getattr(script, "needs_ahead", ())
        self.first_alerts = {} if first_alerts is None else first_alerts

    def begin(self, alert: State, body: int) -> Any:
        memory, is_first = self._begin(alert, body), body not in self.first_alerts
        if is_first:
            self._check_alike("begin", body, memory, self._begin(alert, body))
        self.first_alerts[body] = alert if is_first and not self.is_agent else None
        return memory

    def _begin(self, alert: State, body: int) -> Any:
        return self._read_only(self.script.begin(alert.read_only(), body), alert.n, body)

    def act(self, state: State, memory: Any, body: int) -> tuple[Any, Any]:
        answer = self.script.act(state.read_only(), memory, body)
        if not isinstance(answer, tuple) or len(answer) != 2:
            right = "must return commands and memory"
            raise AgentFailed(self.name, None, f"vehicle_{body}: act returned {answer!r:.60}; {right}")
        first_alert = self.first_alerts.get(body)
        if first_alert is not None:
            self._begin(first_alert, body)  # a script that keeps new random numbers in the object now acts differently
            self._check_alike("act", body, answer, self.script.act(state.read_only(), memory, body))
        return answer[0], self._read_only(answer[1], state.n, body)

    def _check_alike(self, method: str, body: int, first: Any, second: Any) -> None:
        """Raise ``AgentFailed`` if two answers differ, except in arrays of objects."""
        if _contents(first) != _contents(second):
            raise AgentFailed(
                self.name,
                None,
                f"vehicle_{body}: {method} answers differently for the same worlds; must draw random numbers from"
                " alert.generators(body) in begin, and keep them in its memory",
            )

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


def _contents(answer: Any) -> list[Any]:
    arrays = [array for array in arrays_of(answer) if not np.dtype(getattr(array, "dtype", float)).hasobject]
    return [array.tobytes() if isinstance(array, np.ndarray) else repr(array) for array in arrays]


def guard_scripts(scripts: Mapping[int, Any], *, are_agents: bool = False) -> dict[int, Any]:
    """The scripts, body -> script, with each script from outside this package in a ``UserScript``.

    Scripts of this package are trusted. ``are_agents``: they drive learners.
    """
    return {
        body: script if type(script).__module__.startswith("ethbrake_marl.") else UserScript(script, are_agents)
        for body, script in scripts.items()
    }


def name_of(script: Any) -> str:
    return str(getattr(script, "name", type(script).__name__))


def begin_script(script: Any, alert: State, body: int) -> Any:
    """Memory of a script at the ``alert`` of new episodes. Raises ``AgentFailed`` if the script fails."""
    return _checked(script, _call(script, "begin", alert, body), body)


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
    return commands, _checked(script, memory, body)


def ask_scripts(scripts: Mapping[int, Any], state: State) -> State:
    """State with new commands and memories of the ``scripts``; its commands are a new array."""
    wanted, memories = state.wanted.copy(), dict(state.memories)
    running = ~state.ended  # nothing changes in an episode that has ended
    for i, script in scripts.items():
        commands, memories[i] = ask_script(script, state, memories[i], i)
        np.copyto(wanted[:, i], commands, where=running)
    return state._replace(wanted=wanted, memories=memories)


def _checked(script: Any, memory: Any, body: int) -> Any:
    """The ``memory``. Raises ``AgentFailed`` if a script tells what is no plan."""
    if isinstance(memory, PlanMemory) and not (good := are_plans(memory.plan)).all():
        right = f"must be {PHASES - 1} times in order, then {PHASES} finite commands; or only NaN, if there is no plan"
        told = memory.plan[np.argmin(good)].tolist()
        raise AgentFailed(name_of(script), None, f"vehicle_{body}: tells the plan {told}; {right}")
    return memory


def _call(script: Any, method: str, state: State, *arguments: Any) -> Any:
    """Result of a script's ``method``. An error of the script becomes ``AgentFailed``."""
    try:
        return getattr(script, method)(state, *arguments)
    except EthBrakeError:
        raise
    except Exception as error:
        problem = f"vehicle_{arguments[-1]}: {method} fails: {describe_error(error)}"
        raise AgentFailed(name_of(script), None, problem) from error
