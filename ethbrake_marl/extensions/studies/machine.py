"""Processor, load and versions of software, printed with every measured time."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version
from pathlib import Path

from ethbrake_marl import __version__


def this_machine() -> str:
    information, cores = Path("/proc/cpuinfo"), os.cpu_count() or 1
    lines = information.read_text("utf-8").splitlines() if information.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else cores
    processor, (load, *_) = [*models, platform.processor() or platform.machine()][0], os.getloadavg()
    return (
        f"{processor}, {usable} of {cores} cores usable, load {load:.1f}; Python {platform.python_version()}, numpy"
        f" {version('numpy')}, numba {version('numba')}, ethbrake_marl {__version__}"
    )
