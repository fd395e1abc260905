"""Read and write policies in folders: a bundle, a shipped policy, the policies of several learners."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

from ethbrake_marl.errors import CorruptBundle, InvalidInput, unknown_name
from ethbrake_marl.files.model import read_json_model
from ethbrake_marl.files.package import package_folder
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.policies.manifest import Manifest, content_sha256
from ethbrake_marl.policies.policy import MANIFEST, WEIGHTS, Policy, checked_tensors

LIMITS_BYTES = {MANIFEST: 1 << 20, WEIGHTS: 256 << 20}  # largest sizes of the files of a bundle
POLICY_FOLDER = package_folder() / "shipped" / "policies"  # NAME/policy is a bundle, NAME/card.md describes it


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Policy in the folder ``path``: a bundle, or a training run whose folder ``policy`` is one.

    Raises ``InvalidInput`` if there is no policy, and ``CorruptBundle`` with file and reason if it is damaged.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidInput(f"policy = {path!r:.60}: must be the path of a training run or of a policy bundle")
    folder = _bundle_in(Path(path).expanduser())
    for name in sorted(LIMITS_BYTES.keys() ^ set(os.listdir(folder))):
        missing = "is missing from the policy bundle"
        wrong = f"does not belong in a bundle, which has only the files {MANIFEST} and {WEIGHTS}"
        raise CorruptBundle(f"{folder / name}: {missing if name in LIMITS_BYTES else wrong}")
    manifest = _read_manifest(folder / MANIFEST)
    file = folder / WEIGHTS
    data = _read(file)
    sha256 = hashlib.sha256(data).hexdigest()
    if sha256 != manifest.weights_sha256:
        raise CorruptBundle(
            f"{file}: the file has SHA-256 {sha256}, but weights_sha256 in the manifest is {manifest.weights_sha256}"
        )
    try:
        return Policy(manifest, checked_tensors(data, manifest.network))
    except ValueError as error:
        raise CorruptBundle(f"{file}: {error}") from None


def _read_manifest(file: Path) -> Manifest:
    try:
        content, manifest = read_json_model(_read(file), Manifest)
    except ValueError as error:
        raise CorruptBundle(str(error) if isinstance(error, CorruptBundle) else f"{file}: {error}") from None
    digest = content_sha256(content)
    if digest != manifest.manifest_sha256:
        raise CorruptBundle(
            f"{file}: the content has SHA-256 {digest}, but manifest_sha256 is {manifest.manifest_sha256}; the file was"
            " changed after it was saved"
        )
    manifest.observation.check(file, manifest.versions.get("ethbrake-marl", "not recorded"))
    return manifest


def _read(file: Path) -> bytes:
    return read_plain(file, LIMITS_BYTES[file.name], refusal=CorruptBundle, follow_links=False)


def _bundle_in(path: Path) -> Path:
    """Folder of the bundle at ``path`` or ``path/policy``."""
    folders = [folder for folder in (path, path / "policy") if os.path.isdir(folder)]  # no errors
    for folder in folders:
        if LIMITS_BYTES.keys() & set(os.listdir(folder)):
            return folder
    for member in (member for folder in folders for member in sorted(folder.glob("vehicle_*"))):
        raise InvalidInput(f"{path}: has one policy for each learner; give the path of one, for instance {member}")
    reason = "contains no policy" if folders else "is not a folder"
    raise InvalidInput(
        f"{path!s:.200}: {reason}; give the folder of a policy bundle ({MANIFEST}, {WEIGHTS}) or of a finished run"
    )


def shipped_policies() -> dict[str, Path]:
    """Shipped policies, name -> folder. A folder has ``card.md`` and the bundle ``policy``."""
    return {folder.parent.name: folder.parent for folder in sorted(POLICY_FOLDER.glob("*/policy"))}


def load_shipped(name: str) -> Policy:
    """Shipped policy with this name, such as ``ppo``. Raises ``UnknownName``."""
    folders = shipped_policies()
    if name not in folders:
        raise unknown_name("shipped policy", name, folders)
    return load_policy(folders[name])


def load_named_policy(name: str) -> Policy:
    """Policy with the name of a shipped policy, or with the path of a run or bundle, such as ``./ppo``."""
    return load_policy(shipped_policies().get(name, name))


def save_drivers(drivers: Mapping[str, Policy], folder: str | os.PathLike[str], *, replace: bool = False) -> None:
    """Write the policies of learners, vehicle -> policy: one bundle if all share one, else one folder per vehicle."""
    first = next(iter(drivers.values()))
    if all(policy is first for policy in drivers.values()) and tuple(drivers) == first.manifest.learners:
        first.save(folder, replace=replace)
        return
    with new_folder(Path(folder), replace=replace) as partial:
        for name, policy in drivers.items():
            policy.save(partial / name)


def load_drivers(folder: str | os.PathLike[str]) -> dict[str, Policy]:
    """Policies in a folder that ``save_drivers`` wrote, vehicle -> policy, front to rear."""
    path = Path(folder)
    names = sorted((place.name for place in path.glob("vehicle_[1-9]*")), key=lambda name: (len(name), name))
    if names:
        return {name: load_policy(path / name) for name in names}
    policy = load_policy(path)
    return dict.fromkeys(policy.manifest.learners, policy)
