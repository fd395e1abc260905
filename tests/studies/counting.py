"""A job that trains nothing, for measuring and disturbing the machinery around it, and the command that sweeps it.

It makes so many steps, each a hash of the one before, keeps a checkpoint of each as a training does, and sleeps in
between, so that many of them disturb nobody.

    python -m tests.studies.counting SWEEP.yaml FOLDER [--jobs N] [--ray ADDRESS] [--steps K] [--sleep S]
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
from contextlib import closing
from pathlib import Path
from typing import Any

from filelock import FileLock

from ethbrake_marl.studies.jobs import Answer, answer

ROOT = Path(__file__).resolve().parents[2]
RESULTS = 10  # values of a row


def count(folder: Path, seed: int, steps: int, sleep_s: float) -> list[str]:
    """The row of a job."""
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / "run.lock", timeout=60.0):
        checkpoint = folder / "checkpoint.json"
        done, text = json.loads(checkpoint.read_text()) if checkpoint.exists() else (0, str(seed))
        while done < steps:
            time.sleep(sleep_s)
            done, text = done + 1, hashlib.sha256(text.encode()).hexdigest()
            (folder / "new.json").write_text(json.dumps([done, text]))
            os.replace(folder / "new.json", checkpoint)
        (folder / "policy").mkdir(exist_ok=True)
        for name in ("manifest.json", "weights.safetensors"):
            (folder / "policy" / name).touch()
        (folder / "run.json").write_text("{}")
    return [str(steps), str(seed), *["0.0"] * (RESULTS - 3), text]


def main() -> int:
    from ethbrake_marl.studies.jobs import Job, LocalWorkers, RayWorkers
    from ethbrake_marl.studies.sweep import RUNS, Row, SweepPlan
    from tests.studies.counting import count as job  # by a name that workers know, not of __main__

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--ray")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--sleep", type=float, default=0.01)
    options = parser.parse_args()

    class Counting(SweepPlan):
        def job(self, row: Row, folder: Path, log: Path) -> Job:
            place = folder.absolute() / RUNS / row.name
            return Job(row.name, job, (place, row.asked.seed, options.steps, options.sleep))

    plan = Counting.read(options.file)
    workers = LocalWorkers(options.jobs) if options.ray is None else RayWorkers(options.ray)
    with closing(workers):
        result = plan.run(options.folder, workers, retries=5)
    return 130 if result.interrupted else result.counts["failed"]


if __name__ == "__main__":
    sys.exit(main())


PROGRAM = [sys.executable, "-c", "from ethbrake_marl.cli.app import main; main()"]


def journal(folder: Path) -> list[dict[str, Any]]:
    """The lines of a sweep's journal that are whole."""
    path = folder / "journal.jsonl"
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    return [json.loads(line) for line in lines if line.endswith("}\n")]


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


class Inside:
    """Takes the place of ``LocalWorkers``: a job at a time, done in this process when it is waited for."""

    def __init__(self, number: int) -> None:
        self.begun: list[tuple[int, bytes]] = []

    def room(self) -> int:
        return 1 - len(self.begun)

    def begin(self, number: int, call: bytes) -> None:
        self.begun.append((number, call))

    def wait(self) -> list[tuple[int, Answer]]:
        number, call = self.begun.pop()
        return [(number, answer(call, []))]

    def interrupt(self) -> None: ...

    def close(self) -> None: ...
