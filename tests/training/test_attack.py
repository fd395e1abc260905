"""Resuming: trainings that are killed (-9) from outside at any moment, also while they write, lose nothing."""

import json
import random
import time
from pathlib import Path

import pytest

from tests.training.tiny import FORK, TRAININGS, begin, go_on, kept


def work(name: str, run: Path) -> None:
    if run.exists():
        go_on(run)
    else:
        begin(name, run)


def partial(run: Path) -> bool:
    return any(run.glob("checkpoints/.ethbrake-*.partial"))


@pytest.mark.nightly
@pytest.mark.parametrize("writing", [False, True])
@pytest.mark.parametrize("name", TRAININGS)
def test_training__that_was_killed_at_any_moment_ends_the_same(
    name: str, writing: bool, size: int, tmp_path: Path
) -> None:
    """Kill 5 times ``--size`` trainings, every fourth one twice; if ``writing``, while a checkpoint is written."""
    rng, begun, torn = random.Random(f"{name} {writing}"), time.monotonic(), 0
    begin(name, tmp_path / "whole")
    whole, lasts = kept(tmp_path / "whole"), time.monotonic() - begun
    for k in range(5 * size):
        run = tmp_path / str(k)
        for _ in range(2 if k % 4 == 3 else 1):
            process, until = FORK.Process(target=work, args=(name, run)), time.monotonic() + rng.uniform(0.0, lasts)
            process.start()
            while process.is_alive() and (not partial(run) if writing else time.monotonic() < until):
                time.sleep(rng.uniform(0.0, 0.001))
            process.kill()
            process.join()
            torn += partial(run)
            if run.exists() and json.loads((run / "run.json").read_text())["status"] == "finished":
                break
        else:
            work(name, run)
        assert kept(run) == whole, k
    print(f"{5 * size} trainings killed, {torn} while they wrote a checkpoint")
