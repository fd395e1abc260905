"""Export of a policy as an ONNX model, for other runtimes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import naming_extras
from ethbrake_marl.first_edition.game.observations import ObservationSpec
from ethbrake_marl.first_edition.policies.manifest import Manifest
from ethbrake_marl.first_edition.policies.network_spec import Activation, Float32s, NetworkSpec


def onnx_model(manifest: Manifest, observation: ObservationSpec, tensors: Mapping[str, Float32s]) -> bytes:
    """Return the ONNX model of a policy, as bytes. The model computes actions and commanded accelerations.

    ``observation`` must contain the vehicle's braking and driving capacities. Raises ``MissingExtra`` if the package
    onnx is not installed.
    """
    with naming_extras():
        import onnx  # an optional extra, imported only here
    helper, float32, spec = onnx.helper, onnx.TensorProto.FLOAT, manifest.network
    nodes: list[Any] = []
    constants: list[Any] = []

    def constant(name: str, array: NDArray[Any]) -> str:
        constants.append(onnx.numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def node(operator: str, inputs: list[str], *, output: str = "", **attributes: Any) -> str:
        name = output or f"{operator.lower()}_{len(nodes)}"
        nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    zero = constant("zero", np.zeros(1, np.float32))
    bounds = [constant(name, np.array(at, np.float32)) for name, at in (("lowest", -1.0), ("highest", 1.0))]

    def network(name: str, hidden: int, activation: Activation) -> str:
        """Add the network whose tensor names begin with ``name``; return the name of its output."""
        x = "observation"
        for layer in [*(f"{name}.{k}" for k in range(hidden)), f"{name}.output"]:
            weight, bias = (constant(f"{layer}.{part}", tensors[f"{layer}.{part}"]) for part in ("weight", "bias"))
            x = node("Gemm", [x, weight, bias], transB=1)
            if not layer.endswith("output"):
                x = node("Relu" if activation == "relu" else "Tanh", [x])
        return x

    def actor(spec: NetworkSpec, prefix: str) -> str:
        """Add the policy whose tensor names begin with ``prefix``; return the name of its output, actions [n, 1]."""
        outputs = [network(prefix + name, len(spec.policy_hidden), spec.activation) for name in spec.actors]
        x = outputs[0]
        if len(outputs) > 1:  # take the expert that the gating network selects
            gate = network(f"{prefix}gate", len(spec.gate_hidden), spec.activation)
            chosen = node("ArgMax", [gate], axis=1, keepdims=1)
            x = node("GatherElements", [node("Concat", outputs, axis=1), chosen], axis=1)
        if spec.output == "tanh":
            return node("Tanh", [x])
        if spec.choices is None:
            return node("Clip", [x, *bounds])
        members = [actor(each, f"{prefix}among_{m}.") for m, each in enumerate(spec.among, 1)]
        nothing = node("Mul", [node("ReduceMax", [x], axes=[1], keepdims=1), zero])  # [n, 1]
        actions = node("Add", [nothing, constant(f"{prefix}choices", spec.actions[np.newaxis])])
        chosen = node("ArgMax", [x], axis=1, keepdims=1)
        return node("GatherElements", [node("Concat", [*members, actions], axis=1), chosen], axis=1)

    action = node("Identity", [actor(spec, "")], output="action")
    capacities = []  # braking and driving capacity in m/s2, [n, 1] each
    features = [f.name for f in observation.features]
    for name in ("own.braking_capacity", "own.driving_capacity"):
        column = features.index(name)
        index = constant(f"{name}.column", np.array([column], np.int64))
        unit = constant(f"{name}.scale", np.array([observation.features[column].scale], np.float32))
        capacities.append(node("Mul", [node("Gather", ["observation", index], axis=1), unit]))
    below = node("Mul", [node("Min", [action, zero]), capacities[0]])
    above = node("Mul", [node("Max", [action, zero]), capacities[1]])
    node("Add", [below, above], output="acceleration_mps2")

    model_inputs = [helper.make_tensor_value_info("observation", float32, ["n", spec.observation_size])]
    model_outputs = [helper.make_tensor_value_info(name, float32, ["n", 1]) for name in ("action", "acceleration_mps2")]
    graph = helper.make_graph(nodes, "policy", model_inputs, model_outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], producer_name="ethbrake-marl")
    model.ir_version = 8  # supported by every runtime since 2022
    metadata = {
        "algorithm": manifest.algorithm,
        "manifest_sha256": manifest.manifest_sha256,
        "features": ",".join(manifest.observation.features),
    }
    helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    data: bytes = model.SerializeToString()
    return data
