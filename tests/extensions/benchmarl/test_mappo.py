"""`train/benchmarl_mappo.py`: BenchMARL's MAPPO."""

import importlib
import runpy
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import MissingExtra
from ethbrake_marl.training.training import Training
from tests.docs.site import load

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")

PROGRAM = Path(__file__).resolve().parents[3] / "train" / "benchmarl_mappo.py"
SMALL = {"n_envs": 16, "n_steps": 16, "batch_size": 128, "network": {"policy": [16, 16], "value": [16, 16]}}


@pytest.mark.parametrize(
    ("arguments", "extra", "message"),
    [
        ([], False, "-m pip install 'ethbrake-marl[marl]'"),
        (["--scenario", "cooperation-3-pear"], False, "did you mean 'cooperation-3-pair'?"),
        (["--recipe", "sac"], False, "recipe 'sac': is for SAC; MAPPO needs one for PPO"),
        (["--steps", "-5"], False, "total_steps = -5: must be greater than or equal to 1"),
        (["--output", "there"], True, "there: already exists"),
        (["--scenario", "level-0-sensors"], False, "has no learner"),
    ],
)
def test_program__refuses_what_cannot_be_before_it_trains(
    arguments: list[str],
    extra: bool,
    message: str,
    empty_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("there").mkdir()
    if extra:
        pytest.importorskip("benchmarl", reason="needs the extra marl")
        monkeypatch.setattr("benchmarl.experiment.Experiment.run", lambda *_: pytest.fail("training"))
    else:
        monkeypatch.setitem(sys.modules, "benchmarl", None)  # cannot be imported, as where the extra is missing
    monkeypatch.setattr(sys, "argv", ["benchmarl_mappo.py", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(PROGRAM), run_name="__main__")
    printed = capsys.readouterr().err
    assert ended.value.code == 2 and message in printed and (extra or printed.count("\n") == 1)
    assert list(empty_folder.rglob("*")) == [empty_folder / "there"]


@pytest.mark.parametrize("module", ["task", "tasks"])
def test_module__without_the_extra_says_how_to_install_it(
    module: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for loaded in ["benchmarl", *(each for each in sys.modules if each.startswith("benchmarl."))]:
        monkeypatch.setitem(sys.modules, loaded, None)  # cannot be imported, as where the extra is missing
    name, message = (
        f"ethbrake_marl.extensions.benchmarl.{module}",
        "needs the package benchmarl, which is not installed",
    )
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(MissingExtra, match=message):
        importlib.import_module(name)
    if module == "tasks":
        with pytest.raises(SystemExit) as ended:
            runpy.run_module(name, run_name="__main__")
        printed = capsys.readouterr().err
        assert ended.value.code == 2 and printed.startswith(f"tasks.py: error: {message}") and printed.count("\n") == 1


@pytest.fixture
def mappo() -> ModuleType:
    pytest.importorskip("benchmarl", reason="needs the extra marl")
    return load("../../train/benchmarl_mappo")


@pytest.mark.parametrize("algorithm", ["mappo", "ippo"])
def test_policy__acts_as_benchmarls_own(algorithm: str, mappo: ModuleType, tmp_path: Path) -> None:
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    recipe = eb.load_recipe("cooperation-ppo").replace(**SMALL, total_steps=2 * 16 * 16 * 2)
    training = Training.of(recipe, "cooperation-3-pair", scheme="centralised")
    experiment = mappo.make_experiment(training, str(tmp_path), algorithm)
    assert type(experiment.algorithm).__name__.lower() == algorithm
    experiment.run()
    policy = mappo.policy_of(experiment, training)
    assert (policy.manifest.steps, policy.manifest.learners) == (2 * 16 * 16 * 2, ("vehicle_2", "vehicle_3"))
    seen = eb.make_sb3_vec_env("cooperation-3-pair", 50, seed=1).reset()
    batch = TensorDict({"learners": {"observation": torch.from_numpy(seen.reshape(50, 2, -1))}}, batch_size=[50])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        theirs = experiment.group_policies["learners"](batch)["learners", "action"].reshape(100, 1).numpy()
    np.testing.assert_allclose(policy(seen), theirs, atol=1e-5)
