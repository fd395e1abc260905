"""Agents that drive with policies of other libraries.

Arguments that several functions share: ``name`` is the name of the agent in error messages; ``seen`` [n, F] are the
observations in all n worlds, and ``state`` is the policy's memory for all n worlds; ``steps`` [n] are the numbers of
steps so far.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import AgentFailed, InvalidInput, check_whole_number, describe_error, naming_extras
from ethbrake_marl.first_edition.agents.foreign_wrappers import normalisation, training_environment
from ethbrake_marl.first_edition.agents.protocol import Source
from ethbrake_marl.first_edition.engine.memory import Memory, checked_memory, map_memory, take_memory
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.actions import LARGEST, action_to_command
from ethbrake_marl.first_edition.game.discrete_actions import index_to_action
from ethbrake_marl.first_edition.game.full_state import Appended, full_state, row_features
from ethbrake_marl.first_edition.game.observations import (
    Observation,
    Observations,
    ObservationSpec,
    choose_observation,
    observe,
)
from ethbrake_marl.first_edition.game.observed import observation_for
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario

State = Any  # memory of a policy: arrays whose first axis counts worlds, or tuples, lists and mappings of such arrays

Infer = Callable[[Observations, State], tuple[Any, State]]  # (observations [n, F], memory) -> (actions, new memory)

Begin = Callable[[int], State]  # number of episodes -> memory at the start of the episodes

_KINDS = (
    "a function of observations, an object with predict, a torch module, an ONNX session or the path of an .onnx file"
)


def adapt_policy(policy: Any, name: str, features: int, initial_state: Begin | None) -> tuple[Infer, Begin | None]:
    """Return two functions that call a policy of a kind that ``policy_agent`` accepts.

    The first function is ``(observations, state) -> (actions, new state)``. The second function is ``n -> state`` and
    returns the initial state for n episodes; for a policy without a memory, None is returned in its place. ``features``
    is the number of features in one observation. For a function or torch module with a memory, ``initial_state`` is
    such a function ``n -> state``; for all other policies it is None. Raises ``InvalidInput`` for a policy of any other
    kind.
    """
    if isinstance(policy, str | os.PathLike):
        policy = _open_onnx(Path(policy), name)
    if not (hasattr(policy, "run") and hasattr(policy, "get_inputs")) and not hasattr(policy, "predict"):
        if _is_torch_module(policy):
            return _ask_torch(policy, name, initial_state is not None), initial_state
        if callable(policy):
            call = policy if initial_state else lambda seen, _: (_without_memory(policy(seen)), None)
            return call, initial_state
        raise InvalidInput(f"agent {name!r}: policy = {policy!r:.80}: must be {_KINDS}")
    if initial_state is not None:
        raise InvalidInput(
            f"agent {name!r}: initial_state: can only be used with a function (observation, state) -> (action, state);"
            " write such a function around this model"
        )
    return (_ask_onnx(policy), None) if hasattr(policy, "run") else _ask_model(policy, name, features)


def _without_memory(action: Any) -> Any:
    if isinstance(action, tuple):
        raise InvalidInput(
            f"returned a tuple of {len(action)} values; the function must return the actions alone, or, if it returns"
            " (action, state), you must also pass initial_state"
        )
    return action


def _ask_model(model: Any, name: str, features: int) -> tuple[Infer, Begin | None]:
    """Do the same as ``adapt_policy``, for a model with a method ``predict``, such as a Stable-Baselines3 model.

    ``predict`` is called once for two worlds and once for three worlds: if ``predict`` also returns a memory, the
    shapes of the memory's arrays show which axis has one entry per world.
    """

    def predict(seen: Observations, **memory: Any) -> tuple[Any, State]:
        statistics = normalisation(model)
        inputs = seen if statistics is None else statistics.normalize_obs(seen)
        output = model.predict(inputs, deterministic=True, **memory)
        return output if isinstance(output, tuple) else (output, None)

    def world_axis(two: Any, three: Any) -> int:
        shapes = np.shape(two), np.shape(three)
        candidates = [axis for axis, sizes in enumerate(zip(*shapes, strict=True)) if sizes == (2, 3)]
        if len(candidates) != 1:
            raise InvalidInput(
                f"an array of the policy's state has shape {shapes[0]} for two worlds and {shapes[1]} for three"
                " worlds; exactly one axis must be as long as the number of worlds"
            )
        return candidates[0]

    try:
        like, of_three = (predict(np.zeros((n, features), np.float32))[1] for n in (2, 3))
        axes = map_memory(world_axis, like, of_three)
    except Exception as error:
        raise InvalidInput(
            f"agent {name!r}: the model's method predict fails for an observation of {features} features:"
            f" {describe_error(error)}"
        ) from error
    if like is None:
        return lambda seen, _: (predict(seen)[0], None), None

    def infer(seen: Observations, state: State) -> tuple[Any, State]:
        begins, memory = state
        carried = None if begins.all() else map_memory(lambda array, axis: np.moveaxis(array, 0, axis), memory, axes)
        action, memory = predict(seen, state=carried, episode_start=begins)
        after = map_memory(lambda array, axis: np.moveaxis(to_array(array), axis, 0), memory, axes)
        return action, (np.zeros(len(seen), np.bool_), after)

    def begin(n: int) -> State:
        shaped = map_memory(lambda array, axis: np.moveaxis(to_array(array), axis, 0), like, axes)
        return np.ones(n, np.bool_), map_memory(lambda array: np.zeros((n, *array.shape[1:]), array.dtype), shaped)

    return infer, begin


def _ask_onnx(session: Any) -> Infer:
    input_name, names = session.get_inputs()[0].name, [output.name for output in session.get_outputs()]
    wanted = "action" if "action" in names else names[0]
    return lambda seen, _: (session.run([wanted], {input_name: seen})[0], None)


def _ask_torch(module: Any, name: str, with_state: bool) -> Infer:
    torch = sys.modules["torch"]
    for layer in module.modules():
        if layer.training and isinstance(
            layer, torch.nn.modules.dropout._DropoutNd | torch.nn.modules.batchnorm._NormBase
        ):
            raise InvalidInput(
                f"agent {name!r}: the layer {type(layer).__name__} is in training mode, in which results are random or"
                " depend on the other worlds of a batch; call the eval() of the module first"
            )

    def call(seen: Observations, state: State) -> tuple[Any, State]:
        parameter = next(iter(module.parameters()), None)
        with torch.no_grad():
            inputs = torch.from_numpy(np.array(seen)).to("cpu" if parameter is None else parameter.device)
            return module(inputs, state) if with_state else (module(inputs), None)

    return call


def _is_torch_module(policy: Any) -> bool:
    """Return whether ``policy`` is a torch module, without importing torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(policy, torch.nn.Module)


def _open_onnx(path: Path, name: str) -> Any:
    if path.suffix != ".onnx" or not path.is_file():
        what = "there is no such file" if path.suffix == ".onnx" else "a policy given by a path must be an .onnx file"
        raise InvalidInput(f"agent {name!r}: policy = {str(path)!r}: {what}")
    with naming_extras():
        import onnxruntime
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def weights_sha256(policy: Any) -> str | None:
    """Return the SHA-256 hash of an .onnx file (given by its path), or of the present weights of a torch or SB3 model.

    The hash of an SB3 model also covers the statistics with which its ``VecNormalize`` normalises observations. Returns
    None for all other policies, because their weights cannot be read.
    """
    if isinstance(policy, str | os.PathLike):
        return hashlib.sha256(Path(policy).read_bytes()).hexdigest() if Path(policy).is_file() else None
    module: Any = policy if _is_torch_module(policy) else getattr(policy, "policy", None)
    if not _is_torch_module(module):
        return None
    arrays, statistics = dict(module.state_dict()), normalisation(policy)
    if statistics is not None and statistics.norm_obs:
        counted = statistics.obs_rms
        arrays |= {"mean": counted.mean, "var": counted.var, "clip": statistics.clip_obs, "eps": statistics.epsilon}
    digest = hashlib.sha256()
    for name, tensor in arrays.items():
        array = to_array(tensor)
        digest.update(f"{name} {array.dtype} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def to_array(value: Any) -> NDArray[Any]:
    """Convert an array, torch tensor or sequence to a NumPy array; masked entries become NaN."""
    if isinstance(value, np.ma.MaskedArray):
        return np.ma.filled(value.astype(np.float64), np.nan)
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)


def policy_agent(
    policy: Any,
    *,
    name: str | None = None,
    scenario: Scenario | str | None = None,
    observation: Observation | None = None,
    initial_state: Callable[[int], State] | None = None,
    clip: bool = False,
    appended: Appended | None = None,
    ignore_wrappers: bool = False,
    actions: int | None = None,
) -> PolicyAgent:
    """Return an agent that drives with a policy of any library.

    The policy maps observations, float32 [n, F], to actions [n, 1] or to indices of discrete actions [n]. A policy with
    a memory is a function ``(observation, state) -> (action, state)`` for which you pass ``initial_state``, or a model
    whose ``predict`` also returns a state.

    Args:
        policy: a function that maps observations to actions, a model with a method ``predict``, a torch module (called
            without gradients), an ONNX session, or the path of an ``.onnx`` file. A Stable-Baselines3 model is called
            with ``deterministic=True``, with the statistics of its ``VecNormalize``, and with a separate memory for
            each world. Copies of the agent use the same policy object.
        name: name of the agent in tables and messages; None: the name of the function or class.
        scenario: scenario (or its name) in which the policy was trained; the scenario determines what the policy
            observes. None: unknown.
        observation: features that the policy observes, instead of the scenario's observation (see
            ``choose_observation``). None: the scenario's observation. If ``scenario`` is also None: the observation of
            the model's training environment or of the policy, if known; otherwise the default observation.
        initial_state: function that returns the policy's memory at the start of n episodes: an array with one row per
            world, or tuples and mappings of such arrays. None: the policy has no memory, or is a model with
            ``predict``.
        clip: True: an action is clipped to [-1, 1], and an index of a discrete action to the valid range. False: an
            action or index outside its range is an error.
        appended: features that were appended to each observation in training, as in ``make_sb3_vec_env``: ``number``
            (the learner's number) or ``state`` (the true state of the line); needs ``scenario``. None: the features of
            the model's training environment, if known; otherwise no features.
        ignore_wrappers: whether to accept a model if wrappers of its training environment may have changed observations
            or actions, if its actions have bounds other than -1 and 1, or if its ``VecNormalize`` statistics are
            missing.
        actions: number of discrete actions, for a policy that returns the index of an action. None: the number of
            discrete actions in the model's training environment, if known; otherwise the policy returns actions in [-1,
            1].

    Raises ``InvalidInput`` if ``policy`` is of another kind, if it was trained with another number of features than the
    observation has, or if wrappers of its training environment may have changed observations or actions.

    >>> import ethbrake_marl.first_edition as eb
    >>> agent = eb.policy_agent(lambda observation: -observation[:, :1].clip(0, 1), name="mine")
    >>> scenario = eb.load_scenario("paper-random")
    >>> eb.evaluate(scenario.sample(5, 7), {"mine": agent}, scenario=scenario).worlds.n
    5

    """
    if actions is not None:
        check_whole_number("actions", actions, 2)
    scenario = load_scenario(scenario) if isinstance(scenario, str) else scenario
    of_file = isinstance(policy, str | os.PathLike)
    named = name or (Path(policy).stem if of_file else str(getattr(policy, "__name__", type(policy).__name__)))
    trained = training_environment(policy, named, ignore_wrappers=ignore_wrappers)
    spec = _observation_of(policy, scenario, observation, trained)
    if appended is None and (appended := getattr(trained, "appended", None)) is not None:
        scenario = trained.engine.scenario if scenario is None else scenario
    if appended is not None and scenario is None:
        raise InvalidInput(
            f"agent {named!r}: appended = {appended!r} needs the scenario of the training; pass it as scenario=..."
        )
    size = spec.size if scenario is None else len(row_features(spec.features, appended, scenario))
    shape = getattr(getattr(policy, "observation_space", None), "shape", None)
    if shape not in (None, (size,)):
        raise InvalidInput(
            f"agent {named!r}: the policy was trained for observations of shape {shape}, but would get observations of"
            f" {size} features; pass the same scenario, observation or appended as in the training"
        )
    seen = spec if trained is None or ignore_wrappers else trained.engine.observation
    if [f.name for f in spec.features] != [f.name for f in seen.features]:
        raise InvalidInput(
            f"agent {named!r}: the model was trained with the observation {seen}, not with {spec}; leave"
            " out observation=, and pass the scenario in which the model was trained, or leave out scenario="
        )
    actions = getattr(trained, "actions", None) if actions is None else actions
    if not ignore_wrappers:
        _check_action_space(policy, named, actions)
    infer, begin = adapt_policy(policy, named, size, initial_state)
    more = None if appended is None or scenario is None else _appending(appended, scenario)
    agent = PolicyAgent(infer, named, spec, begin, clip, lambda: weights_sha256(policy), more, actions)
    if appended == "state":
        agent.knows = Source.STATE
    return agent


def _check_action_space(policy: Any, name: str, actions: int | None) -> None:
    """Raise ``InvalidInput`` if the policy's action space does not fit ``actions``, the number of discrete actions."""
    space = getattr(policy, "action_space", None)
    low, high = (np.asarray(getattr(space, end, np.nan)).tolist() for end in ("low", "high"))
    count, least = getattr(space, "n", None), getattr(space, "start", None)
    fits = (low, high) == ([-1.0], [1.0]) if actions is None else (count, least) == (actions, 0)
    if space is None or fits:
        return
    right = "a number in [-1, 1]" if actions is None else f"an index from 0 to {actions - 1} (actions={actions})"
    advice = "write a function around the policy that converts its actions"
    if least == 0:
        advice = f"pass actions={count} if the actions are evenly spaced from -1 to 1, or {advice}"
    raise InvalidInput(f"agent {name!r}: the actions of the policy are in {space}; must be {right}; {advice}")


def _appending(appended: Appended, scenario: Scenario) -> Callable[[Worlds, int], Observations]:
    """Return a function ``(worlds, vehicle)`` that returns the features to append to the vehicle's observation, [n, K].

    For ``appended = "number"`` the feature is the number of the vehicle among the scenario's learners, from 0. For
    ``appended = "state"`` the features are the true state of the whole line.
    """

    def number(worlds: Worlds, vehicle: int) -> Observations:
        if vehicle not in scenario.learners:
            raise InvalidInput(
                f"appended = 'number' adds the learner's number to the observation, but vehicle_{vehicle + 1} is not a"
                f" learner of scenario {scenario.name!r}"
            )
        return np.full((worlds.n, 1), scenario.learners.index(vehicle), np.float32)

    return number if appended == "number" else lambda worlds, _: full_state(worlds, scenario)


def _observation_of(policy: Any, scenario: Scenario | None, given: Observation | None, trained: Any) -> ObservationSpec:
    if given is not None:
        return choose_observation(given, None if scenario is None else scenario.time_step_s)
    if scenario is not None:
        return observation_for(scenario)
    own = getattr(policy, "observation", None) if trained is None else trained.engine.observation
    return own if isinstance(own, ObservationSpec) else ObservationSpec()


class PolicyAgent:
    """Agent that drives one vehicle with a policy of any library. The function ``policy_agent`` makes such agents."""

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
        actions: int | None = None,
    ) -> None:
        self.name = name
        self.weights_sha256 = weights_sha256  # hash of the policy's present weights; None if they cannot be read
        self.observation = observation
        self._infer, self._initial_state, self._clip = infer, initial_state, clip
        self._more = more  # computes the features appended to the observation; None: no such features
        self._actions = actions  # number of discrete actions, if the policy returns an index; None: no index

    def policy_sha256(self) -> str | None:
        """Return the SHA-256 hash of the policy's present weights; None if the weights cannot be read."""
        return self.weights_sha256()

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Return the agent's memory before the first decision, which contains the policy's initial memory."""
        n, state = alert.n, None
        try:
            if self._initial_state is not None:
                state = take_memory(checked_memory(self._initial_state(n), n), np.arange(n))
        except Exception as error:
            raise AgentFailed(self.name, None, f"initial_state({n}): {describe_error(error)}") from error
        return {"steps": np.zeros(n, np.int64), "state": state}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Return the acceleration that the agent commands for ``vehicle``, [n] m/s2, and the agent's new memory.

        Raises ``AgentFailed``, which names world and step, if the policy raises an error, or returns an array of a
        wrong shape, a value that is not a number, or an action outside its range.
        """
        seen = observe(worlds, vehicle, self.observation).astype(np.float32, copy=False)
        if self._more is not None:
            seen = np.concatenate([seen, self._more(worlds, vehicle)], axis=1, dtype=np.float32)
        steps = memory["steps"]
        action, state = self._ask(seen, memory["state"], worlds, steps)
        values = self._checked(action, seen, worlds, steps)
        return action_to_command(values, worlds.vehicles, vehicle), {"steps": steps + 1, "state": state}

    def _ask(self, seen: Observations, state: State, worlds: Worlds, steps: Ints) -> tuple[NDArray[Any], State]:
        try:
            return self._answer(seen, state, np.arange(worlds.n))
        except Exception as error:
            k = self._find_failing(seen, state)
            first, last = steps.min(initial=10**9) + 1, steps.max(initial=0) + 1  # over all running episodes
            where = f"step {first}" if first >= last else f"steps {first} to {last}"
            where = where if k is None else _moment_text(k, worlds, steps)
            reason = f"{where}: observations of shape {seen.shape}: {describe_error(error)}"
            raise AgentFailed(self.name, k, reason) from error

    def _answer(self, seen: Observations, state: State, rows: Ints) -> tuple[NDArray[Any], State]:
        """Return the policy's unchecked actions, and its new memory, for the worlds with the indices ``rows``."""
        if self._initial_state is None:
            return to_array(self._infer(seen[rows], None)[0]), None
        action, state = self._infer(seen[rows], take_memory(state, rows))
        return to_array(action), checked_memory(state, len(rows))

    def _find_failing(self, seen: Observations, state: State) -> int | None:
        """Return the index of a world for which the policy fails when called for this world alone, or None."""

        def fails(rows: Ints) -> bool:
            try:
                self._answer(seen, state, rows)
            except Exception:
                return True
            return False

        rows = np.arange(len(seen))
        while len(rows) > 1:
            halves = (rows[: len(rows) // 2], rows[len(rows) // 2 :])
            failing = next((half for half in halves if fails(half)), None)
            if failing is None:
                return None
            rows = failing
        return int(rows[0])

    def _checked(self, action: NDArray[Any], seen: Observations, worlds: Worlds, steps: Ints) -> Floats:
        """Check the policy's output ``action``, and return the actions as an array [n] in [-1, 1].

        Raises ``AgentFailed`` if ``action`` has a wrong shape or contains an invalid value.
        """
        n, what = worlds.n, f"returned {action.dtype} of shape {action.shape} for observations of shape {seen.shape}"
        if self._actions is not None:
            return self._checked_indices(action, self._actions, what, worlds, steps)
        if action.shape != (n, 1) or action.dtype.kind not in "fiu":
            first = len(action) if action.shape[1:] in ((), (1,)) and action.ndim and len(action) < n else 0
            raise self._refusal(first, worlds, steps, f"{what}; must return one number per world, shape ({n}, 1)")
        values: Floats = action[:, 0].astype(np.float64)
        if not np.isfinite(values).all():
            k = int(np.argmin(np.isfinite(values)))
            raise self._refusal(
                k, worlds, steps, f"{what}; the action for this world is {values[k]}; must be in [-1, 1]"
            )
        inside = np.abs(values) <= LARGEST
        if not (self._clip or inside.all()):
            k = int(np.argmin(inside))
            right = "must be in [-1, 1]; clip=True clips such actions"
            raise self._refusal(k, worlds, steps, f"{what}; the action for this world is {values[k]:g}; {right}")
        return values.clip(-1.0, 1.0)

    def _checked_indices(self, indices: NDArray[Any], count: int, what: str, worlds: Worlds, steps: Ints) -> Floats:
        """Check the indices of discrete actions, and return the actions that they select, [n] in [-1, 1]."""
        n, last = worlds.n, count - 1
        right = f"must be a whole number from 0 to {last} per world with actions={count}, shape ({n},) or ({n}, 1)"
        if indices.shape not in ((n,), (n, 1)) or indices.dtype.kind not in "iu":
            raise self._refusal(0, worlds, steps, f"{what}; {right}")
        row = indices.reshape(n).clip(0, last) if self._clip else indices.reshape(n)
        inside = (row >= 0) & (row <= last)
        if not inside.all():
            k = int(np.argmin(inside))
            raise self._refusal(k, worlds, steps, f"{what}; the action index for this world is {row[k]}; {right}")
        return index_to_action(row, count)

    def _refusal(self, k: int, worlds: Worlds, steps: Ints, reason: str) -> AgentFailed:
        return AgentFailed(self.name, k, f"{_moment_text(k, worlds, steps)}: {reason}")


def _moment_text(k: int, worlds: Worlds, steps: Ints) -> str:
    return f"step {steps[k] + 1} ({worlds.time_s[k]:.2f} s)"
