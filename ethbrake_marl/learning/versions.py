"""Which versions made a run or a policy."""

from __future__ import annotations

import platform
from importlib.metadata import version

import ethbrake_marl

_PACKAGES = ("gymnasium", "numba", "numpy", "safetensors", "stable-baselines3", "torch")


def installed_versions() -> dict[str, str]:
    """Name -> version of this package, Python and every package that a training's numbers depend on."""
    own = {"ethbrake-marl": ethbrake_marl.__version__, "python": platform.python_version()}
    return own | {name: version(name) for name in _PACKAGES}
