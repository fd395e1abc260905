"""Commands in a process of their own that a signal ends half-way."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[3]
PROGRAM = [sys.executable, "-c", "from ethbrake_marl.cli.app import main; main()"]


def end_when(command: list[Any], ready: Callable[[int], bool], by: signal.Signals) -> tuple[int, str]:
    """Run a command until ``ready(its process)``, then send it a signal; its exit status and what it told."""
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as driver:
        try:
            while not ready(driver.pid):
                assert driver.poll() is None
                time.sleep(0.01)
            driver.send_signal(by)
            _, told = driver.communicate(timeout=300)
        finally:
            driver.kill()
    return driver.returncode, told
