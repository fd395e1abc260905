"""Jobs on Ray: a pretended one for what the machinery does with it, and a real one where it is installed."""

from __future__ import annotations

import operator
import os
import pickle
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.studies import jobs
from ethbrake_marl.studies.jobs import Attempt, Job, RayWorkers, WorkerLost, run_jobs

ROOT = Path(__file__).resolve().parents[3]

# The sockets on which the processes of a local Ray listen, by their addresses in hexadecimal digits.
LISTENING = """
import os
from contextlib import closing
from pathlib import Path
from ethbrake_marl.studies.jobs import Job, RayWorkers, run_jobs

before = {line.split()[9] for kind in ("tcp", "tcp6") for line in Path("/proc/net", kind).read_text().splitlines()[1:]}
found = []
with closing(RayWorkers("local", 2)) as workers:
    calls = [Job(name, os.getenv, ("OMP_NUM_THREADS",)) for name in "ab"]
    run_jobs(calls, workers, lambda one: found.append(one.answer.value))
    for kind in ("tcp", "tcp6"):
        for line in Path("/proc/net", kind).read_text().splitlines()[1:]:
            parts = line.split()
            if parts[3] == "0A" and parts[9] not in before:
                print("listens", parts[1].partition(":")[0], parts[1].endswith(":2051"))
print("threads", *found)
"""


class PretendedRay:
    """One core; ``lost`` jobs are lost once, ``refused`` ones cannot be loaded."""

    class RayError(Exception):
        pass

    class RayTaskError(RayError):
        cause = ImportError("no module")

    def __init__(self, lost: set[int], refused: set[int]) -> None:
        self.lost, self.refused, self.ended, self.cancelled = set(lost), refused, False, 0
        self.exceptions = SimpleNamespace(
            RayError=self.RayError,
            RayTaskError=self.RayTaskError,
            RuntimeEnvSetupError=_Never,
            AuthenticationError=_Never,
        )

    def remote(self, **options: object):
        assert options["max_retries"] == 0 and options["num_cpus"] == 1
        return lambda function: SimpleNamespace(remote=lambda *given: _Reference(function, given))

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 1.0}

    def wait(self, references, **options: object):
        return references[:1], references[1:]

    def get(self, reference):
        answer = reference.function(*reference.given)
        number = abs(answer.value)
        if number in self.lost:
            self.lost.discard(number)
            raise self.RayError
        if number in self.refused:
            raise self.RayTaskError
        return answer

    def cancel(self, reference, force: bool) -> None:
        assert not force
        self.cancelled += 1

    def shutdown(self) -> None:
        self.ended = True


class _Never(Exception):
    pass


class _Reference:
    def __init__(self, function, given) -> None:
        self.function, self.given = function, given


def test_ray__lost_jobs_are_tried_again_by_us_and_refused_ones_are_not(monkeypatch):
    ray = PretendedRay({2}, {3})
    monkeypatch.setattr(jobs, "_connect", lambda address, number: ray)
    workers = RayWorkers("10.0.0.1:6379")
    attempts: list[Attempt] = []
    assert workers.room() == 2  # one runs, one waits
    assert run_jobs([Job(str(k), operator.neg, (k,)) for k in range(5)], workers, attempts.append)
    last = {int(one.job.name): one for one in attempts if one.last}
    assert {number: one.answer.value for number, one in last.items()} == {0: 0, 1: -1, 2: -2, 3: None, 4: -4}
    assert last[2].attempt == 2 and type(attempts[2].answer.error) is WorkerLost
    assert isinstance(last[3].answer.error, InvalidInput) and "no module" in str(last[3].answer.error)
    workers.begin(9, pickle.dumps((operator.neg, (9,))))
    workers.interrupt()
    workers.close()
    assert (ray.cancelled, ray.ended) == (1, True)


def test_ray__is_an_extra(monkeypatch, write_sweep, small, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    command = ["study", "sweep", str(write_sweep(**small)), "--output", str(tmp_path / "out"), "--ray", "local"]
    assert run_command(command) == 2
    assert "needs the package ray" in (told := capsys.readouterr().err) and "ethbrake-marl[cluster]" in told
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_local_ray__listens_on_loopback_alone_and_has_no_dashboard():
    pytest.importorskip("ray")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    told = subprocess.run(
        [sys.executable, "-c", LISTENING], env=environment, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    listens = [line for line in told if line.startswith("listens")]
    assert listens and set(listens) <= {
        "listens 0100007F False", "listens 0000000000000000FFFF00000100007F False"
    }  # fmt: skip
    assert told[-1] == "threads 1 1"


@pytest.mark.long
@pytest.mark.parametrize(("work", "number"), [("counting", 60), ("training", 8)])
def test_cluster__of_two_nodes_whose_workers_are_killed_makes_the_same_table(work, number):
    pytest.importorskip("ray")
    command = [sys.executable, "-m", "tests.programmes", "cluster", "--jobs", str(number), "--work", work]
    assert subprocess.run(command, cwd=ROOT, timeout=3600, check=False).returncode == 0
