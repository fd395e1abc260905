"""Policies of other libraries: how each kind is called, and which settings of a training are applied or refused."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.errors import InvalidInput, describe_error, naming_extras
from ethbrake_marl.files.model import first_mistake
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.training_range import TrainingRange

MOST_ONNX_BYTES = 1 << 31

Ask = Callable[[Any, Observations], Any]  # (policy, observations [n, F]) -> actions

# library -> its classes around an environment that change neither observations nor actions, or are applied
HARMLESS = {
    "gymnasium": (
        "OrderEnforcing", "PassiveEnvChecker", "TimeLimit", "RecordEpisodeStatistics", "RecordVideo",
        "TransformReward", "NormalizeReward",
    ),
    "stable_baselines3": ("DummyVecEnv", "Monitor", "VecMonitor", "VecCheckNan", "VecVideoRecorder", "VecNormalize"),
    "pettingzoo": (
        "OrderEnforcingWrapper", "AssertOutOfBoundsWrapper", "aec_to_parallel_wrapper", "parallel_to_aec_wrapper",
    ),
    "supersuit": ("SB3VecEnvWrapper", "ConcatVecEnv", "MarkovVectorEnv"),
}  # fmt: skip
WRAPPED_ATTRIBUTES = ("venv", "envs", "vec_envs", "par_env", "aec_env", "env")  # attributes that hold what is wrapped


def ask_of(policy: Any, who: str) -> Ask:
    """Function ``(policy, observations) -> actions`` that calls a policy of this kind. The policy has no memory.

    Raises ``InvalidInput``, with a message that begins with ``who``, for an unknown kind of policy, and for a model
    whose actions would be random or depend on the rest of the batch.
    """
    if isinstance(policy, bytes) or (hasattr(policy, "run") and hasattr(policy, "get_inputs")):
        return ask_onnx
    if hasattr(policy, "predict"):
        return ask_model
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(policy, torch.nn.Module):
        _refuse_training_mode(policy, who)
        return ask_torch
    if not callable(policy) or isinstance(policy, Policy):
        raise InvalidInput(
            f"{who}: policy = {policy!r:.80}: must be a function of observations, an object with predict, a torch"
            " module, an ONNX session or the path of an .onnx file; a policy of this package drives by"
            " LearnedAgent(policy)"
        )
    return ask_function


def ask_function(function: Any, observations: Observations) -> Any:
    return function(observations)


def ask_model(model: Any, observations: Observations) -> Any:
    """Deterministic actions of an object with ``predict``; the ``VecNormalize`` of its training is applied.

    Raises ``InvalidInput`` if the model also returns a state.
    """
    statistics = statistics_of(model)
    answer = model.predict(
        observations if statistics is None else statistics.normalize_obs(observations), deterministic=True
    )
    if not isinstance(answer, tuple):
        return answer
    actions, *states = answer
    if any(state is not None for state in states):
        raise InvalidInput(
            "predict returned a state, so the model has a memory; write a function (observation, state) -> (action,"
            " state) around it, whose states are arrays with one row per world, and pass initial_state"
        )
    return actions


def ask_torch(module: Any, observations: Observations) -> Any:
    torch = sys.modules["torch"]
    usual = torch.zeros(0, dtype=torch.float32, device="cpu")
    parameter = next(filter(torch.is_floating_point, module.parameters()), usual)
    with torch.no_grad():
        answer = module(torch.from_numpy(observations).to(parameter))
        return answer.float() if getattr(answer, "dtype", None) == torch.bfloat16 else answer  # which numpy lacks


def ask_onnx(session: Any, observations: Observations) -> Any:
    """Actions of an ONNX model: its output ``action``, or else its first output."""
    session = session_of(session)
    names = [output.name for output in session.get_outputs()]
    return session.run(["action" if "action" in names else names[0]], {session.get_inputs()[0].name: observations})[0]


def onnx_file(path: str | os.PathLike[str], who: str) -> bytes:
    file = Path(path).expanduser()
    if file.suffix != ".onnx":
        raise InvalidInput(
            f"{who}: policy = {str(path)!r:.120}: must be the path of an .onnx file; the policy of a run or bundle"
            " drives by LearnedAgent(load_policy(PATH))"
        )
    return read_plain(file, MOST_ONNX_BYTES)


def session_of(model: Any) -> Any:
    """ONNX session for the bytes of a file; a session is returned unchanged."""
    return _open_session(model) if isinstance(model, bytes) else model


@lru_cache(16)
def _open_session(content: bytes) -> Any:
    with naming_extras():
        import onnxruntime
    try:
        return onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise InvalidInput(f"policy: the file is no ONNX model that can be run: {describe_error(error)}") from error


def _refuse_training_mode(module: Any, who: str) -> None:
    """Raise ``InvalidInput`` if a layer of a torch module is in training mode and this affects its results."""
    for layer in module.modules():
        shares = [getattr(layer, name, None) for name in ("p", "dropout")]
        random = any(isinstance(share, float | int) and share > 0.0 for share in shares)
        if layer.training and (random or getattr(layer, "running_mean", None) is not None):
            raise InvalidInput(
                f"{who}: the layer {type(layer).__name__} is in training mode, in which results are random or depend on"
                " the other worlds of a batch; call the eval() of the module first"
            )


def features_of(policy: Any, ask: Ask) -> tuple[str, ...] | None:
    """Names of the features that a model was trained on, or None if it does not record them."""
    if ask is ask_onnx:
        feature_list = session_of(policy).get_modelmeta().custom_metadata_map.get("features")
        return tuple(feature_list.split(",")) if feature_list else None
    return getattr(getattr(policy, "observation_space", None), "features", None)


def range_of(policy: Any, ask: Ask, features: int, who: str) -> TrainingRange | None:
    """Range of training that an ONNX model records, or None.

    Raises ``InvalidInput``, with a message that begins with ``who``, if the range does not fit the F ``features``.
    """
    text = session_of(policy).get_modelmeta().custom_metadata_map.get("training_range") if ask is ask_onnx else None
    if text is None:
        return None
    try:
        training_range = TrainingRange.model_validate_json(text)
    except ValidationError as error:
        raise InvalidInput(f"{who}: training_range in the model's metadata: {first_mistake(error)}") from None
    if len(training_range.low) != features:
        raise InvalidInput(f"{who}: training_range in the model's metadata must have {features} features")
    return training_range


def count_of_actions(policy: Any, count: int | None, who: str) -> int | None:
    """Number of discrete actions of a policy; None if it returns numbers in [-1, 1].

    ``count``: the number that the user states, or None. Raises ``InvalidInput``, with a message that begins with
    ``who``, if the policy's action space is neither ``count`` indices nor, without ``count``, a box from -1 to 1.
    """
    space: Any = getattr(policy, "action_space", None)
    if count is None and getattr(space, "evenly_spaced", False):  # of an environment of this package
        count = int(space.n)
    if count is None:
        fits = [np.asarray(getattr(space, end, None)).tolist() for end in ("low", "high")] == [[-1.0], [1.0]]
        right = "a number in [-1, 1]; for indices of K evenly spaced actions pass actions=K"
    else:
        fits = (getattr(space, "n", None), getattr(space, "start", None)) == (count, 0)
        right = f"an index from 0 to {count - 1} (actions={count})"
    if space is not None and not fits:
        raise InvalidInput(
            f"{who}: the actions of the policy are in {space}; must be {right}; or write a function around the policy"
            " that converts its actions"
        )
    return count


def statistics_of(model: Any) -> Any:
    """``VecNormalize`` of a Stable-Baselines3 model, or None."""
    return getattr(model, "get_vec_normalize_env", lambda: None)()


def check_wrappers(policy: Any, who: str) -> None:
    """Raise ``InvalidInput`` if a model was trained under a wrapper that may change observations or actions.

    Also raised if a model was trained under ``VecNormalize`` and the statistics of ``VecNormalize`` are missing.
    """
    env, statistics = getattr(policy, "get_env", lambda: None)(), statistics_of(policy)
    for layer in [] if env is None else wrappers_of(env):
        kind, library = type(layer), type(layer).__module__.partition(".")[0]
        if library != "ethbrake_marl" and kind.__name__ not in HARMLESS.get(library, ()):
            name = vars(layer).get("modifier_class", kind).__name__  # of SuperSuit
            raise InvalidInput(
                f"{who}: the model was trained under {name}, which may change observations or"
                " actions and is not applied here; write a function around the model that makes the"
                " same changes, or pass ignore_wrappers=True if there are none"
            )
    if statistics is None and _was_normalised(policy):
        raise InvalidInput(
            f"{who}: the model was trained under VecNormalize, whose statistics are missing; load them with"
            " model.set_env(VecNormalize.load(PATH, venv)); if VecNormalize changed rewards only, pass"
            " ignore_wrappers=True"
        )


def check_gamma(model: Any, who: str) -> None:
    """Raise ``InvalidInput`` if a model's discount was too large for the reward of its training environment."""
    env, gamma = getattr(model, "get_env", lambda: None)(), getattr(model, "gamma", None)
    for layer in [] if env is None else wrappers_of(env):
        game = getattr(layer, "game", None)
        if gamma is not None and isinstance(game, Game):
            game.rewarding.params.check_gamma(gamma, f"{who}: the model was trained with gamma")


def wrappers_of(env: Any) -> Iterator[Any]:
    yield env
    for name in WRAPPED_ATTRIBUTES:
        inside = getattr(env, "__dict__", {}).get(name, ())  # its own: wrappers forward attributes
        for wrapper in inside if isinstance(inside, list | tuple) else (inside,):
            if hasattr(wrapper, "step") or hasattr(wrapper, "step_wait"):
                yield from wrappers_of(wrapper)


def _was_normalised(model: Any) -> bool:
    """Whether a model was trained on normalised observations.

    The last observation in training is then outside the model's observation space, or the model also stores the
    original observation. Off-policy algorithms always store it, so it says nothing about them.
    """
    if getattr(model, "_last_original_obs", None) is not None and not hasattr(model, "replay_buffer"):
        return True
    observation, space = getattr(model, "_last_obs", None), getattr(model, "observation_space", None)
    low, high = getattr(space, "low", -np.inf), getattr(space, "high", np.inf)
    return isinstance(observation, np.ndarray) and not np.all((low <= observation) & (observation <= high))
