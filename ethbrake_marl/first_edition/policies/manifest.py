"""The manifest of a policy: network, observation, training, versions and hashes."""

from __future__ import annotations

import hashlib
import json
import platform
import re
from collections.abc import Mapping
from importlib.metadata import version
from operator import not_
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, JsonValue, model_validator

from ethbrake_marl.files.model import NAME_PATTERN, FileModel
from ethbrake_marl.first_edition.game.features import Of, registered_in
from ethbrake_marl.first_edition.game.observations import ObservationSpec, choose_observation
from ethbrake_marl.first_edition.policies.network_spec import NetworkSpec
from ethbrake_marl.registry import versions_used

_PACKAGES = ("ethbrake-marl", "gymnasium", "numba", "numpy", "safetensors", "stable-baselines3", "torch")


def installed_versions() -> dict[str, str]:
    """Return name -> version of Python, of this package, and of every package on which training results may depend.

    These include packages whose entry points are used in this process (``registry.versions_used``).
    """
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES} | versions_used()


Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]

Neighbours = Annotated[int, Field(ge=0, le=64)]


class _Strict(FileModel):
    model_config = ConfigDict(allow_inf_nan=False)


class FeatureDefinition(_Strict):
    """Definition of a registered feature at the time of the training."""

    name: Annotated[str, Field(max_length=64)]  # name under which the feature was registered
    of: Of  # ``own``: feature of the vehicle itself; ``neighbour``: feature of a neighbour
    unit: str  # unit of the value
    scale: float  # the observed number is clip(value / scale, low, high)
    low: float  # least observed number
    high: float  # largest observed number
    unknown: float  # value for an unknown neighbour, in ``unit``
    tried: Annotated[tuple[float, ...], Field(max_length=64)]  # values of the feature in a few test worlds


class ObservationSchema(_Strict):
    """An observation: number of neighbours, feature names in order, and a hash of the features' scaling."""

    front: Neighbours  # number of observed neighbours ahead
    rear: Neighbours  # number of observed neighbours behind
    features: Annotated[tuple[str, ...], Field(min_length=1, max_length=4096)]  # full names, in order
    scaling_sha256: Sha256  # hash of names, units, scales and bounds of the features
    registered: Annotated[tuple[FeatureDefinition, ...], Field(max_length=4096, exclude_if=not_)] = ()

    @classmethod
    def of(cls, spec: ObservationSpec) -> Self:
        """Return a description of the observation ``spec``, by which later changes of its features can be detected."""
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
        """The observation that this schema describes; raises ``UnknownName`` if a feature does not exist any more."""
        return choose_observation(self.features)


class Manifest(_Strict):
    """Everything that a bundle stores about a policy, except its tensors (weights and biases).

    The network determines the format version: 3 for a mixture of experts, 4 for a network that scores actions, 5 for a
    network that also scores policies, and 2 for any other network.
    """

    format: Literal["ethbrake-policy"] = "ethbrake-policy"  # marks the file as a manifest
    format_version: Literal[2, 3, 4, 5] = 2  # format version of the network
    algorithm: Annotated[str, Field(pattern=NAME_PATTERN)]  # name of the training algorithm
    network: NetworkSpec  # sizes and kind of the networks
    observation: ObservationSchema  # features that the policy observes
    action: Literal["fraction_of_own_capacity"] = "fraction_of_own_capacity"  # unit of an action; -1 is full braking
    learners: Annotated[tuple[str, ...], Field(min_length=1)]  # vehicles that the policy learned to control
    scenario: dict[str, JsonValue]  # all values of the scenario of the training
    reward: dict[str, JsonValue]  # all settings of the reward of the training
    seeds: dict[str, int]  # purpose -> seed of the training
    steps: Annotated[int, Field(ge=0)]  # number of learners' decisions in training
    versions: dict[str, str]  # package -> version at the time of training
    weights_sha256: Sha256  # hash of the file with the tensors
    manifest_sha256: Sha256  # hash of all other fields, see ``content_sha256``

    @model_validator(mode="after")
    def _parts_fit(self) -> Manifest:
        network, features, step = self.network, self.observation.features, self.scenario.get("time_step_s")
        if self.format_version != network.format_version:
            raise ValueError(
                f"format_version = {self.format_version}: must be {network.format_version} if"
                f" networks = {network.networks} and output = {network.output!r}"
            )
        if len(features) != network.observation_size:
            raise ValueError(
                f"observation.features: has {len(features)} features; must have {network.observation_size}, the"
                " observation_size of the network"
            )
        if any(name.startswith(("contact.", "contact_far.")) for name in features) and (
            isinstance(step, bool) or not isinstance(step, int | float) or not step > 0.0
        ):
            raise ValueError(
                f"scenario: time_step_s = {step!r}: must be a number of seconds above 0, because the policy observes"
                " contact features"
            )
        for name in self.learners:
            if re.fullmatch(r"vehicle_[1-9][0-9]?", name) is None:
                raise ValueError(f"learners: {name!r}: must be a vehicle's name, such as vehicle_2")
        if len(set(self.learners)) < len(self.learners):
            raise ValueError(f"learners: {', '.join(self.learners)}: must name each vehicle only once")
        vehicles, roles = self.scenario.get("vehicles"), self.scenario.get("roles")
        for name in self.learners:
            if isinstance(vehicles, int) and int(name.removeprefix("vehicle_")) > vehicles:
                raise ValueError(f"learners: {name}: must be one of the {vehicles} vehicles of the scenario")
            if isinstance(roles, dict) and roles.get(name) != "learner":
                raise ValueError(f"learners: {name}: must be a learner in the scenario's roles")
        return self


def content_sha256(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a manifest's content without the key ``manifest_sha256``.

    The content is written as ASCII JSON with sorted keys and without spaces. The hash detects damage and edits of
    names, architecture or weights; it is not a signature.
    """
    hashed = {key: value for key, value in content.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(hashed, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
