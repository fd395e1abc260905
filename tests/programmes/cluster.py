"""A sweep on a Ray cluster of two nodes on this machine, while its workers and once its driver are killed.

A job either only counts, with a checkpoint at every step (200 jobs take two minutes), or trains a tiny policy (half an
hour on two cores, mostly for loading torch after each kill). The table of results must equal the table of an
undisturbed sweep, byte for byte. No job may be lost or run twice.
"""

import os
import random
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from functools import partial
from pathlib import Path

import yaml

from tests.extensions.studies.conftest import RECIPE
from tests.extensions.studies.counting import PROGRAM, finished, holders
from tests.programmes import Cases, Given, Told

WORK = {
    "counting": ([sys.executable, "-m", "tests.extensions.studies.counting"], []),
    "training": ([*PROGRAM, "study", "sweep"], ["--retries", "5", "--output"]),
}
NODES = 2  # nodes, with one core each
LONGEST_S = 3600.0


def write_sweep(folder: Path, jobs: int) -> Path:
    recipe, path = folder / "tiny.yaml", folder / "sweep.yaml"
    recipe.write_text(yaml.safe_dump(RECIPE))
    grid = {"scenario": "paper-random", "recipe": str(recipe), "seed": {"count": jobs}}
    path.write_text(yaml.safe_dump({"grid": grid}))
    return path


def disturb(
    driver: subprocess.Popen[bytes], out: Path, hits: dict[str, int], wanted: int, chance: random.Random, ends_at: int
) -> int:
    """Kill workers at random times, until ``wanted`` jobs were hit once. Return the driver's exit status.

    The driver is killed when ``ends_at`` jobs are finished.
    """
    seen: dict[str, float] = {}  # job -> time at which its worker is killed
    end = time.monotonic() + LONGEST_S
    while driver.poll() is None and time.monotonic() < end:
        now = time.monotonic()
        for process, job in holders(out).items():
            if job not in seen:
                seen[job] = now + chance.uniform(0.0, 0.5) if chance.random() < 0.5 else float("inf")
            if job not in hits and len(hits) < wanted and now >= seen[job]:
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
                    hits[job] = process
        if finished(out) >= ends_at:
            driver.kill()
        time.sleep(0.02)
    driver.kill()
    return driver.wait()


def run(folder: Path, given: Given) -> Told:
    """Run the sweep undisturbed with local processes, then disturbed on the cluster, and compare the tables."""
    import ray
    from ray.cluster_utils import Cluster

    jobs, out, wanted = given.jobs, folder / "cluster", round(given.share * given.jobs)
    file = write_sweep(folder, jobs)
    started = time.monotonic()
    program, options = WORK[given.work]
    subprocess.run([*program, str(file), *options, str(folder / "local"), "--jobs", "2"], check=True)
    print(f"undisturbed, a Ray of this machine: {time.monotonic() - started:.0f} s", flush=True)
    node = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 100 << 20}
    cluster = Cluster(initialize_head=True, head_node_args=node)
    for _ in range(NODES - 1):
        cluster.add_node(num_cpus=1, object_store_memory=100 << 20)
    command = [*program, str(file), *options, str(out), "--ray", cluster.address]
    hits: dict[str, int] = {}
    chance, started = random.Random(given.seed), time.monotonic()
    try:
        killed = disturb(subprocess.Popen(command), out, hits, wanted, chance, jobs // 2)
        told = f"driver killed by signal {-killed} after {finished(out)} jobs"
        status = disturb(subprocess.Popen(command), out, hits, wanted, chance, jobs + 1)
    finally:
        ray.shutdown()
        cluster.shutdown()
    same = (out / "results.csv").read_bytes() == (folder / "local" / "results.csv").read_bytes()
    ends = [len(file.read_text().splitlines()) for file in out.glob("runs/*/ends")]  # of counting
    lost, doubled = jobs - finished(out), sum(number > 1 for number in ends)
    return Told(
        same and not lost and not doubled and status == 0 and len(hits) == wanted,
        f"{NODES} raylets: {len(hits)} jobs hit, {told}, {time.monotonic() - started:.0f} s;"
        f" lost {lost}, run twice {doubled}; table {'equal, byte for byte' if same else 'DIFFERENT'}",
    )


OPTIONS = {
    "--jobs": {"type": int, "default": 200},
    "--share": {"type": float, "default": 0.2},
    "--seed": {"type": int, "default": 0},
    "--work": {"choices": list(WORK), "default": "counting"},
}


def cases(given: Given) -> Cases:
    # These must be set before Ray is loaded: both nodes have the address 127.0.0.1, and every connection needs a token.
    os.environ |= {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0", "RAY_AUTH_MODE": "token", "RAY_USAGE_STATS_ENABLED": "0"}
    os.environ |= {"RAY_AUTH_TOKEN": secrets.token_hex(32), "PYTHONPATH": os.getcwd()}
    with tempfile.TemporaryDirectory(prefix="ethbrake-") as folder:
        yield f"{given.jobs} jobs, {given.work}", partial(run, Path(folder), given)
