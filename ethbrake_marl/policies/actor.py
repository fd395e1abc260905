"""The hyperbolic tangent from products, sums and one quotient: the same bits in any batch and on any machine.

Vector units and mathematics libraries round their own ``tanh`` differently, by machine and even by where in an array a
number stands. Here it is a fixed sequence of IEEE operations in double precision, rounded to single at the end.
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from operator import not_
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, JsonValue, model_validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import FileModel
from ethbrake_marl.observations import ObservationSpec, choose_observation
from ethbrake_marl.physics.compiled import LN2_HIGH, LN2_LOW, PER_LN2, compiled, exp_of_small
from ethbrake_marl.scenario.features import Of, registered_in

# The manifest of a policy: network, observation, training, versions and hashes.

_PACKAGES = ("ethbrake-marl", "gymnasium", "numba", "numpy", "safetensors", "stable-baselines3", "torch")


def installed_versions() -> dict[str, str]:
    """Name -> version of this package, Python and every package that a training's numbers depend on."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


Activation = Literal["relu", "tanh"]
Output = Literal["clip", "tanh"]
Width = Annotated[int, Field(ge=1, le=4096)]
Hidden = Annotated[tuple[Width, ...], Field(min_length=1, max_length=8)]
PerhapsHidden = Annotated[tuple[Width, ...], Field(max_length=8)]


class NetworkSpec(FileModel):
    """An actor, and perhaps a critic, both multilayer perceptrons on the same observation.

    The action is ``output(actor(observation))`` in [-1, 1]: ``clip`` cuts the actor's mean at the bounds (PPO's
    Gaussian, whose noise is one number per action), ``tanh`` squashes it (SAC's Gaussian, whose noise is a second
    head of the actor). Without ``value_hidden`` there is no critic: a policy needs none to act.

    With ``networks`` above 1 there are as many actors of this shape, and a gate with ``gate_hidden`` layers that gives
    each a score: the actor of the highest score acts, the first of equal ones. The gate is asked at each decision and
    remembers nothing. There is neither noise nor critic then.
    """

    observation_size: Annotated[int, Field(ge=1, le=4096)]
    action_size: Annotated[int, Field(ge=1, le=64)]
    policy_hidden: Hidden
    value_hidden: PerhapsHidden
    activation: Activation
    output: Output
    networks: Annotated[int, Field(ge=1, le=16, exclude_if=lambda networks: networks == 1)] = 1
    gate_hidden: Annotated[PerhapsHidden, Field(exclude_if=not_)] = ()

    @model_validator(mode="after")
    def _a_gate_between_several(self) -> NetworkSpec:
        if (self.networks > 1) != bool(self.gate_hidden):
            raise ValueError(
                f"networks = {self.networks} with gate_hidden = {list(self.gate_hidden)}; several need a gate"
            )
        if self.networks > 1 and self.value_hidden:
            raise ValueError(f"value_hidden = {list(self.value_hidden)}: must be empty beside several networks")
        return self


@dataclass(frozen=True, slots=True)
class TensorRow:
    """One tensor: its name in a bundle, its shape, and its name in Stable-Baselines3's policy (PPO's or SAC's)."""

    name: str
    shape: tuple[int, ...]
    sb3_name: str


def tensor_table(spec: NetworkSpec) -> tuple[TensorRow, ...]:
    """List every tensor of ``spec``, all float32; weights are [outputs, inputs] as in ``y = W x + b``."""
    if spec.networks > 1:
        return _mixture_table(spec)
    last = spec.policy_hidden[-1]
    if spec.output == "clip":
        rows = [
            *_layers("policy", "mlp_extractor.policy_net", spec.observation_size, spec.policy_hidden),
            *_layer("policy.output", "action_net", last, spec.action_size),
            TensorRow("policy.log_std", (spec.action_size,), "log_std"),
        ]
    else:
        rows = [
            *_layers("policy", "actor.latent_pi", spec.observation_size, spec.policy_hidden),
            *_layer("policy.output", "actor.mu", last, spec.action_size),
            *_layer("policy.log_std", "actor.log_std", last, spec.action_size),
        ]
    if spec.value_hidden:
        rows += _layers("value", "mlp_extractor.value_net", spec.observation_size, spec.value_hidden)
        rows += _layer("value.output", "value_net", spec.value_hidden[-1], 1)
    return tuple(rows)


def actor_names(spec: NetworkSpec) -> tuple[str, ...]:
    """How the tensors' names of each actor begin."""
    return ("policy",) if spec.networks == 1 else tuple(f"network_{m + 1}" for m in range(spec.networks))


def _mixture_table(spec: NetworkSpec) -> tuple[TensorRow, ...]:
    rows: list[TensorRow] = []
    for m, name in enumerate(actor_names(spec)):
        inside = f"members.{m}"
        rows += _layers(name, f"{inside}.mlp_extractor.policy_net", spec.observation_size, spec.policy_hidden)
        rows += _layer(f"{name}.output", f"{inside}.action_net", spec.policy_hidden[-1], spec.action_size)
    rows += _layers("gate", "gate.average", spec.observation_size, spec.gate_hidden)
    rows += _layer("gate.output", f"gate.average.{2 * len(spec.gate_hidden)}", spec.gate_hidden[-1], spec.networks)
    return tuple(rows)


def _layers(name: str, sb3_name: str, inputs: int, hidden: tuple[int, ...]) -> list[TensorRow]:
    """Hidden layers; the training library counts activations too, so its index is twice ours."""
    rows: list[TensorRow] = []
    for k, width in enumerate(hidden):
        rows += _layer(f"{name}.{k}", f"{sb3_name}.{2 * k}", inputs, width)
        inputs = width
    return rows


def _layer(name: str, sb3_name: str, inputs: int, outputs: int) -> list[TensorRow]:
    return [
        TensorRow(f"{name}.weight", (outputs, inputs), f"{sb3_name}.weight"),
        TensorRow(f"{name}.bias", (outputs,), f"{sb3_name}.bias"),
    ]


Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Neighbours = Annotated[int, Field(ge=0, le=64)]

_VEHICLE = re.compile(r"vehicle_[1-9][0-9]?")


class _Strict(FileModel):
    model_config = ConfigDict(allow_inf_nan=False)


class FeatureDefinition(_Strict):
    """A registered feature as it was when the policy was trained."""

    name: Annotated[str, Field(max_length=64)]
    of: Of
    unit: str
    scale: float
    low: float
    high: float
    unknown: float
    tried: Annotated[tuple[float, ...], Field(max_length=64)]  # what it gave in a few worlds


class ObservationSchema(_Strict):
    """What the policy sees: neighbours on each side, feature names in order, and a hash of how each is scaled."""

    front: Neighbours
    rear: Neighbours
    features: Annotated[tuple[str, ...], Field(min_length=1, max_length=4096)]
    scaling_sha256: Sha256
    registered: Annotated[tuple[FeatureDefinition, ...], Field(max_length=4096, exclude_if=not_)] = ()

    @property
    def spec(self) -> ObservationSpec:
        """The observation as the environment builds it, from the names; raises ``UnknownName``."""
        return choose_observation(self.features)


class Manifest(_Strict):
    """Everything about a policy but its tensors; ``action`` is a fraction of the own capacity, -1 = full braking.

    Format 3 is for policies of several networks; one network is written as ever, for earlier versions too.
    """

    format: Literal["ethbrake-policy"] = "ethbrake-policy"
    format_version: Literal[2, 3] = 2
    algorithm: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    network: NetworkSpec
    observation: ObservationSchema
    action: Literal["fraction_of_own_capacity"] = "fraction_of_own_capacity"
    learners: Annotated[tuple[str, ...], Field(min_length=1)]
    scenario: dict[str, JsonValue]
    reward: dict[str, JsonValue]
    seeds: dict[str, int]
    steps: Annotated[int, Field(ge=0)]
    versions: dict[str, str]
    weights_sha256: Sha256
    manifest_sha256: Sha256  # of everything above, see ``content_sha256``

    @property
    def spec(self) -> ObservationSpec:
        """The observation as the environment builds it; raises ``UnknownName``."""
        spec, step = self.observation.spec, self.scenario.get("time_step_s")
        return spec.at_steps_of(float(step)) if isinstance(step, int | float) else spec

    @model_validator(mode="after")
    def _format_of_the_network(self) -> Manifest:
        if self.format_version != format_of(self.network):
            raise ValueError(
                f"format_version: {self.format_version} for {self.network.networks} networks; must be"
                f" {format_of(self.network)}"
            )
        return self

    @model_validator(mode="after")
    def _one_input_per_feature(self) -> Manifest:
        features, inputs = len(self.observation.features), self.network.observation_size
        if features != inputs:
            raise ValueError(f"{features} observation features for a network that takes {inputs}")
        return self

    @model_validator(mode="after")
    def _a_time_step_for_contacts(self) -> Manifest:
        if any(name.startswith(("contact.", "contact_far.")) for name in self.observation.features):
            step = self.scenario.get("time_step_s")
            if isinstance(step, bool) or not isinstance(step, int | float) or not step > 0.0:
                raise ValueError(f"scenario: time_step_s = {step!r}; contact features need a number above 0")
        return self

    @model_validator(mode="after")
    def _learners_of_the_scenario(self) -> Manifest:
        for name in self.learners:
            if _VEHICLE.fullmatch(name) is None:
                raise ValueError(f"learners: {name!r} is no vehicle; vehicles are vehicle_1, vehicle_2, ...")
        if len(set(self.learners)) < len(self.learners):
            raise ValueError(f"learners: {', '.join(self.learners)}: each vehicle learns once")
        vehicles, roles = self.scenario.get("vehicles"), self.scenario.get("roles")
        for name in self.learners:
            if isinstance(vehicles, int) and int(name.removeprefix("vehicle_")) > vehicles:
                raise ValueError(f"learners: {name}: the scenario has {vehicles} vehicles")
            if isinstance(roles, dict) and roles.get(name) != "learner":
                raise ValueError(f"learners: {name}: does not learn in the scenario's roles")
        return self


def format_of(network: NetworkSpec) -> Literal[2, 3]:
    """The format of a bundle with this network."""
    return 2 if network.networks == 1 else 3


def content_sha256(content: Mapping[str, Any]) -> str:
    """SHA-256 of a manifest's plain content without its own hash: sorted keys, no blanks, ASCII.

    It binds names, architecture and weights together, against accidents and edits; it is no signature.
    """
    hashed = {key: value for key, value in content.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(hashed, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def observation_schema(spec: ObservationSpec) -> ObservationSchema:
    """Describe ``spec`` so that a later change of a name, unit, scale or bound is noticed."""
    names = tuple(f.name for f in spec.features)
    return ObservationSchema(
        front=spec.front,
        rear=spec.rear,
        features=names,
        scaling_sha256=scaling_sha256(spec, names),
        registered=tuple(
            FeatureDefinition(
                name=name, of=entry.of, unit=entry.feature.unit, scale=entry.feature.scale, low=entry.feature.low,
                high=entry.feature.high, unknown=entry.unknown, tried=entry.tried,
            )
            for name, entry in registered_in(names).items()
        ),
    )  # fmt: skip


def scaling_sha256(spec: ObservationSpec, names: Sequence[str]) -> str:
    """SHA-256 of how each feature is scaled, under these names."""
    rows = [[name, f.unit, f.scale, f.low, f.high] for name, f in zip(names, spec.features, strict=True)]
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest()


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
            s = (z - k * LN2_HIGH) - k * LN2_LOW  # |s| <= ln(2) / 2
            e = exp_of_small(s)
            t = 1.0 - 2.0 / (e * float(1 << k) + 1.0)
            if a < _SMALL:
                t = a - a * a * a / 3.0
            row[r] = np.float32(t if x >= 0.0 else -t)


Float32s = NDArray[np.float32]

Layers = list[tuple[Float32s, Float32s]]  # weights and biases, from the first layer to the last

BLOCK_ROWS = 256  # worlds handled together: their activations stay in the cache; changes no bit of any of them


class Actor:
    """The deterministic policy: observation [n, F] float32 -> action [n, A] float32 in [-1, 1].

    Of several networks only the one that the gate chooses is computed in a row.
    """

    def __init__(self, spec: NetworkSpec, tensors: Mapping[str, Float32s]) -> None:
        """Take the layers out of ``tensors``, which must fit ``spec`` (see ``tensor_table``)."""
        self.spec = spec
        self._networks = [_layers_of(name, len(spec.policy_hidden), tensors) for name in actor_names(spec)]
        self._gate = _layers_of("gate", len(spec.gate_hidden), tensors) if spec.networks > 1 else []

    def __call__(self, observation: Float32s) -> Float32s:
        """Return the action of each row; raises ``InvalidInput`` on a wrong shape, dtype or a non-finite entry."""
        seen = self._check(observation)
        action = np.empty((seen.shape[0], self.spec.action_size), dtype=np.float32)
        for start in range(0, seen.shape[0], BLOCK_ROWS):
            rows = slice(start, start + BLOCK_ROWS)
            action[rows] = self._block(np.ascontiguousarray(seen[rows].T)).T
        return action

    def choose(self, observation: Float32s) -> NDArray[np.int64]:
        """Which of its networks acts in each row, [n] from 0; raises what a call raises."""
        return self._choose(np.ascontiguousarray(self._check(observation).T))

    def _choose(self, x: Float32s) -> NDArray[np.int64]:
        """[F, rows] -> [rows]."""
        if not self._gate:
            return np.zeros(x.shape[1], np.int64)
        chosen: NDArray[np.int64] = self._forward(self._gate, x).argmax(axis=0)
        return chosen

    def _block(self, x: Float32s) -> Float32s:
        """[F, rows] -> [A, rows]."""
        if len(self._networks) == 1:
            y = self._forward(self._networks[0], x)
        else:
            chosen = self._choose(x)
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
        for weight, bias in layers[:-1]:
            y = np.empty((weight.shape[0], x.shape[1]), dtype=np.float32)
            dense(weight, bias, x, y)
            if self.spec.activation == "relu":
                x = np.maximum(y, np.float32(0.0))
            else:
                squash(y)
                x = y
        weight, bias = layers[-1]
        y = np.empty((weight.shape[0], x.shape[1]), dtype=np.float32)
        dense(weight, bias, x, y)
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
