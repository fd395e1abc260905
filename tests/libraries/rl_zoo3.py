"""RL Baselines3 Zoo."""

from __future__ import annotations

from pathlib import Path

from tests.libraries.library import Library

LIBRARY = Library(
    title="RL Baselines3 Zoo",
    package="rl_zoo3",
    requires=("rl_zoo3==2.9.2",),
    about="Hyperparameters stand in a file of yours; `--gym-packages` makes the id known.",
)


@LIBRARY.way(
    "from the command line",
    "PPO, 30,000 steps in 8 worlds",
    learns=True,
    command="""
cat > ppo.yml <<END
EthBrake-v0: {policy: MlpPolicy, n_envs: 8, n_timesteps: 30000, n_steps: 256, batch_size: 256}
END
python -m rl_zoo3.train --algo ppo --env EthBrake-v0 --gym-packages ethbrake_marl --conf-file ppo.yml \\
    --seed 1 --eval-freq -1 --log-folder logs
""",
)
def trained_by_zoo():
    from stable_baselines3 import PPO

    (file,) = Path("logs").glob("ppo/*/EthBrake-v0.zip")
    return PPO.load(file)
