"""The policies of a BenchMARL experiment as agents."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import ethbrake_marl as eb

pytest.importorskip("benchmarl", reason="needs the extra marl")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")


@pytest.mark.parametrize("algorithm, actions", [("mappo", None), ("masac", None), ("qmix", 9)])
def test_drivers__act_as_the_experiments_own_policy(algorithm: str, actions: int | None, tmp_path: Path) -> None:
    """Drivers that share no weights: each vehicle has the row of its own network."""
    from benchmarl.algorithms import algorithm_config_registry
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    from ethbrake_marl.extensions.benchmarl.drivers import drivers_of
    from ethbrake_marl.extensions.benchmarl.task import LineEnv
    from ethbrake_marl.extensions.benchmarl.tasks import EthBrakeTask

    task, config = EthBrakeTask.COOPERATION_3_PAIR.get_from_yaml(), ExperimentConfig.get_from_yaml()
    task.config["actions"], config.save_folder, config.share_policy_params = actions, str(tmp_path), False
    config.evaluation, config.loggers, config.create_json = False, [], False
    models = MlpConfig.get_from_yaml(), MlpConfig.get_from_yaml()
    experiment = Experiment(
        task, algorithm_config_registry[algorithm].get_from_yaml(), models[0], 0, config, critic_model_config=models[1]
    )
    drivers = drivers_of(experiment)
    assert [*drivers] == ["vehicle_2", "vehicle_3"] and {driver.name for driver in drivers.values()} == {algorithm}
    env = LineEnv(task.scenario, 5, 7, actions=actions)
    content = env.reset()
    seen = content["learners", "observation"]
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        rows: Any = experiment.group_policies["learners"](content)["learners", "action"].numpy().reshape(5, 2)
    for number, driver in enumerate(drivers.values()):
        answers = np.asarray(driver.policy(seen[:, number].numpy())).reshape(5)
        np.testing.assert_allclose(answers, rows[:, number], atol=1e-6)
    result = eb.evaluate("cooperation-3-pair", {algorithm: drivers}, episodes=5)
    assert np.isfinite(result[algorithm]["total_harm"]).all()
