"""Ids of this environment in Gymnasium and PettingZoo. Registration does not import the interfaces."""

from __future__ import annotations

GYMNASIUM_ID = "EthBrake-v0"

MO_GYMNASIUM_ID = "EthBrakeMO-v0"  # with vector rewards, for MO-Gymnasium

PETTINGZOO_ID = "ethbrake/ethbrake-v0"


def register_environments() -> None:
    """Register the environment's ids in Gymnasium and PettingZoo. A second call changes nothing."""
    import gymnasium  # imported here because it would slow down --help
    import pettingzoo

    for id_ in (GYMNASIUM_ID, f"ethbrake/{GYMNASIUM_ID}"):
        if id_ in gymnasium.registry:
            continue
        gymnasium.register(
            id_,
            entry_point="ethbrake_marl.envs.gymnasium:EthBrakeEnv",
            vector_entry_point="ethbrake_marl.envs.vector:EthBrakeVectorEnv",
        )
    if MO_GYMNASIUM_ID not in gymnasium.registry:  # its rewards are arrays, which Gymnasium's checker warns of
        gymnasium.register(
            MO_GYMNASIUM_ID,
            entry_point="ethbrake_marl.envs.gymnasium:EthBrakeEnv",
            vector_entry_point="ethbrake_marl.envs.vector:EthBrakeVectorEnv",
            disable_env_checker=True,
            kwargs={"reward_vector": "vehicles"},
        )
    if PETTINGZOO_ID not in pettingzoo.parallel_registry:
        pettingzoo.register("parallel", PETTINGZOO_ID, "ethbrake_marl.ethbrake_v0:parallel_env")
    if PETTINGZOO_ID not in pettingzoo.aec_registry:
        pettingzoo.register("aec", PETTINGZOO_ID, "ethbrake_marl.ethbrake_v0:env")
