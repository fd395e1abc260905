"""Run jobs wherever there is room, and try again what was lost, so and so often."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from ethbrake_marl.learning.interruption import stop_on_signal
from ethbrake_marl.studies.jobs.work import Answer, Workers

RETRIES = 2  # further attempts at a job whose worker was lost


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a job that has ended, and whether it was the last."""

    number: int  # of the job
    attempt: int  # from 1
    answer: Answer
    last: bool  # finished, or failed for good


def run_jobs(
    call_of: Callable[[int], bytes],
    jobs: int,
    workers: Workers,
    on_attempt: Callable[[Attempt], None],
    *,
    retries: int = RETRIES,
) -> bool:
    """Run the jobs 0 to ``jobs - 1``, in this order as far as there is room; False when Ctrl-C or SIGTERM stopped it.

    Running jobs are then asked to end and are waited for, and so they are when ``on_attempt`` raises.

    Args:
        call_of: makes a job's call, when its turn has come.
        jobs: how many there are.
        workers: where they run; not closed here.
        on_attempt: is told every attempt that has ended.
        retries: further attempts at a job that was lost with its worker, or that failed by no error of this package.

    """
    waiting, running, attempts = deque(range(jobs)), set[int](), dict[int, int]()
    try:
        with stop_on_signal() as asked:
            while waiting or running:
                if asked():
                    raise KeyboardInterrupt
                while waiting and workers.room() > 0:
                    number = waiting.popleft()
                    attempts[number] = attempts.get(number, 0) + 1
                    workers.begin(number, call_of(number))
                    running.add(number)
                for number, answer in workers.wait():
                    running.discard(number)
                    again = answer.again and attempts[number] <= retries
                    if again:
                        waiting.appendleft(number)
                    on_attempt(Attempt(number, attempts[number], answer, not again))
                    if not again:
                        del attempts[number]
    except BaseException as error:
        _stop(running, workers, on_attempt, attempts)
        if isinstance(error, KeyboardInterrupt):
            return False
        raise
    return True


def _stop(running: set[int], workers: Workers, on_attempt: Callable[[Attempt], None], attempts: dict[int, int]) -> None:
    """Ask what runs to end, and wait for it; what has come to its end all the same is told."""
    workers.interrupt()
    while running:
        for number, answer in workers.wait():
            running.discard(number)
            if answer.value is not None:
                on_attempt(Attempt(number, attempts[number], answer, True))
