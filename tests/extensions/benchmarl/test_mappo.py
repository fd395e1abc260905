"""`train/benchmarl_mappo.py`: BenchMARL's MAPPO."""

import runpy
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl.first_edition as eb
from tests.docs.site import load
from tests.first_edition.learning.tiny import harm_beside_full_braking

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")

TRAIN = Path(__file__).resolve().parents[3] / "train"


PAIR = eb.load_scenario("cooperation-3-pair")


RECIPE = eb.load_recipe("cooperation-ppo").replace(
    n_envs=16, n_steps=16, batch_size=128, network={"policy": [16, 16], "value": [16, 16]}
)


@pytest.mark.parametrize(
    ("arguments", "extra", "message"),
    [
        ([], False, "-m pip install 'ethbrake-marl[marl]'"),
        (["--scenario", "cooperation-3-pear"], False, "did you mean 'cooperation-3-pair'?"),
        (["--recipe", "sac"], False, "recipe 'sac': is for SAC; MAPPO needs one for PPO"),
        (["--steps", "-5"], False, "total_steps = -5: must be greater than or equal to 1"),
        (["--output", "there"], True, "there: exists already and is not a run; give another name"),
        (["--scenario", "cooperation-0-sensors"], True, "no vehicle learns"),
    ],
)
def test_mappo__refuses_what_cannot_be_before_it_trains(
    arguments: list[str],
    extra: bool,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    if extra:
        pytest.importorskip("benchmarl", reason="needs the extra marl")
        monkeypatch.setattr("benchmarl.experiment.Experiment.run", lambda *_: pytest.fail("training"))
    else:
        monkeypatch.setitem(sys.modules, "benchmarl", None)  # cannot be imported, as where the extra is missing
    monkeypatch.setattr(sys, "argv", ["benchmarl_mappo.py", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(TRAIN / "benchmarl_mappo.py"), run_name="__main__")
    told = capsys.readouterr().err
    assert ended.value.code == 2 and message in told and (extra or told.count("\n") == 1)
    assert list(tmp_path.rglob("*")) == [tmp_path / "there"]


@pytest.fixture
def mappo() -> ModuleType:
    pytest.importorskip("benchmarl", reason="needs the extra marl")
    return load("../../train/benchmarl_mappo")


@pytest.mark.usefixtures("mappo")
def test_line_env__keeps_torchrls_contract_and_shows_the_native_worlds() -> None:
    from torchrl.envs.utils import check_env_specs

    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    check_env_specs(LineEnv(PAIR, 4, 0, RECIPE.reward))
    env = LineEnv(PAIR, 4, 5, RECIPE.reward)
    native = eb.make_sb3_vec_env(PAIR, 4, seed=5, reward=RECIPE.reward, appended="state")
    seen, rows, own = env.reset(), native.reset(), env.engine.observation.size
    env.engine.reset(seed=5)  # reset goes on with the stream; the native interface has just begun it
    assert seen["learners", "observation"].shape == (4, 2, own)
    np.testing.assert_array_equal(env._observe_all()["state"].numpy(), rows[::2, own:])
    actions = torch.full((4, 2, 1), -0.7)
    seen["learners", "action"] = actions
    ended = 0
    for _ in range(90):
        now = env._observe_all()["learners"]["observation"]
        np.testing.assert_array_equal(now.reshape(8, own).numpy(), rows[:, :own])
        stepped = env.step(seen.clone())["next"]
        rows, rewards, dones, _ = native.step(actions.reshape(8, 1).numpy())
        np.testing.assert_allclose(stepped["learners", "reward"].reshape(8).numpy(), rewards, atol=1e-6)
        np.testing.assert_array_equal(stepped["done"][:, 0].numpy(), dones[::2])
        ended += int(stepped["done"].sum())
        if stepped["done"].any():
            restart = stepped.select("done", "terminated", "truncated").clone()
            restart["_reset"] = stepped["done"].clone()
            env._reset(restart)
    assert ended > 0


@pytest.mark.usefixtures("mappo")
def test_line_env__behind_a_shield_keeps_the_bound_of_every_alert() -> None:
    from torchrl.envs.utils import check_env_specs

    from ethbrake_marl.extensions.benchmarl.task import LineEnv, LineTask

    check_env_specs(LineEnv(PAIR, 4, 0, RECIPE.reward, shield="step"))
    config = {"scenario": PAIR, "reward": "harm", "horizon_is_end": True}
    harm = {}
    for shield in (None, "step"):
        env = LineTask("pair", {**config, "shield": shield}).get_env_fun(64, True, 5, "cpu")()
        seen = env.reset()
        bound = env.engine.guarded.shield.memory.first_bound.copy() if shield else np.inf
        returned = torch.zeros(64)
        for _ in range(90):
            seen["learners", "action"] = torch.ones((64, 2, 1))
            seen = env.step(seen)["next"]
            returned += seen["learners", "reward"][:, 0, 0]
        harm[shield] = -returned.numpy()
        assert env.engine.ended.all() and (harm[shield] <= bound + 1e-3).all()
    assert harm["step"].mean() < 0.5 * harm[None].mean()


@pytest.mark.parametrize("algorithm", ["mappo", "ippo"])
def test_mappo__leaves_a_policy_that_acts_as_benchmarls_own_does(
    algorithm: str, mappo: ModuleType, tmp_path: Path
) -> None:
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    recipe = RECIPE.replace(total_steps=2 * 16 * 16 * 2, scheme="centralised")
    experiment = mappo.make_experiment(recipe, PAIR, str(tmp_path), algorithm)
    assert type(experiment.algorithm).__name__.lower() == algorithm
    experiment.run()
    policy = mappo.policy_of(experiment, recipe, PAIR)
    assert policy.manifest.steps == 2 * 16 * 16 * 2
    seen = eb.make_sb3_vec_env(PAIR, 50, seed=1).reset()
    batch = TensorDict({"learners": {"observation": torch.from_numpy(seen.reshape(50, 2, -1))}}, batch_size=[50])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        theirs = experiment.group_policies["learners"](batch)["learners", "action"].reshape(100, 1).numpy()
    np.testing.assert_allclose(policy(seen), theirs, atol=1e-5)


@pytest.mark.long
def test_mappo__learns_to_beat_full_braking(mappo: ModuleType, tmp_path: Path) -> None:
    mappo.train_mappo(eb.load_recipe("cooperation-ppo").replace(total_steps=300_000), PAIR, tmp_path / "run")
    assert harm_beside_full_braking(f"team@{tmp_path / 'run'}") < 0.9
