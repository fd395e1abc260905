"""BenchMARL's QMIX on discrete actions."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput

pytest.importorskip("benchmarl", reason="needs the extra marl")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")

PAIR = eb.load_scenario("cooperation-3-pair")
CONFIG: dict[str, Any] = {"scenario": PAIR, "reward": "harm", "horizon_is_end": True}


@pytest.mark.parametrize("shield", [None, "step"])
def test_line_env__takes_an_index_of_each_learner(shield: str | None) -> None:
    from torchrl.envs.utils import check_env_specs

    from ethbrake_marl.extensions.benchmarl.task import LineEnv

    settings = {"reward": "harm", "shield": shield}
    check_env_specs(LineEnv(PAIR, 4, 0, actions=9, **settings))
    by_index, by_share = LineEnv(PAIR, 4, 5, actions=9, **settings), LineEnv(PAIR, 4, 5, **settings)
    assert by_index.full_action_spec["learners", "action"].shape == (4, 2)
    one, two = by_index.reset(), by_share.reset()
    for k in range(40):
        indices = torch.tensor([[k % 9, 0]] * 4)
        one["learners", "action"], two["learners", "action"] = indices, (indices / 4.0 - 1.0)[:, :, None]
        one, two = by_index.step(one)["next"], by_share.step(two)["next"]
        assert (one["learners", "reward"] == two["learners", "reward"]).all()
        assert (one["learners", "observation"] == two["learners", "observation"]).all()
    one["learners", "action"] = torch.full((4, 2), 9)
    with pytest.raises(
        InvalidInput, match=r"action of the learners = .*9.*: with actions=9, an action must be an index"
    ):
        by_index._step(one)


def test_task__with_actions_is_discrete_and_else_continuous() -> None:
    from ethbrake_marl.extensions.benchmarl.task import LineTask

    for actions in (None, 9):
        task = LineTask("pair", {**CONFIG, "actions": actions})
        assert task.supports_discrete_actions() == (actions is not None) != task.supports_continuous_actions()
        assert task.get_env_fun(2, actions is None, 0, "cpu")().actions == actions
        with pytest.raises(InvalidInput, match=f"task pair: continuous_actions = .* contradicts actions = {actions}"):
            task.get_env_fun(2, actions is not None, 0, "cpu")
    with pytest.raises(InvalidInput, match="actions = 1: must be a whole number, at least 2"):
        LineTask("pair", {**CONFIG, "actions": 1}).get_env_fun(2, False, 0, "cpu")()


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
    with pytest.raises(ValueError, match="is not compatible with the action space"):
        Experiment(LineTask("pair", CONFIG), *learns, 0, config)
    experiment = Experiment(LineTask("pair", {**CONFIG, "actions": 5}), *learns, 0, config)
    experiment.run()
    actor = experiment.group_policies["learners"]

    def qmix(seen: Any) -> Any:
        rows = torch.tensor(seen)[:, None].expand(-1, 2, -1)
        each = TensorDict({"observation": rows}, rows.shape[:2])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(TensorDict({"learners": each}, rows.shape[:1]))["learners", "action"][:, 0]

    agent = eb.policy_agent(qmix, scenario=PAIR, actions=5)
    assert np.isfinite(eb.evaluate(PAIR, {"qmix": agent}, episodes=20)["qmix"]["first_impact_harm"]).all()
