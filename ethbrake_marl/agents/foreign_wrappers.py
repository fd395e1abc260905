"""Checks for wrappers in a Stable-Baselines3 model's training environment that change observations or actions.

An agent calls the model alone, without these wrappers, so their changes would be lost. Neither Stable-Baselines3 nor
the libraries of the wrappers need to be installed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.errors import InvalidInput

# Library -> classes that pass observations and actions on unchanged. ``VecNormalize`` is applied by the agent.
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
    """Return whether a class of wrappers or environments may change observations or actions.

    A class does not if each of its methods is defined by a class in ``HARMLESS`` or by a class of this package.
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
    """Stand-in class for ``env_is_wrapped``: every object whose class may change something is an instance of it.

    ``env_is_wrapped`` also runs in other processes, where ``changes`` cannot be called directly.
    """


def training_environment(model: Any, name: str, *, ignore_wrappers: bool = False) -> Any:
    """Return this package's environment inside the training environment of a Stable-Baselines3 model.

    Args:
        model: any policy; returns None for one that has no environment, or none of this package.
        name: name of the agent in error messages.
        ignore_wrappers: accept everything that raises an error otherwise.

    Raises ``InvalidInput`` for a wrapper, in any copy of the environment, that may change observations or actions; for
    copies with different features; and for missing statistics of ``VecNormalize``.

    """
    statistics = normalisation(model)
    if statistics is None and not ignore_wrappers and _was_normalised(model):
        raise InvalidInput(
            f"agent {name!r}: the model was trained under VecNormalize, whose statistics are missing; load them,"
            " model.set_env(VecNormalize.load(PATH, venv)), or drive without them by ignore_wrappers=True,"
            " as is right if it normalised rewards alone"
        )
    env, bases = getattr(model, "get_env", lambda: None)(), list[Any]()
    for layer in [] if env is None else _layers(env):
        wrapper, inside = _look(layer, name)
        if hasattr(type(layer), "normalize_obs") and layer is not statistics:
            wrapper = "VecNormalize inside another one"
        if wrapper is not None and not ignore_wrappers:
            raise InvalidInput(
                f"agent {name!r}: the model was trained under {wrapper}, which may change what it sees or does, and"
                " here it would drive without; write a function around the model that does the same, or say that"
                " nothing is changed by ignore_wrappers=True"
            )
        bases += inside
    features = [base.engine.observation.features for base in bases]
    if not ignore_wrappers and any(each != features[0] for each in features):
        raise InvalidInput(
            f"agent {name!r}: the copies of the model's environment observe different features; all need the same"
        )
    counts = {getattr(base, "actions", None) for base in bases}
    if not ignore_wrappers and len(counts) > 1:
        raise InvalidInput(
            f"agent {name!r}: the copies of the model's environment have different actions, {counts}; all need the same"
        )
    return bases[0] if bases else None


def normalisation(model: Any) -> Any:
    """Return the ``VecNormalize`` under which the model is trained, with its present statistics; None without one."""
    return getattr(model, "get_vec_normalize_env", lambda: None)()


def _was_normalised(model: Any) -> bool:
    """Return whether the saved training data of a Stable-Baselines3 model show that its observations were normalised.

    They were if the last observation lies outside the observation space, or its original is saved too. Off-policy
    algorithms always save an original, so for them only the space counts.
    """
    if getattr(model, "_last_original_obs", None) is not None and not hasattr(model, "replay_buffer"):
        return True
    seen, space = getattr(model, "_last_obs", None), getattr(model, "observation_space", None)
    low, high = getattr(space, "low", -np.inf), getattr(space, "high", np.inf)
    return isinstance(seen, np.ndarray) and not np.all((low <= seen) & (seen <= high))


def _layers(env: Any) -> Iterator[Any]:
    """Yield an environment, then every wrapper and environment inside it, from the outside in, in every parallel copy.

    It stops at environments of this package.
    """
    yield env
    for name in [] if _is_ours(env) else _INSIDE:
        inside = _own(env).get(name, [])
        for each in inside if isinstance(inside, list | tuple) else [inside]:
            yield from _layers(each)


def _look(layer: Any, name: str) -> tuple[str | None, list[Any]]:
    """Return which class of a layer may change observations or actions, and this package's environments in it.

    Args:
        layer: one wrapper or environment, from ``_layers``.
        name: name of the agent in error messages.

    The first result is the name of that class; None if the layer changes nothing. The environments are the layer itself
    or, if it runs environments in other processes, those.

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
            f"agent {name!r}: the model's environment runs in other processes, which do not answer; ask before they are"
            " closed, or load the model from its file"
        ) from None


def _is_ours(env: Any) -> bool:
    return isinstance(_own(env).get("engine"), Engine)


def _own(layer: Any) -> dict[str, Any]:
    """Return the attributes of a wrapper or environment itself, without those that it forwards from inside."""
    return getattr(layer, "__dict__", {})
