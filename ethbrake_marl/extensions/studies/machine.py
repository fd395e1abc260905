"""Description of this machine, printed with every measured time."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from ethbrake_marl import __version__


@dataclass(frozen=True, slots=True)
class Machine:
    """Processor, load and software versions of this machine."""

    processor: str  # model of the processor
    cores_usable: int  # number of cores that this process may use
    cores: int  # number of cores of the machine
    load: float  # mean number of running processes over the last minute
    python: str  # version of Python
    numpy: str  # version of numpy
    numba: str  # version of numba
    ethbrake_marl: str  # version of this package

    def __str__(self) -> str:
        """Return one line, for captions."""
        return (
            f"{self.processor}, {self.cores_usable} of {self.cores} cores usable, load {self.load:.1f};"
            f" Python {self.python}, numpy {self.numpy}, numba {self.numba}, ethbrake_marl {self.ethbrake_marl}"
        )


def this_machine() -> Machine:
    information = Path("/proc/cpuinfo")
    lines = information.read_text("utf-8").splitlines() if information.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Machine(
        models[0] if models else platform.processor() or platform.machine(),
        usable,
        os.cpu_count() or 1,
        os.getloadavg()[0],
        platform.python_version(),
        version("numpy"),
        version("numba"),
        __version__,
    )
