"""Independent calls: one at a time, in processes, and where joblib's configuration says."""

import os
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from ethbrake_marl import parallel
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.parallel import WorkerLost, run_each


def test_calls__are_taken_shortly_before_their_turn_and_answered_in_order() -> None:
    taken: list[int] = []
    answers = run_each((pow, taken.append(k) or k, 2) for k in (3, 1, 2))
    assert (next(answers), taken) == (9, [3])
    assert ([*answers], taken) == ([1, 4], [3, 1, 2])


def test_calls__run_where_joblib_is_told_to_run_them() -> None:
    joblib = pytest.importorskip("joblib")
    with joblib.parallel_config(backend="threading"):
        assert [*run_each(((os.getpid,) for _ in range(3)), 2)] == [os.getpid()] * 3


def test_process__that_is_killed_is_an_error_and_each_has_one_thread() -> None:
    pytest.importorskip("joblib")
    assert [*run_each(((os.getenv, "OMP_NUM_THREADS") for _ in range(3)), 2)] == ["1"] * 3
    with pytest.raises(WorkerLost, match="use fewer processes"):
        list(run_each([(os._exit, 3)], 2))


def test_chosen_threads__are_those_of_the_argument_or_of_the_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "usable_cores", lambda: 8)
    assert parallel.chosen_threads(None) == 1
    monkeypatch.setenv("ETHBRAKE_THREADS", "3")
    assert [parallel.chosen_threads(threads) for threads in (None, 2, 64)] == [3, 2, 8]


@pytest.mark.parametrize("text", ["", "0", "1.5"])
def test_chosen_threads__refuses_a_bad_variable(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ETHBRAKE_THREADS", text)
    with pytest.raises(InvalidInput, match=rf"^ETHBRAKE_THREADS = '{text}': must be a whole number from 1 to 1024$"):
        parallel.chosen_threads(None)


@pytest.mark.parametrize("threads", [0, True])
def test_chosen_threads__refuses_a_bad_number(threads: object) -> None:
    with pytest.raises(InvalidInput, match=r"^threads = .*: must be a whole number in 1..1024$"):
        parallel.chosen_threads(threads)


def test_processes__ignore_ctrl_c_from_their_start_and_this_one_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loky = pytest.importorskip("joblib").externals.loky
    usual = signal.getsignal(signal.SIGINT)
    (tmp_path / "sitecustomize.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    loky.get_reusable_executor().shutdown(kill_workers=True)
    assert [*run_each([(signal.getsignal, signal.SIGINT)] * 3, 2)] == [signal.SIG_IGN] * 3
    assert signal.getsignal(signal.SIGINT) == usual


def test_processes__that_a_thread_starts_ignore_ctrl_c() -> None:
    """Python changes signals in the main thread only."""
    pytest.importorskip("joblib").externals.loky.get_reusable_executor().shutdown(kill_workers=True)
    calls = [(signal.getsignal, signal.SIGINT)] * 3
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: [*run_each(calls, 2)]).result() == [signal.SIG_IGN] * 3


@pytest.mark.parametrize(("cores", "jobs", "processes", "share"), [(5, 2, 2, 2), (3, 8, 3, 1), (2, 2, 2, 1)])
def test_processes_and_their_threads__are_never_more_than_the_cores(
    cores: int, jobs: int, processes: int, share: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    joblib = pytest.importorskip("joblib")
    sizes, parallel_class = list[int](), joblib.Parallel

    def counted(size: int, **settings: object) -> object:
        sizes.append(size)
        return parallel_class(size, **settings)

    monkeypatch.setattr(joblib, "Parallel", counted)
    monkeypatch.setattr(parallel, "usable_cores", lambda: cores)
    assert [*run_each(((parallel.chosen_threads, 64) for _ in range(3)), jobs)] == [share] * 3
    assert sizes == [processes]
