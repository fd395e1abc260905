"""A policy of any library as an agent: a function, a Stable-Baselines3 model, a torch module, an ONNX model.

The model is shared: a copy of the agent has its own memory of the running episodes, and the same model.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import LARGEST, action_to_command
from ethbrake_marl.agents.foreign import (
    Infer,
    State,
    adapt_policy,
    map_state,
    to_array,
    training_environment,
    weights_sha256,
)
from ethbrake_marl.agents.knowledge import Source
from ethbrake_marl.errors import AgentFailed, InvalidInput, count_of, describe_error
from ethbrake_marl.observations import (
    Observation,
    Observations,
    ObservationSpec,
    choose_observation,
    observation_for,
    observe,
)
from ethbrake_marl.observations.state import Appended, appending, row_features
from ethbrake_marl.physics import Floats, Ints, Worlds
from ethbrake_marl.scenario import Scenario


def policy_agent(
    policy: Any,
    *,
    name: str | None = None,
    scenario: Scenario | None = None,
    observation: Observation | None = None,
    initial_state: Callable[[int], State] | None = None,
    clip: bool = False,
    appended: Appended | None = None,
) -> PolicyAgent:
    """An agent that drives by a policy of any library: observations [n, F] float32 -> actions [n, 1] in [-1, 1].

    A policy with a memory is a function ``(observation, state) -> (action, state)`` with an ``initial_state``, or a
    model whose ``predict`` gives a state.

    Args:
        policy: a function, a model with ``predict`` (Stable-Baselines3; asked deterministically, its state kept world
            by world, its observations normalised by its ``VecNormalize``), a torch module (called as it is, without
            gradients), an ONNX session, or the path of an ``.onnx`` file. Copies share it.
        name: in tables and messages; None: the name of the function or class.
        scenario: the policy observes what learners of it do.
        observation: what it observes instead, as ``choose_observation`` reads it; None: that of the scenario, or of the
            policy itself, or of the environment that a Stable-Baselines3 model has, or the usual one.
        initial_state: makes the memory of ``n`` episodes that begin: an array whose first axis is the world, or tuples
            and mappings of such. None: a function has no memory.
        clip: actions beyond -1 and 1 mean -1 and 1; otherwise they are refused.
        appended: ``number`` or ``state`` of ``make_sb3_vec_env``, where the policy was trained on such rows; needs the
            scenario with its learners. None: as in the environment that the model has. Who sees the ``state`` knows
            the true state of the line.

    Raises ``InvalidInput`` for what is no such policy, or one for another number of features.

    >>> import ethbrake_marl as eb
    >>> agent = eb.policy_agent(lambda observation: -observation[:, :1].clip(0, 1), name="mine")
    >>> scenario = eb.load_scenario("paper-random")
    >>> eb.evaluate(scenario.sample(5, 7), {"mine": agent}, scenario=scenario).worlds.n
    5

    """
    named = name or _name_of(policy)
    trained = training_environment(policy, named)
    spec = _observation_of(policy, scenario, observation, trained)
    if appended is None and (appended := getattr(trained, "appended", None)) is not None:
        scenario = trained.engine.scenario if scenario is None else scenario
    if appended is not None and scenario is None:
        raise InvalidInput(f"agent {named!r}: appended = {appended!r} needs the scenario that it was trained in")
    size = spec.size if scenario is None else len(row_features(spec.features, appended, scenario))
    shape = getattr(getattr(policy, "observation_space", None), "shape", None)
    if shape not in (None, (size,)):
        raise InvalidInput(
            f"agent {named!r}: the policy takes observations of shape {shape}, here are {size} features;"
            " give what it was trained on: scenario, observation, or appended (number or state, of make_sb3_vec_env)"
        )
    if trained is not None and [f.name for f in spec.features] != [f.name for f in trained.engine.observation.features]:
        raise InvalidInput(
            f"agent {named!r}: the model is trained on other features than {spec}: {trained.engine.observation}; leave"
            " observation out, and give the scenario it was trained in, or none"
        )
    actions = getattr(policy, "action_space", None)
    ends = getattr(actions, "low", -1.0), getattr(actions, "high", 1.0)
    if not (clip or (np.all(ends[0] == -1.0) and np.all(ends[1] == 1.0))):
        raise InvalidInput(
            f"agent {named!r}: the policy gives actions in {actions}, here they mean [-1, 1]; write a function around"
            " it that says what they mean"
        )
    infer, begin = adapt_policy(policy, named, size, initial_state)
    more = None if appended is None or scenario is None else appending(appended, scenario)
    agent = PolicyAgent(infer, named, spec, begin, clip, lambda: weights_sha256(policy), more)
    if appended == "state":
        agent.knows = Source.STATE
    return agent


def _observation_of(policy: Any, scenario: Scenario | None, given: Observation | None, trained: Any) -> ObservationSpec:
    if given is not None:
        return choose_observation(given, None if scenario is None else scenario.time_step_s)
    if scenario is not None:
        return observation_for(scenario)
    own = getattr(policy, "observation", None) if trained is None else trained.engine.observation
    return own if isinstance(own, ObservationSpec) else ObservationSpec()


def _name_of(policy: Any) -> str:
    """Of the file, the function or the class."""
    if isinstance(policy, str | os.PathLike):
        return Path(policy).stem
    return str(getattr(policy, "__name__", type(policy).__name__))


class PolicyAgent:
    """Drives one vehicle by a policy of any library; made by ``policy_agent``."""

    knows = Source.MESSAGES

    def __init__(
        self,
        infer: Infer,
        name: str,
        observation: ObservationSpec,
        initial_state: Callable[[int], State] | None,
        clip: bool,
        weights_sha256: Callable[[], str | None],
        more: Callable[[Worlds, int], Observations] | None = None,
    ) -> None:
        self.name = name
        self.weights_sha256 = weights_sha256  # of the policy as it is now; None where nobody can find its weights
        self.observation = observation
        self._infer, self._initial_state, self._clip = infer, initial_state, clip
        self.remembers = initial_state is not None
        self._more = more  # what stands behind the own observation
        self._steps: Ints = np.zeros(0, np.int64)  # [n] decisions of the running episodes
        self._rows: Ints = np.zeros(0, np.int64)  # [n] their rows in the batch that began
        self._state: State = None

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        """Own memory, the same model."""
        return self.take(np.arange(len(self._steps)))

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Forget the episodes in these rows."""
        size = max(len(self._steps), int(rows.max(initial=-1)) + 1)
        old = np.arange(len(self._steps))
        if self._initial_state is not None:
            everywhere = self._begun(size)
            if len(old):
                everywhere = _put(everywhere, old, self._state)
            self._state = _put(everywhere, rows, self._begun(len(rows)))
        steps = np.zeros(size, np.int64)
        steps[old] = self._steps
        steps[rows] = 0
        self._steps, self._rows = steps, np.arange(size)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration [n], m/s2.

        Raises ``AgentFailed`` naming world and step where the policy raises, or gives another shape, no number, or one
        that is not in [-1, 1].
        """
        if len(self._steps) < worlds.n:
            raise InvalidInput(
                f"agent {self.name!r}: act on {count_of(worlds.n, 'world')}, but begin was not called for each of them"
            )
        if len(self._steps) > worlds.n:  # a smaller batch has begun
            self.__dict__.update(self.take(np.arange(worlds.n)).__dict__)
        seen = observe(worlds, vehicle, self.observation).astype(np.float32, copy=False)
        if self._more is not None:
            seen = np.concatenate([seen, self._more(worlds, vehicle)], axis=1, dtype=np.float32)
        action, state = self._ask(seen, worlds)
        values = self._checked(action, seen, worlds)
        self._state, self._steps = state, self._steps + 1
        return action_to_command(values, worlds.vehicles, vehicle)

    def take(self, rows: Ints) -> Self:
        """A copy that drives on in some rows of its batch only."""
        part = copy.copy(self)
        part._steps, part._rows = self._steps[rows], self._rows[rows]
        part._state = _take(self._state, rows)
        return part

    def _begun(self, n: int) -> State:
        assert self._initial_state is not None
        try:
            return _take(_checked_state(self._initial_state(n), n), np.arange(n))
        except Exception as error:
            raise AgentFailed(self.name, None, f"initial_state({n}): {describe_error(error)}") from error

    def _ask(self, seen: Observations, worlds: Worlds) -> tuple[NDArray[Any], State]:
        try:
            return self._answer(seen, np.arange(worlds.n))
        except Exception as error:
            k = self._find_failing(seen)
            where = self._whenever() if k is None else self._when(k, worlds)
            reason = f"{where}: observations of shape {seen.shape}: {describe_error(error)}"
            raise AgentFailed(self.name, None if k is None else int(self._rows[k]), reason) from error

    def _answer(self, seen: Observations, rows: Ints) -> tuple[NDArray[Any], State]:
        """What the policy says in some rows of the batch, and its memory of them then."""
        if self._initial_state is None:
            return to_array(self._infer(seen[rows], None)[0]), None
        action, state = self._infer(seen[rows], _take(self._state, rows))
        return to_array(action), _checked_state(state, len(rows))

    def _find_failing(self, seen: Observations) -> int | None:
        """The row for which alone the policy fails too, found by halves; None where no half fails."""
        rows = np.arange(len(seen))
        while len(rows) > 1:
            halves = (rows[: len(rows) // 2], rows[len(rows) // 2 :])
            found = next((half for half in halves if self._fails(seen, half)), None)
            if found is None:
                return None
            rows = found
        return int(rows[0])

    def _fails(self, seen: Observations, rows: Ints) -> bool:
        try:
            self._answer(seen, rows)
        except Exception:
            return True
        return False

    def _checked(self, action: NDArray[Any], seen: Observations, worlds: Worlds) -> Floats:
        """The actions [n] in [-1, 1]."""
        n, what = worlds.n, f"gave {action.dtype} of shape {action.shape} for observations of shape {seen.shape}"
        if action.shape != (n, 1) or action.dtype.kind not in "fiu":
            first = len(action) if action.shape[1:] in ((), (1,)) and action.ndim and len(action) < n else 0
            raise self._refusal(first, worlds, f"{what}; one number per world is needed, shape ({n}, 1)")
        values: Floats = action[:, 0].astype(np.float64)
        if not np.isfinite(values).all():
            k = int(np.argmin(np.isfinite(values)))
            raise self._refusal(k, worlds, f"{what}, in which stands {values[k]}; must be in [-1, 1]")
        inside = np.abs(values) <= LARGEST
        if not (self._clip or inside.all()):
            k = int(np.argmin(inside))
            right = "must be in [-1, 1]; with clip=True the nearest is meant"
            raise self._refusal(k, worlds, f"{what}, in which stands {values[k]:g}; {right}")
        return values.clip(-1.0, 1.0)

    def _refusal(self, k: int, worlds: Worlds, reason: str) -> AgentFailed:
        return AgentFailed(self.name, int(self._rows[k]), f"{self._when(k, worlds)}: {reason}")

    def _whenever(self) -> str:
        """The step, of all running episodes, at which nobody knows whose it was."""
        first, last = self._steps.min(initial=10**9) + 1, self._steps.max(initial=0) + 1
        return f"step {first}" if first >= last else f"steps {first} to {last}"

    def _when(self, k: int, worlds: Worlds) -> str:
        return f"step {self._steps[k] + 1} ({worlds.time_s[k]:.2f} s)"


def _take(state: State, rows: Ints) -> State:
    return map_state(lambda array: array[rows], state)


def _put(state: State, rows: Ints, part: State) -> State:
    """The memory with that of ``rows`` from another; changes and gives the first."""

    def put(array: Any, new: Any) -> Any:
        array[rows] = new
        return array

    return map_state(put, state, part)


def _checked_state(state: State, n: int) -> State:
    def check(array: Any) -> Any:
        shape = tuple(getattr(array, "shape", ()))
        if not shape or shape[0] != n:
            raise InvalidInput(f"state: {type(array).__name__} of shape {shape}; its first axis must be the {n} worlds")
        return array

    return map_state(check, state)
