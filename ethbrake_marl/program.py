"""The program ``ethbrake``: whether this process is it; and its end by Ctrl-C while it is imported.

The package imports this module first. From then on Ctrl-C prints one line, until the program has its command.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130  # exit status after Ctrl-C: 128 + SIGINT, as shells expect


def is_program() -> bool:
    """Whether this process runs ``ethbrake``, or has begun to run ``python -m ethbrake_marl``."""
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    return name == "ethbrake" or (name == "-m" and "ethbrake_marl" in sys.orig_argv)


def end_program(number: int, frame: FrameType | None) -> None:
    """Handler of Ctrl-C. An exception would print a traceback, or Python would lose it in a callback."""
    try:
        os.write(2, b"interrupted; repeat the command\n")
    finally:  # even without stderr
        os._exit(INTERRUPTED)


def raise_on_interrupt() -> None:
    """Let Ctrl-C raise ``KeyboardInterrupt`` again, unless it is ignored, as in a shell's background job."""
    if signal.getsignal(signal.SIGINT) is end_program:
        signal.signal(signal.SIGINT, signal.default_int_handler)


if is_program() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, end_program)
