"""Policies that ship with the package, and how they are chosen by name.

Each is a folder in ``_policies/`` with a bundle and ``card.md``, which says what the policy was trained on, how good it
is and where it fails.
"""

from __future__ import annotations

from pathlib import Path

from ethbrake_marl.errors import refuse_shipped_path, unknown_name
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.policies.policy import Policy

_FOLDER = Path(__file__).resolve().parents[1] / "_policies"


def shipped_policies() -> dict[str, Path]:
    """Return name -> folder of the bundle of every shipped policy."""
    return {path.parent.name: path.parent for path in sorted(_FOLDER.glob("*/policy"))}


def load_shipped(name: str) -> Policy:
    """Load the shipped policy called ``name``, such as ``universal``; raise ``UnknownName`` with a suggestion."""
    folders = shipped_policies()
    if name not in folders:
        raise unknown_name("shipped policy", name, folders)
    return load_policy(folders[name])


def load_named_policy(name: str) -> Policy:
    """Load a policy: a shipped one by its name, otherwise from a folder.

    ``name``: a shipped policy's name, or the path of a run or a bundle; a folder called ``ppo`` is written ``./ppo``.
    Raises what ``load_policy`` raises, and ``UnknownName`` for ``shipped/NAME``, an old spelling.
    """
    refuse_shipped_path(name)
    return load_shipped(name) if name in shipped_policies() else load_policy(name)
