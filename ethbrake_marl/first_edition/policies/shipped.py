"""Policies that are shipped with the package, loaded by name.

Each shipped policy is a folder in ``_policies/`` with a bundle and ``card.md``, which says in which scenario the policy
was trained, how good it is, and where it fails.
"""

from __future__ import annotations

from pathlib import Path

from ethbrake_marl.errors import refuse_shipped_path, unknown_name
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.policy import Policy

_FOLDER = Path(__file__).resolve().parents[2] / "_policies"


def shipped_policies() -> dict[str, Path]:
    """Return the folder of the bundle of every shipped policy, by the policy's name."""
    return {path.parent.name: path.parent for path in sorted(_FOLDER.glob("*/policy"))}


def load_shipped(name: str) -> Policy:
    """Load the shipped policy called ``name``, such as ``universal``; raise ``UnknownName`` for an unknown name."""
    folders = shipped_policies()
    if name not in folders:
        raise unknown_name("shipped policy", name, folders)
    return load_policy(folders[name])


def load_named_policy(name: str) -> Policy:
    """Load a shipped policy by its name, or any policy by the path of a run or a bundle.

    If a folder has the same name as a shipped policy, such as ``ppo``, write ``./ppo`` for the folder. Raises the
    errors of ``load_policy``, and ``UnknownName`` for the old spelling ``shipped/NAME``.
    """
    refuse_shipped_path(name)
    return load_shipped(name) if name in shipped_policies() else load_policy(name)
