"""Register the environments in Gymnasium and PettingZoo, without importing the modules of the environments."""

from __future__ import annotations

GYMNASIUM_ID = "EthBrake-v1"

MO_GYMNASIUM_ID = "EthBrakeMO-v1"  # environment with vector rewards, for MO-Gymnasium

PETTINGZOO_ID = "ethbrake/ethbrake-v1"


def register_environments() -> None:
    """Register the environments' ids in Gymnasium and PettingZoo. Further calls have no effect."""
    import gymnasium  # imported here, because the import takes time
    import pettingzoo

    for id_ in (GYMNASIUM_ID, f"ethbrake/{GYMNASIUM_ID}"):
        if id_ in gymnasium.registry:
            continue
        gymnasium.register(
            id_,
            entry_point="ethbrake_marl.first_edition.envs.gymnasium:EthBrakeEnv",
            vector_entry_point="ethbrake_marl.first_edition.envs.vector:EthBrakeVectorEnv",
        )
    if MO_GYMNASIUM_ID not in gymnasium.registry:  # Gymnasium's checker would warn about array rewards
        gymnasium.register(
            MO_GYMNASIUM_ID,
            entry_point="ethbrake_marl.first_edition.envs.gymnasium:EthBrakeEnv",
            vector_entry_point="ethbrake_marl.first_edition.envs.vector:EthBrakeVectorEnv",
            disable_env_checker=True,
            kwargs={"reward_vector": "vehicles"},
        )
    if PETTINGZOO_ID not in pettingzoo.parallel_registry:
        pettingzoo.register("parallel", PETTINGZOO_ID, "ethbrake_marl.ethbrake_v1:parallel_env")
    if PETTINGZOO_ID not in pettingzoo.aec_registry:
        pettingzoo.register("aec", PETTINGZOO_ID, "ethbrake_marl.ethbrake_v1:env")
