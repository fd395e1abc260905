"""Whatever stops a training, and whenever: it goes on as if nothing had happened, to the bit."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.files import store
from ethbrake_marl.progress import Progress
from ethbrake_marl.training import checkpoint
from ethbrake_marl.training.run import RunFolder
from tests.refused import refused
from tests.training.tiny import PAIR, TRAININGS, begin, die, dying_after, go_on, kept, killed

Made = Callable[[str], Any]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Function that tells what an uninterrupted training leaves."""
    made: dict[str, dict[str, Any]] = {}

    def get(name: str) -> dict[str, Any]:
        if name not in made:
            run = tmp_path_factory.mktemp(name) / "run"
            begin(name, run)
            made[name] = kept(run)
        return made[name]

    return get


@pytest.fixture(scope="module")
def dead(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training that was killed after five of six updates; its checkpoints are after two and four."""
    run = tmp_path_factory.mktemp("dead") / "run"
    killed(begin, "ppo", run, on_progress=dying_after(5))
    return run


@pytest.fixture
def run(dead: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(dead, tmp_path / "run"))


def newest(run: Path) -> Path:
    return checkpoint.files_in(run / "checkpoints")[0]


def test_resume__after_a_kill_everything_is_the_same(run: Path, whole: Made) -> None:
    assert [path.name for path in checkpoint.files_in(run / "checkpoints")] == [
        "step_000000000512.pt",
        "step_000000000256.pt",
    ]
    spent = checkpoint.read(newest(run))["course"]["wall_s"]
    result = go_on(run)
    assert result.status == "finished" and result.wall_s > spent > 0.0
    assert kept(run) == whole("ppo")
    events = EventAccumulator(str(run / "tensorboard"))
    events.Reload()
    assert {event.step for event in events.Scalars("train/loss")} == {128 * k for k in range(1, 7)}
    with refused("this training has finished and cannot be resumed"):
        go_on(run)


@pytest.mark.parametrize("name", ["sac", "independent"])
def test_resume__after_ctrl_c_everything_is_the_same(name: str, whole: Made, tmp_path: Path) -> None:
    run, seen = tmp_path / "run", list[int]()

    def ctrl_c(progress: Progress) -> None:
        seen.append(progress.updates)
        if len(seen) == 4:
            os.kill(os.getpid(), signal.SIGINT)

    stopped = begin(name, run, on_progress=ctrl_c)
    assert (stopped.status, stopped.updates) == ("interrupted", seen[-1])
    assert json.loads((run / "run.json").read_text())["status"] == "interrupted"
    assert stopped.evaluations[-1]["steps"] == stopped.steps > 0  # the last policy is measured
    go_on(run)
    assert kept(run) == whole(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAININGS)
def test_resume__after_kills_at_random_updates_everything_is_the_same(name: str, whole: Made, tmp_path: Path) -> None:
    recipe, rng = TRAININGS[name][0], random.Random(name)
    learners = 2 if TRAININGS[name][1] == PAIR else 1
    updates = recipe.total_steps // (recipe.n_envs * recipe.rounds * learners)
    for k in range(4):
        run = tmp_path / str(k)
        first, second = sorted(rng.sample(range(updates - 1), 2))
        killed(begin, name, run, on_progress=dying_after(first))
        killed(go_on, run, on_progress=dying_after(second + 1))
        go_on(run)
        assert kept(run) == whole(name), (first, second)


def test_resume__after_a_kill_while_a_checkpoint_is_written(
    whole: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, replace = tmp_path / "run", os.replace

    def fatal(*arguments: Any) -> Any:
        if list(run.glob("checkpoints/step_000000000256.pt")):
            die()
        return replace(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(store.os, "replace", fatal)
        killed(begin, "ppo", run)
    assert newest(run).name == "step_000000000256.pt" and list((run / "checkpoints").glob(".ethbrake-*"))
    go_on(run)
    assert kept(run) == whole("ppo")
    assert not list(run.glob("**/.ethbrake-*"))


@pytest.mark.parametrize("nth", [1, 4])
def test_resume__after_an_error_and_a_kill_while_policies_are_replaced(
    nth: int, whole: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, rename, count = tmp_path / "run", Path.rename, 0

    def fail(progress: Progress) -> None:
        if progress.updates == 5:
            raise LookupError("mine")

    def fatal(path: Path, target: Path) -> Path:
        nonlocal count
        count += 1
        if count == nth:
            die()
        return rename(path, target)

    with pytest.raises(LookupError, match="mine"):
        begin("ppo", run, on_progress=fail)
    status = json.loads((run / "run.json").read_text())
    assert (status["status"], status["reason"], status["updates"]) == ("failed", "LookupError: mine", 5)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", fatal)
        killed(go_on, run)
    status = json.loads((run / "run.json").read_text())
    assert (status["status"], status["reason"], status["updates"]) == ("running", None, 5)
    go_on(run)
    assert kept(run) == whole("ppo")
    assert not list(run.glob("**/.ethbrake-*"))


def spoil(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        part = max(archive.infolist(), key=lambda each: each.file_size)
    data = bytearray(path.read_bytes())
    data[part.header_offset + 200 + part.file_size // 2] ^= 1
    path.write_bytes(data)


class Evil:
    """Writes a file when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (Path("evil"),)


DAMAGE = {
    "a byte": spoil,
    "code": lambda path: torch.save({"training": Evil()}, path),
    "other data": lambda path: torch.save({"training": 1}, path),
    "a link": lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
    "a link to a sound one": lambda path: path.symlink_to(path.rename(path.parent.parent / "elsewhere.pt")),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_newest__goes_back_behind_a_damaged_checkpoint(damage: str, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(run.parent)
    damaged, before = checkpoint.files_in(run / "checkpoints")
    DAMAGE[damage](damaged)
    saved, reasons = checkpoint.newest_checkpoint(run / "checkpoints")
    assert saved is not None and saved["steps"] == 256
    assert len(reasons) == 1 and reasons[0].startswith(f"{damaged}: is ")
    assert checkpoint.files_in(run / "checkpoints") == [before] and not Path("evil").exists()


def test_resume__says_that_a_checkpoint_was_damaged_and_begins_again_without_any(run: Path, whole: Made) -> None:
    for path in checkpoint.files_in(run / "checkpoints"):
        path.write_bytes(b"")
    notes: list[str] = []
    go_on(run, on_progress=lambda progress: notes.append(progress.note) if progress.note else None)
    assert len(notes) == 1 and notes[0].count("deleted a damaged checkpoint: ") == 2
    assert kept(run) == whole("ppo")


def forged(saved: dict[str, Any], place: str, value: Any) -> None:
    *parts, last = place.split("/")
    for part in parts:
        saved = saved[int(part) if isinstance(saved, list) else part]
    saved[last if isinstance(saved, dict) else int(last)] = value


FORGED = {
    "model/environment/stream": [1],
    "model/environment/episode": [torch.zeros(8, 7, 3, dtype=torch.float64)],
    "model/torch": torch.zeros(3, dtype=torch.uint8),
    "model/parameters/policy/log_std": torch.full((1,), float("nan")),
    "course/best": [{"policy.0.weight": torch.zeros(1)}],
}


@pytest.mark.parametrize("place", FORGED)
def test_resume__a_checkpoint_that_does_not_fit_is_refused_in_one_line(place: str, run: Path) -> None:
    saved = checkpoint.read(newest(run))
    forged(saved, place, FORGED[place])
    torch.save(saved, newest(run))
    states = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    with pytest.raises(CorruptBundle, match=r"the checkpoint of step 512 does not fit this training: .*; delete this"):
        go_on(run)
    assert states == (random.getstate(), np.random.get_state()[1].tolist())  # noqa: NPY002
    assert newest(run).exists()


def test_resume__other_versions_are_refused_unless_accepted(run: Path, whole: Made) -> None:
    saved = checkpoint.read(newest(run))
    saved["versions"]["physics"] = "0.1"
    torch.save(saved, newest(run))
    with refused("this training began with physics 0.1, but physics "):
        go_on(run)
    go_on(run, other_versions=True)
    assert kept(run) == whole("ppo")


def test_resume__an_edited_configuration_is_another_training(run: Path) -> None:
    config = json.loads((run / "config.json").read_text())
    config["recipe"]["gamma"] = 0.9
    (run / "config.json").write_text(json.dumps(config))
    with refused("config.json: this file was changed after the checkpoint of step 512"):
        go_on(run)


def test_resume__one_process_at_a_time(run: Path) -> None:
    with RunFolder(run).held(), refused("another process is training in this folder"):
        go_on(run)


LINKS = {"policy": True, "run.lock": True, "progress.csv": False}  # is the run refused then?


@pytest.mark.parametrize("name", LINKS)
def test_resume__follows_no_link_out_of_the_run(name: str, run: Path) -> None:
    outside, path = run.parent / "outside", run / name
    outside.mkdir()
    (outside / "precious.txt").write_text("precious")
    target = outside if path.is_dir() or name == "policy" else outside / "precious.txt"
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(target)
    if LINKS[name]:
        with refused(f"{name}: "):
            go_on(run)
    else:
        go_on(run)
    assert [file.name for file in outside.iterdir()] == ["precious.txt"]
    assert (outside / "precious.txt").read_text() == "precious"


def test_write__keeps_the_newest_two_checkpoints(tmp_path: Path) -> None:
    for steps in (1, 2, 10):
        checkpoint.write(tmp_path, {"steps": steps})
    assert [path.name for path in checkpoint.files_in(tmp_path)] == ["step_000000000010.pt", "step_000000000002.pt"]
