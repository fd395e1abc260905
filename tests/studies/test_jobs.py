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
from dataclasses import replace
from functools import partial
from multiprocessing import active_children
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import ANY, Mock

import numpy as np
import pytest
from filelock import FileLock

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.evaluation.measures import Tally
from ethbrake_marl.evaluation.results import Question
from ethbrake_marl.scenario import Scenario
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
    evaluate_shards,
    run_jobs,
)
from tests.studies.conftest import ABLATE, TRIALS
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


def kept_by(folder: Path) -> int:
    """How many shards the folder keeps."""
    return len([one for one in journal(folder) if one["status"] == "finished"])


def killed(asked: Question, folder: Path, after: int, shards: int, **more) -> None:
    """Let an evaluation be killed when so many shards are finished."""

    def tell(progress) -> None:
        if kept_by(folder) == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate_shards(asked, shards=shards, folder=folder, tell=tell, **more)


def test_shards__killed_go_on_with_what_is_left_and_damaged_ones_are_driven_again(
    asked, tally, driven, tmp_path
) -> None:
    folder, told = tmp_path / "kept", []

    def ranges(**more) -> list[tuple[int, int]]:
        driven.clear()
        assert evaluate_shards(asked, shards=4, folder=folder, **more) == tally
        return [*driven]

    killed(asked, folder, 2, shards=4)
    assert driven == [(0, 1_000), (1_000, 2_000)]
    assert ranges() == [(2_000, 3_000), (3_000, 4_500)] and ranges() == []
    with pytest.raises(InvalidInput, match="rows False, here True; shards 4, here 3"):
        evaluate_shards(asked, shards=3, folder=folder, with_rows=True)
    lines = folder / "journal.jsonl"
    lines.write_text(lines.read_text().replace('"worlds": 1000', '"worlds": 1001', 1))
    assert ranges(tell=told.append) == [(0, 1_000)] and "1 finished shard damaged" in told[0].note
    evaluate_shards(asked, shards=1, folder=tmp_path / "one")
    lines.write_text(lines.read_text() + (tmp_path / "one" / "journal.jsonl").read_text())
    assert ranges() == []  # no world counts twice


@pytest.mark.slow
def test_shards__their_processes_are_ended_where_one_fails_or_on_ctrl_c(asked, tmp_path: Path) -> None:
    changed = replace(asked, identity={**asked.identity, "seed": 12})
    with pytest.raises(InvalidInput, match="seed changed since the evaluation began"):
        evaluate_shards(changed, shards=4, jobs=2)

    def stop(progress) -> None:
        if progress.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate_shards(asked, shards=4, jobs=2, folder=tmp_path / "kept", tell=stop)
    assert 1 <= kept_by(tmp_path / "kept") < 4 and not active_children()


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


N = 4_500


@pytest.fixture(scope="module")
def asked(paper_random: Scenario) -> Question:
    return Question(paper_random, ("full_brake", "coast"), N, 11).ask()


@pytest.fixture(scope="module")
def tally(asked: Question) -> Tally:
    return evaluate_shards(asked, shards=1)


@pytest.fixture
def driven(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The ranges of worlds that are driven from now on."""
    found: list[tuple[int, int]] = []
    answer = Question.answer

    def noted(asked, first, end, *more):
        found.append((first, end))
        return answer(asked, first, end, *more)

    monkeypatch.setattr(Question, "answer", noted)
    return found


def test_rows__are_the_same_for_any_shards_and_those_of_killed_shards_go(asked, tally, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    tables = []
    for shards in (1, 4):
        folder = tmp_path / str(shards)
        if shards == 4:
            killed(asked, folder, 2, shards, with_rows=True)
            (folder / "worlds-0000000002000-0000000004500.parquet").write_bytes(b"half")
        assert evaluate_shards(asked, shards=shards, folder=folder, with_rows=True, block=1_000 * shards) == tally
        files = sorted(folder.glob("worlds-*.parquet"))
        assert len(files) == shards
        tables.append([row for file in files for row in parquet.read_table(file).to_pylist()])
    assert tables[0] == tables[1]
    order = [(row["world"], row["agent"]) for row in tables[0]]
    assert order == [(world, agent) for world in range(N) for agent in ("full_brake", "coast")]
    harm = np.mean([row["total_harm"] for row in tables[0] if row["agent"] == "full_brake"])
    assert harm == pytest.approx(tally.agents["full_brake"].moments["total_harm"].mean, rel=1e-12)
    damaged = tmp_path / "1" / "worlds-0000000000000-0000000004500.parquet"
    damaged.write_bytes(b"")
    assert evaluate_shards(asked, shards=1, folder=tmp_path / "1", with_rows=True) == tally  # driven again
    assert parquet.read_table(damaged).num_rows == 2 * N


# ---------------------------------------------------------------- one contract for every folder


class Study(NamedTuple):
    """A command, the folder of its finished work, one with other settings, its refusal, and where they are kept."""

    line: tuple[object, ...]
    folder: Path
    other: tuple[object, ...] = ()
    told: str = ""
    record: str = ""


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders of a sharded evaluation and of a reproduction; not to be changed."""
    folder = tmp_path_factory.mktemp("done")
    assert run_command(["evaluate", *SHARDS, "--output", str(folder / "shards")]) == 0
    assert run_command([*REPRODUCE, "--output", str(folder / "reproduction")]) == 0
    return folder


REPRODUCE = ("reproduce", "learning-low", "--episodes", "20")
SHARDS = ("--agents", "coast", "--episodes", "20", "--shards", "2")


STUDIES: dict[str, Callable[[Callable[[str], Any]], Study]] = {
    "shards": lambda get: Study(
        ("evaluate", *SHARDS),
        get("done") / "shards",
        ("evaluate", *SHARDS, "--seed", "8"),
        "holds shards with other settings (seed 7, here 8)",
        "question.json",
    ),
    "reproduction": lambda get: Study(
        REPRODUCE, get("done") / "reproduction", (*REPRODUCE, "--episodes", "50"), "(episodes 20, here 50)",
        "reproduction.json",
    ),
    "ablation": lambda get: Study(
        ("study", "ablate", "--recipes", get("tiny_total"), *ABLATE),
        get("finished_ablation"),
        ("study", "ablate", "--recipes", get("tiny_total"), *ABLATE, "--budget", "60", "--seeds", "3"),
        "(seeds 2, here 3; budget 50, here 60)",
        "settings.json",
    ),
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
    if study.line[0] != "study":  # a study's own files stand beside what is there
        assert "holds no" in told(tmp_path / "mine", *study.line)


def test_second_process__is_refused(study: Study, told, tmp_path: Path) -> None:
    shutil.copytree(study.folder, tmp_path / "copy")
    if study.line[0] == "evaluate":  # which looks at what is finished first
        (tmp_path / "copy" / "journal.jsonl").unlink()
    with FileLock(tmp_path / "copy" / ".lock"):
        assert "another process works in it" in told(tmp_path / "copy", *study.line)


def test_damaged_record__is_named(study: Study, told, tmp_path: Path) -> None:
    if study.record:
        shutil.copytree(study.folder, tmp_path / "copy")
        (tmp_path / "copy" / study.record).write_text("[]")
        assert f"{study.record}: is damaged" in told(tmp_path / "copy", *study.line)


LAST = "trainings/cooperation-3-congested-tiny-shared-seed1"


@pytest.mark.parametrize(
    ("study", "file", "damage", "message"),
    [
        ("tuning", "tuning.json", ('"torch": "2.', '"torch": "1.'), "other settings (versions torch 1."),
        ("tuning", "proposals.json", ('"trials"', '"trails"'), "proposals.json: is damaged"),
        ("tuning", "proposals.json", ('"n_epochs": 2', '"n_epochs": 5'), "proposals.json: is damaged"),
        ("tuning", "proposals.json", ('"n_epochs": 2', '"n_epoch": 2'), "proposals.json: is damaged"),
        ("ablation", f"{LAST}/run.json", ("{", "["), "run.json: is damaged"),
        ("ablation", f"{LAST}/config.json", ("{", "["), "config.json: is damaged"),
        (
            "ablation",
            f"{LAST}/config.json",
            ('"total_steps": 256', '"total_steps": 512'),
            "holds another training (here other: recipe total_steps); give another folder",
        ),
        ("ablation", f"{LAST}/run.json", None, "is no training"),
        ("ablation", f"{LAST}/team.json", ('"scheme"', '"shceme"'), "team.json"),
        ("ablation", f"{LAST}/policy/manifest.json", ("{", "{}"), "manifest.json"),
    ],
    indirect=["study"],
)
def test_damaged_file__is_named_in_one_line_before_anything_is_done(
    study: Study, file: str, damage: tuple[str, str] | None, message: str, told, tmp_path: Path
) -> None:
    """Of an ablation a joint optimum and a training are left to be made, which come before it."""
    damaged = Path(shutil.copytree(study.folder, tmp_path / "copy")) / file
    for other in (tmp_path / "copy" / "optimum", damaged.parents[1] / "cooperation-3-pair-tiny-shared-seed0"):
        shutil.rmtree(other, ignore_errors=True)
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
        (
            "ablation",
            True,
            ["--cost"],
            ["to do: 0 trainings, 0 decisions: 0 s; joint", "npz: is damaged; its worlds are"],
        ),
        ("ablation", True, ["--seeds", "3", "--cost"], ["to do: 2 trainings, 512 decisions at"]),
        ("ablation", False, ["--seeds", "1", "--cost"], ["to do: 2 trainings, 512 decisions at"]),
        ("sweep", True, ["--dry-run", "--json"], ['(?s)("state": "finished".*){4}']),
        (
            "sweep",
            False,
            ["--dry-run"],
            [r"^(new +paper-random-tiny-seed\d-\w+  gamma=\S+\n){4}", "seed3-.* gamma=0.9\n"],
        ),
        ("tuning", False, ["--dry-run", "--jobs", "2"], ["\nn_epochs  from 1 to 4, whole  \\(the recipe has 2\\)\n"]),
        ("tuning", False, ["--dry-run", "--json"], ['"n_epochs": 2,', f'"trials": {TRIALS}']),
    ],
    indirect=["study"],
)
def test_cost__is_told_and_nothing_is_made(
    study: Study, copied: bool, options: list[str], patterns: list[str], told, tmp_path: Path
) -> None:
    folder = tmp_path / "there"
    if copied:
        shutil.copytree(study.folder, folder)
    for damaged in [*folder.glob("optimum/*/*.npz")][:1]:
        damaged.write_bytes(b"no table")
    said = told(folder, *study.line, *options, status=0)
    assert [each for each in patterns if not re.search(each, said)] == [] and folder.exists() == copied
