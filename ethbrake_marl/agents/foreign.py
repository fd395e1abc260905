"""Policies of other libraries, each as one function: ``(observation, state) -> (action, state)``."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, naming_extras
from ethbrake_marl.observations import Observations

State = Any  # arrays whose first axis is the world, or tuples, lists and mappings of such
Infer = Callable[[Observations, State], tuple[Any, State]]

_KINDS = (
    "a function of observations, an object with predict, a torch module, an ONNX session or the path of an .onnx file"
)


def adapt_policy(policy: Any, name: str, with_state: bool) -> Infer:
    """The policy as such a function; raises ``InvalidInput`` for what is none."""
    if isinstance(policy, str | os.PathLike):
        policy = _open_onnx(Path(policy), name)
    if hasattr(policy, "run") and hasattr(policy, "get_inputs"):
        call = _ask_onnx(policy)
    elif hasattr(policy, "predict"):
        call = _ask_model(policy)
    elif _is_torch_module(policy):
        return _ask_torch(policy, with_state)
    elif callable(policy):
        return policy if with_state else lambda seen, _: (_without_memory(policy(seen)), None)
    else:
        raise InvalidInput(f"agent {name!r}: a {type(policy).__name__} is no policy; must be {_KINDS}")
    if with_state:
        raise InvalidInput(
            f"agent {name!r}: initial_state is for a function (observation, state) -> (action, state); write one"
            " around this model"
        )
    return lambda seen, _: (call(seen), None)


def _without_memory(action: Any) -> Any:
    if isinstance(action, tuple):
        raise InvalidInput(
            f"gave a tuple of {len(action)} in place of an action; a policy with a memory gives (action, state), and"
            " needs initial_state"
        )
    return action


def _ask_model(model: Any) -> Callable[[Observations], Any]:
    def call(seen: Observations) -> Any:
        found = model.predict(seen, deterministic=True)
        return found[0] if isinstance(found, tuple) else found

    return call


def _ask_onnx(session: Any) -> Callable[[Observations], Any]:
    given = session.get_inputs()[0].name
    names = [output.name for output in session.get_outputs()]
    wanted = "action" if "action" in names else names[0]
    return lambda seen: session.run([wanted], {given: seen})[0]


def _ask_torch(module: Any, with_state: bool) -> Infer:
    torch = sys.modules["torch"]

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

    None for anything else, whose weights nobody can find.
    """
    if isinstance(policy, str | os.PathLike):
        return hashlib.sha256(Path(policy).read_bytes()).hexdigest() if Path(policy).is_file() else None
    module: Any = policy if _is_torch_module(policy) else getattr(policy, "policy", None)
    if not _is_torch_module(module):
        return None
    digest = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        array = to_array(tensor)
        digest.update(f"{name} {array.dtype} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def to_array(value: Any) -> NDArray[Any]:
    """An array, of a tensor too; what is masked is no number."""
    if isinstance(value, np.ma.MaskedArray):
        return np.ma.filled(value.astype(np.float64), np.nan)
    return np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
