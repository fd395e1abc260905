"""Trainings of a fifth of a second, and what the tests compare of them."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ethbrake_marl.progress import Progress
from ethbrake_marl.training.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.training.train import resume, train

UPDATE = 8 * 16  # decisions of one learner in an update of TINY
TINY = load_recipe("ppo").replace(
    total_steps=6 * UPDATE,
    n_envs=8,
    n_steps=16,
    batch_size=64,
    n_epochs=2,
    network={"policy": [8], "value": [8, 4]},
    evaluation={"every_updates": 3, "worlds": 10, "seed": 7},
    checkpoint_every_updates=2,
)
TINY_SAC = load_recipe("sac").replace(
    total_steps=60 * 8,
    n_envs=8,
    batch_size=32,
    buffer_size=300,  # fills up on the way
    learning_starts=100,
    network={"policy": [8, 4], "value": [8]},
    evaluation={"every_updates": 30, "worlds": 10, "seed": 7},
    checkpoint_every_updates=12,
    log_every_updates=10,
)
PAIR = "cooperation-3-pair"
TRAININGS: dict[str, tuple[TrainingRecipe, str]] = {
    "ppo": (TINY, "paper-random"),
    "sac": (TINY_SAC, "paper-random"),
    "shared": (TINY.replace(scheme="shared", total_steps=6 * 2 * UPDATE), PAIR),
    "independent": (TINY.replace(scheme="independent", total_steps=6 * 2 * UPDATE), PAIR),
    "centralised": (TINY.replace(scheme="centralised", total_steps=6 * 2 * UPDATE), PAIR),
}
FORK = multiprocessing.get_context("fork")
MISSED = ("fps", "time_elapsed", "iterations")  # columns of progress.csv that a resumed training counts anew


def killed(work: Callable[..., Any], *arguments: Any, **settings: Any) -> None:
    """Call a function in a process of its own, which must be killed in it."""
    process = FORK.Process(target=work, args=arguments, kwargs=settings)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL, process.exitcode


def die() -> None:
    """Kill this process, which can do nothing about it."""
    os.kill(os.getpid(), signal.SIGKILL)


def dying_after(updates: int) -> Callable[[Progress], None]:
    """Listener that kills the process when so many updates are done and reported."""
    return lambda progress: die() if progress.updates >= updates else None


def begin(name: str, run: Path, **settings: Any) -> Any:
    """Train a tiny training."""
    return train(*TRAININGS[name], run, **{"on_progress": None, **settings})


def go_on(run: Path, **settings: Any) -> Any:
    """Resume quietly."""
    return resume(run, **{"on_progress": None, **settings})


def kept(run: Path) -> dict[str, Any]:
    """What a run leaves, without clocks: policies and rows of progress."""
    lines = (run / "progress.csv").read_text().splitlines()
    names = lines[0].split(",")
    rows = [
        {name: cell for name, cell in zip(names, line.split(","), strict=True) if not name.endswith(MISSED) and cell}
        for line in lines[1:]
    ]
    files = {str(file.relative_to(run)): file.read_bytes() for file in run.glob("policy*/**/*.*")}
    return {"rows": rows, **files}
