"""A policy as a folder of two plain files: ``manifest.json`` (what it is) and ``weights.safetensors`` (numbers).

Reading one runs no code from it: no pickle, no names to import, no torch. Everything is checked against our own
table of tensors before any of it is used, and what is damaged or unknown is refused by name.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from pydantic import ValidationError
from safetensors import SafetensorError

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files.arrays import ArrayRow, check_arrays, safetensors_headers
from ethbrake_marl.files.store import new_folder, read_plain, write_file
from ethbrake_marl.files.yaml import first_mistake, read_json_model
from ethbrake_marl.observations import ObservationSpec, choose_observation
from ethbrake_marl.policies.actor import (
    Actor,
    FeatureDefinition,
    Float32s,
    Manifest,
    content_sha256,
    format_of,
    observation_schema,
    tensor_table,
)
from ethbrake_marl.scenario.features import FEATURES

# The check that a policy's features are still what their names stand for.


def check_observed(path: Path, manifest: Manifest) -> None:
    """Compare what the policy observes with what these features are now.

    Raises ``InvalidInput`` naming a registered feature that is missing or was changed, ``CorruptBundle`` for features
    that this version does not have, or scales otherwise.
    """
    seen = manifest.observation
    for feature in seen.registered:
        _check_registered(path, feature)
    try:
        today = observation_schema(choose_observation(seen.features))
    except InvalidInput:
        raise _other_features(path, manifest) from None
    was, now = (
        (each.front, each.rear, each.features, [part.name for part in each.registered], each.scaling_sha256)
        for each in (seen, today)
    )
    if was != now:
        raise _other_features(path, manifest)


def _check_registered(path: Path, was: FeatureDefinition) -> None:
    if was.name not in FEATURES:
        raise InvalidInput(
            f"{path}: the policy observes {was.name!r:.80}, which is not registered; import the file that registers it"
            " (eb.register_feature) first"
        )
    entry = FEATURES[was.name]
    now = {name: getattr(entry.feature, name) for name in ("unit", "scale", "low", "high")}
    now |= {"of": entry.of, "unknown": entry.unknown}
    for key, value in now.items():
        if getattr(was, key) != value:
            raise InvalidInput(
                f"{path}: the policy observes {was.name!r:.80}, whose {key} was {getattr(was, key)!r:.60} when it was"
                f" trained and is {value!r:.60} now; register it as it was, or train again"
            )
    if len(was.tried) != len(entry.tried) or not np.allclose(was.tried, entry.tried, rtol=1e-6, atol=1e-6):
        raise InvalidInput(
            f"{path}: the policy observes {was.name!r:.80}, whose function gives other numbers than when it was"
            " trained; register it as it was, or train again"
        )


def _other_features(path: Path, manifest: Manifest) -> CorruptBundle:
    return CorruptBundle(
        f"{path}: observation: features or their scaling are not those of this version of the package;"
        f" use the one it was made with ({manifest.versions.get('ethbrake-marl', 'unknown')}), or train again"
    )


MANIFEST = "manifest.json"
WEIGHTS = "weights.safetensors"
MANIFEST_LIMIT_BYTES = 1 << 20
WEIGHTS_LIMIT_BYTES = 256 << 20


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
    _actor: Actor = field(init=False, compare=False)
    _observed: ObservationSpec | None = field(default=None, init=False, compare=False, repr=False)

    def __repr__(self) -> str:
        told, scenario = self.manifest, self.manifest.scenario.get("name")
        return (
            f"Policy({told.algorithm!r}, {self.observation.size} observations, {told.steps:,} steps on"
            f" {scenario!r:.66}, sha256 {told.manifest_sha256[:12]})"
        )

    def __post_init__(self) -> None:
        """Build the forward pass."""
        object.__setattr__(self, "_actor", Actor(self.manifest.network, self.tensors))

    def __call__(self, observation: Float32s) -> Float32s:
        """Map observation [n, F] float32 to action [n, A] float32 in [-1, 1]; row k depends on row k alone."""
        return self._actor(observation)

    @property
    def observation(self) -> ObservationSpec:
        """What to observe for this policy, at the time steps of the scenario that it was trained on.

        Found from the names at first use, which takes as long as to act.
        """
        if self._observed is None:
            object.__setattr__(self, "_observed", self.manifest.spec)
        assert self._observed is not None
        return self._observed


def make_policy(tensors: Mapping[str, Float32s], **manifest: Any) -> Policy:
    """Build a policy from ``tensors`` and the fields of ``Manifest`` (all but hashes and format, which follow).

    Raises ``InvalidInput`` naming the tensor or field that does not fit.
    """
    data = _serialise(tensors)
    try:
        manifest["format_version"] = format_of(manifest["network"])
        draft = Manifest(**manifest, weights_sha256=hashlib.sha256(data).hexdigest(), manifest_sha256="0" * 64)
        own = content_sha256(draft.model_dump(mode="json"))
        checked = draft.model_copy(update={"manifest_sha256": own})
        return Policy(checked, _tensors(data, checked))
    except ValidationError as error:
        raise InvalidInput(f"policy: {first_mistake(error)}") from None
    except ValueError as error:
        raise InvalidInput(f"policy: {error}") from None


def save_policy(policy: Policy, folder: Path, *, replace: bool = False) -> None:
    """Write ``policy`` as the new folder ``folder``, completely or not at all; raises ``AlreadyExists``.

    With ``replace`` a folder that is there goes once the new one is written.
    """
    with new_folder(folder, replace=replace) as partial:
        write_file(partial / WEIGHTS, _serialise(policy.tensors))
        write_file(partial / MANIFEST, policy.manifest.model_dump_json(indent=2).encode() + b"\n")


def has_bundle(folder: Path) -> bool:
    """Whether the files of a bundle stand in ``folder``; they are not read."""
    return all((folder / name).is_file() for name in (MANIFEST, WEIGHTS))


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Read the bundle at ``path``: a bundle's own folder, or a run's folder (then its ``policy/``).

    Raises ``InvalidInput`` when there is none, ``CorruptBundle`` (file, what is wrong) when it cannot be trusted.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidInput(f"policy {path!r:.60}: must be the path of a run or of a policy bundle")
    folder = _bundle_folder(Path(path))
    _check_files(folder)
    manifest = _manifest(folder / MANIFEST)
    data = _read(folder / WEIGHTS, WEIGHTS_LIMIT_BYTES)
    found = hashlib.sha256(data).hexdigest()
    if found != manifest.weights_sha256:
        raise CorruptBundle(f"{folder / WEIGHTS}: SHA-256 is {found}, the manifest says {manifest.weights_sha256}")
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


def _check_files(folder: Path) -> None:
    found = {entry.name for entry in os.scandir(folder)}
    for name in sorted({MANIFEST, WEIGHTS} - found):
        raise CorruptBundle(f"{folder / name}: is missing")
    for name in sorted(found - {MANIFEST, WEIGHTS}):
        raise CorruptBundle(f"{folder / name}: does not belong into a bundle, which is {MANIFEST} and {WEIGHTS} only")


def _read(path: Path, limit: int) -> bytes:
    return read_plain(path, limit, refusal=CorruptBundle, follow_links=False)


def _manifest(path: Path) -> Manifest:
    data = _read(path, MANIFEST_LIMIT_BYTES)
    try:
        content, manifest = read_json_model(data, Manifest)
    except ValueError as error:
        raise CorruptBundle(f"{path}: {error}") from None
    found = content_sha256(content)
    if found != manifest.manifest_sha256:
        raise CorruptBundle(
            f"{path}: its content has SHA-256 {found}, but it says {manifest.manifest_sha256}; it was changed after it"
            " was saved"
        )
    check_observed(path, manifest)
    return manifest


def _serialise(tensors: Mapping[str, Float32s]) -> bytes:
    return safetensors.numpy.save({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()})


def _tensors(data: bytes, manifest: Manifest) -> dict[str, Float32s]:
    """Check ``data`` against the tensor table, then read it; raises ``ValueError`` naming the tensor."""
    rows = [ArrayRow(row.name, "F32", row.shape) for row in tensor_table(manifest.network)]
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


# Policies of several learners that were trained together, one for each: in memory and as a folder of bundles.


@dataclass(frozen=True)
class PolicyTeam:
    """One policy for each learner, by the vehicle's name, front to rear."""

    members: Mapping[str, Policy]


Trained = Policy | PolicyTeam  # what a training makes: one policy for all its learners, or one for each


def steps_of(trained: Trained) -> int:
    """Decisions of learners after which it was taken."""
    policy = trained if isinstance(trained, Policy) else next(iter(trained.members.values()))
    return policy.manifest.steps


def drivers_of(trained: Trained, learners: tuple[str, ...]) -> dict[str, Policy]:
    """The policy that drives each of the ``learners``."""
    return dict.fromkeys(learners, trained) if isinstance(trained, Policy) else dict(trained.members)


def save_trained(trained: Trained, folder: Path, *, replace: bool = False) -> None:
    """Write a bundle, or a folder ``vehicle_i/`` for each learner with its bundle: completely or not at all.

    ``replace`` and what is raised: as for ``save_policy``.
    """
    if isinstance(trained, Policy):
        save_policy(trained, folder, replace=replace)
        return
    with new_folder(folder, replace=replace) as partial:
        for name, policy in trained.members.items():
            save_policy(policy, partial / name)


def read_trained(folder: Path) -> Trained:
    """Read what ``save_trained`` wrote; raises ``CorruptBundle``, and what ``load_policy`` raises."""
    if (folder / MANIFEST).exists():
        return load_policy(folder)
    names = sorted((path.name for path in folder.glob("vehicle_*")), key=lambda name: int(name.split("_")[1]))
    if not names:
        raise CorruptBundle(f"{folder}: holds neither a bundle nor one for each learner")
    return PolicyTeam({name: load_policy(folder / name) for name in names})
