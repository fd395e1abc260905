"""Jobs: told once, tried again, in processes and on Ray; and one contract for every folder of jobs."""

import operator
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import ANY, Mock

import pytest
from filelock import FileLock

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.studies import jobs
from ethbrake_marl.studies.jobs import (
    Answer,
    Attempt,
    Job,
    JobFolder,
    LocalWorkers,
    RayWorkers,
    WorkerLost,
    answer,
    run_jobs,
)
from tests.studies.conftest import TRIALS
from tests.studies.counting import Inside, journal

QUESTION = {"seed": 1, "levels": [1, 2], "versions": {"numpy": "2", "torch": "2"}}


def folder_of(path: Path, **changes: Any) -> JobFolder:
    return JobFolder(path, "sums", {**QUESTION, **changes}, more={"owner": "me"}, beside=("mine",))


def do(folder: JobFolder, *numbers: int, workers: Any = 1) -> list[str]:
    """Run ``number + 1`` for each, and give the names of those that ended well."""
    told = Mock()
    with folder.work():
        folder.run([Job(str(number), operator.add, (number, 1)) for number in numbers], workers, told)
    return [call.args[0].job.name for call in told.call_args_list if call.args[0].answer.value is not None]


@pytest.mark.parametrize("workers", [1, Inside(1)])
def test_finished_jobs__are_kept_with_what_they_gave(tmp_path: Path, workers) -> None:
    folder = folder_of(tmp_path / "new")
    assert folder.kept() == ({}, 0) and do(folder, 3, 4, workers=workers) == ["3", "4"]
    assert folder_of(tmp_path / "new").kept() == ({"3": 4, "4": 5}, 0)
    entry, _ = journal(tmp_path / "new")
    assert (entry["job"], entry["status"], entry["attempt"]) == ("3", "finished", 1) and "process" in entry["where"]


def test_failed_jobs__are_noted_with_their_reason_and_not_kept(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    with folder.work():
        folder.run([Job("bad", operator.truediv, (1, 0))], Inside(1), lambda attempt: None, retries=1)
    again, failed = journal(tmp_path)
    assert (again["status"], failed["status"]) == ("again", "failed") and "division" in failed["reason"]
    assert folder.kept() == ({}, 0)


@pytest.mark.parametrize(
    "damage",
    [lambda text: text[:-3], lambda text: text.replace('"found": 5', '"found": 6'), lambda text: text + "[]\n"],
)
def test_damaged_lines__are_counted_and_the_next_line_is_whole(tmp_path: Path, damage) -> None:
    folder, journal = folder_of(tmp_path), tmp_path / "journal.jsonl"
    do(folder, 3, 4)
    journal.write_text(damage(journal.read_text()))
    kept, damaged = folder.kept()
    assert damaged == 1 and kept["3"] == 4 and kept.get("4", 5) == 5
    do(folder, 7)
    assert folder.kept() == ({**kept, "7": 8}, 1)


def test_killed_writer__what_it_left_goes(tmp_path: Path) -> None:
    tmp_path.joinpath(".ethbrake-x.partial").write_text("half")
    with JobFolder(tmp_path, "sums").work():
        assert [file.name for file in tmp_path.iterdir() if file.name != ".lock"] == []


class Pretended(Inside):
    """Two workers that end jobs in reverse; jobs of ``lost`` lose theirs so often, ``wrong`` ones fail for good."""

    def __init__(
        self, lost: dict[int, int], wrong: set[int], stop_at: int | None = None, by: signal.Signals = signal.SIGINT
    ) -> None:
        self.lost, self.wrong, self.stop_at, self.by = dict(lost), wrong, stop_at, by
        self.running: list[int] = []
        self.begun: list[int] = []
        self.interrupted = False

    def room(self) -> int:
        return 2 - len(self.running)

    def begin(self, number: int, call: bytes) -> None:
        assert pickle.loads(call) == (operator.neg, (number,))
        self.begun.append(number)
        self.running.append(number)

    def wait(self) -> list[tuple[int, Answer]]:
        number = self.running.pop()
        if number == self.stop_at and not self.interrupted:
            self.running.append(number)
            signal.raise_signal(self.by)
            return []
        if self.lost.get(number, 0) > 0:
            self.lost[number] -= 1
            return [(number, Answer(None, WorkerLost("lost"), True))]
        if number in self.wrong:
            return [(number, Answer(None, InvalidInput("wrong")))]
        return [(number, Answer(None if self.interrupted else -number, again=self.interrupted))]

    def interrupt(self) -> None:
        self.interrupted = True


def calls(number: int) -> list[Job]:
    return [Job(str(k), operator.neg, (k,)) for k in range(number)]


def run(workers: Pretended, jobs: int = 4, retries: int = 2) -> tuple[bool, list[Attempt]]:
    attempts: list[Attempt] = []
    whole = run_jobs(calls(jobs), workers, attempts.append, retries=retries)
    return whole, attempts


def test_jobs__a_lost_one_is_tried_again_so_often_and_no_more() -> None:
    whole, attempts = run(Pretended({1: 2, 2: 9}, {3}), retries=2)
    last = {int(one.job.name): (one.attempt, one.answer.value, type(one.answer.error)) for one in attempts if one.last}
    assert whole and last == {
        0: (1, 0, type(None)),
        1: (3, -1, type(None)),
        2: (3, None, WorkerLost),
        3: (1, None, InvalidInput),  # it would be the same again
    }


class Unsendable(Exception):
    """What cannot be made again of its message."""

    def __init__(self, one: int, two: int) -> None:
        super().__init__("as one")


def raise_unsendable() -> None:
    raise Unsendable(1, 2)


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_jobs__a_signal_asks_those_that_run_to_end_and_begins_no_other(by: signal.Signals) -> None:
    workers = Pretended({}, set(), stop_at=2, by=by)
    whole, attempts = run(workers, jobs=6)
    assert not whole and workers.interrupted and workers.running == []
    assert workers.begun == [0, 1, 2] and [one.job.name for one in attempts] == ["1"]


def test_jobs__ctrl_c_while_one_is_begun_waits_for_it() -> None:
    class Interrupted(Pretended):
        def room(self) -> int:
            return 1 - len(self.begun)

        def begin(self, number: int, call: bytes) -> None:
            signal.raise_signal(signal.SIGINT)  # a process that is half begun would be waited for without end
            super().begin(number, call)

    before, workers = signal.getsignal(signal.SIGINT), Interrupted({}, set())
    whole, attempts = run(workers)
    assert not whole and [int(one.job.name) for one in attempts] == workers.begun == [0] and workers.running == []
    assert signal.getsignal(signal.SIGINT) is before


def test_jobs__an_error_of_who_is_told_stops_them() -> None:
    workers = Pretended({}, set())
    with pytest.raises(OSError, match="disk full"):
        run_jobs(calls(4), workers, Mock(side_effect=OSError("disk full")))
    assert workers.interrupted and workers.running == []


@pytest.mark.parametrize(
    ("call", "error", "again"),
    [
        ((operator.add, (2, 3)), type(None), False),
        ((check_whole_number, ("seed", -1, 0)), InvalidInput, False),
        ((os.stat, ("/nowhere",)), FileNotFoundError, True),
        ((raise_unsendable, ()), RuntimeError, True),
    ],
)
def test_answer__an_error_of_this_package_lasts_and_any_other_may_not(call: Any, error: type, again: bool) -> None:
    found = answer(pickle.dumps(call), [])
    assert (type(found.error), found.again, found.value) == (error, again, 5 if error is type(None) else None)


def test_processes__have_one_thread_each_and_a_lost_one_is_replaced() -> None:
    work = [(os.getenv, "OMP_NUM_THREADS"), (os._exit, 3), (os.getpid,), (signal.raise_signal, 9)]
    jobs = [Job(str(k), function, tuple(given)) for k, (function, *given) in enumerate(work)]
    attempts: list[Attempt] = []
    before = os.environ.get("OMP_NUM_THREADS")
    with closing(LocalWorkers(2)) as workers:
        assert run_jobs(jobs, workers, attempts.append, retries=0)
    last = {int(one.job.name): one.answer for one in attempts if one.last}
    assert last[0].value == "1" and os.environ.get("OMP_NUM_THREADS") == before
    assert str(last[1].error) == "the worker ended with status 3 in the middle of the job"
    assert last[2].value != os.getpid() and f"process {last[2].value}" in last[2].where
    assert str(last[3].error) == "the worker was killed by signal 9 in the middle of the job"
    assert sorted(int(one.job.name) for one in attempts) == [0, 1, 2, 3]


ROOT = Path(__file__).resolve().parents[2]


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


class PretendedRay(Mock):
    """One core; ``lost`` jobs are lost once, ``refused`` ones cannot be loaded."""

    class RayError(Exception):
        pass

    class RayTaskError(RayError):
        cause = ImportError("no module")

    class Never(Exception):
        pass

    def remote(self, **options: object):
        assert options["max_retries"] == 0 and options["num_cpus"] == 1
        return lambda function: SimpleNamespace(remote=partial(partial, function))

    def wait(self, references, **options: object):
        return references[:1], references[1:]

    def get(self, reference):
        answer = reference()
        number = abs(answer.value)
        if number in self.lost:
            self.lost.discard(number)
            raise self.RayError
        if number in self.refused:
            raise self.RayTaskError
        return answer


def test_ray__lost_jobs_are_tried_again_by_us_and_refused_ones_are_not(monkeypatch):
    ray = PretendedRay(lost={2}, refused={3})
    never = dict.fromkeys(("RuntimeEnvSetupError", "AuthenticationError"), ray.Never)
    ray.exceptions = SimpleNamespace(RayError=ray.RayError, RayTaskError=ray.RayTaskError, **never)
    ray.cluster_resources.return_value = {"CPU": 1.0}
    monkeypatch.setattr(jobs, "_connect", lambda address, number: ray)
    workers, attempts = RayWorkers("10.0.0.1:6379"), list[Attempt]()
    assert workers.room() == 2  # one runs, one waits
    assert run_jobs(calls(5), workers, attempts.append)
    last = {int(one.job.name): one for one in attempts if one.last}
    assert {number: one.answer.value for number, one in last.items()} == {0: 0, 1: -1, 2: -2, 3: None, 4: -4}
    assert last[2].attempt == 2 and type(attempts[2].answer.error) is WorkerLost
    assert isinstance(last[3].answer.error, InvalidInput) and "no module" in str(last[3].answer.error)
    workers.begin(9, pickle.dumps((operator.neg, (9,))))
    workers.interrupt()
    workers.close()
    ray.cancel.assert_called_once_with(ANY, force=False)
    ray.shutdown.assert_called_once_with()


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


# ---------------------------------------------------------------- one contract for every folder


class Study(NamedTuple):
    """A command, the folder of its finished work, one with other settings, its refusal, and where they are kept."""

    line: tuple[object, ...]
    folder: Path
    other: tuple[object, ...] = ()
    told: str = ""
    record: str = ""


STUDIES: dict[str, Callable[[Callable[[str], Any]], Study]] = {
    "tuning": lambda get: Study(
        ("study", "tune", get("finished_tuning").parent / "tuning.yaml", "--trials", TRIALS),
        get("finished_tuning"),
        ("study", "tune", get("write_tuning")(seed=1), "--trials", TRIALS),
        "holds a tuning with other settings",
        "tuning.json",
    ),
    "sweep": lambda get: Study(
        ("study", "sweep", get("finished_sweep").parent / "sweep.yaml", "--jobs", "1"), get("finished_sweep")
    ),
}  # fmt: skip


@pytest.fixture(params=STUDIES)
def study(request: pytest.FixtureRequest) -> Study:
    """Each of them."""
    return STUDIES[request.param](request.getfixturevalue)


def files_in(folder: Path, but: str) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != but}


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Call it with a folder, a command line and its exit status: what it says; the folder stays as it is.

    Files named ``but`` may change.
    """

    def call(folder: Path, *line: object, status: int = 2, but: str = "") -> str:
        before = files_in(folder, but)
        capsys.readouterr()
        assert run_command([*map(str, line), "--output", str(folder)]) == status
        assert files_in(folder, but) == before
        return "\n".join(capsys.readouterr())

    return call


def test_other_settings__are_refused_with_what_differs(study: Study, told) -> None:
    assert not study.other or study.told in told(study.folder, *study.other)


def test_folder_of_something_else__is_left_alone(study: Study, told, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    assert "is a file; give a folder" in told(tmp_path / "mine" / "thesis.tex", *study.line)


def test_second_process__is_refused(study: Study, told, tmp_path: Path) -> None:
    shutil.copytree(study.folder, tmp_path / "copy")
    with FileLock(tmp_path / "copy" / ".lock"):
        assert "another process works in it" in told(tmp_path / "copy", *study.line)


def test_damaged_record__is_named(study: Study, told, tmp_path: Path) -> None:
    if study.record:
        shutil.copytree(study.folder, tmp_path / "copy")
        (tmp_path / "copy" / study.record).write_text("[]")
        assert f"{study.record}: is damaged" in told(tmp_path / "copy", *study.line)


@pytest.mark.parametrize(
    ("study", "file", "damage", "message"),
    [
        ("tuning", "tuning.json", ('"torch": "2.', '"torch": "1.'), "other settings (versions torch 1."),
        ("tuning", "study.journal", ('{"op_code":0', '{"op_kode":0'), "cannot be used"),
        ("tuning", "study.journal", ('{"op_code":0', "\x00"), "cannot be used"),
        ("tuning", "study.journal", ('"results":"[', '"results":"{'), "trial 0 is damaged"),
        ("tuning", "study.journal", ('"results":"[', '"results":7,"x":"['), "cannot be used"),
    ],
    indirect=["study"],
)
def test_damaged_file__is_named_in_one_line_before_anything_is_done(
    study: Study, file: str, damage: tuple[str, str] | None, message: str, told, tmp_path: Path
) -> None:
    damaged = Path(shutil.copytree(study.folder, tmp_path / "copy")) / file
    text = damaged.read_text()
    damaged.unlink()
    if damage is not None:
        assert damage[0] in text
        damaged.write_text(text.replace(*damage))
    said = told(tmp_path / "copy", *study.line, but=damaged.name)
    assert message in said and said.count("\n") == 2


@pytest.mark.parametrize(
    ("study", "copied", "options", "patterns"),
    [
        ("sweep", True, ["--dry-run", "--json"], ['(?s)("state": "finished".*){4}', '"decisions_left": 0,']),
        (
            "sweep",
            False,
            ["--dry-run"],
            [
                r"^(new +paper-random-tiny-seed\d-\w+  gamma=\S+\n){4}",
                "seed3-.* gamma=0.9\n",
                "to do: 4 jobs, 1,024 dec",
            ],
        ),
        (
            "tuning",
            False,
            ["--dry-run", "--jobs", "2"],
            ["\nn_epochs  from 1 to 4, whole  \\(the recipe has 2\\)\n", f"{TRIALS} trials of 512 decisions: about"],
        ),
        ("tuning", False, ["--dry-run", "--json"], ['"n_epochs": 2,', r'"core_s_per_trial": (?!0\.0\b)\d']),
    ],
    indirect=["study"],
)
def test_cost__is_told_and_nothing_is_made(
    study: Study, copied: bool, options: list[str], patterns: list[str], told, tmp_path: Path
) -> None:
    folder = tmp_path / "there"
    if copied:
        shutil.copytree(study.folder, folder)
    said = told(folder, *study.line, *options, status=0)
    assert [each for each in patterns if not re.search(each, said)] == [] and folder.exists() == copied
