"""Independent calls, one at a time in this process; the slow tests of evaluation have several."""

import subprocess
import sys

import pytest

from ethbrake_marl.parallel import run_each


def test_calls__are_taken_shortly_before_their_turn_and_answered_in_order() -> None:
    taken: list[int] = []
    answers = run_each((pow, taken.append(k) or k, 2) for k in (3, 1, 2))
    assert (next(answers), taken) == (9, [3])
    assert ([*answers], taken) == ([1, 4], [3, 1, 2])


AFTER_RAY = """
import signal, sys
from ethbrake_marl.parallel import run_each

if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda number, frame: print("own handler", flush=True))
    print(list(run_each([(pow, 3, k) for k in range(3)], 1, "local")), flush=True)
    signal.raise_signal(signal.SIGTERM)
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


@pytest.mark.slow
def test_on_ray__the_callers_signal_handlers_are_in_force_afterwards() -> None:
    """Ray sets a handler in C, which Python's ``signal.getsignal`` does not show; so signals are sent."""
    pytest.importorskip("ray")
    ended = subprocess.run([sys.executable, "-c", AFTER_RAY], capture_output=True, text=True, check=False)
    told = [line for line in ended.stdout.splitlines() if "raylet" not in line]
    assert (ended.returncode, told) == (0, ["[1, 3, 9]", "own handler", "interrupted"]), ended.stderr
