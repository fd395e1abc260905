"""Running jobs: the order, further attempts, an end by Ctrl-C, and processes that are lost."""

from __future__ import annotations

import operator
import os
import pickle
import signal
from contextlib import closing

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.studies.jobs import Answer, Attempt, Job, LocalWorkers, WorkerLost, answer, run_jobs


class Pretended:
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

    def close(self) -> None:
        pass


def calls(number: int) -> list[Job]:
    return [Job(str(k), operator.neg, (k,)) for k in range(number)]


def run(workers: Pretended, jobs: int = 4, retries: int = 2) -> tuple[bool, list[Attempt]]:
    attempts: list[Attempt] = []
    whole = run_jobs(calls(jobs), workers, attempts.append, retries=retries)
    return whole, attempts


def test_jobs__each_ends_once() -> None:
    whole, attempts = run(Pretended({}, set()))
    assert whole and all(one.last and one.attempt == 1 for one in attempts)
    assert sorted((int(one.job.name), one.answer.value) for one in attempts) == [(0, 0), (1, -1), (2, -2), (3, -3)]


def test_jobs__a_lost_one_is_tried_again_so_often_and_no_more() -> None:
    whole, attempts = run(Pretended({1: 2, 2: 9}, {3}), retries=2)
    last = {int(one.job.name): one for one in attempts if one.last}
    assert whole and len(last) == 4
    assert (last[1].attempt, last[1].answer.value) == (3, -1)
    assert (last[2].attempt, type(last[2].answer.error)) == (3, WorkerLost)
    assert (last[3].attempt, type(last[3].answer.error)) == (1, InvalidInput)  # it would be the same again


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_jobs__a_signal_asks_those_that_run_to_end_and_begins_no_other(by: signal.Signals) -> None:
    workers = Pretended({}, set(), stop_at=2, by=by)
    whole, attempts = run(workers, jobs=6)
    assert not whole and workers.interrupted and workers.running == []
    assert workers.begun == [0, 1, 2] and [one.job.name for one in attempts] == ["1"]


def test_jobs__ctrl_c_while_one_is_begun_waits_for_it() -> None:
    class Interrupted(Pretended):
        def begin(self, number: int, call: bytes) -> None:
            signal.raise_signal(signal.SIGINT)  # a process that is half begun would be waited for without end
            super().begin(number, call)

    before = signal.getsignal(signal.SIGINT)
    workers = Interrupted({}, set())
    workers.room = lambda: 1 - len(workers.begun)  # type: ignore[method-assign]
    whole, attempts = run(workers)
    assert not whole and [int(one.job.name) for one in attempts] == workers.begun == [0] and workers.running == []
    assert signal.getsignal(signal.SIGINT) is before


def test_jobs__an_error_of_who_is_told_stops_them() -> None:
    def refuse(attempt: Attempt) -> None:
        raise OSError("disk full")

    workers = Pretended({}, set())
    with pytest.raises(OSError, match="disk full"):
        run_jobs(calls(4), workers, refuse)
    assert workers.interrupted and workers.running == []


def test_answer__an_error_of_this_package_lasts_and_any_other_may_not() -> None:
    assert answer(pickle.dumps((operator.add, (2, 3))), ()).value == 5
    lasting, passing = (answer(pickle.dumps((_raise, (error,))), ()) for error in (InvalidInput("x"), OSError("y")))
    assert (type(lasting.error), lasting.again) == (InvalidInput, False)
    assert (type(passing.error), passing.again) == (OSError, True)
    assert type(answer(pickle.dumps((_raise_unsendable, ())), ()).error) is RuntimeError


def _raise(error: Exception) -> None:
    raise error


def _raise_unsendable() -> None:
    raise _Unsendable(1, 2)


class _Unsendable(Exception):
    def __init__(self, one: int, two: int) -> None:
        super().__init__("as one")


def test_processes__have_one_thread_each_and_a_lost_one_is_replaced() -> None:
    work = [(os.getenv, "OMP_NUM_THREADS"), (os._exit, 3), (os.getpid,), (signal.raise_signal, 9)]
    jobs = [Job(str(k), function, tuple(given)) for k, (function, *given) in enumerate(work)]
    attempts: list[Attempt] = []
    before = os.environ.get("OMP_NUM_THREADS")
    with closing(LocalWorkers(2)) as workers:
        assert run_jobs(jobs, workers, attempts.append, retries=1)
    last = {int(one.job.name): one.answer for one in attempts if one.last}
    assert last[0].value == "1" and os.environ.get("OMP_NUM_THREADS") == before
    assert str(last[1].error) == "the worker ended with status 3 in the middle of the job"
    assert last[2].value != os.getpid() and f"process {last[2].value}" in last[2].where
    assert str(last[3].error) == "the worker was killed by signal 9 in the middle of the job"
    assert sorted(int(one.job.name) for one in attempts) == [0, 1, 1, 2, 3, 3]
