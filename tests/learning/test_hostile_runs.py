"""Run folders from elsewhere: nothing outside them is touched, and checkpoints must be of the training."""

from __future__ import annotations

import json
import random
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.learning.runs import resume
from tests.programmes.folders import CHANGES, RUN, listed_anew, newest, stopped


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """An interrupted training that may be changed."""
    shutil.copytree(stopped("ppo"), tmp_path / "inside" / RUN)
    return tmp_path / "inside" / RUN


def _state(run: Path, change: dict[str, object]) -> None:
    path = newest(run) / "state.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    listed_anew(newest(run))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"counters": {}}, "counters.num_timesteps: is missing"),
        ({"random": {"numpy": [0, 0, 0.0], "python": [3, None], "actions": {}}}, "random.actions.bit_generator"),
        ({"log": {"a": ["x", 1, []]}}, "log.a.0"),
        ({"events": {"x": "1"}}, "events.x"),
        ({"between": []}, "between: must be a mapping"),
        ({"more": 1}, "more: unknown key"),
    ],
)
def test_resume__a_listing_that_agrees_does_not_make_a_checkpoint(
    run: Path, change: dict[str, object], reason: str
) -> None:
    """It is refused, and stays: what is as it was written is of another version, not damaged."""
    _state(run, change)
    with pytest.raises(InvalidInput, match=rf"state.json: .*{re.escape(reason)}.*; every file .* go on with that"):
        resume(run)
    assert json.loads((newest(run) / "state.json").read_text()).items() >= change.items()


@pytest.mark.parametrize(
    ("name", "array", "reason"),
    [
        ("policy.log_std", np.zeros(2, np.float32), r"'policy.log_std' is <f4 \[2\], should be <f4 \[1\]"),
        ("policy.log_std", np.full(1, np.nan, np.float32), r"'policy.log_std' holds a number that is not finite"),
        ("environment.begun", np.nan, r"'environment.begun' holds a number that is not finite"),
        ("environment.engine.script.1.act", np.zeros(3), r"'environment.engine.script.1.act' does not belong here"),
        ("random.python", np.full(625, 2**40, np.uint64), r"'random.python' is no state"),
        ("environment.engine.stream", np.array([0, 2**60], np.uint64), r"'environment.engine.stream' is"),
    ],
)
def test_resume__arrays_must_be_those_of_this_training(run: Path, name: str, array: object, reason: str) -> None:
    path = newest(run) / "arrays.safetensors"
    arrays = safetensors.numpy.load(path.read_bytes())
    arrays[name] = np.full_like(arrays[name], array) if isinstance(array, float) else array
    path.write_bytes(safetensors.numpy.save(arrays))  # type: ignore[arg-type]
    listed_anew(newest(run))
    before = {file: file.read_bytes() for file in run.rglob("*") if file.is_file() and file.name != "run.lock"}
    with pytest.raises(CorruptBundle, match=rf"is not of this training: array {reason}"):
        resume(run)
    del before[run / "team.json"]  # follows from the configuration, and is written anew
    assert all(file.read_bytes() == data for file, data in before.items())


@pytest.mark.parametrize("category", [name for name in CHANGES if name.endswith(": link outside")])
def test_resume__follows_no_link_out_of_the_run(run: Path, category: str) -> None:
    outside = run.parents[1] / "outside"
    (outside / "step_000000000001").mkdir(parents=True)
    (outside / "precious.txt").write_text("years of work")
    CHANGES[category][3](random.Random(0), run)
    try:
        resume(run)
    except (InvalidInput, FileExistsError):
        pass
    else:
        assert not CHANGES[category][2]
    assert sorted(path.name for path in outside.iterdir()) == ["precious.txt", "step_000000000001"]
    assert (outside / "precious.txt").read_text() == "years of work"
