"""Read a policy bundle (a folder with manifest and weights); refuse a damaged one, and one with unknown features."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from pathlib import Path

import numpy as np

from ethbrake_marl.errors import RENAMED, CorruptBundle, InvalidInput
from ethbrake_marl.files.model import read_json_model
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.game.features import FEATURES
from ethbrake_marl.policies.manifest import Manifest, ObservationSchema, content_sha256
from ethbrake_marl.policies.policy import MANIFEST, WEIGHTS, Policy, checked_tensors

_LIMITS_BYTES = {MANIFEST: 1 << 20, WEIGHTS: 256 << 20}


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Load the policy bundle at ``path``: the folder of a bundle, or of a training run (then its ``policy/``).

    Raises ``InvalidInput`` if there is none; ``CorruptBundle`` with file and reason if it is damaged.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidInput(f"policy {path!r:.60}: must be the path of a run or of a policy bundle")
    folder = _bundle_folder(Path(path))
    entries = {entry.name for entry in os.scandir(folder)}
    for name in sorted({MANIFEST, WEIGHTS} - entries):
        raise CorruptBundle(f"{folder / name}: is missing")
    for name in sorted(entries - {MANIFEST, WEIGHTS}):
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
    manifest = manifest.model_copy(update={"algorithm": RENAMED.get(manifest.algorithm, manifest.algorithm)})
    _check_observed(place, manifest)
    data = _read(folder / WEIGHTS)
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != manifest.weights_sha256:
        raise CorruptBundle(f"{folder / WEIGHTS}: SHA-256 is {sha256}, the manifest says {manifest.weights_sha256}")
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
    """Check that the features that a policy observes are the same today as when it was trained.

    ``path``: its manifest file, for messages. Raises ``InvalidInput`` for a registered feature that is missing or was
    changed; ``CorruptBundle`` for features that this version does not have, or scales differently.
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
    with suppress(InvalidInput):  # a feature that no longer exists
        today = ObservationSchema.of(seen.spec)
        known = seen.model_copy(update={"registered": today.registered})  # registered features are compared above
        if known == today and [each.name for each in seen.registered] == [each.name for each in today.registered]:
            return
    raise CorruptBundle(
        f"{path}: observation: features or their scaling are not those of this version of the package;"
        f" use the one it was made with ({manifest.versions.get('ethbrake-marl', 'unknown')}), or train again"
    )
