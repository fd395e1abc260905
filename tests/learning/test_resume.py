from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning import runs as train_module
from ethbrake_marl.learning.runs import TrainResult, resume, train
from ethbrake_marl.learning.training import RunDirectory, Training, load_recipe
from ethbrake_marl.policies import Policy, load_policy
from ethbrake_marl.scenario import load_scenario
from tests.learning.tiny import TINY_PPO

SCENARIO = load_scenario("paper-random")

PPO = TINY_PPO.replace(total_steps=12 * 128)
SAC = load_recipe("sac").replace(
    total_steps=90 * 8,
    n_envs=8,
    batch_size=32,
    buffer_size=400,  # fills up on the way
    learning_starts=100,
    network={"policy": [8], "value": [8]},
    evaluation={"every_updates": 30, "worlds": 10, "seed": 7},
    checkpoint_every_updates=12,
    log_every_updates=10,
)
RECIPES = {"ppo": PPO, "sac": SAC}


def _harm(policy: Policy) -> dict[str, float]:
    """Something that depends on every weight and changes all the time."""
    digest = hashlib.sha256(policy.manifest.weights_sha256.encode()).digest()
    return {"first_impact_harm": digest[0] / 8.0, "total_harm": digest[1] / 8.0}


def _bundle(run: Path, name: str) -> tuple[bytes, bytes]:
    return (run / name / "manifest.json").read_bytes(), (run / name / "weights.safetensors").read_bytes()


def _rows(run: Path) -> list[dict[str, str]]:
    """The progress table without its clocks."""
    rows = csv.DictReader((run / "progress.csv").read_text().splitlines())
    return [{name: value for name, value in row.items() if name not in CLOCKS} for row in rows]


CLOCKS = ("time/fps", "time/time_elapsed")


def _events(run: Path) -> dict[str, list[tuple[int, float]]]:
    events = EventAccumulator(str(run / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    return {
        tag: [(e.step, e.value) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"] if tag not in CLOCKS
    }


def _stop_in(monkeypatch: pytest.MonkeyPatch, step: int, act: Callable[[], None]) -> None:
    """Do ``act`` in the environment's step of this number."""

    class Watched(EthBrakeVecEnv):
        count = 0

        def step_wait(self) -> tuple[Any, ...]:
            self.count += 1
            if self.count == step:
                act()
            return super().step_wait()

    def make(*args: Any, **kwargs: Any) -> EthBrakeVecEnv:
        environment = make_sb3_vec_env(*args, **kwargs)
        environment.__class__ = Watched
        return environment

    monkeypatch.setattr(train_module, "make_sb3_vec_env", make)


def _interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def _measure(training: Training) -> Callable[[Policy], dict[str, float]]:
    return _harm


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, TrainResult]]:
    """The training of each algorithm that nobody stops."""
    made: dict[str, tuple[Path, TrainResult]] = {}

    def get(name: str) -> tuple[Path, TrainResult]:
        if name not in made:
            folder = tmp_path_factory.mktemp("whole") / name
            made[name] = folder, train(RECIPES[name], SCENARIO, folder, measure=_measure)
        return made[name]

    return get


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    ("step", "name"),
    [
        pytest.param(step, name, marks=() if (step, name) in ((37, "ppo"), (76, "sac")) else pytest.mark.slow)
        for step in (1, 37, 61, 76)
        for name in ("ppo", "sac")
    ],
)
def test_resume__after_ctrl_c_everything_is_as_if_nobody_had_stopped_it(
    name: str,
    step: int,
    whole: Callable[[str], tuple[Path, TrainResult]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reference, expected = whole(name)
    with monkeypatch.context() as patch:
        _stop_in(patch, step, _interrupt)
        stopped = train(RECIPES[name], SCENARIO, tmp_path / "run", measure=_measure)
    assert stopped.status == "interrupted" and stopped.steps < expected.steps
    result = resume(tmp_path / "run", measure=_measure)
    assert (result.status, result.steps, result.updates) == ("finished", expected.steps, expected.updates)
    for bundle in ("policy", "policy-last"):
        assert _bundle(tmp_path / "run", bundle) == _bundle(reference, bundle)
    assert result.evaluations == expected.evaluations
    assert _rows(tmp_path / "run") == _rows(reference)
    assert _events(tmp_path / "run") == _events(reference)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "finished"
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_train__keeps_the_policy_of_least_harm_and_the_last_one(
    whole: Callable[[str], tuple[Path, TrainResult]],
) -> None:
    folder, result = whole("ppo")
    harms = [entry["first_impact_harm"] for entry in result.evaluations]
    best = result.evaluations[int(np.argmin(harms))]
    assert harms[-1] > min(harms)  # else the two were one
    assert load_policy(folder).manifest.steps == best["steps"] == result.policy.manifest.steps
    assert load_policy(folder / "policy-last").manifest.steps == result.steps == result.last_policy.manifest.steps
    assert _harm(load_policy(folder))["first_impact_harm"] == min(harms)


_TRAIN_AND_DIE = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, {root!r})
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.learning.runs import train
from tests.learning.test_resume import RECIPES, SCENARIO, _measure
recipe, folder = RECIPES[sys.argv[1]], Path(sys.argv[2])
step, left = EthBrakeVecEnv.step_wait, [5]

def step_wait(self):
    left[0] -= bool(list(folder.glob("checkpoints/step_*")))
    if left[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self)

EthBrakeVecEnv.step_wait = step_wait
train(recipe, SCENARIO, folder, measure=_measure)
"""


def train_and_die(name: str, folder: Path) -> int:
    """Another process that trains until it is killed (-9), in the fifth step after its first checkpoint.

    It kills itself: from outside, on a busy machine, one may come too late.
    """
    program = _TRAIN_AND_DIE.format(root=str(Path(__file__).resolve().parents[2]))
    return subprocess.run([sys.executable, "-c", program, name, str(folder)], check=False).returncode


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_resume__after_kill_9_the_weights_are_the_same(
    name: str, whole: Callable[[str], tuple[Path, TrainResult]], tmp_path: Path
) -> None:
    reference, _ = whole(name)
    run = tmp_path / "run"
    assert train_and_die(name, run) == -signal.SIGKILL
    assert json.loads((run / "run.json").read_text())["status"] == "running"
    resume(run, measure=_measure)
    for bundle in ("policy", "policy-last"):
        assert _bundle(run, bundle) == _bundle(reference, bundle)
    assert _rows(run) == _rows(reference)


def _stopped(folder: Path, monkeypatch: pytest.MonkeyPatch, step: int = 100) -> list[Path]:
    """A PPO run stopped with two checkpoints, the newest first."""
    with monkeypatch.context() as patch:
        _stop_in(patch, step, _interrupt)
        train(PPO, SCENARIO, folder, measure=_measure)
    return sorted(folder.glob("checkpoints/step_*"), reverse=True)


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        ("checkpoint.json", "truncated"),
        pytest.param("checkpoint.json", "missing", marks=pytest.mark.slow),
        pytest.param("state.json", "flipped", marks=pytest.mark.slow),
        ("arrays.safetensors", "truncated"),
        pytest.param("policy/weights.safetensors", "missing", marks=pytest.mark.slow),
    ],
)
def test_resume__a_damaged_checkpoint_is_found_and_the_one_before_is_used(
    file: str,
    damage: str,
    whole: Callable[[str], tuple[Path, TrainResult]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reference, _ = whole("ppo")
    newest, _ = _stopped(tmp_path / "run", monkeypatch)
    path = newest / file
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    else:
        middle = len(data) // 2
        path.write_bytes(data[:middle] if damage == "truncated" else data[:middle] + b"\x07" + data[middle + 1 :])
    notes: list[str] = []
    resume(tmp_path / "run", measure=_measure, on_progress=lambda p: notes.append(p.note) if p.note else None)
    assert len(notes) == 1 and notes[0].startswith(f"a damaged checkpoint was left aside: {newest}")
    assert _bundle(tmp_path / "run", "policy-last") == _bundle(reference, "policy-last")
    assert _rows(tmp_path / "run") == _rows(reference)


@pytest.mark.parametrize("key", ["training", "format_version"])
def test_resume__a_checkpoint_of_another_version_is_refused_and_stays(
    key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    newest, before = _stopped(tmp_path / "run", monkeypatch)
    path, listing = newest / "state.json", json.loads((newest / "checkpoint.json").read_text())
    if key == "training":  # of a time when no checkpoint said so
        path.write_text(json.dumps({name: each for name, each in json.loads(path.read_text()).items() if name != key}))
        data = path.read_bytes()
        listing["files"]["state.json"] = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    else:
        listing[key] = 2
    (newest / "checkpoint.json").write_text(json.dumps(listing))
    files = {path: path.read_bytes() for path in newest.rglob("*") if path.is_file()}
    told = {"training": "state.json: training: is missing", "format_version": "format_version = 2: must be 1"}[key]
    with pytest.raises(InvalidInput, match=rf"{told}; .* is as version .* wrote it, .*: go on with that version, or"):
        resume(tmp_path / "run", measure=_measure)
    assert {path: path.read_bytes() for path in newest.rglob("*") if path.is_file()} == files and before.is_dir()


def test_resume__without_any_checkpoint_it_starts_again(
    whole: Callable[[str], tuple[Path, TrainResult]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reference, _ = whole("ppo")
    for folder in _stopped(tmp_path / "run", monkeypatch):
        (folder / "state.json").unlink()
    (tmp_path / "run" / ".ethbrake-left.partial").mkdir()
    resume(tmp_path / "run", measure=_measure)
    assert _bundle(tmp_path / "run", "policy") == _bundle(reference, "policy")
    assert _rows(tmp_path / "run") == _rows(reference)
    assert not (tmp_path / "run" / ".ethbrake-left.partial").exists()


def test_resume__a_vehicle_with_a_memory_goes_on_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "e_v2x_bm:pairwise"}
    scenario = SCENARIO.replace(roles=roles, early_impacts="keep")
    train(PPO, scenario, tmp_path / "whole", measure=None)
    with monkeypatch.context() as patch:
        _stop_in(patch, 100, _interrupt)
        train(PPO, scenario, tmp_path / "run", measure=None)
    resume(tmp_path / "run", measure=None)
    assert _bundle(tmp_path / "run", "policy") == _bundle(tmp_path / "whole", "policy")


def test_resume__refuses_what_it_cannot_go_on_with(
    whole: Callable[[str], tuple[Path, TrainResult]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InvalidInput, match="holds no training; give the folder of a run"):
        resume(tmp_path)
    with pytest.raises(InvalidInput, match="this training has finished; measure what it has learned with"):
        resume(whole("ppo")[0])
    _stopped(tmp_path / "run", monkeypatch)
    monkeypatch.setattr(train_module, "installed_versions", lambda: {"torch": "99.0"})
    with pytest.raises(InvalidInput, match=r"was trained with ethbrake-marl .*: the numbers would differ"):
        resume(tmp_path / "run")
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "interrupted"
    assert resume(tmp_path / "run", other_versions=True).status == "finished"


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("recipe", {"gamma": 0.9}),
        pytest.param("recipe", {"seed": 5}, marks=pytest.mark.slow),
        pytest.param("scenario", {"horizon_s": 9.0}, marks=pytest.mark.slow),
    ],
)
def test_resume__an_edited_configuration_is_another_training(
    part: str, change: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _stopped(tmp_path / "run", monkeypatch)
    file = tmp_path / "run" / "config.json"
    asked = file.read_text()
    config = json.loads(asked)
    file.write_text(json.dumps({**config, part: {**config[part], **change}}))
    with pytest.raises(InvalidInput, match=r"config.json: was changed after the checkpoint step_\d+ of this training"):
        resume(tmp_path / "run", measure=_measure)
    file.write_text(json.dumps({**config, part: {**config[part], "title": "Words change no training"}}))
    assert resume(tmp_path / "run", measure=_measure).status == "finished"


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("run.json", None, "is missing"),
        ("run.json", '{"format": "ethbrake', "is damaged: Unterminated string"),
        ("run.json", "[]", "is damaged: holds no JSON object"),
        ("run.json", "{}", "format = None: must be ethbrake-run"),
        ("run.json", '{"format": "ethbrake-run", "status": "done"}', "status = 'done': must be running or finished"),
        ("config.json", None, "is missing"),
        ("config.json", "[]", "is damaged: holds no JSON object"),
        ("config.json", "{}", "is not the configuration of a training: 'recipe' is missing"),
        ("config.json", '{"recipe": 3}', "recipe: must be a mapping"),
        ("config.json", {"scenario": {"name": "paper-random"}}, "scenario: .*braking_capacity_mps2: missing"),
    ],
)
def test_resume__names_the_damaged_file(tmp_path: Path, file: str, content: str | dict | None, message: str) -> None:
    run = RunDirectory(tmp_path / "run").create({"recipe": PPO.model_dump(mode="json")})
    if content is None:
        (run.path / file).unlink()
    else:
        text = content if isinstance(content, str) else json.dumps({**json.loads(run.config.read_text()), **content})
        (run.path / file).write_text(text)
    with pytest.raises(InvalidInput, match=f"{re.escape(str(run.path / file))}: {message}"):
        resume(run.path)


def test_resume__one_process_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _stopped(tmp_path / "run", monkeypatch)
    messages: list[str] = []

    def second() -> None:
        with pytest.raises(InvalidInput, match="another process is training here") as caught:
            resume(tmp_path / "run", measure=_measure)
        messages.append(str(caught.value))

    with monkeypatch.context() as patch:
        _stop_in(patch, 5, second)
        resume(tmp_path / "run", measure=_measure)
    assert len(messages) == 1
