"""Read a policy bundle (a folder with manifest and weights); refuse damaged bundles and unknown features."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

import numpy as np

from ethbrake_marl.errors import RENAMED, CorruptBundle, InvalidInput
from ethbrake_marl.files.model import read_json_model
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.first_edition.game.features import FEATURES
from ethbrake_marl.first_edition.policies.manifest import Manifest, ObservationSchema, content_sha256
from ethbrake_marl.first_edition.policies.policy import MANIFEST, WEIGHTS, Policy, checked_tensors

_LIMITS_BYTES = {MANIFEST: 1 << 20, WEIGHTS: 256 << 20}


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Load a policy bundle. ``path`` is the folder of the bundle, or of a training run with a folder ``policy/``.

    Raises ``InvalidInput`` if there is no bundle, and ``CorruptBundle`` with file and reason if it is damaged.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidInput(f"policy = {path!r:.60}: must be the path of a training run or of a policy bundle")
    folder = _bundle_folder(Path(path))
    entries = {entry.name for entry in os.scandir(folder)}
    for name in sorted({MANIFEST, WEIGHTS} - entries):
        raise CorruptBundle(f"{folder / name}: is missing from the policy bundle")
    for name in sorted(entries - {MANIFEST, WEIGHTS}):
        raise CorruptBundle(
            f"{folder / name}: does not belong in a bundle, which has only the files {MANIFEST} and {WEIGHTS}"
        )
    place = folder / MANIFEST
    data = _read(place)
    try:
        content, manifest = read_json_model(data, Manifest)
    except ValueError as error:
        raise CorruptBundle(f"{place}: {error}") from None
    own = content_sha256(content)
    if own != manifest.manifest_sha256:
        raise CorruptBundle(
            f"{place}: the content has SHA-256 {own}, but manifest_sha256 is {manifest.manifest_sha256}; the file was"
            " changed after it was saved"
        )
    manifest = manifest.model_copy(update={"algorithm": RENAMED.get(manifest.algorithm, manifest.algorithm)})
    _check_observed(place, manifest)
    data = _read(folder / WEIGHTS)
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != manifest.weights_sha256:
        raise CorruptBundle(
            f"{folder / WEIGHTS}: the file has SHA-256 {sha256}, but weights_sha256 in the manifest is"
            f" {manifest.weights_sha256}"
        )
    try:
        return Policy(manifest, checked_tensors(data, manifest))
    except ValueError as error:
        raise CorruptBundle(f"{folder / WEIGHTS}: {error}") from None


def _bundle_folder(path: Path) -> Path:
    for folder in (path, path / "policy"):
        try:
            exists = (folder / MANIFEST).exists() or (folder / WEIGHTS).exists()
        except OSError as error:
            raise InvalidInput(f"{str(path)!r:.120}: cannot be read ({error.strerror})") from None
        if exists:
            if folder.is_symlink():
                raise CorruptBundle(f"{folder}: is a symbolic link; give the folder to which the link points")
            return folder
    members = sorted((path / "policy").glob("vehicle_*"))
    if members:
        raise InvalidInput(
            f"{path}: has one policy for each learner; give the path of one of them, for instance {members[0]}"
        )
    reason = "contains no policy" if path.is_dir() else "is not a folder"
    raise InvalidInput(
        f"{path}: {reason}; give the folder of a policy bundle ({MANIFEST}, {WEIGHTS}) or of a finished run"
    )


def _read(path: Path) -> bytes:
    return read_plain(path, _LIMITS_BYTES[path.name], refusal=CorruptBundle, follow_links=False)


def _check_observed(path: Path, manifest: Manifest) -> None:
    """Raise an error unless the features that a policy observes are the same as when the policy was trained.

    Raises ``InvalidInput`` for a registered feature that is missing or has changed, and ``CorruptBundle`` for features
    of this package that are missing or whose scaling has changed. ``path`` is the manifest file, for the error
    message.
    """
    seen = manifest.observation
    for was in seen.registered:
        observes = f"{path}: the policy observes the feature {was.name!r:.80}"
        if was.name not in FEATURES:
            raise InvalidInput(
                f"{observes}, which is not registered; install the package that registers it, or register it yourself"
                " first with eb.register_feature"
            )
        entry = FEATURES[was.name]
        now = {name: getattr(entry.feature, name) for name in ("unit", "scale", "low", "high")}
        for key, value in (now | {"of": entry.of, "unknown": entry.unknown}).items():
            if getattr(was, key) != value:
                raise InvalidInput(
                    f"{observes}, whose {key} was {getattr(was, key)!r:.60} in training and is {value!r:.60} now;"
                    " register the feature as in training, or train again"
                )
        if len(was.tried) != len(entry.tried) or not np.allclose(was.tried, entry.tried, rtol=1e-6, atol=1e-6):
            raise InvalidInput(
                f"{observes}, whose function now returns other numbers than in training; register the feature as in"
                " training, or train again"
            )
    with suppress(InvalidInput):  # a feature that no longer exists
        today = ObservationSchema.of(seen.spec)
        known = seen.model_copy(update={"registered": today.registered})  # registered features are compared above
        if known == today and [each.name for each in seen.registered] == [each.name for each in today.registered]:
            return
    raise CorruptBundle(
        f"{path}: observation: this version of the package computes or scales features differently than the version"
        f" in which the policy was trained ({manifest.versions.get('ethbrake-marl', 'not recorded')}); use that"
        " version, or train again"
    )
