"""Policies of other libraries: how each kind is called, and which settings of a training are applied or refused."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ethbrake_marl.agents.action_scale import REACH, ActionForm, ActionScale, count_in
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.policy import Policy

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
    """Function that calls a policy of this kind.

    Raises ``InvalidInput``, beginning with ``who``, for an unknown kind, and for a model whose actions would be random
    or depend on the rest of the batch.
    """
    if hasattr(policy, "predict"):
        return ask_model
    torch = sys.modules.get("torch")
    if torch is not None and isinstance(policy, torch.nn.Module):
        _refuse_training_mode(policy, who)
        return ask_torch
    if not callable(policy) or isinstance(policy, Policy):
        raise InvalidInput(
            f"{who}: policy = {policy!r:.80}: must be a function of observations, an object with predict or a torch"
            " module; the policy of a run or bundle drives by LearnedAgent(load_policy(PATH))"
        )
    return ask_function


def ask_function(function: Any, observations: Observations) -> Any:
    return function(observations)


def ask_model(model: Any, observations: Observations) -> Any:
    """Deterministic actions of an object with ``predict``, under the ``VecNormalize`` of its training.

    Raises ``InvalidInput`` for a model with a memory.
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


def _refuse_training_mode(module: Any, who: str) -> None:
    for layer in module.modules():
        shares = [getattr(layer, name, None) for name in ("p", "dropout")]
        random = any(isinstance(share, float | int) and share > 0.0 for share in shares)
        if layer.training and (random or getattr(layer, "running_mean", None) is not None):
            raise InvalidInput(
                f"{who}: the layer {type(layer).__name__} is in training mode, in which results are random or depend on"
                " the other worlds of a batch; call the eval() of the module first"
            )


def features_of(policy: Any) -> tuple[str, ...] | None:
    """Names of the features that a model was trained on, or None if it does not record them."""
    return getattr(getattr(policy, "observation_space", None), "features", None)


def form_of_actions(policy: Any, form: ActionForm, who: str) -> ActionForm:
    """Form of the actions of a policy. ``form``: as the user states.

    Raises ``InvalidInput``, beginning with ``who``, for an action space that does not fit.
    """
    space: Any = getattr(policy, "action_space", None)
    if form is None and getattr(space, "scale", None):  # of an environment of this package, as below
        form = ActionScale(*space.scale)
    if form is None and getattr(space, "evenly_spaced", False):
        form = int(space.n)
    count, reach = count_in(form, f"{who}: actions"), REACH if isinstance(form, ActionScale) else 1.0
    if count is None:
        fits = [np.asarray(getattr(space, end, None)).tolist() for end in ("low", "high")] == [[-reach], [reach]]
        right = f"a number in [-{reach:g}, {reach:g}]; for indices of K evenly spaced actions pass actions=K"
    else:
        fits = (getattr(space, "n", None), getattr(space, "start", None)) == (count, 0)
        right = f"an index from 0 to {count - 1} (actions={count})"
    if space is not None and not fits:
        raise InvalidInput(
            f"{who}: the actions of the policy are in {space}; must be {right}; or write a function around the policy"
            " that converts its actions"
        )
    return form


def statistics_of(model: Any) -> Any:
    """``VecNormalize`` of a Stable-Baselines3 model, or None."""
    return getattr(model, "get_vec_normalize_env", lambda: None)()


def check_wrappers(policy: Any, who: str) -> None:
    """Raise ``InvalidInput`` for a model that was trained under a wrapper which may change observations or actions.

    Also raised if the statistics of its ``VecNormalize`` are missing.
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

    Then its last observation is outside its observation space, or it also stores the original observation, which
    off-policy algorithms always do.
    """
    if getattr(model, "_last_original_obs", None) is not None and not hasattr(model, "replay_buffer"):
        return True
    observation, space = getattr(model, "_last_obs", None), getattr(model, "observation_space", None)
    low, high = getattr(space, "low", -np.inf), getattr(space, "high", np.inf)
    return isinstance(observation, np.ndarray) and not np.all((low <= observation) & (observation <= high))
