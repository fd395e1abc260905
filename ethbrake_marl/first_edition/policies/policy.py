"""A policy in memory: manifest, tensors and deterministic action."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import safetensors.numpy
from pydantic import ValidationError
from safetensors import SafetensorError

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.arrays import ArrayRow, check_arrays, safetensors_headers
from ethbrake_marl.files.model import first_mistake
from ethbrake_marl.files.store import new_folder, write_file
from ethbrake_marl.first_edition.game.observations import ObservationSpec
from ethbrake_marl.first_edition.policies.actor import Actor
from ethbrake_marl.first_edition.policies.manifest import (
    Manifest,
    ObservationSchema,
    content_sha256,
    installed_versions,
)
from ethbrake_marl.first_edition.policies.network_spec import Float32s
from ethbrake_marl.first_edition.policies.onnx_model import onnx_model

MANIFEST = "manifest.json"

WEIGHTS = "weights.safetensors"


@dataclass(frozen=True)
class Policy:
    """A policy in memory. Calling ``policy(observation)`` returns the deterministic action.

    >>> import ethbrake_marl.first_edition as eb
    >>> import numpy as np
    >>> policy = eb.load_shipped("ppo")
    >>> policy.manifest.algorithm, policy.observation.size
    ('ppo', 27)
    >>> policy(np.zeros((2, 27), np.float32)).shape
    (2, 1)

    """

    manifest: Manifest  # network, observation, training, versions and hashes
    tensors: Mapping[str, Float32s]  # weights and biases by name, see ``NetworkSpec.tensors``

    def __repr__(self) -> str:
        manifest, scenario = self.manifest, self.manifest.scenario.get("name")
        return (
            f"Policy({manifest.algorithm!r}, {self.observation.size} observations, {manifest.steps:,} steps on"
            f" {scenario!r:.66}, sha256 {manifest.manifest_sha256[:12]})"
        )

    @cached_property
    def _actor(self) -> Actor:
        return Actor(self.manifest.network, self.tensors)

    def __call__(self, observation: Float32s) -> Float32s:
        """Return the actions [n, A] in [-1, 1] for the observations [n, F], float32; each row is computed
        independently.
        """
        return self._actor(observation)

    @cached_property
    def observation(self) -> ObservationSpec:
        """The policy's observation, with the time step of the scenario in which the policy was trained.

        Raises ``UnknownName`` if a feature does not exist any more.
        """
        spec, step = self.manifest.observation.spec, self.manifest.scenario.get("time_step_s")
        return spec.at_steps_of(float(step)) if isinstance(step, int | float) else spec

    def policy_sha256(self) -> str:
        """Return the hash of the policy (manifest and weights), as hexadecimal digits."""
        return self.manifest.manifest_sha256

    @property
    def steps(self) -> int:
        """Number of decisions that the learners made in training before the policy was saved."""
        return self.manifest.steps

    @property
    def drivers(self) -> dict[str, Policy]:
        """The policy itself for each vehicle that it learned to control, by vehicle name: ``{"vehicle_2": policy}``."""
        return dict.fromkeys(self.manifest.learners, self)

    @classmethod
    def make(
        cls, tensors: Mapping[str, Float32s], *, observation: ObservationSpec | ObservationSchema, **manifest: Any
    ) -> Self:
        """Make a policy from tensors and the fields of its manifest; hashes and format version are computed.

        Args:
            tensors: weights and biases by name, see ``NetworkSpec.tensors``.
            observation: the observation that is the input of the networks.
            **manifest: values of the other fields of ``Manifest``; ``versions`` defaults to the installed versions.

        Raises ``InvalidInput`` naming the invalid tensor or field.

        """
        data = _serialise(tensors)
        seen = observation if isinstance(observation, ObservationSchema) else ObservationSchema.of(observation)
        manifest_ = {"versions": installed_versions(), **manifest, "format_version": manifest["network"].format_version}
        try:
            weights = hashlib.sha256(data).hexdigest()
            draft = Manifest(**manifest_, observation=seen, weights_sha256=weights, manifest_sha256="0" * 64)
            own = content_sha256(draft.model_dump(mode="json"))
            checked = draft.model_copy(update={"manifest_sha256": own})
            return cls(checked, checked_tensors(data, checked))
        except ValidationError as error:
            raise InvalidInput(f"policy: {first_mistake(error)}") from None
        except ValueError as error:
            raise InvalidInput(f"policy: {error}") from None

    @property
    def among(self) -> tuple[Policy, ...]:
        """Policies among which the network of this policy chooses (``NetworkSpec.among``); empty for most policies."""
        follows = {"network", "observation", "format_version", "weights_sha256", "manifest_sha256"}
        fields = self.manifest.model_dump(exclude=follows)
        members = []
        for k, network in enumerate(self.manifest.network.among, start=1):
            start = f"among_{k}."
            tensors = {name.removeprefix(start): each for name, each in self.tensors.items() if name.startswith(start)}
            members.append(Policy.make(tensors, network=network, observation=self.manifest.observation, **fields))
        return tuple(members)

    @staticmethod
    def stands_in(folder: Path) -> bool:
        """Return whether ``folder`` contains the files of a policy bundle, without reading them."""
        return all((folder / name).is_file() for name in (MANIFEST, WEIGHTS))

    def save(self, folder: str | os.PathLike[str], *, replace: bool = False) -> None:
        """Write the bundle as a new folder, completely or not at all; raise ``AlreadyExists`` if the folder exists.

        With ``replace``, an existing folder with this path is deleted after the new folder was written.
        """
        own = content_sha256(self.manifest.model_dump(mode="json"))  # keys of older versions are not written
        manifest = self.manifest.model_copy(update={"manifest_sha256": own})
        with new_folder(Path(folder), replace=replace) as partial:
            write_file(partial / WEIGHTS, _serialise(self.tensors))
            write_file(partial / MANIFEST, manifest.model_dump_json(indent=2).encode() + b"\n")

    def to_onnx(self) -> bytes:
        """Return the ONNX model: ``observation`` [n, F] float32 -> ``action`` [n, 1] and ``acceleration_mps2`` [n, 1].

        The acceleration is the action times the vehicle's braking capacity (action below 0) or driving capacity (action
        above 0), which are read from the observation. The ONNX model adds products in another order than this package,
        so its results differ by rounding errors. Raises ``MissingExtra`` if the package onnx is not installed.
        """
        return onnx_model(self.manifest, self.observation, self.tensors)


def _serialise(tensors: Mapping[str, Float32s]) -> bytes:
    return safetensors.numpy.save({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()})


def checked_tensors(data: bytes, manifest: Manifest) -> dict[str, Float32s]:
    """Load the tensors of a policy from safetensors ``data``: name -> read-only array.

    Raises ``ValueError`` naming the first tensor whose name or shape differs from ``manifest``, or that has an entry
    that is not finite.
    """
    rows = [ArrayRow(row.name, "F32", row.shape) for row in manifest.network.tensors]
    check_arrays(safetensors_headers(data), rows, "tensor")
    try:
        tensors = safetensors.numpy.load(data)
    except SafetensorError as error:
        raise ValueError(f"not a safetensors file ({error})") from None
    for name, tensor in tensors.items():
        if not np.isfinite(tensor).all():
            raise ValueError(f"tensor {name!r}: contains a number that is not finite")
        tensor.setflags(write=False)
    return tensors
