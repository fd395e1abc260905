"""BenchMARL."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.libraries.library import Library

LIBRARY = Library(
    title="BenchMARL",
    package="benchmarl",
    requires=("benchmarl==1.5.2", "torchrl<0.12", "tensordict<0.12", "stable-baselines3==2.9.2"),
    about=(
        "Every shipped scenario in which somebody learns is a task "
        "(`ethbrake/cooperation_3_pair` and so on; `task.scenario=my.yaml`, `task.reward=...`). BenchMARL "
        "finds tasks in its own folder only, so its command line is called through ours, which enters them "
        "into its registry first."
    ),
)
# Few frames and updates, and nothing written but a checkpoint.
QUICK = "experiment.loggers=[] experiment.render=False experiment.evaluation=False experiment.create_json=False"


@LIBRARY.way(
    "its command line with our tasks: MAPPO",
    "MAPPO, 2 iterations of 6,000 frames, two learners",
    command=f"""
python -m ethbrake_marl.learning.benchmarl_tasks algorithm=mappo task=ethbrake/cooperation_3_pair \\
    experiment.max_n_iters=2 experiment.on_policy_n_minibatch_iters=3 \\
    {QUICK}
""",
)
def by_command():
    assert list(Path("outputs").rglob(".hydra"))


@LIBRARY.way(
    "MASAC",
    "MASAC, 2 iterations of 6,000 frames, two learners",
    command=f"""
python -m ethbrake_marl.learning.benchmarl_tasks algorithm=masac task=ethbrake/cooperation_3_pair \\
    experiment.max_n_iters=2 experiment.off_policy_n_optimizer_steps=20 \\
    {QUICK}
""",
)
def masac():
    assert list(Path("outputs").rglob(".hydra"))


@LIBRARY.way("in Python: IPPO", "IPPO, 96,000 frames", learns=True)
def ippo():
    from benchmarl.algorithms import IppoConfig
    from benchmarl.experiment import Experiment, ExperimentConfig
    from benchmarl.models.mlp import MlpConfig

    from ethbrake_marl.learning.benchmarl_tasks import EthBrakeTask

    task, config = EthBrakeTask.PAPER_RANDOM.get_from_yaml(), quick(ExperimentConfig.get_from_yaml())
    task.config["reward"] = {"harm": 0.05, "shaping": 0.05}
    models = MlpConfig.get_from_yaml(), MlpConfig.get_from_yaml()
    experiment = Experiment(task, IppoConfig.get_from_yaml(), models[0], 0, config, models[1])
    experiment.run()
    return keep(experiment)


def quick(config: Any) -> Any:
    """Fewer frames and updates than its own numbers."""
    config.max_n_frames, config.lr = 96_000, 5e-4
    config.on_policy_n_envs_per_worker, config.on_policy_collected_frames_per_batch = 32, 4_000
    config.on_policy_n_minibatch_iters = 8
    config.evaluation, config.loggers, config.create_json = False, [], False
    return config


def keep(experiment: Any) -> Any:
    """The policy, and its own rollout; leaves ``benchmarl.pt``."""
    import torch

    policy = experiment.group_policies["learners"]
    torch.save(policy, "benchmarl.pt")
    return policy_of(policy), lambda n: own_rollout(policy, n)


def policy_of(policy: Any) -> Any:
    """Observations [n, F] -> actions [n, 1] of the one learner, without exploration."""
    import torch
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    def benchmarl(observations: Any) -> Any:
        n = len(observations)
        seen = TensorDict({"observation": torch.tensor(observations)[:, None]}, batch_size=[n, 1])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return policy(TensorDict({"learners": seen}, batch_size=[n]))["learners", "action"][:, 0]

    return benchmarl


def own_rollout(policy: Any, n: int) -> Any:
    """Harm [n] by TorchRL's ``rollout`` of BenchMARL's policy in the batched environment."""
    import torch
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    import ethbrake_marl as eb
    from ethbrake_marl.envs.interfaces import report
    from ethbrake_marl.learning.benchmarl import LineEnv

    env = LineEnv(eb.load_scenario("paper-random"), n, 7, "harm")
    env.engine.reset(seed=7)
    begun = TensorDict(env._observe_all(), batch_size=[n])  # ``reset`` would go on in the stream
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        env.rollout(
            200, policy, auto_reset=False, tensordict=begun, break_when_any_done=False, break_when_all_done=True
        )
    return [row[0][4] for row in report(env.engine).values]
