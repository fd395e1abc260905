"""Environments for PettingZoo (parallel and AEC), Gymnasium (single and vector) and Stable-Baselines3."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.first_edition.envs.gymnasium import EthBrakeEnv as EthBrakeEnv
    from ethbrake_marl.first_edition.envs.making import make_engine as make_engine
    from ethbrake_marl.first_edition.envs.pettingzoo import (
        EthBrakeParallelEnv as EthBrakeParallelEnv,
        env as env,
        parallel_env as parallel_env,
    )
    from ethbrake_marl.first_edition.envs.registration import register_environments as register_environments
    from ethbrake_marl.first_edition.envs.sb3 import (
        EthBrakeVecEnv as EthBrakeVecEnv,
        make_sb3_vec_env as make_sb3_vec_env,
    )
    from ethbrake_marl.first_edition.envs.vector import EthBrakeVectorEnv as EthBrakeVectorEnv
else:
    __getattr__ = front_door(__name__, __file__)
