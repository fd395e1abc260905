"""A job that trains nothing, for measuring and disturbing the machinery around it, and the command that sweeps it.

It makes so many steps, each a hash of the one before, keeps a checkpoint of each as a training does, and sleeps in
between, so that many of them disturb nobody.

    python -m tests.studies.sweep.counting SWEEP.yaml FOLDER [--jobs N] [--ray ADDRESS] [--steps K] [--sleep S]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from contextlib import closing
from pathlib import Path

from filelock import FileLock

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
    from tests.studies.sweep.counting import count as job  # by a name that workers know, not of __main__

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
