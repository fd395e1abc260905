"""The four interfaces, thin over ``engine``: PettingZoo, Gymnasium, its vector API, Stable-Baselines3."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.envs.drawing import (
        BODY_M as BODY_M,
        COLOURS as COLOURS,
        Frame as Frame,
        Scene as Scene,
        Trace as Trace,
        animate_films as animate_films,
        vehicle_colour as vehicle_colour,
    )
    from ethbrake_marl.envs.interfaces import (
        CostEnv as CostEnv,
        EthBrakeEnv as EthBrakeEnv,
        EthBrakeParallelEnv as EthBrakeParallelEnv,
        EthBrakeVectorEnv as EthBrakeVectorEnv,
        InTurns as InTurns,
        Ordered as Ordered,
        Report as Report,
        SeededInside as SeededInside,
        action_box as action_box,
        env as env,
        feature_box as feature_box,
        make_engine as make_engine,
        parallel_env as parallel_env,
        raw_env as raw_env,
    )
    from ethbrake_marl.envs.registration import register_environments as register_environments
    from ethbrake_marl.envs.sb3 import EthBrakeVecEnv as EthBrakeVecEnv, make_sb3_vec_env as make_sb3_vec_env
else:
    __getattr__ = front_door(__name__, __file__)
