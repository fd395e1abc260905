"""Processor, load and versions of software, printed with every measured time."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from ethbrake_marl import __version__


@dataclass(frozen=True, slots=True)
class Machine:
    """Processor, load and software versions."""

    processor: str  # model
    cores_usable: int  # that this process may use
    cores: int  # of the machine
    load: float  # mean number of running processes over the last minute
    python: str
    numpy: str
    numba: str
    ethbrake_marl: str

    def __str__(self) -> str:
        """Return one line, for captions."""
        return (
            f"{self.processor}, {self.cores_usable} of {self.cores} cores usable, load {self.load:.1f};"
            f" Python {self.python}, numpy {self.numpy}, numba {self.numba}, ethbrake_marl {self.ethbrake_marl}"
        )


def this_machine() -> Machine:
    """Return what this machine is now."""
    information, cores = Path("/proc/cpuinfo"), os.cpu_count() or 1
    lines = information.read_text("utf-8").splitlines() if information.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else cores
    processor, (load, *_) = [*models, platform.processor() or platform.machine()][0], os.getloadavg()
    versions = platform.python_version(), version("numpy"), version("numba"), __version__
    return Machine(processor, usable, cores, load, *versions)
