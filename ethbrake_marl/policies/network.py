"""The hyperbolic tangent from products, sums and one quotient: the same bits in any batch and on any machine.

Vector units and mathematics libraries round their own ``tanh`` differently, by machine and even by where in an array
a number stands. Here it is a fixed sequence of IEEE operations in double precision, rounded to single at the end.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from pydantic import ValidationError
from safetensors import SafetensorError

from ethbrake_marl.errors import CorruptBundle, InvalidInput, naming_extras
from ethbrake_marl.files.arrays import ArrayRow, check_arrays, safetensors_headers
from ethbrake_marl.files.model import first_mistake, read_json_model
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.store import new_folder, write_file
from ethbrake_marl.game.features import FEATURES
from ethbrake_marl.game.observations import ObservationSpec
from ethbrake_marl.physics.elementary import PER_LN2, exp_rest
from ethbrake_marl.physics.jit import compiled
from ethbrake_marl.policies.manifest import (
    Activation,
    Float32s,
    Manifest,
    NetworkSpec,
    ObservationSchema,
    content_sha256,
    installed_versions,
)

_SATURATED = 10.0  # from 9.02 on the single-precision result is 1

_SMALL = 1e-4  # below, x - x^3 / 3 is exact to double precision


@compiled
def squash(values: NDArray[np.float32]) -> None:
    """Replace ``values`` [k, rows] by their hyperbolic tangents, within half a unit of the last place (and a hair)."""
    for j in range(values.shape[0]):
        row = values[j]
        for r in range(row.shape[0]):
            x = float(row[r])
            a = min(abs(x), _SATURATED)
            z = 2.0 * a
            k = int(z * PER_LN2 + 0.5)
            t = 1.0 - 2.0 / (exp_rest(z, k) * float(1 << k) + 1.0)
            if a < _SMALL:
                t = a - a * a * a / 3.0
            row[r] = np.float32(t if x >= 0.0 else -t)


Layers = list[tuple[Float32s, Float32s]]  # weights and biases, from the first layer to the last

BLOCK_ROWS = 256  # worlds handled together: their activations stay in the cache; changes no bit of any of them


class Actor:
    """The deterministic policy: observation [n, F] float32 -> action [n, A] float32 in [-1, 1].

    Of several networks only the one that the gate chooses is computed in a row.
    """

    def __init__(self, spec: NetworkSpec, tensors: Mapping[str, Float32s], prefix: str = "") -> None:
        """Take the layers out of ``tensors``, which must fit ``spec`` (see ``NetworkSpec.tensors``)."""
        self.spec = spec
        self._networks = [_layers_of(prefix + name, len(spec.policy_hidden), tensors) for name in spec.actors]
        self._gate = _layers_of(f"{prefix}gate", len(spec.gate_hidden), tensors) if spec.networks > 1 else []
        self._actions = spec.actions
        self._among = [type(self)(each, tensors, f"among_{m}.") for m, each in enumerate(spec.among, 1)]

    def __call__(self, observation: Float32s) -> Float32s:
        """Return the action of each row; raises ``InvalidInput`` on a wrong shape, dtype or a non-finite entry."""
        seen = self._check(observation)
        action = np.empty((seen.shape[0], self.spec.action_size), dtype=np.float32)
        for start in range(0, seen.shape[0], BLOCK_ROWS):
            rows = slice(start, start + BLOCK_ROWS)
            action[rows] = self._block(np.ascontiguousarray(seen[rows].T)).T
        return action

    def choose(self, x: Float32s) -> NDArray[np.int64]:
        """[F, rows] -> which of several networks acts, [rows] from 0."""
        chosen: NDArray[np.int64] = self._forward(self._gate, x).argmax(axis=0)
        return chosen

    def take(self, number: NDArray[np.int64], x: Float32s) -> Float32s:
        """The actions with these numbers [rows], policies first, where [F, rows] is seen, [1, rows]."""
        found = self._actions[np.newaxis, np.maximum(number - len(self._among), 0)]
        for m, member in enumerate(self._among):
            rows = np.flatnonzero(number == m)
            if len(rows):
                found[:, rows] = member._block(np.ascontiguousarray(x[:, rows]))
        return found

    def _block(self, x: Float32s) -> Float32s:
        """[F, rows] -> [A, rows]."""
        if len(self._networks) == 1:
            y = self._forward(self._networks[0], x)
            if self.spec.choices is not None:
                return self.take(y.argmax(axis=0), x)
        else:
            chosen = self.choose(x)
            y = np.empty((self.spec.action_size, x.shape[1]), dtype=np.float32)
            for m, layers in enumerate(self._networks):
                rows = np.flatnonzero(chosen == m)
                y[:, rows] = self._forward(layers, np.ascontiguousarray(x[:, rows]))
        if self.spec.output == "clip":
            return np.clip(y, np.float32(-1.0), np.float32(1.0))
        squash(y)
        return y

    def _forward(self, layers: Layers, x: Float32s) -> Float32s:
        """[F, rows] -> [outputs, rows] of one network."""
        for number, (weight, bias) in enumerate(layers, start=1):
            y = np.empty((weight.shape[0], x.shape[1]), dtype=np.float32)
            dense(weight, bias, x, y)
            if number == len(layers):
                break
            if self.spec.activation == "relu":
                x = np.maximum(y, np.float32(0.0))
            else:
                squash(y)
                x = y
        return y

    def _check(self, observation: Float32s) -> Float32s:
        wanted = (observation.shape[0] if observation.ndim else 0, self.spec.observation_size)
        if observation.shape != wanted or observation.dtype != np.float32:
            raise InvalidInput(
                f"observation: {observation.dtype} of shape {observation.shape};"
                f" this policy takes float32 [n, {self.spec.observation_size}]"
            )
        if not np.isfinite(observation).all():
            row, column = np.argwhere(~np.isfinite(observation))[0]
            raise InvalidInput(f"observation[{row}, {column}] = {observation[row, column]}: must be finite")
        return observation


def _layers_of(name: str, hidden: int, tensors: Mapping[str, Float32s]) -> Layers:
    names = [f"{name}.{k}" for k in range(hidden)] + [f"{name}.output"]
    return [
        (np.ascontiguousarray(tensors[f"{layer}.weight"]), np.ascontiguousarray(tensors[f"{layer}.bias"]))
        for layer in names
    ]


@compiled
def dense(weight: Float32s, bias: Float32s, x: Float32s, y: Float32s) -> None:
    """Fill ``y = weight x + bias`` for weight [O, K], bias [O], x [K, rows], y [O, rows]; rows are independent.

    Inputs are added in groups of four, ``(a + b) + (c + d)``, always in this order and never fused or reordered
    (no fastmath): half the rounding of a plain running sum, and the same result whatever the other rows hold.
    """
    inputs = weight.shape[1]
    whole = inputs - inputs % 4
    for j in range(weight.shape[0]):
        out = y[j]
        out[:] = bias[j]
        for k in range(0, whole, 4):
            w0, w1, w2, w3 = weight[j, k], weight[j, k + 1], weight[j, k + 2], weight[j, k + 3]
            x0, x1, x2, x3 = x[k], x[k + 1], x[k + 2], x[k + 3]
            for r in range(out.shape[0]):
                out[r] += (w0 * x0[r] + w1 * x1[r]) + (w2 * x2[r] + w3 * x3[r])
        for k in range(whole, inputs):
            for r in range(out.shape[0]):
                out[r] += weight[j, k] * x[k, r]


MANIFEST = "manifest.json"

WEIGHTS = "weights.safetensors"

_LIMITS_BYTES = {MANIFEST: 1 << 20, WEIGHTS: 256 << 20}


@dataclass(frozen=True)
class Policy:
    """A policy in memory: its manifest, its tensors, and ``policy(observation)`` for the deterministic action.

    >>> import ethbrake_marl as eb
    >>> import numpy as np
    >>> policy = eb.load_shipped("ppo")
    >>> policy.manifest.algorithm, policy.observation.size
    ('ppo', 27)
    >>> policy(np.zeros((2, 27), np.float32)).shape
    (2, 1)

    """

    manifest: Manifest
    tensors: Mapping[str, Float32s]

    def __repr__(self) -> str:
        told, scenario = self.manifest, self.manifest.scenario.get("name")
        return (
            f"Policy({told.algorithm!r}, {self.observation.size} observations, {told.steps:,} steps on"
            f" {scenario!r:.66}, sha256 {told.manifest_sha256[:12]})"
        )

    @cached_property
    def _actor(self) -> Actor:
        return Actor(self.manifest.network, self.tensors)

    def __call__(self, observation: Float32s) -> Float32s:
        """Map observation [n, F] float32 to action [n, A] float32 in [-1, 1]; row k depends on row k alone."""
        return self._actor(observation)

    @cached_property
    def observation(self) -> ObservationSpec:
        """What to observe for this policy, at the time steps of the scenario that it was trained on.

        Found from the names at first use, which takes as long as to act. Raises ``UnknownName``.
        """
        spec, step = self.manifest.observation.spec, self.manifest.scenario.get("time_step_s")
        return spec.at_steps_of(float(step)) if isinstance(step, int | float) else spec

    @property
    def steps(self) -> int:
        """Decisions of learners after which it was taken."""
        return self.manifest.steps

    def policy_sha256(self) -> str:
        """The hash in its manifest."""
        return self.manifest.manifest_sha256

    @property
    def drivers(self) -> dict[str, Policy]:
        """The policy that drives each of its learners."""
        return dict.fromkeys(self.manifest.learners, self)

    @classmethod
    def make(
        cls, tensors: Mapping[str, Float32s], *, observation: ObservationSpec | ObservationSchema, **manifest: Any
    ) -> Self:
        """A policy from ``tensors`` and the fields of ``Manifest`` (all but hashes and format, which follow).

        ``versions`` are the installed ones where they are not given. Raises ``InvalidInput`` naming the tensor or field
        that does not fit.
        """
        data = _serialise(tensors)
        seen = observation if isinstance(observation, ObservationSchema) else ObservationSchema.of(observation)
        given = {"versions": installed_versions(), **manifest, "format_version": manifest["network"].format_version}
        try:
            weights = hashlib.sha256(data).hexdigest()
            draft = Manifest(**given, observation=seen, weights_sha256=weights, manifest_sha256="0" * 64)
            own = content_sha256(draft.model_dump(mode="json"))
            checked = draft.model_copy(update={"manifest_sha256": own})
            return cls(checked, _tensors(data, checked))
        except ValidationError as error:
            raise InvalidInput(f"policy: {first_mistake(error)}") from None
        except ValueError as error:
            raise InvalidInput(f"policy: {error}") from None

    @property
    def among(self) -> tuple[Policy, ...]:
        """The policies among which it chooses; most choose among none."""
        follows = {"network", "observation", "format_version", "weights_sha256", "manifest_sha256"}
        fields = self.manifest.model_dump(exclude=follows)
        found = []
        for k, network in enumerate(self.manifest.network.among, start=1):
            start = f"among_{k}."
            tensors = {name.removeprefix(start): each for name, each in self.tensors.items() if name.startswith(start)}
            found.append(Policy.make(tensors, network=network, observation=self.manifest.observation, **fields))
        return tuple(found)

    @staticmethod
    def stands_in(folder: Path) -> bool:
        """Whether the files of a bundle stand in ``folder``; they are not read."""
        return all((folder / name).is_file() for name in (MANIFEST, WEIGHTS))

    def save(self, folder: str | os.PathLike[str], *, replace: bool = False) -> None:
        """Write it as the new folder ``folder``, completely or not at all; raises ``AlreadyExists``.

        With ``replace`` a folder that is there goes once the new one is written.
        """
        own = content_sha256(self.manifest.model_dump(mode="json"))  # an older version may have written keys that go
        manifest = self.manifest.model_copy(update={"manifest_sha256": own})
        with new_folder(Path(folder), replace=replace) as partial:
            write_file(partial / WEIGHTS, _serialise(self.tensors))
            write_file(partial / MANIFEST, manifest.model_dump_json(indent=2).encode() + b"\n")

    def to_onnx(self) -> bytes:
        """The ONNX model: ``observation`` [n, F] float32 -> ``action`` [n, 1] and ``acceleration_mps2`` [n, 1].

        The acceleration is the action times the own braking (below 0) or driving capacity (above 0), which the
        observation holds. Products are summed in another order than in our forward pass: results agree within rounding,
        not to the bit. Raises ``MissingExtra`` where the package onnx is not installed.
        """
        with naming_extras():
            import onnx  # only here: an extra
        helper, float32, manifest, spec = onnx.helper, onnx.TensorProto.FLOAT, self.manifest, self.manifest.network
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
            """One network of the policy, from the observation on."""
            x = "observation"
            for layer in [*(f"{name}.{k}" for k in range(hidden)), f"{name}.output"]:
                weight, bias = (
                    constant(f"{layer}.{part}", self.tensors[f"{layer}.{part}"]) for part in ("weight", "bias")
                )
                x = node("Gemm", [x, weight, bias], transB=1)
                if not layer.endswith("output"):
                    x = node("Relu" if activation == "relu" else "Tanh", [x])
            return x

        def actor(spec: NetworkSpec, prefix: str) -> str:
            """The actions [n, 1] of a policy, or of one among which it chooses."""
            outputs = [network(prefix + name, len(spec.policy_hidden), spec.activation) for name in spec.actors]
            x = outputs[0]
            if len(outputs) > 1:  # the one that the gate chooses
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
        capacities = []  # in m/s2, [n, 1]
        features = [f.name for f in self.observation.features]
        for name in ("own.braking_capacity", "own.driving_capacity"):
            column = features.index(name)
            index = constant(f"{name}.column", np.array([column], np.int64))
            unit = constant(f"{name}.scale", np.array([self.observation.features[column].scale], np.float32))
            capacities.append(node("Mul", [node("Gather", ["observation", index], axis=1), unit]))
        below = node("Mul", [node("Min", [action, zero]), capacities[0]])
        above = node("Mul", [node("Max", [action, zero]), capacities[1]])
        node("Add", [below, above], output="acceleration_mps2")

        given = [helper.make_tensor_value_info("observation", float32, ["n", spec.observation_size])]
        found = [helper.make_tensor_value_info(name, float32, ["n", 1]) for name in ("action", "acceleration_mps2")]
        graph = helper.make_graph(nodes, "policy", given, found, constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], producer_name="ethbrake-marl")
        model.ir_version = 8  # old enough for every runtime since 2022
        told = {
            "algorithm": manifest.algorithm,
            "manifest_sha256": manifest.manifest_sha256,
            "features": ",".join(manifest.observation.features),
        }
        helper.set_model_props(model, told)
        onnx.checker.check_model(model)
        data: bytes = model.SerializeToString()
        return data


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Read the bundle at ``path``: a bundle's own folder, or a run's folder (then its ``policy/``).

    Raises ``InvalidInput`` when there is none, ``CorruptBundle`` (file, what is wrong) when it cannot be trusted.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidInput(f"policy {path!r:.60}: must be the path of a run or of a policy bundle")
    folder = _bundle_folder(Path(path))
    found = {entry.name for entry in os.scandir(folder)}
    for name in sorted({MANIFEST, WEIGHTS} - found):
        raise CorruptBundle(f"{folder / name}: is missing")
    for name in sorted(found - {MANIFEST, WEIGHTS}):
        raise CorruptBundle(f"{folder / name}: does not belong into a bundle, which is {MANIFEST} and {WEIGHTS} only")
    place = folder / MANIFEST
    data = _read(place)
    try:
        content, manifest = read_json_model(data, Manifest)
    except ValueError as error:
        raise CorruptBundle(f"{place}: {error}") from None
    own = content_sha256(content)
    if own != manifest.manifest_sha256:
        raise CorruptBundle(
            f"{place}: its content has SHA-256 {own}, but it says {manifest.manifest_sha256}; it was changed after it"
            " was saved"
        )
    _check_observed(place, manifest)
    data = _read(folder / WEIGHTS)
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != manifest.weights_sha256:
        raise CorruptBundle(f"{folder / WEIGHTS}: SHA-256 is {sha256}, the manifest says {manifest.weights_sha256}")
    try:
        return Policy(manifest, _tensors(data, manifest))
    except ValueError as error:
        raise CorruptBundle(f"{folder / WEIGHTS}: {error}") from None


def _bundle_folder(path: Path) -> Path:
    for folder in (path, path / "policy"):
        try:
            found = (folder / MANIFEST).exists() or (folder / WEIGHTS).exists()
        except OSError as error:
            raise InvalidInput(f"{str(path)!r:.120}: cannot be read ({error.strerror})") from None
        if found:
            if folder.is_symlink():
                raise CorruptBundle(f"{folder}: is a symbolic link; give the folder it points to")
            return folder
    members = sorted((path / "policy").glob("vehicle_*"))
    if members:
        raise InvalidInput(f"{path}: each of its learners has a policy of its own; name one, for instance {members[0]}")
    reason = "holds no policy" if path.is_dir() else "is not a folder"
    raise InvalidInput(f"{path}: {reason}; give a policy bundle ({MANIFEST}, {WEIGHTS}) or a run that finished")


def _read(path: Path) -> bytes:
    return read_plain(path, _LIMITS_BYTES[path.name], refusal=CorruptBundle, follow_links=False)


def _check_observed(path: Path, manifest: Manifest) -> None:
    """Compare what the policy observes with what these features are now.

    Raises ``InvalidInput`` naming a registered feature that is missing or was changed, ``CorruptBundle`` for features
    that this version does not have, or scales otherwise.
    """
    seen = manifest.observation
    for was in seen.registered:
        of = f"{path}: the policy observes {was.name!r:.80}"
        if was.name not in FEATURES:
            raise InvalidInput(
                f"{of}, which is not registered; install the package that gives it, or register it first"
                " (eb.register_feature)"
            )
        entry = FEATURES[was.name]
        now = {name: getattr(entry.feature, name) for name in ("unit", "scale", "low", "high")}
        for key, value in (now | {"of": entry.of, "unknown": entry.unknown}).items():
            if getattr(was, key) != value:
                raise InvalidInput(
                    f"{of}, whose {key} was {getattr(was, key)!r:.60} when it was trained and is {value!r:.60} now;"
                    " register it as it was, or train again"
                )
        if len(was.tried) != len(entry.tried) or not np.allclose(was.tried, entry.tried, rtol=1e-6, atol=1e-6):
            raise InvalidInput(
                f"{of}, whose function gives other numbers than when it was trained; register it as it was, or train"
                " again"
            )
    with suppress(InvalidInput):  # a feature that there is no more
        today = ObservationSchema.of(seen.spec)
        known = seen.model_copy(update={"registered": today.registered})  # compared above, within rounding
        if known == today and [each.name for each in seen.registered] == [each.name for each in today.registered]:
            return
    raise CorruptBundle(
        f"{path}: observation: features or their scaling are not those of this version of the package;"
        f" use the one it was made with ({manifest.versions.get('ethbrake-marl', 'unknown')}), or train again"
    )


def _serialise(tensors: Mapping[str, Float32s]) -> bytes:
    return safetensors.numpy.save({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()})


def _tensors(data: bytes, manifest: Manifest) -> dict[str, Float32s]:
    """Check ``data`` against the tensor table, then read it; raises ``ValueError`` naming the tensor."""
    rows = [ArrayRow(row.name, "F32", row.shape) for row in manifest.network.tensors]
    check_arrays(safetensors_headers(data), rows, "tensor")
    try:
        tensors = safetensors.numpy.load(data)
    except SafetensorError as error:
        raise ValueError(f"not a safetensors file ({error})") from None
    for name, tensor in tensors.items():
        if not np.isfinite(tensor).all():
            raise ValueError(f"tensor {name!r} holds a number that is not finite")
        tensor.setflags(write=False)
    return tensors
