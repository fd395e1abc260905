"""Trainings of a second, and what the tests do to them and compare of them."""

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.training import models

TINY_PPO = eb.load_recipe("ppo").replace(
    n_envs=8,
    n_steps=16,
    batch_size=64,
    n_epochs=2,
    network={"policy": [8], "value": [8, 4]},
    reward={"harm": 0.05, "shaping": 0.02, "shaping_discount": 0.995},
    evaluation={"every_updates": 3, "worlds": 10, "seed": 7},
    checkpoint_every_updates=2,
)
TINY_SAC = eb.load_recipe("sac").replace(
    total_steps=64 * 8,
    n_envs=8,
    batch_size=32,
    buffer_size=400,  # fills up on the way
    learning_starts=100,
    network={"policy": [8], "value": [8]},
    evaluation={"every_updates": 30, "worlds": 10, "seed": 7},
    checkpoint_every_updates=12,
    log_every_updates=10,
)
Answer = tuple[Any, ...]


def watch_steps(monkeypatch: pytest.MonkeyPatch, watch: Callable[[int, Answer], Answer]) -> None:
    """Let the environment's answer to every step pass through ``watch(number of the step, answer)``."""

    class Watched(eb.EthBrakeVecEnv):
        count = 0

        def step_wait(self) -> Answer:
            self.count += 1
            return watch(self.count, super().step_wait())

    def make(*args: Any, **kwargs: Any) -> eb.EthBrakeVecEnv:
        environment = eb.make_sb3_vec_env(*args, **kwargs)
        environment.__class__ = Watched
        return environment

    monkeypatch.setattr(models, "make_sb3_vec_env", make)


def ctrl_c_in(*steps: int) -> Callable[[int, Answer], Answer]:
    """For ``watch_steps``: Ctrl-C in each of these steps."""

    def watch(step: int, answer: Answer) -> Answer:
        if step in steps:
            os.kill(os.getpid(), signal.SIGINT)
        return answer

    return watch


def newest(run: Path) -> Path:
    """The newest checkpoint."""
    return max(run.glob("checkpoints/step_*"))


OUTSIDE, PRECIOUS = "outside", "precious.txt"  # beside a run: what nothing may touch
# What may stand in a run as a link out of it -> where it leads, and whether the run must be refused then.
LINKS = {
    "checkpoints": ("", True),
    "tensorboard": ("", True),
    "run.lock": (PRECIOUS, True),
    "progress.csv": (PRECIOUS, False),
    "config.json": (PRECIOUS, True),
    "team.json": (PRECIOUS, False),
    "policy": ("", False),
    "tensorboard/events.out.tfevents.1.x": (PRECIOUS, False),
}


def link_out(name: str, run: Path) -> None:
    """A link out of the run in the place of something in it."""
    path = run / name
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(run.parents[1] / OUTSIDE / LINKS[name][0])


def files_of(run: Path) -> dict[str, bytes]:
    """Name and content of all that a run has kept of its policies, and of who drives what."""
    files = [*run.glob("policy*/**/*.*"), *run.glob("team.json")]
    return {str(path.relative_to(run)): path.read_bytes() for path in files}


def scalars(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """(step, value) of every tag, as TensorBoard reads them."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def harm_beside_full_braking(spec: str) -> float:
    """Mean harm of this agent, in that of full braking, in 1,000 worlds of two learners."""
    scenario = eb.load_scenario("cooperation-3-pair")
    agents = {name: eb.make_agent(name, scenario=scenario) for name in ("full_brake", spec)}
    found = eb.evaluate(scenario.sample(1000, 7), agents, scenario=scenario)
    braking, trained = (found.outcome(name).first_impact_harm.mean() for name in agents)
    return float(trained / braking)


def marked(schema: dict[str, Any], content: Any) -> set[str]:
    """The places where an editor that has this schema marks a mistake; empty: the whole file."""
    Draft202012Validator.check_schema(schema)
    return {".".join(map(str, error.absolute_path)) for error in Draft202012Validator(schema).iter_errors(content)}
