"""Policies that come with the package, and how they are chosen by name.

Each is a folder of ``_policies/``: a bundle, and beside it ``card.md``, which says what it was trained on, how good it
is and where it is bad.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import InvalidInput, naming_extras, unknown_name
from ethbrake_marl.policies.actor import actor_names
from ethbrake_marl.policies.bundle import Policy, load_policy
from ethbrake_marl.scenario import Scenario

SHIPPED = "shipped"
BUNDLE = "policy"

PolicyKind = Literal["ppo", "sac", "counterfactual", "universal", "policy"]
_BEST_FIRST: tuple[PolicyKind, ...] = ("counterfactual", "ppo", "sac", "universal")  # of ``policy``, where several are

_FOLDER = Path(__file__).resolve().parents[1] / "_policies"


def shipped_policies() -> dict[str, Path]:
    """Name -> folder of every policy that ships."""
    return {path.parent.name: path.parent for path in sorted(_FOLDER.glob(f"*/{BUNDLE}"))}


def shipped_name(kind: PolicyKind, scenario: str | None, harm_count: HarmCount) -> str:
    """Name of the policy of this kind for ``scenario``, of those trained for ``harm_count`` if there is one.

    ``universal`` is for all scenarios, ``ppo`` and ``sac`` are for the one that they were trained on, ``ppo-SCENARIO``
    and ``sac-SCENARIO`` for that one; ``-total`` behind says that a policy was trained for total harm. ``policy`` is
    the best of all kinds. Raises ``InvalidInput`` listing what ships.
    """
    names = shipped_policies()
    for each in _BEST_FIRST if kind == "policy" else ():
        with suppress(InvalidInput):
            return shipped_name(each, scenario, harm_count)
    plain = [kind] if kind == "universal" or scenario is None else [f"{kind}-{scenario}", kind]
    for stem in plain:
        for name in (f"{stem}-total", stem) if harm_count == "total" else (stem,):
            if name in names and (stem != kind or scenario is None or _is_for(kind, names[name], scenario)):
                return name
    wanted = kind if scenario is None or kind == "universal" else f"{kind} for scenario {scenario!r}"
    every = ", ".join(names) or "none"
    raise InvalidInput(f"shipped policy {wanted}: there is none; shipped are: {every} (each as {SHIPPED}/NAME)")


def _is_for(kind: PolicyKind, folder: Path, scenario: str) -> bool:
    return kind == "universal" or load_policy(folder / BUNDLE).manifest.scenario.get("name") == scenario


def load_shipped(name: str) -> Policy:
    """The shipped policy called ``name``; raises ``UnknownName`` with a suggestion."""
    folders = shipped_policies()
    if name not in folders:
        raise unknown_name("shipped policy", name, folders)
    return load_policy(folders[name] / BUNDLE)


def load_named_policy(
    path: str, kind: PolicyKind = "ppo", scenario: Scenario | None = None, harm_count: HarmCount = "first"
) -> Policy:
    """The policy of a run or bundle at ``path``; ``shipped``: the one of this kind for ``scenario``; ``shipped/NAME``.

    A folder that is called so is ``./shipped``. Raises what ``load_policy`` and the functions above raise.
    """
    head, slash, name = path.partition("/")
    if head != SHIPPED:
        return load_policy(path)
    if slash:
        return load_shipped(name)
    return load_shipped(shipped_name(kind, None if scenario is None else scenario.name, harm_count))


# A policy as an ONNX model: observation in, acceleration out. Needs the extra ``export``.

OPSET = 17
IR_VERSION = 8  # old enough for every runtime since 2022

_CAPACITIES = ("own.braking_capacity", "own.driving_capacity")


def onnx_model(policy: Policy) -> bytes:
    """The serialised model: ``observation`` [n, F] float32 -> ``action`` [n, 1] and ``acceleration_mps2`` [n, 1].

    The acceleration is the action times the own braking (below 0) or driving capacity (above 0), which the observation
    holds. Products are summed in another order than in our forward pass: results agree within rounding, not to the
    bit. Raises ``MissingExtra`` where the package onnx is not installed.
    """
    with naming_extras():
        import onnx  # only here: an extra
    writer = _Writer(onnx)
    action = writer.actor(policy)
    features = {f.name: (k, f.scale) for k, f in enumerate(policy.observation.features)}
    braking, driving = (writer.feature(name, *features[name]) for name in _CAPACITIES)
    zero = writer.constant("zero", np.zeros(1, np.float32))
    below = writer.node("Mul", [writer.node("Min", [action, zero]), braking])
    above = writer.node("Mul", [writer.node("Max", [action, zero]), driving])
    writer.node("Add", [below, above], output="acceleration_mps2")
    return writer.model(policy)


class _Writer:
    """Collects the nodes and constants of one graph."""

    def __init__(self, onnx: Any) -> None:
        self._onnx = onnx
        self._nodes: list[Any] = []
        self._constants: list[Any] = []

    def constant(self, name: str, array: NDArray[Any]) -> str:
        self._constants.append(self._onnx.numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def node(self, operator: str, inputs: list[str], *, output: str = "", **attributes: Any) -> str:
        name = output or f"{operator.lower()}_{len(self._nodes)}"
        self._nodes.append(self._onnx.helper.make_node(operator, inputs, [name], **attributes))
        return name

    def actor(self, policy: Policy) -> str:
        """The network that the gate chooses, and the output function that gives ``action``."""
        network = policy.manifest.network
        hidden, names = len(network.policy_hidden), actor_names(network)
        outputs = [self.layers(policy, name, hidden) for name in names]
        x = outputs[0]
        if len(outputs) > 1:
            scores = self.layers(policy, "gate", len(network.gate_hidden))
            chosen = self.node("ArgMax", [scores], axis=1, keepdims=1)
            x = self.node("GatherElements", [self.node("Concat", outputs, axis=1), chosen], axis=1)
        if network.output == "tanh":
            return self.node("Tanh", [x], output="action")
        low = self.constant("lowest", np.array(-1.0, np.float32))
        high = self.constant("highest", np.array(1.0, np.float32))
        return self.node("Clip", [x, low, high], output="action")

    def layers(self, policy: Policy, network: str, hidden: int) -> str:
        """One network of the policy, from the observation on."""
        x, activation = "observation", policy.manifest.network.activation
        for name in [f"{network}.{k}" for k in range(hidden)] + [f"{network}.output"]:
            weight, bias = (
                self.constant(f"{name}.{part}", policy.tensors[f"{name}.{part}"]) for part in ("weight", "bias")
            )
            x = self.node("Gemm", [x, weight, bias], transB=1)
            if not name.endswith("output"):
                x = self.node("Relu" if activation == "relu" else "Tanh", [x])
        return x

    def feature(self, name: str, column: int, scale: float) -> str:
        """One feature in its unit, [n, 1]."""
        index = self.constant(f"{name}.column", np.array([column], np.int64))
        unit = self.constant(f"{name}.scale", np.array([scale], np.float32))
        return self.node("Mul", [self.node("Gather", ["observation", index], axis=1), unit])

    def model(self, policy: Policy) -> bytes:
        """The whole graph, checked, with what the bundle's manifest says about it."""
        onnx, manifest = self._onnx, policy.manifest
        helper, float32 = onnx.helper, onnx.TensorProto.FLOAT
        inputs = [helper.make_tensor_value_info("observation", float32, ["n", manifest.network.observation_size])]
        outputs = [helper.make_tensor_value_info(name, float32, ["n", 1]) for name in ("action", "acceleration_mps2")]
        graph = helper.make_graph(self._nodes, "policy", inputs, outputs, self._constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="ethbrake-marl")
        model.ir_version = IR_VERSION
        told = {
            "algorithm": manifest.algorithm,
            "manifest_sha256": manifest.manifest_sha256,
            "features": ",".join(manifest.observation.features),
        }
        helper.set_model_props(model, told)
        onnx.checker.check_model(model)
        data: bytes = model.SerializeToString()
        return data
