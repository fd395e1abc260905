"""A training that was stopped, killed or damaged goes on to the same bits, or is refused and left as it is."""

import hashlib
import json
import random
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

import ethbrake_marl as eb
from ethbrake_marl.errors import CorruptBundle, InvalidInput, Progress
from ethbrake_marl.learning import RunDirectory, Training, TrainResult, resume, runs, train
from ethbrake_marl.policies import Trained
from tests.learning.tiny import (
    MODES,
    TINY_COUNTERFACTUAL,
    TINY_MODES,
    TINY_OPTIONS,
    TINY_PPO,
    TINY_SAC,
    Answer,
    ctrl_c_in,
    files_of,
    scalars,
    watch_steps,
)
from tests.programmes.files import CHANGES, listed_anew, newest

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")
PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")
MIXTURE = eb.load_scenario(
    {"name": "both", "mixture": [{"scenario": "realistic-mixed"}, {"scenario": "realistic-truck", "weight": 2}]}
)
REMEMBERING = PAPER.replace(
    early_impacts="keep", roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "e_v2x_bm:pairwise"}
)
PPO = TINY_PPO.replace(total_steps=8 * 128)
TEAM = TINY_PPO.replace(total_steps=6 * 256)
TRAININGS = {
    "ppo": (PPO, PAPER),
    "sac": (TINY_SAC, PAPER),
    "mixture": (PPO, MIXTURE),
    "remembering": (PPO, REMEMBERING),
    "shared": (TEAM.replace(scheme="shared"), PAIR),
    "independent": (TEAM.replace(scheme="independent"), PAIR),
    "turns": (TEAM.replace(scheme="independent", turns=2), PAIR),
    "centralised": (TEAM.replace(scheme="centralised"), PAIR),
    "counterfactual": (TINY_COUNTERFACTUAL, PAPER),
    "modes": (TINY_MODES, PAPER),
    "options": (TINY_OPTIONS, PAPER),
    "scout": (TINY_MODES.replace(focus=0.75, modes=MODES | {"tie_break": 0.0}), PAPER),
}
Whole = Callable[[str], tuple[Path, TrainResult]]


def measure(training: Training) -> Callable[[Trained], dict[str, float]]:
    """Something that depends on every weight and changes all the time."""

    def harm(trained: Trained) -> dict[str, float]:
        names = "".join(policy.manifest.weights_sha256 for policy in trained.drivers.values())
        digest = hashlib.sha256(names.encode()).digest()
        return {"first_impact_harm": digest[0] / 8.0, "total_harm": digest[1] / 8.0}

    return harm


CLOCKS = ("time/fps", "time/time_elapsed")


def told_by(run: Path) -> tuple[list[dict[str, str]], dict[str, list[tuple[int, float]]]]:
    """The progress table and the events, without their clocks."""
    return (
        [{name: value for name, value in row.items() if name not in CLOCKS} for row in RunDirectory(run).rows()],
        {tag: told for tag, told in scalars(run / "tensorboard").items() if tag not in CLOCKS},
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """The training of each kind that nobody stops."""
    made: dict[str, tuple[Path, TrainResult]] = {}

    def get(name: str) -> tuple[Path, TrainResult]:
        if name not in made:
            folder = tmp_path_factory.mktemp("whole") / name
            made[name] = folder, train(*TRAININGS[name], folder, measure=measure)
        return made[name]

    return get


def stop(name: str, run: Path, at: tuple[str, int]) -> TrainResult:
    """Train until Ctrl-C in a step of the environment, or after an update."""
    unit, number = at

    def ctrl_c(progress: Progress) -> None:
        if (unit, number) == ("update", progress.updates):
            signal.raise_signal(signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch:
        watch_steps(patch, ctrl_c_in(number if unit == "step" else 0))
        return train(*TRAININGS[name], run, measure=measure, on_progress=ctrl_c)


@pytest.fixture(scope="module")
def stopped_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A PPO run stopped with two checkpoints."""
    run = tmp_path_factory.mktemp("stopped") / "run"
    stop("ppo", run, ("step", 100))
    assert len(list(run.glob("checkpoints/step_*"))) == 2
    return run


@pytest.fixture
def run(stopped_once: Path, tmp_path: Path) -> Path:
    """A copy of it that may be changed."""
    return Path(shutil.copytree(stopped_once, tmp_path / "inside" / "run"))


def assert_same(run: Path, reference: Path) -> None:
    assert files_of(run) == files_of(reference)
    assert told_by(run) == told_by(reference)
    assert json.loads((run / "run.json").read_text())["status"] == "finished"
    assert not (run / "checkpoints").exists()


FAST = [("ppo", 37), ("sac", 52), ("mixture", 70), ("remembering", 100), ("turns", 72)]


@pytest.mark.parametrize(
    ("name", "at"),
    [
        *((name, ("step", step)) for name, step in FAST),
        ("counterfactual", ("update", 5)),
        ("modes", ("update", 5)),
        *(
            pytest.param(name, (unit, number), marks=pytest.mark.slow)
            for name, unit, numbers in (
                ("ppo", "step", (1, 61, 76)),
                ("sac", "step", (1, 37, 61)),
                ("shared", "step", (72,)),
                ("independent", "step", (72,)),
                ("centralised", "step", (72,)),
                ("modes", "update", (3, 7)),  # in its other stages
                ("scout", "update", (5,)),
            )
            for number in numbers
        ),
    ],
    ids=str,
)
def test_resume__after_ctrl_c_everything_is_as_if_nobody_had_stopped_it(
    name: str, at: tuple[str, int], whole: Whole, tmp_path: Path
) -> None:
    reference, expected = whole(name)
    stopped = stop(name, tmp_path / "run", at)
    assert stopped.status == "interrupted" and 0 <= stopped.steps < expected.steps
    result = resume(tmp_path / "run", measure=measure)
    assert (result.status, result.steps, result.updates) == ("finished", expected.steps, expected.updates)
    assert result.evaluations == expected.evaluations
    assert_same(tmp_path / "run", reference)


def test_resume__after_a_failure_and_another_stop_it_ends_as_if_nothing_had_happened(
    whole: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(step: int, answer: Answer) -> Answer:
        if step == 5 * 16 + 3:
            raise RuntimeError("power cut")
        return answer

    run = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="power cut"):
        watch_steps(patch, fail)
        train(*TRAININGS["turns"], run, measure=measure)
    with monkeypatch.context() as patch:
        watch_steps(patch, ctrl_c_in(10))
        assert resume(run, measure=measure).status == "interrupted"
    (run / "team.json").write_text("{}")  # follows from the configuration, and is written anew
    resume(run, measure=measure)
    assert_same(run, whole("turns")[0])


KILLED = """
import os, signal, sys
from pathlib import Path
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.learning.runs import train
from tests.learning.test_resume import TRAININGS, measure
folder, step, left = Path(sys.argv[2]), EthBrakeVecEnv.step_wait, [5]

def step_wait(self):
    left[0] -= bool(list(folder.glob("checkpoints/step_*")))
    if left[0] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(self)

EthBrakeVecEnv.step_wait = step_wait
train(*TRAININGS[sys.argv[1]], folder, measure=measure)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["ppo", *(pytest.param(name, marks=pytest.mark.long) for name in ("sac", "independent"))]
)
def test_resume__after_kill_9_the_weights_are_the_same(name: str, whole: Whole, tmp_path: Path) -> None:
    """Another process kills itself in the fifth step after its first checkpoint; from outside one may come too late."""
    root, run = Path(__file__).resolve().parents[2], tmp_path / "run"
    killed = subprocess.run([sys.executable, "-c", KILLED, name, str(run)], cwd=root, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert json.loads((run / "run.json").read_text())["status"] == "running"
    resume(run, measure=measure)
    assert_same(run, whole(name)[0])


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        ("checkpoint.json", lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])),
        ("checkpoint.json", Path.unlink),
        ("state.json", lambda path: path.write_bytes(path.read_bytes()[:200] + b"\x07" + path.read_bytes()[201:])),
        ("arrays.safetensors", lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])),
        pytest.param("policy/weights.safetensors", Path.unlink, marks=pytest.mark.slow),
    ],
)
def test_resume__a_damaged_checkpoint_is_found_and_the_one_before_is_used(
    file: str, damage: Callable[[Path], object], whole: Whole, run: Path
) -> None:
    notes: list[str] = []
    damage(newest(run) / file)
    told = f"a damaged checkpoint was left aside: {newest(run)}"
    resume(run, measure=measure, on_progress=lambda p: notes.append(p.note) if p.note else None)
    assert len(notes) == 1 and notes[0].startswith(told)
    assert_same(run, whole("ppo")[0])


def test_resume__without_any_checkpoint_it_starts_again(whole: Whole, run: Path) -> None:
    for file in run.glob("checkpoints/step_*/state.json"):
        file.unlink()
    (run / ".ethbrake-left.partial").mkdir()
    resume(run, measure=measure)
    assert_same(run, whole("ppo")[0])
    assert not (run / ".ethbrake-left.partial").exists()


def test_resume__with_other_versions_is_refused_unless_it_is_asked_for(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "installed_versions", lambda: {"torch": "99.0"})
    with pytest.raises(InvalidInput, match=r"was trained with ethbrake-marl .*: the numbers would differ"):
        resume(run)
    assert json.loads((run / "run.json").read_text())["status"] == "interrupted"
    assert resume(run, other_versions=True).status == "finished"


WORDS = {"title": "Words change no training"}


@pytest.mark.parametrize(
    ("changes", "same"),
    [
        ({"recipe": {"gamma": 0.9}}, False),
        ({"recipe": {"seed": 5}}, False),
        ({"scenario": {"horizon_s": 9.0}}, False),
        ({"recipe": WORDS, "scenario": WORDS}, True),
    ],
)
def test_resume__an_edited_configuration_is_another_training(
    changes: dict[str, dict[str, Any]], same: bool, run: Path
) -> None:
    config = json.loads((run / "config.json").read_text())
    edited = {part: config[part] | change for part, change in changes.items()}
    (run / "config.json").write_text(json.dumps(config | edited))
    told = r"config.json: was changed after the checkpoint step_\d+ of this training"
    with nullcontext() if same else pytest.raises(InvalidInput, match=told):
        assert resume(run, measure=measure).status == "finished"


def test_resume__one_process_at_a_time(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def second(step: int, answer: Answer) -> Answer:
        if step == 5:
            asked.append(step)
            with pytest.raises(InvalidInput, match="another process is training here"):
                resume(run, measure=measure)
        return answer

    watch_steps(monkeypatch, second)
    resume(run, measure=measure)
    assert asked == [5]


@pytest.mark.parametrize(
    ("file", "change", "reason"),
    [
        ("checkpoint.json", {"format_version": 2}, "format_version = 2: must be 1"),
        ("state.json", {"training": None}, "training: is missing"),  # of a time when no checkpoint said so
        ("state.json", {"counters": {}}, "counters.num_timesteps: is missing"),
        (
            "state.json",
            {"random": {"numpy": [0, 0, 0.0], "python": [3, None], "actions": {}}},
            "random.actions.bit_generator",
        ),
        ("state.json", {"log": {"a": ["x", 1, []]}}, "log.a.0"),
        ("state.json", {"events": {"x": "1"}}, "events.x"),
        ("state.json", {"between": []}, "between: must be a mapping"),
        ("state.json", {"more": 1}, "more: unknown key"),
    ],
)
def test_resume__a_checkpoint_as_another_version_wrote_it_is_refused_and_stays(
    run: Path, file: str, change: dict[str, Any], reason: str
) -> None:
    """Its listing agrees with what is there, so it is not damaged."""
    path = newest(run) / file
    content = {**json.loads(path.read_text()), **change}
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    if file == "state.json":
        listed_anew(newest(run))
    before = {file: file.read_bytes() for file in run.glob("checkpoints/**/*.*")}
    told = rf"{file}: .*{re.escape(reason)}.*is as version .* wrote it, .*: go on with that version, or"
    with pytest.raises(InvalidInput, match=told):
        resume(run, measure=measure)
    assert {file: file.read_bytes() for file in run.glob("checkpoints/**/*.*")} == before


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
def test_resume__arrays_must_be_those_of_this_training(run: Path, name: str, array: Any, reason: str) -> None:
    path = newest(run) / "arrays.safetensors"
    arrays = safetensors.numpy.load(path.read_bytes())
    arrays[name] = np.full_like(arrays[name], array) if isinstance(array, float) else array
    path.write_bytes(safetensors.numpy.save(arrays))
    listed_anew(newest(run))
    before = {file: file.read_bytes() for file in run.rglob("*") if file.is_file() and file.name != "run.lock"}
    with pytest.raises(CorruptBundle, match=rf"is not of this training: array {reason}"):
        resume(run)
    del before[run / "team.json"]
    assert all(file.read_bytes() == data for file, data in before.items())


@pytest.mark.parametrize("category", [name for name in CHANGES if name.endswith(": link outside")])
def test_resume__follows_no_link_out_of_the_run(run: Path, category: str) -> None:
    outside = run.parents[1] / "outside"
    (outside / "step_000000000001").mkdir(parents=True)
    (outside / "precious.txt").write_text("years of work")
    CHANGES[category][3](random.Random(0), run)
    try:
        resume(run, measure=None)
    except (InvalidInput, FileExistsError):
        pass
    else:
        assert not CHANGES[category][2]
    assert sorted(path.name for path in outside.iterdir()) == ["precious.txt", "step_000000000001"]
    assert (outside / "precious.txt").read_text() == "years of work"
