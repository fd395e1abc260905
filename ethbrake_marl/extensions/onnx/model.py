"""A policy as an ONNX model, for other programs."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, naming_extras
from ethbrake_marl.policies.policy import Policy

CAPACITIES = ("own.braking_capacity", "own.driving_capacity")


def to_onnx(policy: Policy) -> bytes:
    """ONNX model as bytes: ``observation`` [n, F] float32 -> ``action`` [n, 1] and ``acceleration_mps2`` [n, 1].

    The acceleration is the action times the observed braking or driving capacity. Results may differ from this
    package's by rounding. The model's metadata have the names of the observed features, and the range of the training
    with the name of the fallback, which is not in the model. Raises ``InvalidInput`` if the
    policy does not observe both capacities of its vehicle, and ``MissingExtra`` if the package onnx is not installed.
    """
    manifest, observation, tensors = policy.manifest, policy.observation, policy.tensors
    spec, columns = manifest.network, {f.name: (c, f.scale) for c, f in enumerate(observation.features)}
    missing = [name for name in CAPACITIES if name not in columns]
    if missing:
        raise InvalidInput(
            f"to_onnx: the policy lacks {' and '.join(missing)}; must observe {' and '.join(CAPACITIES)}, which give"
            " the acceleration"
        )
    with naming_extras():
        import onnx  # an optional extra, imported only here
    helper, float32 = onnx.helper, onnx.TensorProto.FLOAT
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

    x = "observation"
    for layer in [*(f"policy.{k}" for k in range(len(spec.policy_hidden))), "policy.output"]:
        weight, bias = (constant(f"{layer}.{part}", tensors[f"{layer}.{part}"]) for part in ("weight", "bias"))
        x = node("Gemm", [x, weight, bias], transB=1)
        if not layer.endswith("output"):
            x = node("Relu" if spec.activation == "relu" else "Tanh", [x])
    bounded = ("Tanh", [x]) if spec.output == "tanh" else ("Clip", [x, *bounds])
    action = node(*bounded, output="action")
    capacities = []  # in m/s2, [n, 1] each
    for name in CAPACITIES:
        column, scale = columns[name]
        index = constant(f"{name}.column", np.array([column], np.int64))
        unit = constant(f"{name}.scale", np.array([scale], np.float32))
        capacities.append(node("Mul", [node("Gather", ["observation", index], axis=1), unit]))
    below = node("Mul", [node("Min", [action, zero]), capacities[0]])
    above = node("Mul", [node("Max", [action, zero]), capacities[1]])
    node("Add", [below, above], output="acceleration_mps2")

    inputs = [helper.make_tensor_value_info("observation", float32, ["n", spec.observation_size])]
    outputs = [helper.make_tensor_value_info(name, float32, ["n", 1]) for name in ("action", "acceleration_mps2")]
    graph = helper.make_graph(nodes, "policy", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], producer_name="ethbrake-marl")
    model.ir_version = 8  # supported by every runtime since 2022
    metadata = {
        "algorithm": manifest.algorithm,
        "manifest_sha256": manifest.manifest_sha256,
        "features": ",".join(observation.names),
    }
    if manifest.training_range is not None:
        metadata["training_range"] = manifest.training_range.model_dump_json()
    helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    data: bytes = model.SerializeToString()
    return data
