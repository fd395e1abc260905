"""What a policy bundle says about its policy: everything but the numbers."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue, model_validator

from ethbrake_marl.learning.networks import NetworkSpec
from ethbrake_marl.observations import ObservationSpec

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Neighbours = Annotated[int, Field(ge=0, le=64)]

_VEHICLE = re.compile(r"vehicle_[1-9][0-9]?")


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class ObservationSchema(_Strict):
    """What the policy sees: neighbours on each side, feature names in order, and a hash of how each is scaled."""

    front: Neighbours
    rear: Neighbours
    features: Annotated[tuple[str, ...], Field(min_length=1, max_length=4096)]
    scaling_sha256: Sha256

    @property
    def spec(self) -> ObservationSpec:
        """The observation as the environment builds it; what follows the neighbours is told by the features' names."""
        groups = {name.partition(".")[0] for name in self.features}
        return ObservationSpec(front=self.front, rear=self.rear, role="role" in groups, hazard="hazard" in groups)


class Manifest(_Strict):
    """Everything about a policy but its tensors; ``action`` is a fraction of the own capacity, -1 = full braking."""

    format: Literal["ethbrake-policy"] = "ethbrake-policy"
    format_version: Literal[2] = 2
    algorithm: Literal["ppo", "sac"]
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
    def _one_input_per_feature(self) -> Manifest:
        features, inputs = len(self.observation.features), self.network.observation_size
        if features != inputs:
            raise ValueError(f"{features} observation features for a network that takes {inputs}")
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


def content_sha256(content: Mapping[str, Any]) -> str:
    """SHA-256 of a manifest's plain content without its own hash: sorted keys, no blanks, ASCII.

    It binds names, architecture and weights together, against accidents and edits; it is no signature.
    """
    hashed = {key: value for key, value in content.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(hashed, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def observation_schema(spec: ObservationSpec) -> ObservationSchema:
    """Describe ``spec`` so that a later change of a name, unit, scale or bound is noticed."""
    rows = [[f.name, f.unit, f.scale, f.low, f.high] for f in spec.features]
    return ObservationSchema(
        front=spec.front,
        rear=spec.rear,
        features=tuple(f.name for f in spec.features),
        scaling_sha256=hashlib.sha256(json.dumps(rows).encode()).hexdigest(),
    )
