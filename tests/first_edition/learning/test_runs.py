"""Trainings: what they leave and tell, when they stop; stopped, killed or damaged they go on to the same bits."""

import hashlib
import json
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import AlreadyExists, EthBrakeError, InvalidInput
from ethbrake_marl.files.store import new_folder, write_file
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.summary import summarise
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.layers import dense
from ethbrake_marl.first_edition.policies.policy import Policy
from ethbrake_marl.first_edition.policies.teams import Trained, read_trained
from ethbrake_marl.first_edition.scenario.catalogue import shipped_folder
from ethbrake_marl.first_edition.training import session as train_module
from ethbrake_marl.first_edition.training.checkpoint import (
    ARRAYS,
    NUMBERS,
    TrainingState,
    read_checkpoint,
    write_checkpoint,
)
from ethbrake_marl.first_edition.training.finite import TrainingDiverged
from ethbrake_marl.first_edition.training.logs import open_logs
from ethbrake_marl.first_edition.training.progress import Course
from ethbrake_marl.first_edition.training.recipe import LearningRate, TrainingRecipe, load_recipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.session import TrainResult, resume
from ethbrake_marl.first_edition.training.training import Training
from ethbrake_marl.progress import Progress
from tests.docs.site import load
from tests.first_edition.learning.tiny import (
    LINKS,
    OUTSIDE,
    PRECIOUS,
    TINY_PPO,
    TINY_SAC,
    Answer,
    ctrl_c_in,
    files_of,
    link_out,
    newest,
    scalars,
    watch_steps,
)

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of those who read event files
SCENARIO = eb.load_scenario("paper-random")
UPDATE = 8 * 16  # decisions
EVERY_SECOND = {"every_updates": 2, "worlds": 10, "seed": 7}
TINY = TINY_PPO.replace(total_steps=3 * UPDATE, evaluation=EVERY_SECOND)
train = partial(train_module.train, measure=None)


def status_of(run: Path) -> dict[str, Any]:
    return json.loads((run / "run.json").read_text())


def test_train__leaves_a_complete_folder(tmp_path: Path) -> None:
    def mean_weight(policy: Policy) -> dict[str, float]:
        return {"mean_weight": float(policy.tensors["policy.0.weight"].mean())}

    recipe, run, seen = TINY.replace(n_steps=128, total_steps=3 * 1024), tmp_path / "run", list[Progress]()
    result = train(recipe, SCENARIO, run, measure=lambda training: mean_weight, on_progress=seen.append)
    steps = [0, 1024, 2048, 3072]
    assert (result.status, result.steps, result.updates) == ("finished", 3072, 3)
    assert [e["updates"] for e in result.evaluations] == [0, 2, 3]
    assert [p.done for p in seen] == steps and seen[-1].metrics["episode_return"] < 0.0
    assert sorted(path.name for path in run.iterdir() if path.is_dir()) == ["policy", "policy-last", "tensorboard"]
    assert [path.stat().st_size > 0 for path in (run / "tensorboard").iterdir()] == [True]
    config = json.loads((run / "config.json").read_text())
    assert TrainingRecipe.of(config["recipe"]) == recipe and config["scenario"]["name"] == "paper-random"
    assert config["versions"]["torch"] in torch.__version__
    expected = {"status": "finished", "steps": 3072, "policy": "policy", "checkpoints": []}
    assert status_of(run).items() >= expected.items()
    rows = RunDirectory(run).rows()
    told = [(int(row["steps"]), row["eval/mean_weight"] != "") for row in rows]
    assert told == list(zip(steps, [True, False, True, True], strict=True))
    last = {name: float(rows[-1][name]) for name in rows[-1] if name.startswith(("eval/mean", "rollout/"))}
    assert last["eval/mean_weight"] == result.evaluations[-1]["mean_weight"]
    assert 0.0 <= last["rollout/collision_rate"] <= 1.0
    assert last["rollout/total_harm"] >= last["rollout/first_impact_harm"] > 0.0
    rates = [float(row["train/learning_rate"]) for row in rows[1:]]
    assert rates == pytest.approx([recipe.learning_rate.at(share) for share in (2 / 3, 1 / 3, 0.0)])
    loaded = load_policy(run).manifest
    assert (loaded, loaded.learners, loaded.steps) == (result.policy.manifest, ("vehicle_2",), 3072)


def test_train__is_bitwise_reproducible_and_leaves_global_random_states(tmp_path: Path) -> None:
    states = random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()  # noqa: NPY002
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        train(TINY, SCENARIO, tmp_path / name, seed=seed)
    a, b, c = (files_of(tmp_path / name) for name in "abc")
    assert a == b and a["policy/weights.safetensors"] != c["policy/weights.safetensors"]
    assert states == (random.getstate(), np.random.get_state()[1].tolist(), torch.get_rng_state().tolist())  # noqa: NPY002
    assert load_policy(tmp_path / "c").manifest.seeds == {"training": 6, "evaluation": TINY.evaluation.seed}


def test_train__ctrl_c_stops_after_the_update_in_progress_and_a_second_one_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    once, twice = tmp_path / "once", tmp_path / "twice"
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    watch_steps(monkeypatch, ctrl_c_in(20))  # in the second rollout of 16 steps
    result = train(TINY, SCENARIO, once, steps=100 * UPDATE)
    assert (result.status, result.updates, result.steps) == ("interrupted", 2, 2 * UPDATE)
    watch_steps(monkeypatch, ctrl_c_in(20, 21))
    with pytest.raises(KeyboardInterrupt):
        train(TINY, SCENARIO, twice, steps=100 * UPDATE)
    assert [status_of(run)["status"] for run in (once, twice)] == ["interrupted"] * 2
    assert [load_policy(run).manifest.steps for run in (once, twice)] == [2 * UPDATE, UPDATE]
    assert (len(RunDirectory(once).rows()), signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == (
        2,
        *before,
    )


def planted(*harms: float) -> Callable[[Training], Callable[[Policy], dict[str, float]]]:
    """Measures harms that were written down before, so that a training seems to collapse."""
    left = list(harms)
    return lambda training: lambda policy: {"first_impact_harm": left.pop(0)}


def not_good_enough(evaluation: Mapping[str, float]) -> str | None:
    return "60 will not do" if (evaluation["updates"], evaluation["first_impact_harm"]) == (4, 60.0) else None


def test_train__stops_where_it_should_and_goes_on_to_the_same_bits(tmp_path: Path) -> None:
    harms = (90.0, 7.0, 60.0, 61.0, 7.0)
    whole = train(TINY, SCENARIO, tmp_path / "whole", steps=8 * UPDATE, measure=planted(*harms))
    run = tmp_path / "run"
    stopped = train(TINY, SCENARIO, run, steps=8 * UPDATE, measure=planted(*harms), stop_at=not_good_enough)
    assert (stopped.status, stopped.updates, whole.updates) == ("interrupted", 4, 8)
    assert status_of(run)["status"] == "interrupted" and "60 will not do" in status_of(run)["reason"]
    assert load_policy(run).manifest.steps == 2 * UPDATE  # of the least harm
    left = planted(*harms[3:])
    result = resume(run, measure=left, on_progress=None, stop_at=not_good_enough)
    assert (result.status, result.evaluations) == ("finished", whole.evaluations)
    assert files_of(run) == files_of(tmp_path / "whole")


def test_train__measures_what_an_evaluation_of_the_kept_policy_tells(tmp_path: Path) -> None:
    check_measured(tmp_path / "run")


def check_measured(run: Path) -> None:
    result = train_module.train(TINY, SCENARIO, run, steps=UPDATE, on_progress=None)
    worlds = result.training.scenario.sample(TINY.evaluation.worlds, TINY.evaluation.seed)
    agents = {"policy": eb.LearnedAgent(result.last_policy, "policy")}
    (row,) = summarise(evaluate(worlds, agents, scenario=result.training.scenario))
    names = ("first_impact_harm", "total_harm", "collision_rate")
    told = {name: getattr(row, name).value for name in names} | {"horizon_rate": row.horizon_ends / row.episodes}
    assert result.evaluations[-1].items() >= told.items()


NOT_FINITE = r"rewards\[row 0\] = nan at step 160: must be finite"


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # the training library's own statistics overflow first
@pytest.mark.parametrize(
    ("recipe", "scheme", "reward", "message"),
    [
        (TINY, None, np.nan, NOT_FINITE),
        (TINY, None, 1e25, r"train/loss = inf after step 256: must be finite"),
        (TINY, None, 3e38, r"the gradient of the loss is not finite at step 256"),
        (TINY, "independent", np.nan, NOT_FINITE.replace("160", "320")),
        (TINY_SAC, None, np.nan, NOT_FINITE),
        (TINY_SAC, None, 3e38, r"(the gradient of the loss is not finite|critic_loss = inf)"),
    ],
)
def test_train__numbers_that_are_not_finite_stop_it_and_keep_the_last_good_policy(
    recipe: TrainingRecipe, scheme: Any, reward: float, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def spoil(step: int, answer: Answer) -> Answer:
        if step == 20:
            answer[1][:] = reward
        return answer

    watch_steps(monkeypatch, spoil)
    scenario = eb.load_scenario("cooperation-3-pair") if scheme else SCENARIO
    with pytest.raises(TrainingDiverged, match=message):
        train(recipe, scenario, tmp_path / "run", steps=max(2 * UPDATE, recipe.total_steps), scheme=scheme)
    assert status_of(tmp_path / "run")["status"] == "failed"
    assert status_of(tmp_path / "run")["reason"].startswith("TrainingDiverged: training: ")
    kept = read_trained(tmp_path / "run" / "policy-last")
    assert 0 < kept.steps <= 256
    for policy in kept.drivers.values():
        assert all(np.isfinite(tensor).all() for tensor in policy.tensors.values())


OF_THEIR_KIND = ("cooperation-ppo", "ppo-paper", "sac-paper")  # others differ in numbers
CORE_RECIPES = [name for name, file in TrainingRecipe.shipped().items() if file.parent == shipped_folder("train")]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in OF_THEIR_KIND else pytest.mark.slow) for name in CORE_RECIPES]
)
def test_shipped_recipe__trains_for_one_update(name: str, tmp_path: Path) -> None:
    recipe = load_recipe(name)
    if recipe.algorithm == "ppo":
        recipe = recipe.replace(n_envs=16, n_steps=recipe.batch_size // 16)
    else:
        recipe = recipe.replace(n_envs=1)
    check_one_update(recipe, tmp_path / "run")


def check_one_update(recipe: TrainingRecipe, run: Path) -> None:
    result = train(recipe, SCENARIO, run, steps=1)
    assert (result.status, result.updates, result.steps) == ("finished", 1, recipe.n_envs * recipe.rounds)
    assert load_policy(run).manifest.algorithm == recipe.algorithm


def test_course__the_best_is_judged_by_the_count_of_the_reward_and_comes_back_from_json(policy) -> None:
    other = policy.__class__(policy.manifest.model_copy(update={"steps": 5}), policy.tensors)
    course, again = Course("total"), Course("total")
    second = {"first_impact_harm": 1.0, "total_harm": 11.0, "objective": 1.0}
    course.add_evaluation(policy, {"first_impact_harm": 9.0, "total_harm": 10.0}, None)
    course.add_evaluation(other, second, -3.0)
    again.restore(course.to_json())
    assert course.chosen is policy  # by the harm, as it was begun without an objective
    assert (again.evaluations, again.best_harm) == (course.evaluations, 10.0)
    assert again.wall_s >= course.wall_before_s
    assert course.evaluations[1] == {"steps": 0, "updates": 0, **second, "episode_return": -3.0}


def test_write_file__replaces_in_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.json"
    path.write_bytes(b"old")
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr("os.replace", lambda *given: 1 / 0)  # a power cut
        write_file(path, b"new, but only half of i")
    assert path.read_bytes() == b"old"
    write_file(path, b"new")
    assert path.read_bytes() == b"new" and list(tmp_path.iterdir()) == [path]


def test_new_folder__is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    with new_folder(tmp_path / "a" / "good") as partial:
        (partial / "x").touch()
        assert not (tmp_path / "a" / "good").exists()
    with pytest.raises(KeyboardInterrupt), new_folder(tmp_path / "a" / "bad") as partial:
        (partial / "x").touch()
        raise KeyboardInterrupt
    with pytest.raises(AlreadyExists, match="taken: already exists"), new_folder(tmp_path / "a" / "taken"):
        (tmp_path / "a" / "taken").mkdir()  # meanwhile, by somebody else
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")) == ["a", "a/good", "a/good/x", "a/taken"]


def test_open_logs__goes_on_after_the_rows_of_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Event files are named by the second in which they begin."""
    clock = iter(range(10**9, 2 * 10**9))
    monkeypatch.setattr(time, "time", lambda: float(next(clock)))
    run = RunDirectory(tmp_path)

    def write(state: TrainingState | None, **losses: float) -> None:
        """One stretch of a training, a row for each loss."""
        formats = open_logs(run, state)
        for name, loss in losses.items():
            step = int(name[1:])
            for each in formats:
                each.write({"steps": step, "loss": loss}, {"steps": ("tensorboard",), "loss": ()}, step)
        for each in formats:
            each.close()

    write(None, s1=0.9)
    progress = run.progress.read_text()
    write(TrainingState({"steps": 1, "progress": progress}, {}), s2=0.8, s3=np.float32(0.7))
    progress = "".join(run.progress.read_text().splitlines(keepends=True)[:3])
    write(TrainingState({"steps": 2, "progress": progress}, {}), s3=0.6, s4=0.5)
    expected = [(1, 0.9), (2, 0.8), (3, 0.6), (4, 0.5)]
    assert [(int(row["steps"]), float(row["loss"])) for row in run.rows()] == expected
    assert scalars(run.tensorboard) == {"loss": [(step, pytest.approx(loss)) for step, loss in expected]}
    write(None, s1=0.4)
    assert len(run.rows()) == 1 and scalars(run.tensorboard)["loss"] == [(1, pytest.approx(0.4))]
    write(TrainingState({"steps": 0, "progress": ""}, {}), s1=0.3)  # before the first row
    assert run.rows() == [{"steps": "1", "loss": "0.3"}]


# ---------------------------------------------------------------- going on


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


def told_by(run: Path) -> tuple[list[dict[str, str]], dict[str, dict[int, float]]]:
    """The progress table and the events, without their clocks; event files of one second have no order."""
    return (
        [{name: value for name, value in row.items() if name not in CLOCKS} for row in RunDirectory(run).rows()],
        {tag: dict(told) for tag, told in scalars(run / "tensorboard").items() if tag not in CLOCKS},
    )


def trained_once(trainings: Mapping[str, Any], factory: pytest.TempPathFactory) -> Whole:
    """The training of each kind that nobody stops."""
    made: dict[str, tuple[Path, TrainResult]] = {}

    def get(name: str) -> tuple[Path, TrainResult]:
        if name not in made:
            folder = factory.mktemp("whole") / name
            made[name] = folder, train(*trainings[name], folder, measure=measure)
        return made[name]

    return get


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    return trained_once(TRAININGS, tmp_path_factory)


def stop(training: tuple[TrainingRecipe, eb.Scenario], run: Path, at: tuple[str, int]) -> TrainResult:
    """Train until Ctrl-C in a step of the environment, or after an update."""
    unit, number = at

    def ctrl_c(progress: Progress) -> None:
        if (unit, number) == ("update", progress.updates):
            signal.raise_signal(signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch:
        watch_steps(patch, ctrl_c_in(number if unit == "step" else 0))
        return train(*training, run, measure=measure, on_progress=ctrl_c)


@pytest.fixture(scope="module")
def stopped_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A PPO run stopped with two checkpoints."""
    run = tmp_path_factory.mktemp("stopped") / "run"
    stop(TRAININGS["ppo"], run, ("step", 100))
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
        *(
            pytest.param(name, ("step", number), marks=pytest.mark.slow)
            for name, numbers in (
                ("ppo", (1, 61, 76)),
                ("sac", (1, 37, 61)),
                ("shared", (72,)),
                ("independent", (72,)),
                ("centralised", (72,)),
            )
            for number in numbers
        ),
    ],
    ids=str,
)
def test_resume__after_ctrl_c_everything_is_as_if_nobody_had_stopped_it(
    name: str, at: tuple[str, int], whole: Whole, tmp_path: Path
) -> None:
    check_resumed(TRAININGS[name], tmp_path / "run", at, *whole(name))


def check_resumed(
    training: tuple[TrainingRecipe, eb.Scenario], run: Path, at: tuple[str, int], reference: Path, expected: TrainResult
) -> None:
    stopped = stop(training, run, at)
    assert stopped.status == "interrupted" and 0 <= stopped.steps < expected.steps
    result = resume(run, measure=measure)
    assert (result.status, result.steps, result.updates) == ("finished", expected.steps, expected.updates)
    assert result.evaluations == expected.evaluations
    assert_same(run, reference)


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
from ethbrake_marl.first_edition.envs.sb3 import EthBrakeVecEnv
from ethbrake_marl.first_edition.training.session import train
from tests.first_edition.learning.test_runs import TRAININGS, measure
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
    root, run = Path(__file__).resolve().parents[3], tmp_path / "run"
    killed = subprocess.run([sys.executable, "-c", KILLED, name, str(run)], cwd=root, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert json.loads((run / "run.json").read_text())["status"] == "running"
    resume(run, measure=measure)
    assert_same(run, whole(name)[0])


def half(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def other_digit(path: Path) -> None:
    text = path.read_text()
    at = text.index('"steps": ') + 9
    path.write_text(text[:at] + str((int(text[at]) + 1) % 10) + text[at + 1 :])


def other_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("file", "damage"),
    [(NUMBERS, half), (NUMBERS, other_digit), (ARRAYS, half), (ARRAYS, other_byte), (ARRAYS, Path.unlink)],
)
def test_resume__a_damaged_checkpoint_is_found_and_the_one_before_is_used(
    file: str, damage: Callable[[Path], object], whole: Whole, run: Path
) -> None:
    notes: list[str] = []
    damage(newest(run) / file)
    told = f"deleted a damaged checkpoint: {newest(run)}"
    resume(run, measure=measure, on_progress=lambda p: notes.append(p.note) if p.note else None)
    assert len(notes) == 1 and notes[0].startswith(told)
    assert_same(run, whole("ppo")[0])


def test_resume__without_any_checkpoint_it_starts_again(whole: Whole, run: Path) -> None:
    for file in run.glob(f"checkpoints/step_*/{NUMBERS}"):
        half(file)
    (run / ".ethbrake-left.partial").mkdir()
    resume(run, measure=measure)
    assert_same(run, whole("ppo")[0])
    assert not (run / ".ethbrake-left.partial").exists()


def test_resume__with_other_versions_is_refused_unless_it_is_asked_for(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_module, "installed_versions", lambda: {"torch": "99.0"})
    with pytest.raises(
        InvalidInput, match=r"this training run began with ethbrake-marl .* and may compute other numbers"
    ):
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
    told = r"config.json: this file was changed after the checkpoint step_\d+ was written"
    with nullcontext() if same else pytest.raises(InvalidInput, match=told):
        assert resume(run, measure=measure).status == "finished"


def test_resume__one_process_at_a_time(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def second(step: int, answer: Answer) -> Answer:
        if step == 5:
            asked.append(step)
            with pytest.raises(InvalidInput, match="another process is training in this folder"):
                resume(run, measure=measure)
        return answer

    watch_steps(monkeypatch, second)
    resume(run, measure=measure)
    assert asked == [5]


FORGED_ARRAYS = {
    "optimizer.policy.0.exp_avg": np.zeros((2, 1), np.float32),
    "optimizer.policy.0.step": np.zeros(3, np.float32),
    "environment.begun": np.zeros((2, 3, 9)),
    "environment.return": np.full(8, np.nan),
    "last.observations": np.zeros((2, 27), np.float32),
    "last.episode_starts": np.zeros(7, np.bool_),
}
FORGED_COUNTERS = {"num_timesteps": 1 << 70, "_n_updates": "x", "_current_progress_remaining": None, "_episode_num": -1}


@pytest.mark.parametrize("name", [*FORGED_ARRAYS, *FORGED_COUNTERS, "optimizer.policy.1.exp_avg_sq", "updates"])
def test_resume__a_forged_checkpoint_is_refused_in_one_line(run: Path, name: str) -> None:
    place = newest(run)
    (numbers, arrays), told = read_checkpoint(place), name.rpartition(".")[2]
    shutil.rmtree(place)
    if name in FORGED_ARRAYS:
        arrays[name] = FORGED_ARRAYS[name]
        told = "" if name.startswith("optimizer") else told  # torch says what is wrong
    elif name in FORGED_COUNTERS:
        numbers["counters"][name] = FORGED_COUNTERS[name]
    elif name == "updates":
        numbers[name] = -1
    else:
        del arrays[name]
    write_checkpoint(place, TrainingState(numbers, arrays))
    with pytest.raises(
        EthBrakeError, match=rf"does not fit this training run: .*{told}.*; delete this checkpoint to resume"
    ) as error:
        resume(run, measure=measure)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", LINKS)
def test_resume__follows_no_link_out_of_the_run(run: Path, name: str) -> None:
    outside = run.parents[1] / OUTSIDE
    (outside / "step_000000000001").mkdir(parents=True)
    (outside / PRECIOUS).write_text("years of work")
    link_out(name, run)
    try:
        resume(run, measure=None)
    except (InvalidInput, FileExistsError):
        pass
    else:
        assert not LINKS[name][1]
    assert sorted(path.name for path in outside.iterdir()) == [PRECIOUS, "step_000000000001"]
    assert (outside / PRECIOUS).read_text() == "years of work"


def test_learning_rate__falls_as_a_cosine_and_never_rises_again() -> None:
    # The last rollout may overshoot the end; the rate must not rise again.
    rate = LearningRate(start=5e-4, end=1e-4)
    assert [round(rate.at(left), 12) for left in (1.0, 0.75, 0.5, 0.0, -0.1)] == [
        0.0005,
        0.000441421356,
        0.0003,
        0.0001,
        0.0001,
    ]
    # 1e-4 + 4e-4 * (1.0 + 0.5**0.5) / 2.0 = 0.0004414213562373095


def test_network_of_the_paper__has_the_tensors_of_its_table() -> None:
    assert [(row.name, row.shape) for row in eb.load_recipe("ppo-paper").network_spec(27).tensors] == [
        ("policy.0.weight", (256, 27)),
        ("policy.0.bias", (256,)),
        ("policy.1.weight", (256, 256)),
        ("policy.1.bias", (256,)),
        ("policy.output.weight", (1, 256)),
        ("policy.output.bias", (1,)),
        ("policy.log_std", (1,)),
        ("value.0.weight", (256, 27)),
        ("value.0.bias", (256,)),
        ("value.1.weight", (256, 256)),
        ("value.1.bias", (256,)),
        ("value.2.weight", (128, 256)),
        ("value.2.bias", (128,)),
        ("value.output.weight", (1, 128)),
        ("value.output.bias", (1,)),
    ]


def test_dense_layer__by_hand() -> None:
    weight = np.array([[1, 2, 3, 4, 5], [0, 0, 0, 0, -1]], np.float32)
    x, y = np.array([[1, 0], [1, 0], [1, 0], [1, 0], [1, 2]], np.float32), np.empty((2, 2), np.float32)
    dense(weight, np.array([10, 20], np.float32), x, y)
    assert y.tolist() == [[25.0, 20.0], [19.0, 18.0]]


def test_script_with_a_memory__leaves_a_folder_whose_agent_remembers(
    empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recurrent = load("../../train/recurrent")
    for name, more, alike in (("gru", [], False), ("none", ["--memoryless"], True)):
        line = "recurrent.py --scenario cooperation-3-pair --updates=1 --worlds=8 --output"
        monkeypatch.setattr("sys.argv", [*line.split(), name, *more])
        recurrent.main()
        agent = recurrent.make_agent(name, None)
        seen = np.zeros((2, agent.observation.size), np.float32)
        zeros, ones = (agent._infer(seen, np.full((2, 64), size, np.float32))[0] for size in (0.0, 1.0))
        assert (zeros == ones).all() == alike
        assert (agent.observation.size, agent.observation.features[-1].name) == (30, "place")
    made = eb.make_agent(f"{recurrent.__file__}:make_agent:gru", scenario=PAIR)
    assert eb.evaluate(PAIR.sample(5, 7), {"gru": made}, scenario=PAIR).worlds.n == 5
