"""A job that trains nothing, for disturbing the machinery around it, and the command that sweeps it.

It makes so many steps, each a hash of the one before, keeps a checkpoint of each as a training does, and sleeps in
between, so that many of them disturb nobody.

    python -m tests.extensions.studies.counting SWEEP.yaml FOLDER [--jobs N] [--ray ADDRESS]
"""

import argparse
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from filelock import FileLock

from ethbrake_marl.extensions.studies.figures import FIGURES
from ethbrake_marl.extensions.studies.sweep import RUNS, Row, SweepPlan

ROOT = Path(__file__).resolve().parents[3]
STEPS, SLEEP_S = 40, 0.01


def count(folder: Path, seed: int) -> None:
    """Do a job, from where it stopped."""
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / "run.lock", timeout=60.0):
        checkpoint = folder / "checkpoint.json"
        done, text = json.loads(checkpoint.read_text()) if checkpoint.exists() else (0, str(seed))
        while done < STEPS:
            time.sleep(SLEEP_S)
            done, text = done + 1, hashlib.sha256(text.encode()).hexdigest()
            (folder / "new.json").write_text(json.dumps([done, text]))
            os.replace(folder / "new.json", checkpoint)
        if not (folder / "run.json").exists():  # its worker may have been killed before it could say so
            (folder / "new.json").write_text(json.dumps({"status": "finished", "text": text}))
            os.replace(folder / "new.json", folder / "run.json")
            with (folder / "ends").open("a") as ends:
                ends.write("finished\n")


class Counting(SweepPlan):
    """A sweep of such jobs."""

    def train(self, row: Row, path: Path) -> None:
        count(path / RUNS / row.name, row.asked.seed)

    def results(self, path: Path) -> dict[str, dict[str, Any]]:
        files = {row.name: path / RUNS / row.name / "run.json" for row in self.rows}
        return {
            name: {FIGURES[0]: STEPS, FIGURES[-1]: json.loads(file.read_text())["text"]}
            for name, file in files.items()
            if file.exists()
        }


def main() -> int:
    from tests.extensions.studies.counting import Counting as Plan  # by a name that workers know, not of __main__

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--jobs", type=int)
    parser.add_argument("--ray", default="local")
    options = parser.parse_args()
    result = Plan.read(options.file).run(options.folder, jobs=options.jobs, ray=options.ray, retries=5)
    return 130 if result.interrupted else result.failed


if __name__ == "__main__":
    sys.exit(main())


PROGRAM = [sys.executable, "-c", "from ethbrake_marl.cli.app import main; main()"]


def finished(folder: Path) -> int:
    """Runs of a sweep that came to their end."""
    return sum('"status": "finished"' in file.read_text() for file in (folder / "runs").glob("*/run.json"))


def holders(folder: Path) -> dict[int, str]:
    """Processes that train in a run of this folder -> the run."""
    found = {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            targets = [os.readlink(process / "fd" / number) for number in os.listdir(process / "fd")]
        except OSError:  # ended in the meantime
            continue
        runs = [Path(each).parent.name for each in targets if each.startswith(f"{folder}/runs/")]
        found |= {int(process.name): run for run in runs}
    return found


def parent(process: int) -> int:
    """Who began a process; 0 for one that has ended in the meantime."""
    try:
        return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def works_for(process: int, driver: int) -> bool:
    """Whether a process was begun by a driver, or by a process that the driver began."""
    while process > 1 and process != driver:
        process = parent(process)
    return process == driver


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
