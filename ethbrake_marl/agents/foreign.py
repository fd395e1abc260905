"""Models of other libraries: how each kind is asked, and what it brings that is applied or refused.

Nothing here imports torch, Stable-Baselines3 or onnxruntime, except to open the path of an ONNX file.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.episode.observe import Observations
from ethbrake_marl.errors import InvalidInput, naming_extras
from ethbrake_marl.faces.actions import Indices
from ethbrake_marl.policies.policy import Policy

Ask = Callable[[Observations, Any], tuple[Any, Any]]  # (observations [n, F], memory) -> (actions, new memory)

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
INSIDE = ("venv", "envs", "vec_envs", "par_env", "aec_env", "env")  # attributes that hold what is wrapped


class Function(NamedTuple):
    """A function of observations."""

    function: Callable[[Observations], Any]

    def __call__(self, seen: Observations, memory: Any) -> tuple[Any, Any]:
        """Return the actions, and the memory as it was."""
        actions = self.function(seen)
        if isinstance(actions, tuple):
            raise InvalidInput(
                f"returned a tuple of {len(actions)} values; must return the actions alone; a function that returns"
                " (actions, state) needs initial_state"
            )
        return actions, memory


class Model(NamedTuple):
    """An object with ``predict``, such as a model of Stable-Baselines3, under its ``VecNormalize``."""

    model: Any

    def __call__(self, seen: Observations, memory: Any) -> tuple[Any, Any]:
        """Return the deterministic actions, and the memory as it was."""
        statistics = statistics_of(self.model)
        inputs = seen if statistics is None else statistics.normalize_obs(seen)
        actions = self.model.predict(inputs, deterministic=True)
        if not isinstance(actions, tuple):
            return actions, memory
        if len(actions) != 2 or actions[1] is not None:
            raise InvalidInput(
                "predict returned a state: the model has a memory; write a function (observation, state) -> (action,"
                " state) around it, whose states are arrays with one row per world, and pass initial_state"
            )
        return actions[0], memory


class Torch(NamedTuple):
    """A torch module, which is called without gradients."""

    module: Any

    def __call__(self, seen: Observations, memory: Any) -> tuple[Any, Any]:
        """Return the actions, and the memory as it was."""
        torch = sys.modules["torch"]
        parameter = next(iter(self.module.parameters()), None)
        with torch.no_grad():
            inputs = torch.from_numpy(seen).to("cpu" if parameter is None else parameter.device)
            return self.module(inputs), memory


class Onnx(NamedTuple):
    """An ONNX model with one input: a session, or the path of a file."""

    session: Any

    def __call__(self, seen: Observations, memory: Any) -> tuple[Any, Any]:
        """Return the output ``action``, or the only one, and the memory as it was."""
        session = self.open()
        names = [output.name for output in session.get_outputs()]
        wanted = "action" if "action" in names else names[0]
        return session.run([wanted], {session.get_inputs()[0].name: seen})[0], memory

    def open(self) -> Any:
        """Return the session."""
        return opened(self.session) if isinstance(self.session, str) else self.session


@cache
def opened(path: str) -> Any:
    """Return the session of an ONNX file."""
    with naming_extras():
        import onnxruntime
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


def ask_of(policy: Any, who: str) -> Ask:
    """Return how a policy without ``initial_state`` is asked. Raises ``InvalidInput``, which begins with ``who``."""
    if isinstance(policy, str | os.PathLike):
        path = Path(policy).expanduser()
        if path.suffix != ".onnx" or not path.is_file():
            raise InvalidInput(
                f"{who}: policy = {str(policy)!r:.120}: must be the path of an .onnx file that exists; load the policy of"
                " a run or bundle with load_policy, and make its agent with LearnedAgent"
            )
        return _onnx(str(path), who)
    if hasattr(policy, "run") and hasattr(policy, "get_inputs"):
        return _onnx(policy, who)
    if hasattr(policy, "predict"):
        return Model(policy)
    if _is_module(policy):
        _refuse_training_mode(policy, who)
        return Torch(policy)
    if isinstance(policy, Policy):
        raise InvalidInput(f"{who}: the policy is of this package; make its agent with LearnedAgent(policy)")
    if not callable(policy):
        raise InvalidInput(
            f"{who}: policy = {policy!r:.80}: must be a function of observations, an object with predict, a torch module,"
            " an ONNX session or the path of an .onnx file"
        )
    return Function(policy)


def _onnx(session: Any, who: str) -> Onnx:
    model = Onnx(session)
    inputs, outputs = model.open().get_inputs(), [output.name for output in model.open().get_outputs()]
    if len(inputs) != 1 or ("action" not in outputs and len(outputs) != 1):
        raise InvalidInput(
            f"{who}: the ONNX model has the inputs {[each.name for each in inputs]} and the outputs {outputs}; must have"
            " one input, and one output or one called 'action'; write a function around a session that needs more"
        )
    return model


def _is_module(policy: Any) -> bool:
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(policy, torch.nn.Module)


def _refuse_training_mode(module: Any, who: str) -> None:
    """Raise ``InvalidInput`` for a layer whose results are random, or depend on the other worlds of a batch."""
    for layer in module.modules():
        random = any(getattr(layer, name, 0) not in (0, None) for name in ("p", "dropout"))  # a share, or a layer
        if layer.training and (random or getattr(layer, "running_mean", None) is not None):
            raise InvalidInput(
                f"{who}: the layer {type(layer).__name__} is in training mode, in which results are random or depend on"
                " the other worlds of a batch; call the eval() of the module first"
            )


def features_of(ask: Ask) -> Sequence[str] | None:
    """Return the names of the features that a model was trained on, where it brings them; None: it does not."""
    if isinstance(ask, Model):
        names: Sequence[str] | None = getattr(getattr(ask.model, "observation_space", None), "features", None)
        return names
    if isinstance(ask, Onnx):
        listed = ask.open().get_modelmeta().custom_metadata_map.get("features")
        return listed.split(",") if listed else None
    return None


def size_of(ask: Ask) -> int | None:
    """Return the number of features that a model was trained on, where it brings it; None: it does not, or any."""
    if isinstance(ask, Model):
        shape: Any = getattr(getattr(ask.model, "observation_space", None), "shape", None) or ()
    else:
        shape = ask.open().get_inputs()[0].shape[1:] if isinstance(ask, Onnx) else ()
    sizes = [size for size in shape if isinstance(size, int)]
    return int(np.prod(sizes)) if sizes else None


def count_of_actions(ask: Ask, given: int | None, who: str) -> int | None:
    """Return the number of discrete actions of a model; None: it returns numbers in [-1, 1].

    Raises ``InvalidInput`` if its action space is neither a box from -1 to 1 nor what was ``given``.
    """
    space = getattr(ask.model, "action_space", None) if isinstance(ask, Model) else None
    if isinstance(space, Indices) and given is None:
        return int(space.n)
    low, high = (np.asarray(getattr(space, end, np.nan)).tolist() for end in ("low", "high"))
    count, least = getattr(space, "n", None), getattr(space, "start", None)
    if space is not None and ((low, high) != ([-1.0], [1.0]) if given is None else (count, least) != (given, 0)):
        right = "a number in [-1, 1]" if given is None else f"an index from 0 to {given - 1} (actions={given})"
        evenly = f"pass actions={count} if they are evenly spaced from -1 to 1, or " if least == 0 else ""
        raise InvalidInput(
            f"{who}: the actions of the policy are in {space}; must be {right}; {evenly}write a function around the"
            " policy that converts its actions"
        )
    return given


def statistics_of(model: Any) -> Any:
    """Return the ``VecNormalize`` of a model of Stable-Baselines3; None: it has none."""
    return getattr(model, "get_vec_normalize_env", lambda: None)()


def check_wrappers(ask: Ask, who: str) -> None:
    """Raise ``InvalidInput`` if a model was trained under a wrapper that may change what it sees or does.

    The wrapper of its environment is named; a model without an environment, such as one from a file, may show that it
    has lost the statistics of a ``VecNormalize``.
    """
    if not isinstance(ask, Model):
        return
    model, statistics = ask.model, statistics_of(ask.model)
    env = getattr(model, "get_env", lambda: None)()
    for layer in [] if env is None else layers_of(env):
        kind = type(layer)
        library, is_second = kind.__module__.partition(".")[0], hasattr(kind, "normalize_obs") and layer is not statistics
        if library != "ethbrake_marl" and (kind.__name__ not in HARMLESS.get(library, ()) or is_second):
            modifier = vars(layer).get("modifier_class", kind)  # of SuperSuit
            raise InvalidInput(
                f"{who}: the model was trained under {modifier.__name__}{' inside another one' * is_second}, which may"
                " change observations or actions and is not applied here; write a function around the model that makes"
                " the same changes, or pass ignore_wrappers=True if there are none"
            )
    if env is None and _was_normalised(model):
        raise InvalidInput(
            f"{who}: the model was trained under VecNormalize, whose statistics are missing; load them with"
            " model.set_env(VecNormalize.load(PATH, venv)); if VecNormalize changed rewards only, pass"
            " ignore_wrappers=True"
        )


def layers_of(env: Any) -> Iterator[Any]:
    """Yield an environment and everything inside it, from the outside in."""
    yield env
    for name in INSIDE:
        inside = vars(env).get(name, ())
        for each in inside if isinstance(inside, list | tuple) else (inside,):
            if hasattr(each, "__dict__") and not isinstance(each, type):
                yield from layers_of(each)


def _was_normalised(model: Any) -> bool:
    """Return whether the last observation in a saved model was normalised.

    It is then kept as it was before, too, which off-policy algorithms always do, or it lies outside its space.
    """
    if getattr(model, "_last_original_obs", None) is not None and not hasattr(model, "replay_buffer"):
        return True
    seen, space = getattr(model, "_last_obs", None), getattr(model, "observation_space", None)
    low, high = getattr(space, "low", -np.inf), getattr(space, "high", np.inf)
    return isinstance(seen, np.ndarray) and not np.all((low <= seen) & (seen <= high))


def to_array(value: Any) -> NDArray[Any]:
    """Return an array, tensor or sequence as an array; masked entries are NaN."""
    if isinstance(value, np.ma.MaskedArray):
        return np.ma.filled(value.astype(np.float64), np.nan)
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
