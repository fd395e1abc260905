"""The manifest of a policy bundle: network, observation, training, versions and hashes."""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import version
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue, model_validator

from ethbrake_marl.episode.features import GROUPS
from ethbrake_marl.files.model import NAME_PATTERN
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.observed import FiniteModel, ObservationSchema, Sha256
from ethbrake_marl.policies.training_range import TrainingRange
from ethbrake_marl.registry import versions_used

LONGEST_STEP_S = 1e6
POLICY_PACKAGES = ("ethbrake-marl", "gymnasium", "numba", "numpy", "safetensors", "stable-baselines3", "torch")
PHYSICS_KEY = "physics"  # key of `versions`: digest of the physics

Learner = Annotated[str, Field(pattern=r"^vehicle_[1-9][0-9]?$")]


version_of = cache(version)  # reading one takes a millisecond


def installed_versions() -> dict[str, str]:
    """Versions of everything that may affect a training, name -> version."""
    core_versions = {"python": platform.python_version(), PHYSICS_KEY: physics_digest()}
    return core_versions | {name: version_of(name) for name in POLICY_PACKAGES} | versions_used()


class Manifest(FiniteModel):
    """Everything that a policy bundle records, except the tensors."""

    format: Literal["ethbrake-policy"] = "ethbrake-policy"
    format_version: Literal[2] = 2
    algorithm: Annotated[str, Field(pattern=NAME_PATTERN)]
    network: NetworkSpec
    observation: ObservationSchema
    action: Literal["fraction_of_own_capacity"] = "fraction_of_own_capacity"  # -1 is full braking
    learners: Annotated[tuple[Learner, ...], Field(min_length=1)]  # vehicles that the policy has learned to control
    scenario: dict[str, JsonValue]  # all values of the scenario of the training
    reward: dict[str, JsonValue]  # all settings of the training's reward
    seeds: dict[str, int]  # purpose -> seed
    steps: Annotated[int, Field(ge=0)]  # decisions of the learners in training
    versions: dict[str, str]  # at the time of training
    training_range: TrainingRange | None = Field(None, exclude_if=lambda training_range: training_range is None)
    weights_sha256: Sha256  # of the file with the tensors
    manifest_sha256: Sha256  # of all other fields: `content_sha256`

    @property
    def time_step_s(self) -> float:
        """Time between two decisions in training (s); NaN if the manifest does not contain it."""
        step = self.scenario.get("time_step_s")
        is_valid = isinstance(step, int | float) and not isinstance(step, bool) and 0.0 < step <= LONGEST_STEP_S
        return float(step) if is_valid else math.nan  # type: ignore[arg-type]  # a number

    @model_validator(mode="after")
    def _parts_fit(self) -> Manifest:
        network, features = self.network, self.observation.features
        if len(features) != network.observation_size:
            raise ValueError(
                f"observation.features: has {len(features)} features; must have {network.observation_size}, the"
                " observation_size of the network"
            )
        if self.training_range is not None and len(self.training_range.low) != len(features):
            raise ValueError(f"training_range: has {len(self.training_range.low)} features; must have {len(features)}")
        forecasts = [name for name in features if name.partition(".")[0] in GROUPS]
        if forecasts and math.isnan(self.time_step_s):
            raise ValueError(
                f"scenario: time_step_s = {self.scenario.get('time_step_s')!r:.60}: must be a number of seconds above"
                f" 0, because the policy observes {forecasts[0]}"
            )
        return self


def content_sha256(content: Mapping[str, Any]) -> str:
    """SHA-256 of a manifest without its key ``manifest_sha256``, written as sorted ASCII JSON without spaces.

    The hash reveals damage and edits, but is not a signature.
    """
    hashed = {key: value for key, value in content.items() if key != "manifest_sha256"}
    return hashlib.sha256(json.dumps(hashed, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
