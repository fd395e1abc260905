"""What a sweep costs beside its jobs: 100,000 jobs of no work, and two processes that are kept busy.

    python docs/studies/sweep_overhead.py [--jobs 100000] [--busy 12] [--busy-s 20]

A job of no work goes the whole way: it is resolved and hashed, sent to a process, answered, written into the journal
and into the table. The driver's seconds and memory are those of this process. The long jobs sleep, so that the figure
is that of the scheduling, whatever else the machine does.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

import yaml

from ethbrake_marl.studies.jobs import Attempt, Job, LocalWorkers, run_jobs

NOTHING = ["0", "0", *["0.0"] * 7, ""]


def no_work(row: list[str]) -> list[str]:
    """A job of no work."""
    return row


def empty_jobs(folder: Path, jobs: int) -> None:
    """Plan and record so many jobs of no work."""
    # torch takes seconds to load, and the processes that load this file again need none
    from ethbrake_marl.studies.sweep import Row, SweepPlan

    grid = {"scenario": ["paper-random", "paper-distance"], "recipe": ["ppo", "sac"], "seed": {"count": jobs // 4}}
    file = folder / "sweep.yaml"
    file.write_text(yaml.safe_dump({"grid": grid}))
    started, before = time.monotonic(), time.process_time()

    class OfNoWork(SweepPlan):
        def job(self, row: Row, folder: Path, log: Path) -> Job:
            return Job(row.name, no_work, (NOTHING,))

    plan = OfNoWork.read(file)
    planned = time.monotonic()
    with closing(LocalWorkers(2)) as workers:
        result = plan.run(folder / "out", workers)
    wall_s, cpu_s = time.monotonic() - started, time.process_time() - before
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"{result.counts['finished']:,} jobs of no work: planned in {planned - started:.0f} s, all in {wall_s:.0f} s"
        f" ({cpu_s:.0f} s of the driver's processor time, {1000.0 * cpu_s / jobs:.2f} ms a job), peak {peak:.2f} GiB"
    )


def busy_processes(jobs: int, busy_s: float) -> None:
    """How much of the time two processes had a job; the first of each begins when the process has."""
    processes = 2
    worked_s, begun = 0.0, time.monotonic()
    first_s: list[float] = []

    def note(attempt: Attempt) -> None:
        nonlocal worked_s
        worked_s += busy_s
        first_s.append(time.monotonic() - begun - busy_s)

    started = time.monotonic()
    with closing(LocalWorkers(processes)) as workers:
        run_jobs([Job(str(k), _sleep, (busy_s,)) for k in range(jobs)], workers, note)
    wall_s = time.monotonic() - started
    ideal_s = worked_s / processes
    print(
        f"{jobs} jobs of {busy_s:g} s on {processes} processes: {wall_s:.1f} s, {100.0 * ideal_s / wall_s:.1f} % of"
        f" ideal, {(wall_s - ideal_s) / jobs:.2f} s a job; the first had begun after {first_s[0]:.1f} s"
    )


def _sleep(seconds: float) -> bool:
    time.sleep(seconds)
    return True


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=100_000)
    parser.add_argument("--busy", type=int, default=12)
    parser.add_argument("--busy-s", type=float, default=20.0)
    options = parser.parse_args()
    busy_processes(options.busy, options.busy_s)
    with tempfile.TemporaryDirectory(prefix="ethbrake-") as folder:
        empty_jobs(Path(folder), options.jobs)
    return 0


if __name__ == "__main__":
    sys.exit(main())
