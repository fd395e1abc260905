"""Policies of other libraries, each as one function: ``(observation, state) -> (action, state)``."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.wrappers import NormalizeObservation, RescaleObservation
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, describe_error, naming_extras
from ethbrake_marl.observations import Observations

State = Any  # arrays whose first axis is the world, or tuples, lists and mappings of such
Infer = Callable[[Observations, State], tuple[Any, State]]
Begin = Callable[[int], State]  # the memory of n episodes that begin

_KINDS = (
    "a function of observations, an object with predict, a torch module, an ONNX session or the path of an .onnx file"
)


def adapt_policy(policy: Any, name: str, features: int, initial_state: Begin | None) -> tuple[Infer, Begin | None]:
    """The policy as such a function, and what makes its memory; raises ``InvalidInput`` for what is none."""
    if isinstance(policy, str | os.PathLike):
        policy = _open_onnx(Path(policy), name)
    if not (hasattr(policy, "run") and hasattr(policy, "get_inputs")) and not hasattr(policy, "predict"):
        if _is_torch_module(policy):
            return _ask_torch(policy, name, initial_state is not None), initial_state
        if callable(policy):
            call = policy if initial_state else lambda seen, _: (_without_memory(policy(seen)), None)
            return call, initial_state
        raise InvalidInput(f"agent {name!r}: a {type(policy).__name__} is no policy; must be {_KINDS}")
    if initial_state is not None:
        raise InvalidInput(
            f"agent {name!r}: initial_state is for a function (observation, state) -> (action, state); write one"
            " around this model"
        )
    return (_ask_onnx(policy), None) if hasattr(policy, "run") else _ask_model(policy, name, features)


def _without_memory(action: Any) -> Any:
    if isinstance(action, tuple):
        raise InvalidInput(
            f"gave a tuple of {len(action)} in place of an action; a policy with a memory gives (action, state), and"
            " needs initial_state"
        )
    return action


def map_state(function: Callable[..., Any], state: State, *others: State) -> State:
    """The function of every array of a memory, together with those in its place in the others."""
    if state is None:
        return None
    if isinstance(state, Mapping):
        return {key: map_state(function, value, *(other[key] for other in others)) for key, value in state.items()}
    if isinstance(state, tuple | list):
        return tuple(map_state(function, *parts) for parts in zip(state, *others, strict=True))
    return function(state, *others)


def _ask_model(model: Any, name: str, features: int) -> tuple[Infer, Begin | None]:
    """A model with ``predict``; where that gives a state, too (sb3-contrib's recurrent ones), the agent keeps it.

    Which axis of the state is that of the worlds is found by asking for two worlds and for three.
    """

    def predict(seen: Observations, **memory: Any) -> tuple[Any, State]:
        statistics = _statistics(model)
        given = seen if statistics is None else statistics.normalize_obs(seen)
        found = model.predict(given, deterministic=True, **memory)
        return found if isinstance(found, tuple) else (found, None)

    def world_axis(two: Any, three: Any) -> int:
        shapes = np.shape(two), np.shape(three)
        found = [axis for axis, sizes in enumerate(zip(*shapes, strict=True)) if sizes == (2, 3)]
        if len(found) != 1:
            raise InvalidInput(f"its state has arrays of shape {shapes[0]} for two worlds and {shapes[1]} for three")
        return found[0]

    try:
        like, of_three = (predict(np.zeros((n, features), np.float32))[1] for n in (2, 3))
        axes = map_state(world_axis, like, of_three)
    except Exception as error:
        raise InvalidInput(f"agent {name!r}: predict on {features} features: {describe_error(error)}") from error
    if like is None:
        return lambda seen, _: (predict(seen)[0], None), None

    def infer(seen: Observations, state: State) -> tuple[Any, State]:
        begins, memory = state
        kept = None if begins.all() else map_state(lambda array, axis: np.moveaxis(array, 0, axis), memory, axes)
        action, memory = predict(seen, state=kept, episode_start=begins)
        after = map_state(lambda array, axis: np.moveaxis(to_array(array), axis, 0), memory, axes)
        return action, (np.zeros(len(seen), np.bool_), after)

    def begin(n: int) -> State:
        shaped = map_state(lambda array, axis: np.moveaxis(to_array(array), axis, 0), like, axes)
        return np.ones(n, np.bool_), map_state(lambda array: np.zeros((n, *array.shape[1:]), array.dtype), shaped)

    return infer, begin


def training_environment(model: Any, name: str) -> Any:
    """The environment of this package in which a Stable-Baselines3 model is trained, inside whatever wraps it.

    None where that is not known. Raises ``InvalidInput`` where Gymnasium's own wrappers change what it observes.
    """
    env = getattr(model, "get_env", lambda: None)()
    if env is None:
        return None
    for wrapper in (NormalizeObservation, RescaleObservation):
        if any(env.env_is_wrapped(wrapper)):
            raise InvalidInput(
                f"agent {name!r}: the model is trained under {wrapper.__name__}, which this agent knows nothing of;"
                " write a function around it that does the same, or train under Stable-Baselines3's VecNormalize"
            )
    try:
        return env.get_attr("unwrapped")[0] if env.get_attr("engine") else None
    except AttributeError:  # another library's
        return None


def _statistics(model: Any) -> Any:
    """Stable-Baselines3's ``VecNormalize`` that the model is trained under, as it counts now; None without one."""
    find = getattr(model, "get_vec_normalize_env", None)
    return None if find is None else find()


def _ask_onnx(session: Any) -> Infer:
    given = session.get_inputs()[0].name
    names = [output.name for output in session.get_outputs()]
    wanted = "action" if "action" in names else names[0]
    return lambda seen, _: (session.run([wanted], {given: seen})[0], None)


def _ask_torch(module: Any, name: str, with_state: bool) -> Infer:
    torch = sys.modules["torch"]
    for layer in module.modules():
        if layer.training and isinstance(
            layer, torch.nn.modules.dropout._DropoutNd | torch.nn.modules.batchnorm._NormBase
        ):
            raise InvalidInput(
                f"agent {name!r}: {type(layer).__name__} is in training mode, where it draws, or mixes the worlds of a"
                " batch; call eval() of the module first"
            )

    def call(seen: Observations, state: State) -> tuple[Any, State]:
        parameter = next(iter(module.parameters()), None)
        with torch.no_grad():
            given = torch.from_numpy(np.array(seen)).to("cpu" if parameter is None else parameter.device)
            return module(given, state) if with_state else (module(given), None)

    return call


def _is_torch_module(policy: Any) -> bool:
    """Never imports torch: whoever has a module has it already."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(policy, torch.nn.Module)


def _open_onnx(path: Path, name: str) -> Any:
    if path.suffix != ".onnx" or not path.is_file():
        what = (
            "there is no such file" if path.suffix == ".onnx" else f"a path must be that of an .onnx file, not {path}"
        )
        raise InvalidInput(f"agent {name!r}: policy {str(path)!r}: {what}")
    with naming_extras():
        import onnxruntime
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def weights_sha256(policy: Any) -> str | None:
    """SHA-256 of an .onnx file, or of the weights of a torch module or a Stable-Baselines3 model as they are now.

    What a ``VecNormalize`` has counted belongs to the weights. None for anything else, whose weights nobody can find.
    """
    if isinstance(policy, str | os.PathLike):
        return hashlib.sha256(Path(policy).read_bytes()).hexdigest() if Path(policy).is_file() else None
    module: Any = policy if _is_torch_module(policy) else getattr(policy, "policy", None)
    if not _is_torch_module(module):
        return None
    arrays, statistics = dict(module.state_dict()), _statistics(policy)
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
    """An array, of a tensor too; what is masked is no number."""
    if isinstance(value, np.ma.MaskedArray):
        return np.ma.filled(value.astype(np.float64), np.nan)
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
