import csv
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from filelock import FileLock

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.scenario.catalogue import new_scenario_text
from tests.fixtures.pictures import draw_nothing

TINY_RECIPE = {
    "name": "tiny",
    "algorithm": "ppo",
    "total_steps": 256,
    "n_envs": 16,
    "n_steps": 8,
    "batch_size": 64,
    "n_epochs": 1,
    "learning_rate": {"start": 3e-4, "end": 3e-5},
    "gamma": 0.99,
    "gae_lambda": 0.95,
    "clip_range": 0.2,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "max_grad_norm": 0.5,
    "network": {"policy": [8], "value": [8]},
    "reward": {"harm": 1.0},
    "seed": 3,
    "evaluation": {"every_updates": 1, "worlds": 10, "seed": 7},
    "checkpoint_every_updates": 100,
}


@dataclass(frozen=True)
class Answer:
    """What a command line left: exit status, stdout, stderr."""

    status: int
    out: str
    err: str


Command = Callable[..., Answer]


@pytest.fixture
def ethbrake(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Command:
    """Runs a command line in this process, 200 columns wide."""
    monkeypatch.setenv("COLUMNS", "200")

    def call(*arguments: str | Path) -> Answer:
        capsys.readouterr()
        status = run_command([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Answer(status, captured.out, captured.err)

    return call


@pytest.fixture(scope="session")
def tiny_recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recipe that trains for two updates of 128 decisions."""
    path = tmp_path_factory.mktemp("recipe") / "tiny.yaml"
    path.write_text(yaml.safe_dump(TINY_RECIPE))
    return path


@pytest.fixture(scope="session")
def finished_run(tmp_path_factory: pytest.TempPathFactory, tiny_recipe: Path) -> Path:
    """The folder of an `ethbrake run` with 60 worlds, made once for all processes of xdist; not to be changed.

    Its pictures are empty; tests/extensions/report draws them, and a slow test a whole run.
    """
    alone = "PYTEST_XDIST_WORKER" not in os.environ
    base = tmp_path_factory.getbasetemp() if alone else tmp_path_factory.getbasetemp().parent
    folder, done = base / "finished_run", base / "finished_run.done"
    with FileLock(base / "finished_run.lock"), pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        if not done.exists():
            words = ["--recipe", str(tiny_recipe), "--episodes", "60", "--output", str(folder), "--force", "--json"]
            assert run_command(["run", *words]) == 0
            done.touch()
    return folder


@pytest.fixture
def scenario_file(tmp_path: Path) -> Callable[[str, str], Path]:
    """Writes mine.yaml, the template with one piece of text replaced."""

    def write(old: str, new: str) -> Path:
        text = new_scenario_text("mine")
        assert text.count(old) == 1
        path = tmp_path / "mine.yaml"
        path.write_text(text.replace(old, new))
        return path

    return write


TINY_SAC = {
    "name": "tiny-sac",
    "algorithm": "sac",
    "total_steps": 320,
    "n_envs": 16,
    "batch_size": 16,
    "buffer_size": 200,
    "learning_starts": 64,
    "learning_rate": {"start": 1e-3, "end": 1e-4},
    "gamma": 0.99,
    "tau": 0.02,
    "network": {"policy": [8], "value": [8]},
    "reward": {"harm": 1.0},
    "evaluation": {"every_updates": 10, "worlds": 10, "seed": 7},
    "checkpoint_every_updates": 100,
    "log_every_updates": 5,
}


@pytest.fixture(scope="session")
def tiny_sac(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recipe that trains by SAC for 320 decisions."""
    path = tmp_path_factory.mktemp("recipe") / "tiny-sac.yaml"
    path.write_text(yaml.safe_dump(TINY_SAC))
    return path


def told_json(answer: Answer) -> Any:
    """The JSON of a command that ended well."""
    assert answer.status == 0, answer.err
    return json.loads(answer.out)


def rows_of(file: Path) -> list[dict[str, str]]:
    """The rows of a CSV file."""
    return list(csv.DictReader(file.read_text().splitlines()))


def check_refused(answer: Answer, *fragments: str) -> None:
    """Status 2, nothing on stdout, and one line on stderr with these pieces of text."""
    assert (answer.status, answer.out, answer.err.count("\n")) == (2, "", 1)
    assert answer.err.startswith("ethbrake: error: ") and all(each in answer.err for each in fragments), answer.err
