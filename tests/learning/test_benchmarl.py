"""The BenchMARL task: its worlds are the engine's, and its actor becomes a bundle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.learning.training import RunDirectory, load_recipe
from tests.docs.site import load

pytest.importorskip("benchmarl", reason="needs the extra marl")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")

SCRIPT = load("../../train/benchmarl_mappo")
PAIR = eb.load_scenario("cooperation-3-pair")
RECIPE = load_recipe("cooperation-ppo").replace(
    n_envs=16, n_steps=16, batch_size=128, network={"policy": [16, 16], "value": [16, 16]}
)


def test_line_env__keeps_torchrls_contract_and_shows_the_native_worlds() -> None:
    import torch
    from torchrl.envs.utils import check_env_specs

    from ethbrake_marl.learning.benchmarl import LineEnv

    check_env_specs(LineEnv(PAIR, 4, 0, RECIPE.reward))
    env = LineEnv(PAIR, 4, 5, RECIPE.reward)
    native = eb.make_sb3_vec_env(PAIR, 4, seed=5, reward=RECIPE.reward, appended="state")
    seen = env.reset()
    rows = native.reset()
    own = env.engine.observation.size
    env.engine.reset(seed=5)  # reset goes on with the stream; the native interface has just begun it
    assert seen["learners", "observation"].shape == (4, 2, own)
    first = env._observe_all()
    np.testing.assert_array_equal(first["learners"]["observation"].reshape(8, own).numpy(), rows[:, :own])
    np.testing.assert_array_equal(first["state"].numpy(), rows[::2, own:])
    actions = torch.full((4, 2, 1), -0.7)
    seen["learners", "action"] = actions
    ended = 0
    for _ in range(90):
        stepped = env.step(seen.clone())["next"]
        rows, rewards, dones, _ = native.step(actions.reshape(8, 1).numpy())
        np.testing.assert_allclose(stepped["learners", "reward"].reshape(8).numpy(), rewards, atol=1e-6)
        np.testing.assert_array_equal(stepped["done"][:, 0].numpy(), dones[::2])
        ended += int(stepped["done"].sum())
        if stepped["done"].any():
            restart = stepped.select("done", "terminated", "truncated").clone()
            restart["_reset"] = stepped["done"].clone()
            env._reset(restart)
        again = env._observe_all()
        np.testing.assert_array_equal(again["learners"]["observation"].reshape(8, own).numpy(), rows[:, :own])
    assert ended > 0


def test_policy_of__acts_as_benchmarls_own_policy_does(tmp_path: Path) -> None:
    import torch
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    recipe = RECIPE.replace(total_steps=2 * 16 * 16 * 2, scheme="centralised")
    experiment = SCRIPT.make_experiment(recipe, PAIR, str(tmp_path))
    experiment.run()
    policy = SCRIPT.policy_of(experiment, recipe, PAIR)
    assert policy.manifest.steps == 2 * 16 * 16 * 2
    seen = eb.make_sb3_vec_env(PAIR, 50, seed=1).reset()
    batch = TensorDict({"learners": {"observation": torch.from_numpy(seen.reshape(50, 2, -1))}}, batch_size=[50])
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        theirs = experiment.group_policies["learners"](batch)["learners", "action"].reshape(100, 1).numpy()
    np.testing.assert_allclose(policy(seen), theirs, atol=1e-5)


@pytest.mark.long
def test_mappo__learns_to_beat_full_braking(tmp_path: Path) -> None:
    SCRIPT.train_mappo(load_recipe("cooperation-ppo").replace(total_steps=300_000), PAIR, tmp_path / "run")
    agents = {"full_brake": eb.make_agent("full_brake"), "team": RunDirectory(tmp_path / "run").load_team(PAIR)}
    result = eb.evaluate(PAIR.sample(1000, 7), agents, scenario=PAIR)
    harm = {name: result.outcome(name).first_impact_harm.mean() for name in agents}
    assert harm["team"] < 0.9 * harm["full_brake"]


def test_tasks__are_in_benchmarls_own_registry_and_make_the_same_worlds() -> None:
    from benchmarl.environments import task_config_registry

    from ethbrake_marl.learning.benchmarl_tasks import EthBrakeTask, register_tasks

    register_tasks()
    names = {name for name in task_config_registry if name.startswith("ethbrake/")}
    assert "ethbrake/cooperation_3_pair" in names
    assert len(names) == len(list(EthBrakeTask))
    settings = {"scenario": PAIR.declared(), "reward": {"harm": 1.0}, "horizon_is_end": True}
    tasks = (
        EthBrakeTask.COOPERATION_3_PAIR.get_from_yaml(),
        task_config_registry["ethbrake/cooperation_3_pair"].get_task(settings),
    )
    seen = [task.get_env_fun(3, True, 5, "cpu")().reset()["learners", "observation"] for task in tasks]
    np.testing.assert_array_equal(*(part.numpy() for part in seen))
    assert [task.group_map(None) for task in tasks] == [{"learners": ["vehicle_2", "vehicle_3"]}] * 2
