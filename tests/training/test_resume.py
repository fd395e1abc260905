"""Whatever stops a training, and whenever: it goes on as if nothing had happened, to the bit."""

from __future__ import annotations

import json
import os
import random
import signal
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files import store
from ethbrake_marl.progress import Progress
from ethbrake_marl.training import checkpoint
from ethbrake_marl.training.run import RunFolder
from tests.training.tiny import PAIR, TINY, TRAININGS, begin, die, dying_after, go_on, kept, killed

Whole = dict[str, dict[str, Any]]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """What uninterrupted trainings leave, by name; made when asked for."""

    class Kept(dict[str, dict[str, Any]]):
        def __missing__(self, name: str) -> dict[str, Any]:
            run = tmp_path_factory.mktemp(name) / "run"
            begin(name, run)
            self[name] = kept(run)
            return self[name]

    return Kept()


@pytest.mark.parametrize("name", ["ppo", "independent"])
def test_resume__after_a_kill_everything_is_the_same(name: str, whole: Whole, tmp_path: Path) -> None:
    run = tmp_path / "run"
    killed(begin, name, run, on_progress=dying_after(5))
    assert go_on(run).status == "finished"
    assert kept(run) == whole[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAININGS)
def test_resume__after_kills_at_random_updates_everything_is_the_same(name: str, whole: Whole, tmp_path: Path) -> None:
    recipe, rng = TRAININGS[name][0], random.Random(name)
    learners = 2 if TRAININGS[name][1] == PAIR else 1
    updates = recipe.total_steps // (recipe.n_envs * recipe.rounds * learners)
    for k in range(4):
        run = tmp_path / str(k)
        first, second = sorted(rng.sample(range(updates - 1), 2))
        killed(begin, name, run, on_progress=dying_after(first))
        killed(go_on, run, on_progress=dying_after(second + 1))
        go_on(run)
        assert kept(run) == whole[name], (first, second)


@pytest.mark.parametrize("when", ["write", "replace"])
def test_resume__after_a_kill_while_a_checkpoint_is_written(
    when: str, whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    untouched = {"write": Path.write_bytes, "replace": os.replace}[when]

    def fatal(*arguments: Any) -> Any:
        if list(run.glob("checkpoints/step_000000000256.pt")):
            if when == "write":
                untouched(arguments[0], b"half")
            die()
        return untouched(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(*((Path, "write_bytes") if when == "write" else (store.os, "replace")), fatal)
        killed(begin, "ppo", run)
    assert [path.name for path in checkpoint.files_in(run / "checkpoints")] == ["step_000000000256.pt"]
    assert list((run / "checkpoints").glob(".ethbrake-*"))
    go_on(run)
    assert kept(run) == whole["ppo"]
    assert not list(run.glob("**/.ethbrake-*"))


def test_resume__after_the_disk_was_full(whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, written = tmp_path / "run", Path.write_bytes

    def full(path: Path, data: bytes) -> int:
        if path.parent.name == "checkpoints" and list(path.parent.glob("step_*")):
            written(path, data[:1000])
            raise OSError(28, "No space left on device")
        return written(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(OSError, match="No space left"):
            begin("ppo", run)
    status = json.loads((run / "run.json").read_text())
    assert (status["status"], status["reason"]) == ("failed", "OSError: [Errno 28] No space left on device")
    assert status["checkpoints"] == ["step_000000000256.pt"]
    go_on(run)
    assert kept(run) == whole["ppo"]


@pytest.mark.parametrize("nth", [1, 2, 3, 4])
def test_resume__after_a_kill_while_policies_are_saved(
    nth: int, whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, rename, count = tmp_path / "run", Path.rename, 0

    def fail(progress: Progress) -> None:
        if progress.updates == 5:
            raise LookupError

    def fatal(path: Path, target: Path) -> Path:
        nonlocal count
        count += 1
        if count == nth:
            die()
        return rename(path, target)

    with pytest.raises(LookupError):
        begin("ppo", run, on_progress=fail)  # leaves policies, which are replaced later
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", fatal)
        killed(go_on, run)
    go_on(run)
    assert kept(run) == whole["ppo"]
    assert not list(run.glob("**/.ethbrake-*"))


@pytest.mark.parametrize("name", ["sac", "turns"])
def test_resume__after_ctrl_c_everything_is_the_same(name: str, whole: Whole, tmp_path: Path) -> None:
    run, seen = tmp_path / "run", list[int]()

    def ctrl_c(progress: Progress) -> None:
        seen.append(progress.updates)
        if len(seen) == 4:
            os.kill(os.getpid(), signal.SIGINT)

    stopped = begin(name, run, on_progress=ctrl_c)
    assert (stopped.status, stopped.updates) == ("interrupted", seen[-1])
    assert json.loads((run / "run.json").read_text())["status"] == "interrupted"
    go_on(run)
    assert kept(run) == whole[name]


def test_resume__an_error_of_a_listener_stops_it_and_loses_nothing(whole: Whole, tmp_path: Path) -> None:
    run = tmp_path / "run"

    def fail(progress: Progress) -> None:
        if progress.updates == 5:
            raise LookupError("mine")

    with pytest.raises(LookupError, match="mine"):
        begin("ppo", run, on_progress=fail)
    status = json.loads((run / "run.json").read_text())
    assert (status["status"], status["reason"], status["updates"]) == ("failed", "LookupError: mine", 5)
    go_on(run)
    assert kept(run) == whole["ppo"]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A training that was killed after five of nine updates; its checkpoints are after two and four."""
    killed(begin, "ppo", tmp_path / "run", on_progress=dying_after(5))
    return tmp_path / "run"


def spoil(path: Path) -> None:
    """Change one byte of the largest part of a checkpoint."""
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
    "half of it": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "nothing": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("hello"),
    "code": lambda path: torch.save({"training": Evil()}, path),
    "other data": lambda path: torch.save({"training": 1}, path),
    "a list": lambda path: torch.save([1], path),
    "a link": lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_resume__goes_back_behind_a_damaged_checkpoint(
    damage: str, run: Path, whole: Whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(run.parent)
    newest = checkpoint.files_in(run / "checkpoints")[0]
    DAMAGE[damage](newest)
    notes: list[str] = []
    go_on(run, on_progress=lambda progress: notes.append(progress.note) if progress.note else None)
    assert len(notes) == 1 and notes[0].startswith(f"deleted a damaged checkpoint: {newest}: is ")
    assert kept(run) == whole["ppo"]
    assert not Path("evil").exists()


def test_resume__without_a_checkpoint_it_begins_again(run: Path, whole: Whole) -> None:
    for path in checkpoint.files_in(run / "checkpoints"):
        path.unlink()
    go_on(run)
    assert kept(run) == whole["ppo"]


def forged(saved: dict[str, Any], place: str, value: Any) -> None:
    """Put a value in its place in a checkpoint."""
    *parts, last = place.split("/")
    for part in parts:
        saved = saved[int(part) if isinstance(saved, list) else part]
    saved[last if isinstance(saved, dict) else int(last)] = value


FORGED = {
    "model/environment/stream": [1, "2"],
    "model/environment/episode": [torch.zeros(8, 7, 3, dtype=torch.float64)],
    "model/environment/_steps": torch.zeros(8),
    "model/last/0": torch.zeros(8, 5),
    "model/counters/num_timesteps": -1,
    "model/counters/_n_updates": 1.5,
    "model/numpy/state/key": torch.zeros(3, dtype=torch.uint32),
    "model/torch": torch.zeros(3, dtype=torch.uint8),
    "model/python": (3, (1, 2), None),
    "model/parameters/policy/log_std": torch.zeros(2),
    "model/parameters/policy.optimizer/state": {0: {"step": torch.tensor(1.0), "exp_avg": torch.zeros(1)}},
    "model/parameters/policy": {},
    "model/episodes": [["x", 1]],
    "model/log": {"x": [1.0]},
    "course/ended": {},
    "course/evaluations": [{"steps": "x"}],
    "course/best": {"vehicle_2": {"policy.0.weight": torch.zeros(1)}},
    "course/progress": 7,
    "model/actions": {"bit_generator": "PCG64"},
}


@pytest.mark.parametrize("place", FORGED)
def test_resume__a_forged_checkpoint_is_refused_in_one_line(place: str, run: Path) -> None:
    newest = checkpoint.files_in(run / "checkpoints")[0]
    saved = checkpoint.read(newest)
    forged(saved, place, FORGED[place])
    torch.save(saved, newest)
    states = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    with pytest.raises(CorruptBundle, match=r"the checkpoint of step 512 does not fit this training: .*; delete this"):
        go_on(run)
    assert states == (random.getstate(), np.random.get_state()[1].tolist())  # noqa: NPY002
    assert newest.exists()


def test_resume__weights_that_are_not_finite_are_refused(run: Path) -> None:
    newest = checkpoint.files_in(run / "checkpoints")[0]
    saved = checkpoint.read(newest)
    saved["model"]["parameters"]["policy"]["log_std"][0] = float("nan")
    torch.save(saved, newest)
    with pytest.raises(CorruptBundle, match="not finite"):
        go_on(run)


@pytest.mark.parametrize("name", ["torch", "numpy", "physics"])
def test_resume__other_versions_are_refused_unless_accepted(name: str, run: Path, whole: Whole) -> None:
    newest = checkpoint.files_in(run / "checkpoints")[0]
    saved = checkpoint.read(newest)
    saved["versions"][name] = "0.1"
    torch.save(saved, newest)
    with pytest.raises(InvalidInput, match=rf"this training began with {name} 0\.1, but {name} .* is installed"):
        go_on(run)
    go_on(run, other_versions=True)
    assert kept(run) == whole["ppo"]


def test_resume__an_edited_configuration_is_another_training(run: Path) -> None:
    config = json.loads((run / "config.json").read_text())
    config["recipe"]["gamma"] = 0.9
    (run / "config.json").write_text(json.dumps(config))
    with pytest.raises(InvalidInput, match=r"config\.json: this file was changed after the checkpoint of step 512"):
        go_on(run)


def test_resume__checkpoints_of_version_0_5_are_refused(run: Path) -> None:
    for path in checkpoint.files_in(run / "checkpoints"):
        path.unlink()
    (run / "checkpoints" / "step_000000000512").mkdir()
    with pytest.raises(InvalidInput, match="step_000000000512: another version of this package wrote this checkpoint"):
        go_on(run)


def test_resume__a_finished_training_is_refused(tmp_path: Path) -> None:
    begin("ppo", tmp_path / "run", measure=None)
    with pytest.raises(InvalidInput, match="this training has finished and cannot be resumed"):
        go_on(tmp_path / "run")


def test_resume__one_process_at_a_time(run: Path) -> None:
    before = kept(run)
    with RunFolder(run).held(), pytest.raises(InvalidInput, match="another process is training in this folder"):
        go_on(run)
    assert kept(run) == before


LINKS = {  # what may stand in a run as a link out of it -> whether the run is refused then
    "checkpoints": True,
    "tensorboard": True,
    "policy": True,
    "run.lock": True,
    "progress.csv": False,
    "team.json": False,
}


@pytest.mark.parametrize("name", LINKS)
def test_resume__follows_no_link_out_of_the_run(name: str, run: Path) -> None:
    outside = run.parent / "outside"
    outside.mkdir()
    (outside / "precious.txt").write_text("precious")
    path = run / name
    target = outside if path.is_dir() or name == "policy" else outside / "precious.txt"
    if path.is_dir():
        store.remove_folder(path)
    path.unlink(missing_ok=True)
    path.symlink_to(target)
    if LINKS[name]:
        with pytest.raises(InvalidInput, match=f"{name}: "):
            go_on(run)
    else:
        go_on(run)
    assert [file.name for file in outside.iterdir()] == ["precious.txt"]
    assert (outside / "precious.txt").read_text() == "precious"


def test_tiny__is_the_training_that_these_tests_think_of() -> None:
    assert TINY.total_steps // (TINY.n_envs * TINY.n_steps) == 9
