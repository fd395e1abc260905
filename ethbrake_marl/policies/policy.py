"""A policy in memory: manifest, tensors and actions."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import safetensors.numpy
from pydantic import ValidationError
from safetensors import SafetensorError

from ethbrake_marl.episode.observe import View
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import first_mistake
from ethbrake_marl.files.store import new_folder, write_file
from ethbrake_marl.policies.actor import Actor
from ethbrake_marl.policies.layers import Float32s
from ethbrake_marl.policies.manifest import Manifest, content_sha256, installed_versions
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.policies.observed import ObservationSchema
from ethbrake_marl.policies.training_range import TrainingRange

MANIFEST, WEIGHTS = "manifest.json", "weights.safetensors"  # the files of a bundle


@dataclass(frozen=True)
class Policy:
    """A policy in memory. ``policy(observations)`` returns its deterministic actions.

    >>> from ethbrake_marl.policies.bundle import load_shipped
    >>> import numpy as np
    >>> policy = load_shipped("ppo")
    >>> policy.manifest.algorithm, len(policy.observation.features)
    ('ppo', 27)
    >>> policy(np.zeros((2, 27), np.float32)).shape
    (2, 1)

    """

    manifest: Manifest
    tensors: Mapping[str, Float32s]  # weights and biases by name: `NetworkSpec.tensors`

    def __repr__(self) -> str:
        manifest, scenario = self.manifest, self.manifest.scenario.get("name")
        return (
            f"Policy({manifest.algorithm!r}, {len(manifest.observation.features)} observations, {manifest.steps:,}"
            f" steps on {scenario!r:.66}, sha256 {manifest.manifest_sha256[:12]})"
        )

    @cached_property
    def actor(self) -> Actor:
        return Actor(self.manifest.network, self.tensors)

    @cached_property
    def observation(self) -> View:
        return View(self.manifest.observation.features)

    def __call__(self, observations: Float32s) -> Float32s:
        """Actions [n, 1] in [-1, 1] for observations [n, F] float32. Row k depends on observation k only."""
        return self.actor(observations)

    @classmethod
    def make(cls, tensors: Mapping[str, Float32s], *, network: NetworkSpec, observation: View, **manifest: Any) -> Self:
        """Policy with these tensors. ``manifest``: all fields of ``Manifest`` except hashes and versions. Raises
        ``InvalidInput``.
        """
        data = serialise(tensors)
        try:
            draft = Manifest(
                **{"versions": installed_versions(), **manifest}, network=network,
                observation=ObservationSchema.of(observation),
                weights_sha256=hashlib.sha256(data).hexdigest(), manifest_sha256="0" * 64,
            )  # fmt: skip
            return cls(
                draft.model_copy(update={"manifest_sha256": _manifest_sha256(draft)}), checked_tensors(data, network)
            )
        except ValueError as error:
            reason = first_mistake(error) if isinstance(error, ValidationError) else error
            raise InvalidInput(f"policy: {reason}") from None

    def with_range(self, training_range: TrainingRange | None) -> Self:
        """Policy with this range. Raises pydantic's ``ValidationError``."""
        content = {**self.manifest.model_dump(), "training_range": training_range and training_range.model_dump()}
        manifest = Manifest.model_validate(content)
        sha256 = _manifest_sha256(manifest)
        return replace(self, manifest=manifest.model_copy(update={"manifest_sha256": sha256}))

    def save(self, folder: str | os.PathLike[str], *, replace: bool = False) -> None:
        """Write the bundle as a new folder, completely or not at all. Raises ``AlreadyExists``, unless ``replace``."""
        manifest = self.manifest.model_copy(update={"manifest_sha256": _manifest_sha256(self.manifest)})
        with new_folder(Path(folder).expanduser(), replace=replace) as partial:
            write_file(partial / WEIGHTS, serialise(self.tensors))
            write_file(partial / MANIFEST, manifest.model_dump_json(indent=2).encode() + b"\n")


def _manifest_sha256(manifest: Manifest) -> str:
    return content_sha256(manifest.model_dump(mode="json"))


def serialise(tensors: Mapping[str, Float32s]) -> bytes:
    return safetensors.numpy.save({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()})


def checked_tensors(data: bytes, network: NetworkSpec) -> dict[str, Float32s]:
    """Read-only tensors in the content of a safetensors file, name -> tensor.

    Raises ``ValueError`` for a wrong name, shape or type, and for an entry that is not finite.
    """
    try:
        tensors = safetensors.numpy.load(data)
    except (SafetensorError, KeyError, TypeError) as error:  # a damaged file, a type that numpy has not
        raise ValueError(f"not a safetensors file ({error})") from None
    shapes = network.tensors
    for name in sorted(shapes.keys() ^ tensors.keys()):
        raise ValueError(f"tensor {name!r}: {'is missing' if name in shapes else 'must not be in this file'}")
    for name, tensor in tensors.items():
        if tensor.dtype != np.float32 or tensor.shape != shapes[name]:
            raise ValueError(
                f"tensor {name!r} has type {tensor.dtype} and shape {list(tensor.shape)}; must have type float32 and"
                f" shape {list(shapes[name])}"
            )
        if not np.isfinite(tensor).all():
            raise ValueError(f"tensor {name!r}: contains a number that is not finite")
        tensor.setflags(write=False)
    return tensors
