"""Find wrappers in a Stable-Baselines3 model's training environment that may change observations or actions.

The agent made from the model does not apply the wrappers of the training environment. Therefore the model would get
other observations than in training, or its actions would have other effects. The checks run without importing
Stable-Baselines3 or the libraries of the wrappers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.engine.engine import Engine

# Library -> classes that do not change observations and actions. The agent itself applies ``VecNormalize``.
HARMLESS = {
    "gymnasium": (
        "Env", "Wrapper", "RewardWrapper", "NormalizeReward", "OrderEnforcing", "PassiveEnvChecker", "TimeLimit",
        "RecordEpisodeStatistics", "RecordVideo", "RenderCollection", "HumanRendering",
    ),
    "stable_baselines3": (
        "VecEnv", "VecEnvWrapper", "DummyVecEnv", "SubprocVecEnv", "Monitor", "VecMonitor", "VecCheckNan",
        "VecVideoRecorder", "VecNormalize",
    ),
    "pettingzoo": (
        "AECEnv", "ParallelEnv", "BaseWrapper", "BaseParallelWrapper", "OrderEnforcingWrapper",
        "AssertOutOfBoundsWrapper", "CaptureStdoutWrapper", "RecordVideo", "RecordVideoParallel",
        "aec_to_parallel_wrapper", "parallel_to_aec_wrapper",
    ),
    "supersuit": ("SB3VecEnvWrapper", "ConcatVecEnv", "MarkovVectorEnv", "gym_reward_lambda", "aec_reward_lambda"),
    "mo_gymnasium": ("LinearReward", "MONormalizeReward", "MORecordEpisodeStatistics"),
    "momaland": ("LinearizeReward", "NormalizeReward", "RecordEpisodeStatistics"),
}  # fmt: skip

_METHODS = ("step", "reset", "step_async", "step_wait", "observe", "last")  # methods that pass observations or actions

_INSIDE = ("venv", "envs", "vec_envs", "par_env", "aec_env", "env")  # attributes that hold the wrapped environment


def changes(layer: type[Any]) -> bool:
    """Return whether ``layer``, a class of wrappers or environments, may change observations or actions.

    The result is False if each method in ``_METHODS`` is defined by a class in ``HARMLESS`` or by a class of this
    package.
    """
    for method in _METHODS:
        definer = next((each for each in layer.__mro__ if method in vars(each)), object)
        library = definer.__module__.partition(".")[0]
        if definer is not object and library != "ethbrake_marl" and definer.__name__ not in HARMLESS.get(library, ()):
            return True
    return False


class _WhatChanges(type):
    def __instancecheck__(cls, layer: object) -> bool:
        return changes(type(layer))


class _Changing(metaclass=_WhatChanges):
    """Class for the argument of ``env_is_wrapped``: ``isinstance(x, _Changing)`` is ``changes(type(x))``.

    ``env_is_wrapped`` also works for environments in other processes, where ``changes`` cannot be called directly.
    """


def training_environment(model: Any, name: str, *, ignore_wrappers: bool = False) -> Any:
    """Return this package's environment in which a Stable-Baselines3 model was trained, without wrappers around it.

    ``model`` may be any policy; the result is None if the policy was not trained in an environment of this package.
    ``name`` is the name of the agent in error messages. If ``ignore_wrappers`` is True, the wrappers are not checked.

    A model may be trained in several copies of an environment at the same time. Raises ``InvalidInput`` if a wrapper of
    any copy may change observations or actions, if the copies differ in their features or number of actions, or if the
    statistics of ``VecNormalize`` are missing.
    """
    statistics = normalisation(model)
    if statistics is None and not ignore_wrappers and _was_normalised(model):
        raise InvalidInput(
            f"agent {name!r}: the model was trained under VecNormalize, whose statistics are missing; load them with"
            " model.set_env(VecNormalize.load(PATH, venv)); if VecNormalize changed rewards only, pass"
            " ignore_wrappers=True"
        )
    env, bases = getattr(model, "get_env", lambda: None)(), list[Any]()
    for layer in [] if env is None else _layers(env):
        wrapper, inside = _look(layer, name)
        if hasattr(type(layer), "normalize_obs") and layer is not statistics:
            wrapper = "VecNormalize inside another VecNormalize"
        if wrapper is not None and not ignore_wrappers:
            raise InvalidInput(
                f"agent {name!r}: the model was trained under {wrapper}, which may change observations or actions and"
                " is not applied here; write a function around the model that makes the same changes, or pass"
                " ignore_wrappers=True if there are no changes"
            )
        bases += inside
    features = [base.engine.observation.features for base in bases]
    if not ignore_wrappers and any(each != features[0] for each in features):
        raise InvalidInput(
            f"agent {name!r}: the parallel environments with which the model was trained have observations with"
            " different features; all must have the same features"
        )
    counts = {getattr(base, "actions", None) for base in bases}
    if not ignore_wrappers and len(counts) > 1:
        raise InvalidInput(
            f"agent {name!r}: the parallel environments with which the model was trained have different numbers of"
            f" discrete actions, {counts}; all must have the same number"
        )
    return bases[0] if bases else None


def normalisation(model: Any) -> Any:
    """Return the model's ``VecNormalize`` wrapper, with its present statistics; None if there is no such wrapper."""
    return getattr(model, "get_vec_normalize_env", lambda: None)()


def _was_normalised(model: Any) -> bool:
    """Return whether the data saved with a Stable-Baselines3 model show that training normalised the observations.

    The result is True if the last saved observation lies outside the observation space, or if the model also saved this
    observation as it was before normalisation. The models of off-policy algorithms always save the observation before
    normalisation, so for these models only the observation space is checked.
    """
    if getattr(model, "_last_original_obs", None) is not None and not hasattr(model, "replay_buffer"):
        return True
    seen, space = getattr(model, "_last_obs", None), getattr(model, "observation_space", None)
    low, high = getattr(space, "low", -np.inf), getattr(space, "high", np.inf)
    return isinstance(seen, np.ndarray) and not np.all((low <= seen) & (seen <= high))


def _layers(env: Any) -> Iterator[Any]:
    """Yield ``env``, then all wrappers and environments inside it, from the outside in.

    All copies of an environment are yielded, but nothing inside an environment of this package.
    """
    yield env
    for name in [] if _is_ours(env) else _INSIDE:
        inside = _own(env).get(name, [])
        for each in inside if isinstance(inside, list | tuple) else [inside]:
            yield from _layers(each)


def _look(layer: Any, name: str) -> tuple[str | None, list[Any]]:
    """Return the class in ``layer`` that may change observations or actions, and this package's environments in it.

    The class is given by its name; None if there is none. The environments are the layer itself, or environments that
    the layer runs in other processes.
    """
    if changes(type(layer)):
        modifier = _own(layer).get("modifier_class", type(layer))  # the modifier of a SuperSuit wrapper
        return getattr(modifier, "__name__", type(layer).__name__), [layer] if _is_ours(layer) else []
    if "remotes" not in _own(layer):
        return None, [layer] if _is_ours(layer) else []
    try:  # a failing call would end the process, so only calls that all environments support are made
        wrapped, ours = layer.env_is_wrapped(_Changing), layer.has_attr("engine")
        bases = layer.get_attr("unwrapped") if ours else []
        odd = [k for k, each in enumerate(wrapped) if each or not ours or changes(type(bases[k]))]
        return layer.env_method("__str__", indices=odd[0])[0] if odd else None, bases
    except (OSError, EOFError):
        raise InvalidInput(
            f"agent {name!r}: the model's environment runs in other processes, which do not answer; make the agent"
            " before you close the environment, or load the model from its file"
        ) from None


def _is_ours(env: Any) -> bool:
    return isinstance(_own(env).get("engine"), Engine)


def _own(layer: Any) -> dict[str, Any]:
    """Return the wrapper's own attributes, without attributes of the environment inside that the wrapper forwards."""
    return getattr(layer, "__dict__", {})
