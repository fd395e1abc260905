"""The manifest of a policy: network, observation, training, versions and hashes."""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections.abc import Mapping
from importlib.metadata import version
from itertools import chain
from operator import not_
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, JsonValue, model_validator

from ethbrake_marl.files.model import NAME_PATTERN, FileModel
from ethbrake_marl.game.features import Of, registered_in
from ethbrake_marl.game.observations import ObservationSpec, choose_observation
from ethbrake_marl.registry import versions_used

_PACKAGES = ("ethbrake-marl", "gymnasium", "numba", "numpy", "safetensors", "stable-baselines3", "torch")


def installed_versions() -> dict[str, str]:
    """Name -> version of this package, Python and every package that a training's numbers depend on.

    Those that gave a part to this process are among them.
    """
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES} | versions_used()


Activation = Literal["relu", "tanh"]

Width = Annotated[int, Field(ge=1, le=4096)]

PerhapsHidden = Annotated[tuple[Width, ...], Field(max_length=8)]


class TensorRow(NamedTuple):
    """One tensor: its name in a bundle, its shape, and its name in Stable-Baselines3's policy (PPO's or SAC's)."""

    name: str
    shape: tuple[int, ...]
    sb3_name: str


class NetworkSpec(FileModel):
    """An actor, and perhaps a critic, both multilayer perceptrons on the same observation.

    The action is ``output(actor(observation))`` in [-1, 1]: ``clip`` cuts the actor's mean at the bounds (PPO's
    Gaussian, whose noise is one number per action), ``tanh`` squashes it (SAC's Gaussian, whose noise is a second
    head of the actor). Without ``value_hidden`` there is no critic: a policy needs none to act.

    With ``networks`` above 1 there are as many actors of this shape, and a gate with ``gate_hidden`` layers that gives
    each a score: the actor of the highest score acts, the first of equal ones. The gate is asked at each decision and
    remembers nothing. There is neither noise nor critic then.

    With output ``choice`` the actor gives each of ``choices`` actions, evenly from -1 to 1, a score, and the action of
    the highest one is taken, the lowest of equal ones. Again there is neither noise nor critic. Where it chooses
    ``among`` whole policies, too, their scores come before those of the actions, and all see the same observation.
    """

    observation_size: Annotated[int, Field(ge=1, le=4096)]
    action_size: Annotated[int, Field(ge=1, le=64)]
    policy_hidden: Annotated[PerhapsHidden, Field(min_length=1)]
    value_hidden: PerhapsHidden
    activation: Activation
    output: Literal["clip", "tanh", "choice"]
    choices: Annotated[int | None, Field(ge=2, le=4096, exclude_if=lambda choices: choices is None)] = None
    networks: Annotated[int, Field(ge=1, le=16, exclude_if=lambda networks: networks == 1)] = 1
    gate_hidden: Annotated[PerhapsHidden, Field(exclude_if=not_)] = ()
    among: Annotated[tuple[NetworkSpec, ...], Field(max_length=16, exclude_if=not_)] = ()

    @model_validator(mode="after")
    def _a_gate_between_several(self) -> NetworkSpec:
        if (self.networks > 1) != bool(self.gate_hidden):
            raise ValueError(
                f"networks = {self.networks} with gate_hidden = {list(self.gate_hidden)}; several need a gate"
            )
        if self.networks > 1 and self.value_hidden:
            raise ValueError(f"value_hidden = {list(self.value_hidden)}: must be empty beside several networks")
        if (self.output == "choice") != (self.choices is not None):
            raise ValueError(
                f"choices = {self.choices} with output {self.output}; output choice needs a number of them"
            )
        if self.choices is not None and (self.value_hidden or self.networks > 1 or self.action_size > 1):
            raise ValueError("output choice is for one network without a critic, and one action")
        for m, member in enumerate(self.among):
            if self.choices is None or member.among:
                raise ValueError("among: is for output choice, and its policies choose among no others")
            if (member.observation_size, member.action_size) != (self.observation_size, self.action_size):
                raise ValueError(f"among[{m}]: observes or acts in another size; must be the same in all")
        return self

    @property
    def actors(self) -> tuple[str, ...]:
        """How the tensors' names of each actor begin."""
        return ("policy",) if self.networks == 1 else tuple(f"network_{m + 1}" for m in range(self.networks))

    @property
    def actions(self) -> Float32s:
        """Those among which output ``choice`` chooses, [choices]."""
        found: Float32s = np.linspace(-1.0, 1.0, self.choices or 0).astype(np.float32)
        return found

    @property
    def format_version(self) -> Literal[2, 3, 4, 5]:
        """Of a bundle with this network."""
        if self.choices is not None:
            return 5 if self.among else 4
        return 2 if self.networks == 1 else 3

    @property
    def tensors(self) -> tuple[TensorRow, ...]:
        """Every tensor, all float32; weights are [outputs, inputs] as in ``y = W x + b``.

        The training library counts activations too, so the index of its layers is twice ours.
        """

        def layer(name: str, sb3_name: str, inputs: int, outputs: int) -> list[TensorRow]:
            return [
                TensorRow(f"{name}.weight", (outputs, inputs), f"{sb3_name}.weight"),
                TensorRow(f"{name}.bias", (outputs,), f"{sb3_name}.bias"),
            ]

        def network(name: str, sb3_name: str, hidden: tuple[int, ...], sb3_head: str, outputs: int) -> list[TensorRow]:
            sizes = [self.observation_size, *hidden]
            layers = [layer(f"{name}.{k}", f"{sb3_name}.{2 * k}", sizes[k], sizes[k + 1]) for k in range(len(hidden))]
            return [*chain(*layers), *layer(f"{name}.output", sb3_head, sizes[-1], outputs)]

        hidden, actions = self.policy_hidden, self.action_size
        if self.networks > 1:
            gate = network(
                "gate", "gate.average", self.gate_hidden, f"gate.average.{2 * len(self.gate_hidden)}", self.networks
            )
            actors = [
                network(name, f"members.{m}.mlp_extractor.policy_net", hidden, f"members.{m}.action_net", actions)
                for m, name in enumerate(self.actors)
            ]
            return (*chain(*actors), *gate)
        if self.choices is not None:
            scores = len(self.among) + self.choices
            chooser = network("policy", "average", hidden, f"average.{2 * len(hidden)}", scores)
            for m, each in enumerate(self.among, 1):
                named = ((f"among_{m}.{row.name}", row.shape) for row in each.tensors)
                chooser += [TensorRow(name, shape, name.replace(".", "_")) for name, shape in named]
            return tuple(chooser)
        if self.output == "clip":
            rows = network("policy", "mlp_extractor.policy_net", hidden, "action_net", actions)
            rows.append(TensorRow("policy.log_std", (actions,), "log_std"))
        else:
            rows = network("policy", "actor.latent_pi", hidden, "actor.mu", actions)
            rows += layer("policy.log_std", "actor.log_std", hidden[-1], actions)
        if self.value_hidden:
            rows += network("value", "mlp_extractor.value_net", self.value_hidden, "value_net", 1)
        return tuple(rows)


Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

Neighbours = Annotated[int, Field(ge=0, le=64)]


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

    @classmethod
    def of(cls, spec: ObservationSpec) -> Self:
        """Describe ``spec`` so that a later change of a name, unit, scale or bound is noticed."""
        names = tuple(f.name for f in spec.features)
        scaling = [[f.name, f.unit, f.scale, f.low, f.high] for f in spec.features]
        return cls(
            front=spec.front,
            rear=spec.rear,
            features=names,
            scaling_sha256=hashlib.sha256(json.dumps(scaling).encode()).hexdigest(),
            registered=tuple(
                FeatureDefinition(
                    name=name, of=entry.of, unit=entry.feature.unit, scale=entry.feature.scale, low=entry.feature.low,
                    high=entry.feature.high, unknown=entry.unknown, tried=entry.tried,
                )
                for name, entry in registered_in(names).items()
            ),
        )  # fmt: skip

    @property
    def spec(self) -> ObservationSpec:
        """The observation as the environment builds it, from the names; raises ``UnknownName``."""
        return choose_observation(self.features)


class Manifest(_Strict):
    """Everything about a policy but its tensors; ``action`` is a fraction of the own capacity, -1 = full braking.

    Format 3 is for policies of several networks, 4 for one that scores its choices, 5 for one that chooses among
    policies; any other network is written as ever, for earlier versions too.
    """

    format: Literal["ethbrake-policy"] = "ethbrake-policy"
    format_version: Literal[2, 3, 4, 5] = 2
    algorithm: Annotated[str, Field(pattern=NAME_PATTERN)]
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

    @model_validator(mode="after")
    def _parts_fit(self) -> Manifest:
        network, features, step = self.network, self.observation.features, self.scenario.get("time_step_s")
        if self.format_version != network.format_version:
            raise ValueError(
                f"format_version: {self.format_version} for {network.networks} networks and output {network.output};"
                f" must be {network.format_version}"
            )
        if len(features) != network.observation_size:
            raise ValueError(
                f"{len(features)} observation features for a network that takes {network.observation_size}"
            )
        if any(name.startswith(("contact.", "contact_far.")) for name in features) and (
            isinstance(step, bool) or not isinstance(step, int | float) or not step > 0.0
        ):
            raise ValueError(f"scenario: time_step_s = {step!r}; contact features need a number above 0")
        for name in self.learners:
            if re.fullmatch(r"vehicle_[1-9][0-9]?", name) is None:
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


def content_sha256(content: Mapping[str, Any]) -> str:
    """SHA-256 of a manifest's plain content without its own hash: sorted keys, no blanks, ASCII.

    It binds names, architecture and weights together, against accidents and edits; it is no signature.
    """
    hashed = {key: value for key, value in content.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(hashed, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


Float32s = NDArray[np.float32]
