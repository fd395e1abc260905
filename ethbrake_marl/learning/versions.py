"""Which versions made a run or a policy."""

from __future__ import annotations

import platform
from importlib.metadata import version

_PACKAGES = ("ethbrake-marl", "gymnasium", "numba", "numpy", "safetensors", "stable-baselines3", "torch")


def installed_versions() -> dict[str, str]:
    """Name -> version of this package, Python and every package that a training's numbers depend on."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}
