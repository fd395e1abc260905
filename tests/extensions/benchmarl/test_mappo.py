"""`train/benchmarl_mappo.py`: BenchMARL's MAPPO; and the environment in which it learns."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.training.recipe import load_recipe
from tests.docs.site import load
from tests.refused import refused

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")
TRAIN = Path(__file__).resolve().parents[3] / "train"
PAIR = eb.load_scenario("cooperation-3-pair")
RECIPE = load_recipe("cooperation-ppo").replace(
    n_envs=16, n_steps=16, batch_size=128, network={"policy": [16, 16], "value": [16, 16]}
)


@pytest.mark.parametrize(
    ("arguments", "extra", "message"),
    [
        ([], False, "-m pip install 'ethbrake-marl[marl]'"),
        (["--scenario", "cooperation-3-pear"], False, "did you mean 'cooperation-3-pair'?"),
        (["--recipe", "sac"], False, "recipe 'sac': is for SAC; MAPPO needs one for PPO"),
        (["--steps", "-5"], False, "total_steps = -5: must be greater than or equal to 1"),
        (["--output", "there"], True, "there: already exists and is not the folder of a run"),
        (["--scenario", "cooperation-0-sensors"], True, "has no learner"),
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
    env, native = LineEnv(PAIR, 4, 5, RECIPE.reward), eb.make_sb3_vec_env(PAIR, 4, 5, None, RECIPE.reward)
    seen, rows = env.reset(), native.reset()
    central = eb.make_sb3_vec_env(PAIR, 4, 5, appended="state").reset()
    np.testing.assert_array_equal(seen["state"].numpy(), central[::2, 27:])
    actions, ended = torch.full((4, 2, 1), -0.7), 0
    for _ in range(90):
        now = env._observe_all()["learners"]["observation"]
        np.testing.assert_array_equal(now.reshape(8, 27).numpy(), rows)
        stepped = env.step(seen.set(("learners", "action"), actions).clone())["next"]
        rows, rewards, dones, _ = native.step(actions.reshape(8, 1).numpy())
        np.testing.assert_array_equal(stepped["learners", "reward"].reshape(8).numpy(), rewards)
        np.testing.assert_array_equal(stepped["done"][:, 0].numpy(), dones[::2])
        ended += int(stepped["done"].sum())
        if stepped["done"].any():
            restart = stepped.select("done", "terminated", "truncated").clone()
            restart["_reset"] = stepped["done"].clone()
            env._reset(restart)
    assert ended > 4


@pytest.mark.usefixtures("mappo")
def test_horizon__is_an_end_or_a_cut() -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    for is_end in (True, False):
        env = LineEnv(PAIR, 4, 5, "harm", is_end)
        seen = env.reset()
        for _ in range(90):
            seen["learners", "action"] = torch.ones((4, 2, 1))  # they press on, until the horizon comes
            seen = env.step(seen)["next"]
        assert seen["done"].all() and seen["terminated"].all() == is_end != seen["truncated"].all()


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
        bound = env.game.own_infos(env.episode)["shield_bound_harm"] if shield else np.inf
        returned = torch.zeros(64)
        for _ in range(90):
            seen["learners", "action"] = torch.ones((64, 2, 1))
            seen = env.step(seen)["next"]
            returned += seen["learners", "reward"][:, 0, 0]
        harm[shield] = -returned.numpy()
        assert env.episode.ended.all() and (harm[shield] <= bound + 1e-3).all()
    assert harm["step"].mean() < 0.5 * harm[None].mean()
    with refused("unknown shield mode 'stop'", UnknownName):
        LineTask("pair", {**config, "shield": "stop"}).get_env_fun(64, True, 5, "cpu")()


@pytest.mark.parametrize("algorithm", ["mappo", "ippo"])
def test_mappo__leaves_a_team_that_acts_as_benchmarls_own_does(
    algorithm: str, mappo: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    made, make = [], mappo.make_experiment
    monkeypatch.setattr(mappo, "make_experiment", lambda *given: made.append(make(*given)) or made[0])
    recipe = RECIPE.replace(total_steps=2 * 16 * 16 * 2)
    policy = mappo.train_mappo(recipe, PAIR, tmp_path / "run", algorithm)
    (experiment,) = made
    assert type(experiment.algorithm).__name__.lower() == algorithm
    assert policy.manifest.steps == 2 * 16 * 16 * 2
    seen = eb.make_sb3_vec_env(PAIR, 50, seed=1).reset()
    batch = TensorDict({"learners": {"observation": torch.from_numpy(seen.reshape(50, 2, -1))}}, batch_size=[50])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        theirs = experiment.group_policies["learners"](batch)["learners", "action"].reshape(100, 1).numpy()
    np.testing.assert_allclose(policy(seen), theirs, atol=1e-5)
    team = eb.make_agent(f"team@{tmp_path / 'run'}")
    assert np.isfinite(eb.evaluate(PAIR, {"mappo": team}, episodes=5)["mappo"]["total_harm"]).all()


@pytest.mark.long
def test_mappo__learns_to_beat_full_braking(mappo: ModuleType, tmp_path: Path) -> None:
    mappo.train_mappo(load_recipe("cooperation-ppo").replace(total_steps=300_000), PAIR, tmp_path / "run")
    agents = f"full_brake,team@{tmp_path / 'run'}"
    full_brake, team = (
        result["first_impact_harm"].mean() for result in eb.evaluate(PAIR, agents, episodes=500).values()
    )
    assert team < 0.9 * full_brake
