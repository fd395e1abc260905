"""A scenario as a TorchRL environment and as a BenchMARL task."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.worlds.catalogue import scenario_path

pytest.importorskip("benchmarl", reason="needs the extra marl")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")

PAIR = eb.load_scenario("cooperation-3-pair")
REWARD = {"harm": 0.05, "shaping": 0.05}


@pytest.mark.parametrize("settings", [{}, {"actions": 9}, {"shield": "step"}, {"actions": 9, "shield": "step"}])
def test_env__keeps_torchrls_contract(settings: dict[str, Any]) -> None:
    from torchrl.envs.utils import check_env_specs

    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    check_env_specs(LineEnv(PAIR, 4, 0, REWARD, **settings))


def test_env__plays_the_worlds_of_the_other_interfaces() -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    env = LineEnv(PAIR, 4, 5, REWARD)
    native = eb.make_sb3_vec_env(PAIR, 4, seed=5, reward=REWARD, appended="state")
    seen, rows, own = env.reset(), native.reset(), len(eb.View().names)
    assert seen["learners", "observation"].shape == (4, 2, own)
    actions, ended = torch.full((4, 2, 1), -0.7), 0
    for _ in range(90):
        np.testing.assert_array_equal(seen["learners", "observation"].reshape(8, own).numpy(), rows[:, :own])
        np.testing.assert_array_equal(seen["state"].numpy(), rows[::2, own:])
        seen["learners", "action"] = actions
        stepped = env.step(seen.clone())["next"]
        rows, rewards, dones, _ = native.step(actions.reshape(8, 1).numpy())
        np.testing.assert_allclose(stepped["learners", "reward"].reshape(8).numpy(), rewards, atol=1e-6)
        np.testing.assert_array_equal(stepped["done"][:, 0].numpy(), dones[::2])
        np.testing.assert_array_equal(stepped["terminated"].numpy(), stepped["done"].numpy())
        assert not stepped["truncated"].any()
        ended += int(stepped["done"].sum())
        seen = stepped
        if stepped["done"].any():
            restart = stepped.select("done", "terminated", "truncated").clone()
            restart["_reset"] = stepped["done"].clone()
            seen = env._reset(restart)
    assert ended > 0


def test_env__tells_an_end_at_the_horizon_from_one_at_rest() -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    ends = {}
    for horizon_is_end in (True, False):
        env = LineEnv(PAIR.replace(horizon_s=1.0), 4, 5, horizon_is_end=horizon_is_end)
        seen = env.reset()
        while not env.episode.ended.all():
            seen["learners", "action"] = torch.ones((4, 2, 1))
            seen = env.step(seen)["next"]
        ends[horizon_is_end] = seen["terminated"].any().item(), seen["truncated"].any().item()
    assert ends == {True: (True, False), False: (False, True)}


def test_env__set_seed_begins_the_worlds_of_a_seed_again() -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    env = LineEnv(PAIR, 2, 5)
    first, second = env.reset()["state"], env.reset()["state"]
    assert not torch.equal(first, second)
    env.set_seed(5)
    assert torch.equal(env.reset()["state"], first)


def test_env__behind_a_shield_keeps_the_bound_of_every_alert() -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineTask

    harm = {}
    for shield in (None, "step"):
        env = LineTask("pair", {"scenario": PAIR, "shield": shield}).get_env_fun(64, True, 5, "cpu")()
        seen = env.reset()
        bound = env.episode.memories["shield"].first.copy() if shield else np.inf
        returned = torch.zeros(64)
        for _ in range(90):
            seen["learners", "action"] = torch.ones((64, 2, 1))
            seen = env.step(seen)["next"]
            returned += seen["learners", "reward"][:, 0, 0]
        harm[shield] = -returned.numpy()
        assert env.episode.ended.all() and (harm[shield] <= bound + 1e-3).all()
    assert harm["step"].mean() < 0.5 * harm[None].mean()


def test_env__takes_an_index_of_each_learner() -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    by_index, by_share = LineEnv(PAIR, 4, 5, actions=9), LineEnv(PAIR, 4, 5)
    assert by_index.full_action_spec["learners", "action"].shape == (4, 2)
    one, two = by_index.reset(), by_share.reset()
    for k in range(40):
        indices = torch.tensor([[k % 9, 0]] * 4)
        one["learners", "action"], two["learners", "action"] = indices, (indices / 4.0 - 1.0)[:, :, None]
        one, two = by_index.step(one)["next"], by_share.step(two)["next"]
        assert (one["learners", "reward"] == two["learners", "reward"]).all()
        assert (one["learners", "observation"] == two["learners", "observation"]).all()
    one["learners", "action"] = torch.full((4, 2), 9)
    with pytest.raises(InvalidInput, match=r"action of the learners: .*9.*must be an index from 0 to 8"):
        by_index._step(one)


def test_env__needs_learners_who_observe_the_same() -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    other = {"vehicle_2": ["own.speed"], "vehicle_3": ["own.mass"]}
    for scenario, words in (
        (PAIR.replace(observation=other), "its 2 learners have 2 different observations"),
        (PAIR.with_learners([]), "its 0 learners have 0 different observations"),
    ):
        with pytest.raises(InvalidInput, match=words):
            LineEnv(scenario, 2, 0)


def test_task__with_actions_is_discrete_and_else_continuous() -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineEnv, LineTask

    for actions in (None, 9):
        task = LineTask("pair", {"scenario": "cooperation-3-pair", "actions": actions})
        assert task.supports_discrete_actions() == (actions is not None) != task.supports_continuous_actions()
        env = task.get_env_fun(2, actions is None, 5, "cpu")()
        assert env.actions == actions and torch.equal(env.reset()["state"], LineEnv(PAIR, 2, 5).reset()["state"])
        assert task.group_map(None) == {"learners": ["vehicle_2", "vehicle_3"]} and task.max_steps(None) == 81
        with pytest.raises(InvalidInput, match=f"task pair: continuous_actions = .* contradicts actions = {actions};"):
            task.get_env_fun(2, actions is not None, 0, "cpu")


def test_task__takes_another_scenario_by_name_path_or_content(empty_folder: Path) -> None:
    from ethbrake_marl.extensions.benchmarl.tasks import EthBrakeTask

    four = eb.load_scenario("cooperation-4-all")
    Path("cooperation-4-all.yaml").write_bytes(scenario_path("cooperation-4-all").read_bytes())
    for scenario in ("cooperation-4-all", "./cooperation-4-all.yaml", Path("cooperation-4-all.yaml").resolve(), four):
        task = EthBrakeTask.COOPERATION_3_PAIR.get_from_yaml()
        task.config["scenario"] = scenario
        names = [four.vehicle_names[body - 1] for body in four.learners]
        assert task.group_map(None) == {"learners": names} and len(names) > 2
        env = task.get_env_fun(2, True, 5, "cpu")()
        assert env.reset()["learners", "observation"].shape[:2] == (2, len(names))
        assert task.max_steps(env) == round(four.horizon_s / four.time_step_s) + 1
    task.config["scenario"] = "cooperation-4-al"
    with pytest.raises(InvalidInput, match="did you mean 'cooperation-4-all'"):
        task.group_map(None)


def test_env__draws_its_first_world() -> None:
    from tensordict import TensorDict

    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    env = LineEnv(PAIR, 3, 5)
    single = eb.parallel_env(PAIR, render_mode="rgb_array", agents="learners")
    single.reset(seed=5)
    env.reset()
    pictures = [(env.render(), single.render())]
    for _ in range(3):
        env.step(TensorDict({"learners": {"action": torch.full((3, 2, 1), -0.7)}}, [3]))
        single.step(dict.fromkeys(single.agents, np.array([-0.7], np.float32)))
        pictures.append((env.render(mode="rgb_array"), single.render()))
    assert all(np.array_equal(*pair) for pair in pictures) and len({one.tobytes() for one, _ in pictures}) == 4
    env.reset()
    assert not any(np.array_equal(env.render(), one) for one, _ in pictures)
    with pytest.raises(InvalidInput, match="render_mode = 'film': must be"):
        LineEnv(PAIR, 3, 5).render("film")


def test_tasks__are_the_scenarios_with_a_learner() -> None:
    from benchmarl.environments import task_config_registry

    from ethbrake_marl.extensions.benchmarl.tasks import EthBrakeTask

    names = {task.name for task in EthBrakeTask}
    assert "PAPER_RANDOM" in names and "COOPERATION_0_SENSORS" not in names
    assert {f"ethbrake/{name.lower()}" for name in names} <= task_config_registry.keys()
    assert EthBrakeTask.PAPER_RANDOM.get_from_yaml().config["scenario"] == eb.load_scenario("paper-random")


def test_qmix__trains_a_team_that_drives(tmp_path: Path) -> None:
    from benchmarl.algorithms import QmixConfig
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    from ethbrake_marl.extensions.benchmarl.task import LineTask

    config = ExperimentConfig.get_from_yaml()
    config.max_n_iters, config.max_n_frames, config.save_folder = 2, None, str(tmp_path)
    config.off_policy_n_envs_per_worker, config.off_policy_collected_frames_per_batch = 8, 160
    config.off_policy_n_optimizer_steps, config.off_policy_memory_size = 2, 1_000
    config.evaluation, config.loggers, config.create_json = False, [], False
    learns = QmixConfig.get_from_yaml(), MlpConfig.get_from_yaml()
    experiment = Experiment(LineTask("pair", {"scenario": PAIR, "actions": 5}), *learns, 0, config)
    experiment.run()
    actor = experiment.group_policies["learners"]

    def qmix(seen: Any) -> Any:
        rows = torch.tensor(seen)[:, None].expand(-1, 2, -1)
        each = TensorDict({"observation": rows}, rows.shape[:2])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(TensorDict({"learners": each}, rows.shape[:1]))["learners", "action"][:, 0]

    agent = eb.policy_agent(qmix, scenario=PAIR, actions=5)
    assert np.isfinite(eb.evaluate(PAIR, {"qmix": agent}, episodes=20)["qmix"]["first_impact_harm"]).all()


@pytest.mark.parametrize("deed", ["step", "reset"])
def test_env__whose_feature_fails_stays_as_it_was(deed: str) -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    fails = False

    def mine(state: eb.State, body: int) -> Any:
        """Time, unless it fails."""
        if fails:
            raise ZeroDivisionError
        return state.time_s

    eb.register_feature("mine", mine, unit="s", scale=1.0, low=0.0, high=9.0)
    scenario, runs = PAIR.replace(observation=["own", "mine"]), []

    def called(env: Any, tensors: Any) -> Any:
        tensors["learners", "action"] = torch.full((3, 2, 1), -0.5)
        return env.step(tensors.clone())["next"] if deed == "step" else env.reset()

    for trapped in (False, True):
        env, seen = LineEnv(scenario, 3, 5), []
        tensors = env.reset()
        for _ in range(3):
            if trapped:
                fails = True
                with pytest.raises(InvalidInput, match="feature 'mine' of vehicle_2: its function fails"):
                    called(env, tensors)
                fails = False
            tensors = called(env, tensors)
            seen.append(tensors["learners", "observation"].tolist())
        runs.append(seen)
    assert runs[0] == runs[1]
